"""FOCOPS and CUP: numbers by hand."""

import copy
import math

import pytest
import torch
from first_order import actor_gradient, build, old_policy, policy, shift, step
from on_policy import estimated, train
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch.distributions import kl_divergence
from torchrl.modules import IndependentNormal, ProbabilisticActor, recurrent_mode
from torchrl.objectives import SoftUpdate

from torchrl_safe.objectives import CUPLoss, FOCOPSLoss, IPOLoss, P3OLoss, penalized_advantage
from torchrl_safe.testing import make_batch, make_critic


def test_the_penalty_without_rescaling():
    reward, cost = torch.tensor([[1.0], [2.0]]), torch.tensor([[3.0, 1.0], [-2.0, 0.0]])
    multiplier = torch.tensor([1.0, 0.5])
    mixed = penalized_advantage(reward, cost, multiplier, rescale=False)
    assert mixed.tolist() == [[-2.5], [4.0]]
    assert torch.equal(mixed / 2.5, penalized_advantage(reward, cost, multiplier))


def test_focops_by_hand():
    multiplier = torch.tensor([0.5, 0.0, 2.0])
    loss = build(FOCOPSLoss, 3, multiplier_init=multiplier, temperature=1.25, kl_bound=0.4)
    data = estimated(loss, 3)
    current, old = policy(loss, data), old_policy(data)
    kl = kl_divergence(current, old)
    ratio = (current.log_prob(data["action"]) - old.log_prob(data["action"])).exp()
    gain = ratio * (data["advantage"] - data["cost_advantage"] @ multiplier[:, None]).squeeze(-1)
    near = (kl <= 0.4).float()
    assert 0 < near.mean() < 1
    expected = (near * (kl - gain / 1.25)).mean()
    losses = loss(data)
    torch.testing.assert_close(losses["loss_kl"] + losses["loss_objective"], expected)
    torch.testing.assert_close(losses["kl"], kl.mean())
    torch.testing.assert_close(
        actor_gradient(loss, losses["loss_kl"] + losses["loss_objective"]),
        actor_gradient(loss, expected),
    )


def test_cup_of_an_actor_without_shapes():
    """It has none where the loss is made; they come with the first batch."""
    net = torch.nn.Sequential(torch.nn.LazyLinear(4), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    loss = CUPLoss(actor, make_critic(), make_critic("cost_value"))
    data = loss.estimate_advantages(make_batch(1)).reshape(-1)
    loss(data)
    loss.start_projection()
    assert loss.projection_loss(data)["kl"] == 0
    train(loss, data, 3)
    assert loss.projection_loss(data)["kl"] > 0


def test_padding_does_not_count_in_what_ends_a_phase_of_cup():
    loss = build(CUPLoss, 1)
    data = estimated(loss, 1)
    kept = torch.arange(len(data)) % 2 == 0
    expected = loss(data[kept])["kl_approx"]
    data["collector", "mask"] = kept.unsqueeze(-1)
    data["action_log_prob"][~kept] = 100.0
    torch.testing.assert_close(loss(data)["kl_approx"], expected)


@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
def test_cup_projects_by_hand(functional):
    multiplier = torch.tensor([0.5, 0.0, 2.0])
    loss = build(CUPLoss, 3, multiplier_init=multiplier, functional=functional)
    loss.make_cost_value_estimator(gamma=0.9, lmbda=0.5)
    data = estimated(loss, 3)
    train(loss, data, 3)
    improved = copy.deepcopy(loss)
    loss.start_projection()
    train(loss, data, 3)
    losses = loss.projection_loss(data)

    def evaluate(some):
        inputs = data.select("observation")
        if not functional:
            return some.actor_network.get_dist(inputs)
        with some.actor_network_params.to_module(some.actor_network):
            return some.actor_network.get_dist(inputs)

    current = evaluate(loss)
    kl = kl_divergence(current, evaluate(improved))
    assert kl.min() > 0
    ratio = (current.log_prob(data["action"]) - data["action_log_prob"]).exp()
    cost = (data["cost_advantage"] * multiplier).sum(-1)
    expected = (kl + (1 - 0.45) / (1 - 0.9) * ratio * cost).mean()
    torch.testing.assert_close(losses["loss_projection"], expected)
    torch.testing.assert_close(losses["kl"], kl.mean())
    losses["loss_projection"].backward()
    reached = {name for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    assert reached
    assert all(name.startswith("actor_network") for name in reached)


def test_the_projection_of_a_recurrent_actor_sees_whole_sequences():
    """TorchRL turns recurrent mode on around methods whose names end in "loss"."""
    loss, modes = build(CUPLoss), []
    data = estimated(loss)
    loss.start_projection()
    for module in loss.actor_network.modules():
        module.register_forward_pre_hook(lambda *_: modes.append(recurrent_mode()))
    loss.projection_loss(data)
    assert modes
    assert all(modes)


def test_cup_does_not_project_before_the_start_of_a_projection():
    """It would go back to the policy that it was made with."""
    loss = build(CUPLoss)
    data = estimated(loss)
    with pytest.raises(RuntimeError, match="Call start_projection before projection_loss"):
        loss.projection_loss(data)
    other = build(CUPLoss, seed=3)
    other.load_state_dict(loss.state_dict())
    with pytest.raises(RuntimeError, match="Call start_projection before projection_loss"):
        other.projection_loss(data)
    loss.start_projection()
    assert loss.projection_loss(data)["kl"] == 0
    other.load_state_dict(loss.state_dict())
    assert other.projection_loss(data)["kl"] == 0


def test_cup_projection_leads_back_to_the_improved_policy():
    loss = build(CUPLoss, 2)
    data = estimated(loss, 2)
    loss.start_projection()
    assert loss.projection_loss(data)["kl"] == 0.0
    train(loss, data, 10)
    moved = loss.projection_loss(data)["kl"]
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(100):  # Multiplier zero: nothing but the divergence is left to minimize.
        loss.projection_loss(data)["loss_projection"].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert moved > 1e-3
    assert loss.projection_loss(data)["kl"] < 0.01 * moved


def behind(loss, data):
    """Logarithms of the ratios to the delayed policy, and of that to the one that collected."""
    with loss.target_actor_network_params.to_module(loss.actor_network):
        delayed = loss.actor_network.get_dist(data.select("observation"))
    log_prob = policy(loss, data).log_prob(data["action"])
    past, old = delayed.log_prob(data["action"]), data["action_log_prob"]
    return (log_prob - past).unsqueeze(-1), (past - old).unsqueeze(-1)


@pytest.mark.parametrize("cap", [None, 1.05])
def test_the_surrogate_of_a_delayed_policy_by_hand(cap):
    """PPO clips the ratio to the delayed policy; the weight is that to the one that collected."""
    loss = build(P3OLoss, 2, penalty_coeff=7.0, delay_actor=True, max_importance_ratio=cap)
    SoftUpdate(loss, eps=0.5)
    data = estimated(loss, 2)
    step(loss, [4.0, 100.0])
    shift(loss)
    log_ratio, log_weight = behind(loss, data)
    assert log_weight.abs().min() > 1e-3
    if cap is not None:
        capped = torch.minimum(log_weight, math.log(cap) - log_ratio.detach())
        assert 0 < (capped < log_weight).sum() < len(data)
        log_weight = capped
    cost, ratio = data["cost_advantage"], log_ratio.exp()
    product = torch.maximum(ratio * cost, ratio.clamp(0.8, 1.2) * cost) - cost
    surrogate = (log_weight.exp() * product).mean(0)
    expected = 7 * (surrogate + 0.01 * torch.tensor([4.0, 100.0])).clamp_min(0).sum()
    penalty = loss(data)["loss_penalty"]
    torch.testing.assert_close(penalty, expected)
    torch.testing.assert_close(actor_gradient(loss, penalty), actor_gradient(loss, expected))


def test_the_projection_of_a_delayed_policy_by_hand():
    """Its ratio is the whole one, to the policy that collected."""
    loss = build(CUPLoss, 1, multiplier_init=2.0, delay_actor=True)
    SoftUpdate(loss, eps=0.5)
    data = estimated(loss, 1)
    loss.start_projection()
    shift(loss)
    log_ratio, log_weight = behind(loss, data)
    losses = loss.projection_loss(data)
    scale = (1 - 0.99 * 0.95) / (1 - 0.99)
    cost = scale * 2 * (log_ratio + log_weight).exp() * data["cost_advantage"]
    torch.testing.assert_close(losses["loss_projection"], losses["kl"] + cost.mean())


def test_a_coefficient_for_each_cost():
    """Each acts as it does alone."""
    for make, name in ((P3OLoss, "penalty_coeff"), (IPOLoss, "sharpness")):
        losses = []
        for value in ([5.0, 20.0], 5.0, 20.0):
            loss = build(make, 2, **{name: value})
            data = estimated(loss, 2)
            step(loss, [2.0, 3.0])
            losses.append(loss)
        both, first, second = (
            loss.penalty(torch.tensor([0.3, 0.4]), scale=0.01) for loss in losses
        )
        assert torch.equal(both, torch.stack([first[0], second[1]]))
        assert losses[0](data)["loss_penalty"].isfinite()
