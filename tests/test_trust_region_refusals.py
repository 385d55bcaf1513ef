"""Steps that TrustRegionStep does not take, what it refuses, and its state."""

import pytest
import torch
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
)
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import (
    ProbabilisticActor,
    TanhNormal,
    TruncatedNormal,
)
from torchrl.objectives import ClipPPOLoss, KLPENPPOLoss, PPOLoss
from trust_region import (
    ACTORS,
    MAX_KL,
    METHODS,
    Fixed,
    actor_state,
    discrete_actor,
    make_data,
    make_loss,
    normal_actor,
)

from torchrl_safe.objectives import (
    CPO,
    PCPO,
    TRPO,
    DualAscent,
    FOCOPSLoss,
    TrustRegionLoss,
    TrustRegionStep,
)
from torchrl_safe.testing import (
    ACTION_SIZE,
    make_critic,
    make_networks,
)

# ---------------------------------------------------------------- steps that are not taken


def test_a_line_search_that_fails_leaves_the_actor_bit_for_bit():
    loss = make_loss()
    step = TrustRegionStep(loss, Fixed(1e4), max_kl=MAX_KL, max_backtracks=2)
    before = actor_state(loss)
    for count in (1, 2):
        info = step.step(make_data(loss))
        assert torch.equal(actor_state(loss), before)
        assert step.rejected_steps == info["rejected_steps"] == count
        assert info["step_fraction"] == info["kl"] == 0


def test_a_step_that_does_not_gain_what_it_promised_is_refused():
    """All actions are good: to first order a little is gained, far away they are all gone."""
    loss = make_loss()
    data = make_data(loss)
    data["advantage"].fill_(1.0)
    step = TrustRegionStep(loss, Fixed(100.0), max_kl=1e6, max_backtracks=0)
    before = actor_state(loss)
    step.step(data)
    assert step.rejected_steps == 1
    assert torch.equal(actor_state(loss), before)


@pytest.mark.parametrize("actor", ACTORS)
def test_a_step_without_end_is_refused(actor):
    loss = make_loss(actor=actor)
    before = actor_state(loss)
    step = TrustRegionStep(loss, Fixed(float("inf")))
    step.step(make_data(loss))
    assert step.rejected_steps == 1
    assert torch.equal(actor_state(loss), before)


class Guard(nn.Module):
    def forward(self, logits):
        if not logits.isfinite().all():
            raise RuntimeError("logits are not finite")
        return logits


def test_an_actor_that_raises_in_the_line_search_is_left_bit_for_bit():
    actor = discrete_actor(Categorical)
    actor.module[0].module.append(Guard())
    loss = PPOLoss(actor, make_critic(), entropy_bonus=False)
    before = actor_state(loss)
    with pytest.raises(RuntimeError, match="logits are not finite"):
        TrustRegionStep(loss, Fixed(float("inf"))).step(make_data(loss))
    assert torch.equal(actor_state(loss), before)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
def test_an_indefinite_fisher_matrix_leaves_the_actor_bit_for_bit(method):
    loss = make_loss()
    data = make_data(loss)
    step = TrustRegionStep(loss, method)
    # No policy has a negative bend of its own, but for rounding. The attribute refuses it.
    vars(step)["damping"] = -1e3
    before = actor_state(loss)
    info = step.step(data)
    assert torch.equal(actor_state(loss), before)
    assert step.indefinite_steps == info["indefinite_steps"] == 1
    assert step.rejected_steps == 0


@pytest.mark.parametrize("name", ["reward", "cost"])
def test_a_gradient_that_is_not_finite_is_refused(name):
    loss = make_loss()
    data = make_data(loss)
    data["advantage" if name == "reward" else "cost_advantage"][3] = float("nan")
    before = actor_state(loss)
    with pytest.raises(ValueError, match=r"gradient of the (reward|cost) surrogate.*nan"):
        TrustRegionStep(loss, CPO()).step(data)
    assert torch.equal(actor_state(loss), before)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
def test_without_any_advantage_nothing_moves_and_nothing_is_refused(method):
    loss = make_loss()
    data = make_data(loss)
    data["advantage"].zero_()
    data["cost_advantage"].zero_()
    before = actor_state(loss)
    step = TrustRegionStep(loss, method)
    info = step.step(data)
    assert torch.equal(actor_state(loss), before)
    assert info["step_fraction"] == 0
    assert not any(
        getattr(step, f"{kind}_steps") for kind in ("rejected", "indefinite", "recovery")
    )


def test_without_cost_gradient_cpo_is_trpo():
    expected, loss = make_loss(), make_loss()
    data = make_data(loss)
    data["cost_advantage"].zero_()
    loss.cost_violation.fill_(5.0)
    TrustRegionStep(loss, CPO(), max_kl=MAX_KL).step(data)
    TrustRegionStep(expected, max_kl=MAX_KL).step(data)
    assert torch.equal(actor_state(loss), actor_state(expected))


# ---------------------------------------------------------------- refusals at the door


@pytest.mark.parametrize("key", ["advantage", "cost_advantage"])
def test_a_missing_advantage_is_named(key):
    loss = make_loss()
    with pytest.raises(KeyError, match=f"'{key}'"):
        TrustRegionStep(loss, CPO()).step(make_data(loss).exclude(key))


@pytest.mark.parametrize("method", [CPO(), PCPO()], ids=["cpo", "pcpo"])
def test_one_cost_and_a_cost_critic_are_asked_for(method):
    with pytest.raises(ValueError, match=r"limits one cost.*has 3"):
        TrustRegionStep(make_loss(3), method)
    actor, critic, _ = make_networks()
    with pytest.raises(ValueError, match=r"needs a TrustRegionLoss.*got PPOLoss"):
        TrustRegionStep(PPOLoss(actor, critic), method)


@pytest.mark.parametrize("method", [CPO(), PCPO()], ids=["cpo", "pcpo"])
def test_multipliers_beside_a_limit_of_its_own_are_refused(method):
    """The cost would count twice: in the mixed advantage, and in the constraint."""
    named = rf"{type(method).__name__}.*lagrange_multiplier.*\[0\.5\]"
    with pytest.raises(ValueError, match=named):
        TrustRegionStep(make_loss(multiplier_init=0.5), method)
    loss = make_loss()
    step, data, before = TrustRegionStep(loss, method), make_data(loss), actor_state(loss)
    DualAscent(loss, cost_limit=1.0, lr=0.25).step(torch.tensor([[3.0]]))
    with pytest.raises(ValueError, match=named):
        step.step(data)
    assert torch.equal(actor_state(loss), before)
    loss.lagrange_multiplier.zero_()
    step.step(data)


class OtherSurrogate(PPOLoss):
    pass


@pytest.mark.parametrize("loss_class", [ClipPPOLoss, KLPENPPOLoss, FOCOPSLoss, OtherSurrogate])
def test_clipped_and_penalized_surrogates_are_refused(loss_class):
    networks = make_networks()[: 3 if loss_class is FOCOPSLoss else 2]
    with pytest.raises(ValueError, match=rf"loss_module.*{loss_class.__name__}"):
        TrustRegionStep(loss_class(*networks))


def test_other_bad_losses_are_refused():
    with pytest.raises(ValueError, match=r"loss_module.*got Linear"):
        TrustRegionStep(nn.Linear(1, 1))
    with pytest.raises(ValueError, match="reduction='mean', got 'sum'"):
        TrustRegionStep(make_loss(reduction="sum"))
    loss = make_loss()
    for parameter in loss.actor_network_params.parameters():
        parameter.requires_grad_(False)
    with pytest.raises(ValueError, match="no trainable parameter"):
        TrustRegionStep(loss)


def test_the_actor_may_be_lazy_until_the_first_step():
    _, critic, cost_critic = make_networks()
    net = nn.Sequential(nn.LazyLinear(2 * ACTION_SIZE), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    loss = TrustRegionLoss(actor, critic, cost_critic, functional=False, entropy_bonus=False)
    assert TrustRegionStep(loss).loss_module is loss


@pytest.mark.parametrize(("separate", "functional"), [(True, True), (False, True), (False, False)])
@pytest.mark.parametrize("kind", ["reward", "cost"])
def test_a_critic_that_the_step_would_move_is_refused(kind, separate, functional):
    actor, critic, cost_critic = make_networks()
    first = next(module for module in actor.modules() if isinstance(module, nn.Linear))
    shared = {"reward": critic, "cost": cost_critic}[kind]
    next(
        module for module in shared.modules() if isinstance(module, nn.Linear)
    ).weight = first.weight
    networks = actor, critic, cost_critic
    loss = TrustRegionLoss(*networks, separate_losses=separate, functional=functional)
    with pytest.raises(ValueError, match="must not share parameters with a critic"):
        TrustRegionStep(loss)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_kl", 0.0),
        ("max_kl", float("nan")),
        ("max_kl", float("inf")),
        ("max_kl", None),
        ("damping", -0.1),
        ("cg_iterations", 0),
        ("shrink", 1.0),
        ("shrink", 0.0),
        ("max_backtracks", -1),
        ("max_backtracks", 2.5),
        ("episode_length", 0),
        ("episode_length", float("inf")),
    ],
)
def test_numbers_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=rf"{name}.*{value}"):
        TrustRegionStep(make_loss(), **{name: value})
    step = TrustRegionStep(make_loss())
    before = getattr(step, name)
    with pytest.raises(ValueError, match=rf"{name}.*{value}"):
        setattr(step, name, value)
    assert getattr(step, name) == before


def test_a_state_is_checked():
    step = TrustRegionStep(make_loss())
    with pytest.raises(ValueError, match="episode_length"):
        step.load_state_dict({**step.state_dict(), "episode_length": -4.0})


@pytest.mark.parametrize("method", [CPO, TRPO, None, "cpo"])
def test_a_method_is_an_object(method):
    with pytest.raises(TypeError, match="method must be an instance of TrustRegionMethod"):
        TrustRegionStep(make_loss(), method)


def test_a_policy_without_a_divergence_in_closed_form_is_refused():
    torch.manual_seed(0)
    loss = PPOLoss(normal_actor(TruncatedNormal), make_critic(), entropy_bonus=False)
    with pytest.raises(NotImplementedError, match="TruncatedNormal"):
        TrustRegionStep(loss).step(make_data(loss))


# ---------------------------------------------------------------- state


def test_state_round_trip():
    """Counts go over, and a resumed run takes the same steps."""
    loss = make_loss()
    loss.cost_violation.fill_(1000.0)
    step = TrustRegionStep(loss, CPO(), max_kl=MAX_KL)
    step.step(make_data(loss))
    step.method = Fixed(1e6)
    step.step(make_data(loss))
    step.episode_length = 40.0  # As a training loop may tell it.
    assert step.state_dict() == {
        "rejected_steps": 1,
        "indefinite_steps": 0,
        "recovery_steps": 1,
        "episode_length": 40.0,
        "max_kl": MAX_KL,
    }

    resumed_loss = make_loss(seed=5)
    resumed_loss.load_state_dict(loss.state_dict())
    resumed = TrustRegionStep(resumed_loss, CPO(), max_kl=MAX_KL)
    resumed.load_state_dict(step.state_dict())
    assert resumed.state_dict() == step.state_dict()
    step.method = CPO()
    data = make_data(loss, seed=3)
    assert (step.step(data) == resumed.step(data)).all()
    assert torch.equal(actor_state(resumed_loss), actor_state(loss))


def test_a_state_that_is_refused_changes_nothing():
    step = TrustRegionStep(TrustRegionLoss(*make_networks()))
    before = step.state_dict()
    incomplete = {name: 7 for name in before if name != "max_kl"}
    with pytest.raises(KeyError, match="max_kl"):
        step.load_state_dict(incomplete)
    assert step.state_dict() == before


def test_a_complex_number_is_refused():
    with pytest.raises(ValueError, match="max_kl must be a number"):
        TrustRegionStep(make_loss(), max_kl=torch.tensor(0.1 + 0j))
