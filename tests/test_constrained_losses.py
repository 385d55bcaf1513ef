"""What constrained on-policy losses share: outputs, scaling, delegation, what stays behind."""

import copy

import pytest
import torch
from on_policy import OTHERS, SUBCLASSES, all_losses, free, make_composite
from tensordict.nn import set_composite_lp_aggregate
from torch import nn
from torchrl.objectives import ClipPPOLoss, KLPENPPOLoss, LossModule, SoftUpdate

from torchrl_safe.objectives import (
    CRPOLoss,
    FOCOPSLoss,
    IPOLoss,
    LagrangianLoss,
    P3OLoss,
    PPOLagrangianLoss,
)
from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.on_policy.constrained import ConstrainedPPO
from torchrl_safe.testing import make_batch, make_networks


@all_losses
def test_what_a_call_returns_is_announced(make):
    loss = make(*make_networks(2), num_costs=2)
    # TorchRL does not announce these two.
    unannounced = {"explained_variance", "kl_approx"}
    assert set(loss(make_batch(2)).keys()) - set(loss.out_keys) <= unannounced


@all_losses
def test_the_discounts_go_with_the_state(make):
    saved, loaded = (make(*make_networks()) for _ in range(2))
    saved.make_cost_value_estimator(gamma=0.5).make_value_estimator(gamma=0.25)
    loaded.load_state_dict(saved.state_dict(), strict=True)
    assert loaded.cost_value_estimator.gamma == 0.5
    assert getattr(loaded, "loss_module", loaded).value_estimator.gamma == 0.25


@pytest.mark.parametrize("num_costs", [1, 3])
# KLPENPPOLoss moves its coefficient at each call: two calls differ.
@pytest.mark.parametrize("name", [name for name in SUBCLASSES if name != "lagrangian-kl-ppo"])
def test_with_composite_actions_and_no_constraint_it_is_its_parent(name, num_costs):
    make, parent = SUBCLASSES[name]
    with set_composite_lp_aggregate(False):
        actor, critic, cost_critic, batch = make_composite(num_costs)
        expected_loss = parent(copy.deepcopy(actor), copy.deepcopy(critic))
        loss = make(actor, critic, cost_critic, num_costs=num_costs)
        free(loss)
        data = loss.estimate_advantages(batch).reshape(-1)
        losses, expected = loss(data), expected_loss(data)
        heads = losses.pop("composite_entropy") == expected.pop("composite_entropy")
        assert heads.all()
        for key, value in expected.items():
            assert torch.equal(losses[key], value), key
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()


# tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.slow
@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
# KLPENPPOLoss branches on its divergence, which no graph can.
@pytest.mark.parametrize("name", [n for n in {**SUBCLASSES, **OTHERS} if n != "lagrangian-kl-ppo"])
def test_every_loss_compiles_to_one_graph(name, functional):
    make, _ = {**SUBCLASSES, **OTHERS}[name]
    loss = make(*make_networks(2), num_costs=2, functional=functional)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    expected = loss(data)
    torch._dynamo.reset()
    actual = torch.compile(loss, fullgraph=True, backend="eager")(data)
    for key, value in expected.items():
        torch.testing.assert_close(actual[key], value)


@all_losses
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_a_batch_without_advantages_is_treated_like_one_with_them(make, scale):
    loss = make(*make_networks(2), num_costs=2)
    buffers = dict(loss.named_buffers())
    for name in {"lagrange_multiplier", "cost_violation"} & buffers.keys():
        buffers[name].fill_(1.0)
    batch = make_batch(2)
    batch["next", "reward"] *= scale
    twin = copy.deepcopy(loss)
    losses, expected = loss(batch.clone()), twin(twin.estimate_advantages(batch))
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key


@all_losses
def test_single_steps_have_no_advantages_to_estimate(make):
    """Those of shuffled steps would be wrong, and move the scale of the costs."""
    loss = make(*make_networks(2), num_costs=2)
    steps = make_batch(2).reshape(-1)[torch.randperm(24)]
    before = copy.deepcopy(loss.state_dict())
    with pytest.raises(ValueError, match=r"must have a dimension of time .* shape \(24,\)"):
        loss(steps)
    with pytest.raises(ValueError, match=r"must have a dimension of time .* shape \(24,\)"):
        loss.estimate_advantages(steps)
    for key, value in loss.state_dict().items():
        assert torch.equal(value, before[key]), key
    trajectory = make_batch(2)[0]
    assert trajectory.names == ["time"]
    assert loss(trajectory)["loss_cost_critic"].isfinite()


def test_the_variance_that_is_explained_is_that_of_the_steps_that_count():
    loss = PPOLagrangianLoss(*make_networks(2), num_costs=2, clip_value=0.01)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    data["cost_value"] += 0.02 * torch.randn(24, 2)  # As if the critic had moved since.
    kept = torch.arange(24) % 3 != 0
    expected = loss(data[kept])
    data["cost_value_target"][~kept] = 1e3
    losses = loss(data.set(("collector", "mask"), kept.unsqueeze(-1)))
    for key in ("cost_explained_variance", "cost_value_clip_fraction"):
        torch.testing.assert_close(losses[key], expected[key])
    assert 0 < losses["cost_value_clip_fraction"] < 1


def test_a_cost_critic_that_writes_another_key_is_named():
    actor, critic, _ = make_networks()
    loss = PPOLagrangianLoss(actor, critic, make_networks(seed=1)[1])
    message = r"cost_critic_network must write 'cost_value', got one that writes \['state_value'\]"
    with pytest.raises(ValueError, match=message):
        loss.estimate_advantages(make_batch())
    for wrong in (None, torch.nn.Linear(4, 1)):
        with pytest.raises(TypeError, match="cost_critic_network must be an instance of"):
            PPOLagrangianLoss(actor, critic, wrong)


@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_a_compiled_cost_critic():
    actor, critic, cost_critic = make_networks(2)
    compiled = torch.compile(cost_critic, backend="eager")
    loss = PPOLagrangianLoss(actor, critic, compiled, num_costs=2, functional=False)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    loss(data)["loss_cost_critic"].backward()
    assert all(parameter.grad.any() for parameter in cost_critic.parameters())


def test_what_was_chosen_when_it_was_made_stays():
    loss = PPOLagrangianLoss(*make_networks(), normalize_cost_advantage=False)
    with pytest.raises(AttributeError):
        loss.normalize_cost_advantage = True


def test_the_objective_does_not_depend_on_the_scale_of_rewards():
    """Without estimate_advantages it was 1000 times as large, and the cost had no effect."""
    loss = PPOLagrangianLoss(*make_networks(2), num_costs=2, multiplier_init=1.0)
    plain = loss(make_batch(2))["loss_objective"]
    batch = make_batch(2)
    batch["next", "reward"] *= 1000
    # The critic does not follow the rewards, so that the two are close and not the same.
    assert (loss(batch)["loss_objective"] - plain).abs() < 0.3


def test_an_advantage_norm_scales_the_reward_advantage_instead():
    class Halve(nn.Module):
        def scale(self):
            return torch.tensor(2.0)

        def update(self, value):
            return None

    loss = PPOLagrangianLoss(*make_networks(2), num_costs=2, advantage_norm=Halve())
    plain = ClipPPOLoss(*make_networks(2)[:2], advantage_norm=Halve())
    batch = make_batch(2)
    assert torch.equal(loss(batch)["loss_objective"], plain(batch)["loss_objective"])


def test_coefficients_are_read_and_set_through_the_wrapper():
    actor, critic, cost_critic = make_networks()
    loss = LagrangianLoss(KLPENPPOLoss(actor, critic, beta=0.7), cost_critic)
    assert loss.beta == torch.tensor(0.7)
    assert loss.entropy_coeff == torch.tensor(0.01)
    assert loss.critic_coeff == torch.tensor(1.0)
    loss.beta, loss.entropy_coeff, loss.critic_coeff = 0.5, 0.25, 2.0
    inner = loss.loss_module
    assert (inner.entropy_coeff, inner.critic_coeff) == (0.25, 2.0)
    assert inner.beta == loss.beta == 0.5
    assert not {"beta", "entropy_coeff", "critic_coeff"} & vars(loss).keys()


def test_a_constrained_loss_made_of_the_kl_penalty_has_that_penalty():
    """It reads what the collector's policy has left in the data."""

    class KLPenalized(ConstrainedPPO, KLPENPPOLoss):
        def policy_losses(self, tensordict, advantage, cost_advantage):
            return self.unconstrained(tensordict, advantage)

    actor, critic, cost_critic = make_networks()
    with torch.no_grad():
        data = actor(make_batch())
        next(actor.parameters()).add_(0.1)
    wrapped = LagrangianLoss(KLPENPPOLoss(actor, critic), cost_critic)
    expected = wrapped(wrapped.estimate_advantages(data.clone()))
    assert (expected["kl"] > 0).all()
    loss = KLPenalized(actor, critic, cost_critic)
    assert torch.equal(loss(loss.estimate_advantages(data.clone()))["kl"], expected["kl"])


def test_plain_options_are_set_in_the_wrapped_loss():
    """It was taken silently, and nothing changed."""
    actor, critic, cost_critic = make_networks()
    loss = LagrangianLoss(ClipPPOLoss(actor, critic), cost_critic)
    data = loss.estimate_advantages(make_batch()).reshape(-1)
    assert "loss_entropy" in loss(data)
    loss.entropy_bonus = False
    assert "loss_entropy" not in loss(data)
    assert loss.loss_module.entropy_bonus is False
    loss.log_explained_variance = False
    assert not any("explained_variance" in key for key in [*loss(data).keys(), *loss.out_keys])
    loss.reduction = "sum"
    mean = loss.loss_module(data)
    assert torch.equal(loss(data)["loss_objective"], mean["loss_objective"])
    loss.separate_losses = True  # That of the cost critic is its own.
    assert loss.loss_module.separate_losses is False


def test_what_neither_has_is_an_error():
    actor, critic, cost_critic = make_networks()
    loss = LagrangianLoss(ClipPPOLoss(actor, critic), cost_critic)
    with pytest.raises(AttributeError, match="no_such_option"):
        _ = loss.no_such_option


@pytest.mark.parametrize("make", [LagrangianLoss, CRPOLoss])
def test_soft_update_finds_the_targets_of_the_wrapped_loss(make):
    actor, critic, cost_critic = make_networks()
    loss = make(ClipPPOLoss(actor, critic, delay_actor=True), cost_critic)
    names = list(loss.state_dict())
    updater = SoftUpdate(loss, eps=0.5)
    data = loss.estimate_advantages(make_batch()).reshape(-1)
    loss(data)  # It warns if the targets have no updater, and warnings are errors here.
    before = loss.target_actor_network_params.clone()
    with torch.no_grad():
        for parameter in loss.actor_network_params.values(True, True):
            parameter.add_(1.0)
    updater.step()
    for key, value in loss.loss_module.target_actor_network_params.items(True, True):
        torch.testing.assert_close(value, before[key] + 0.5)
    assert list(loss.state_dict()) == names


def test_a_loss_with_costs_of_its_own_is_not_wrapped():
    inner = PPOLagrangianLoss(*make_networks())
    with pytest.raises(ValueError, match="without costs, got PPOLagrangianLoss"):
        LagrangianLoss(inner, make_networks()[2])


@all_losses
def test_a_loss_can_be_copied_after_a_call_that_failed(make):
    loss = make(*make_networks(2), num_costs=2)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    with pytest.raises(KeyError):
        loss(data.exclude("cost_value_target"))
    twin = copy.deepcopy(loss)
    expected = loss(data.clone())
    for key, value in twin(data).items():
        assert torch.equal(value, expected[key]), key


@all_losses
def test_no_call_leaves_a_tensor_of_the_graph_on_the_loss(make):
    loss = make(*make_networks(2), num_costs=2)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    loss(data)
    modules = [loss, *(m for m in loss.children() if isinstance(m, LossModule))]
    held = [value for module in modules for value in vars(module).values()]
    assert not [value for value in held if isinstance(value, torch.Tensor | tuple) and value != ()]


def test_focops_evaluates_the_policy_once():
    actor, critic, cost_critic = make_networks()
    calls = []
    actor[0].module[0].register_forward_hook(lambda *_: calls.append(1))
    loss = FOCOPSLoss(actor, critic, cost_critic)
    data = loss.estimate_advantages(make_batch()).reshape(-1)
    calls.clear()
    loss(data)
    assert len(calls) == 1


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
@pytest.mark.parametrize("key", ["auto", None, "mine"])
@pytest.mark.parametrize("shape", [(4, 6, 1), (4, 6)], ids=str)
def test_values_are_reduced_as_torchrl_does(shape, key, reduction):
    """TorchRL's own is private; this tells when it moves."""
    loss = ClipPPOLoss(*make_networks()[:2], reduction=reduction)
    loss.loss_mask_key = key
    data, values = make_batch(), torch.randn(shape)
    expected = loss._reduce_loss(values, data)
    assert torch.equal(reduced(loss, values, data), expected)
    data["collector", "mask"] = torch.rand(4, 6, 1) > 0.3
    data["shifted_valid"] = torch.rand(4, 6) > 0.3
    data["mine"] = torch.rand(4, 6, 1) > 0.3
    expected = loss._reduce_loss(values, data)
    assert torch.equal(reduced(loss, values, data), expected)
    with pytest.raises(ValueError, match='reduction must be "mean", "sum" or "none", got'):
        reduced(loss, values, data, reduction="Sum")


@pytest.mark.parametrize("make", [P3OLoss, IPOLoss])
def test_multipliers_are_refused_where_there_are_none(make):
    with pytest.raises(TypeError, match=r"has no multipliers, got multiplier_init=0\.5"):
        make(*make_networks(), multiplier_init=0.5)


def test_an_advantage_norm_is_not_updated_by_minibatches():
    updates = []

    class Norm(nn.Module):
        def scale(self):
            return torch.tensor(2.0)

        def update(self, value):
            updates.append(value)

    loss = PPOLagrangianLoss(*make_networks(2), num_costs=2, advantage_norm=Norm())
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    updates.clear()
    loss(data)
    assert not updates
