"""What FOCOPS, CUP, P3O, IPO and CRPO share beside what test_testing.py checks of all losses."""

from functools import partial

import pytest
import torch
from first_order import LOSSES, build, crpo, every_loss, step
from on_policy import estimated, train
from torchrl.objectives import A2CLoss, KLPENPPOLoss
from torchrl.objectives.value import TD0Estimator

from torchrl_safe.objectives import (
    CRPOLoss,
    CUPLoss,
    DualAscent,
    FOCOPSLoss,
    IPOLoss,
    P3OLoss,
    PIDControl,
    PPOLagrangianLoss,
    TrustRegionLoss,
)
from torchrl_safe.testing import make_batch, make_critic, make_networks

# ---------------------------------------------------------------- what all of them share


def test_cup_keeps_the_improved_policy_in_its_state():
    saved, loaded = build(CUPLoss, 2), build(CUPLoss, 2, seed=5)
    data = estimated(saved, 2)
    train(saved, data, 3)
    saved.start_projection()
    train(saved, data, 3)
    loaded.load_state_dict(saved.state_dict())
    expected = saved.projection_loss(data)
    assert expected["kl"] > 0
    assert torch.equal(loaded.projection_loss(data)["kl"], expected["kl"])
    assert not any("improved" in name for name, _ in saved.named_parameters())


@pytest.mark.parametrize("make", [FOCOPSLoss, CUPLoss])
@pytest.mark.parametrize(
    "rule",
    [
        partial(DualAscent, lr=1.0),
        partial(
            PIDControl, kp=1.0, ki=1.0, kd=1.0, max_multiplier=None, pessimism=0.0, normalize=False
        ),
    ],
)
def test_every_rule_moves_the_multiplier(make, rule):
    loss = build(make, 2, multiplier_init=0.5)
    rule(loss, cost_limit=torch.tensor([1.0, 2.0])).step(torch.tensor([[3.0, 1.0]]))
    assert loss.lagrange_multiplier[0] > 0.5 > loss.lagrange_multiplier[1]
    assert loss(make_batch(2))["lagrange_multiplier_0"] == loss.lagrange_multiplier[0]


# ---------------------------------------------------------------- compilation


# tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
# The calls of CUP and IPO add nothing to trace to that of PPOLagrangianLoss and of P3O.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["focops", "cup-projection", "p3o", "crpo"])
def test_compiles_to_one_graph_that_sees_the_costs_move(name):
    graphs = []

    def eager(graph, inputs):
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    loss = build(LOSSES[name.removesuffix("-projection")], 2)
    data = estimated(loss, 2)
    train(loss, data, 2)
    if name == "cup-projection":
        loss.start_projection()
    call = loss.projection_loss if name == "cup-projection" else loss
    compiled = torch.compile(call, fullgraph=True, backend=eager)
    step(loss, [-1.0, -1.0])
    compiled(data)
    step(loss, [2.0, 1.0])
    second, expected = compiled(data), call(data)
    assert set(second.keys()) == set(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(second[key], value)
    assert len(graphs) == 1


# ---------------------------------------------------------------- what does not fit


@pytest.mark.parametrize(
    ("make", "argument", "value"),
    [
        (FOCOPSLoss, "temperature", 0.0),
        (FOCOPSLoss, "kl_bound", -0.1),
        (FOCOPSLoss, "multiplier_init", -1.0),
        (CUPLoss, "multiplier_init", -1.0),
        (P3OLoss, "penalty_coeff", 0.0),
        (P3OLoss, "reduction", "none"),
        (IPOLoss, "sharpness", float("nan")),
        (IPOLoss, "sharpness", 1e-40),
        (IPOLoss, "sharpness", 10**20),
        (IPOLoss, "reduction", "sum"),
        (crpo, "tolerance", -0.5),
        (FOCOPSLoss, "num_costs", 0),
        (FOCOPSLoss, "num_costs", 10**400),
        (CUPLoss, "num_costs", 0),
        (P3OLoss, "num_costs", 0),
        (IPOLoss, "num_costs", 0),
        (crpo, "num_costs", 0),
    ],
)
def test_an_argument_that_cannot_be_used_is_named(make, argument, value):
    with pytest.raises(ValueError, match=rf"{argument} must .*, got .*{value}"):
        make(*make_networks(), **{argument: value})


@pytest.mark.parametrize(
    ("make", "argument", "value"),
    [(crpo, "tolerance", torch.zeros(2)), (P3OLoss, "penalty_coeff", [1.0, 2.0])],
)
def test_coefficients_are_as_many_as_costs(make, argument, value):
    message = rf"{argument} must be .* one for each of the 1 costs, got shape \(2,\)"
    with pytest.raises(ValueError, match=message):
        make(*make_networks(), **{argument: value})


@pytest.mark.parametrize(
    "make", [PPOLagrangianLoss, TrustRegionLoss, FOCOPSLoss, CUPLoss, P3OLoss, IPOLoss]
)
def test_an_argument_that_does_not_exist_is_refused(make):
    """TorchRL's PPOLoss would ignore it, a limit too."""
    with pytest.raises(TypeError, match=r"unexpected arguments: clip_epsilom, cost_limit"):
        make(*make_networks(), cost_limit=25.0, clip_epsilom=0.1)
    with pytest.raises(TypeError, match=r"unexpected arguments: kwargs"):
        make(*make_networks(), kwargs={"clip_epsilon": 0.1})


@every_loss
def test_a_batch_without_cost_is_refused(make):
    loss = build(make)
    for call in (loss, loss.estimate_advantages):
        with pytest.raises(KeyError, match=r"\('next', 'cost'\)"):
            call(make_batch().exclude(("next", "cost")))


@every_loss
def test_a_cost_critic_of_the_wrong_width_is_refused(make):
    actor, critic, _ = make_networks()
    loss = make(actor, critic, make_critic("cost_value", 2), num_costs=3)
    for call in (loss, loss.estimate_advantages):
        with pytest.raises(ValueError, match=r"\(4, 6, 3\) and \(4, 6, 2\)"):
            call(make_batch(3))


@every_loss
@pytest.mark.parametrize("num_costs", [1, 2])
def test_a_loss_of_the_wrong_width_is_refused(make, num_costs):
    actor, critic, cost_critic = make_networks(3)
    data = estimated(make(actor, critic, cost_critic, num_costs=3), 3)
    loss = make(actor, critic, cost_critic, num_costs=num_costs)
    with pytest.raises(ValueError, match=r"'cost'.* each of the . costs of num_costs"):
        loss.estimate_advantages(make_batch(3))
    if make is CUPLoss:
        loss.start_projection()
    with pytest.raises(ValueError, match=r"cost_advantage.*\(24, 3\)"):
        (loss.projection_loss if make is CUPLoss else loss)(data)


@pytest.mark.parametrize("make", [FOCOPSLoss, CUPLoss])
def test_the_divergence_that_is_reported_is_that_of_the_steps_that_count(make):
    loss = build(make)
    data = estimated(loss)
    if make is CUPLoss:
        loss.start_projection()
        train(loss, data, 3)
    kept = torch.arange(len(data)) % 3 > 0
    evaluate = loss.projection_loss if make is CUPLoss else loss
    expected = evaluate(data[kept])["kl"]
    data["collector", "mask"] = kept.unsqueeze(-1)
    assert expected > 1e-4
    torch.testing.assert_close(evaluate(data)["kl"], expected)


def test_what_only_one_of_them_needs_is_named_when_missing():
    loss = build(FOCOPSLoss)
    with pytest.raises(KeyError, match="loc"):
        loss(estimated(loss).exclude("loc"))
    loss = build(CUPLoss)
    loss.start_projection()
    with pytest.raises(KeyError, match="'cost_advantage'"):
        loss.projection_loss(make_batch().reshape(-1))
    estimator = TD0Estimator(gamma=0.9, value_network=loss.cost_critic_network)
    with pytest.raises(ValueError, match=r"estimator must be a GAE, .* got TD0Estimator"):
        loss.make_cost_value_estimator(estimator)


def test_crpo_wraps_any_advantage_loss():
    for parent in (A2CLoss, KLPENPPOLoss):
        actor, critic, cost_critic = make_networks(2)
        loss = CRPOLoss(parent(actor, critic), cost_critic, num_costs=2)
        before = loss(make_batch(2))["loss_objective"]
        step(loss, [1.0, -1.0])
        assert not torch.equal(loss(make_batch(2))["loss_objective"], before)
    with pytest.raises(ValueError, match="normalize_advantage=True"):
        crpo(*make_networks(), normalize_advantage=True)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (FOCOPSLoss, "temperature"),
        (FOCOPSLoss, "kl_bound"),
        (P3OLoss, "penalty_coeff"),
        (IPOLoss, "sharpness"),
        (crpo, "tolerance"),
    ],
)
def test_coefficients_can_be_scheduled(make, name):
    loss = build(make)
    setattr(loss, name, 0.5)
    assert getattr(loss, name) == 0.5
