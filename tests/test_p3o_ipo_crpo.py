"""P3O, IPO and CRPO: numbers by hand."""

import math

import pytest
import torch
from first_order import actor_gradient, build, crpo, old_policy, parent_of, policy, step
from on_policy import estimated
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_safe.objectives import CUPLoss, IPOLoss, P3OLoss
from torchrl_safe.objectives.on_policy.crpo import rectified_advantage
from torchrl_safe.objectives.on_policy.ipo import log_barrier
from torchrl_safe.objectives.on_policy.surrogate import clipped_cost_surrogate
from torchrl_safe.testing import make_batch, make_networks


def surrogate_by_hand(loss, data):
    current, old = policy(loss, data), old_policy(data)
    ratio = (current.log_prob(data["action"]) - old.log_prob(data["action"])).exp().unsqueeze(-1)
    products = ratio * data["cost_advantage"], ratio.clamp(0.8, 1.2) * data["cost_advantage"]
    return torch.maximum(*products).mean(0)


def test_the_cost_surrogate_takes_the_larger_product():
    bounds = torch.tensor(0.8).log(), torch.tensor(1.2).log()
    log_ratio = torch.tensor([[2.0], [0.5], [1.1]]).log()
    cost_advantage = torch.tensor([[1.0, -1.0], [1.0, -1.0], [3.0, -3.0]])
    surrogate = clipped_cost_surrogate(log_ratio, cost_advantage, bounds)
    expected = torch.tensor([[2.0, -1.2], [0.8, -0.5], [3.3, -3.3]]) - cost_advantage
    torch.testing.assert_close(surrogate, expected)
    correction = torch.tensor(2.0).log()
    weighted = clipped_cost_surrogate(log_ratio, cost_advantage, bounds, correction)
    torch.testing.assert_close(weighted, 2 * expected)


def test_the_barrier_is_a_logarithm_with_a_tangent():
    sharpness = torch.tensor(2.0, dtype=torch.float64)
    violation = torch.tensor([-math.e, -1.0, -0.25, 0.0, 3.0], dtype=torch.float64)
    edge = math.log(4) / 2
    expected = [-0.5, 0.0, edge, edge + 0.5, edge + 6.5]
    penalty = log_barrier(violation, sharpness)
    torch.testing.assert_close(penalty, torch.tensor(expected, dtype=torch.float64))
    violation.requires_grad_()
    log_barrier(violation, sharpness).sum().backward()
    slopes = torch.tensor([1 / (2 * math.e), 0.5, 2.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(violation.grad[[0, 1, 3, 4]], slopes)
    # Where both meet, their slopes do too.
    near = torch.tensor([-0.25 - 1e-9, -0.25 + 1e-9], dtype=torch.float64, requires_grad=True)
    log_barrier(near, sharpness).sum().backward()
    torch.testing.assert_close(near.grad, torch.full((2,), 2.0).double())


def test_the_worst_cost_above_the_tolerance_takes_the_place_of_the_reward():
    reward = torch.tensor([[1.0], [2.0]])
    cost = torch.tensor([[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])
    for violation, expected in (
        ([-3.0, -2.0, -5.0], reward),
        ([0.5, 0.25, -5.0], reward),
        ([0.5, 0.75, -5.0], -cost[:, 1:2]),
        ([0.75, 1.0, 2.0], -cost[:, 2:3]),
    ):
        mixed = rectified_advantage(reward, cost, torch.tensor(violation), tolerance=0.5)
        assert torch.equal(mixed, expected)


def test_the_worst_of_costs_in_different_units_is_the_worst_by_their_sizes():
    """The second is a fifth of its size above its limit, the first half of it."""
    reward, cost = torch.tensor([[1.0]]), torch.tensor([[3.0, 4.0]])
    violation, scale = torch.tensor([0.5, 200.0]), torch.tensor([1.0, 1000.0])
    assert rectified_advantage(reward, cost, violation, 0.0).item() == -4.0
    assert rectified_advantage(reward, cost, violation, 0.0, scale).item() == -3.0
    # With a tolerance each, only the second is above.
    tolerance = torch.tensor([0.75, 10.0])
    assert rectified_advantage(reward, cost, violation, tolerance, scale).item() == -4.0
    assert rectified_advantage(reward, cost, -violation, tolerance, scale).item() == 1.0
    # A cost that never varies teaches nothing.
    some, none = torch.tensor([1.0, 0.0]), torch.zeros(2)
    assert rectified_advantage(reward, cost, violation, 0.0, some).item() == -3.0
    assert rectified_advantage(reward, cost, violation, 0.0, none).item() == -4.0


def test_crpo_lowers_the_cost_that_is_worst_by_its_size():
    loss = build(crpo, 2)
    step(loss, [0.5, 200.0])
    loss.cost_advantage_scale.copy_(torch.tensor([1.0, 1000.0]))
    data = make_batch(2).reshape(-1)
    data["advantage"] = torch.randn(24, 1)
    data["cost_advantage"] = torch.randn(24, 2)
    data["value_target"], data["cost_value_target"] = torch.randn(24, 1), torch.randn(24, 2)
    expected = parent_of("crpo")(data.clone().set("advantage", -data["cost_advantage"][:, :1]))
    assert torch.equal(loss(data)["loss_objective"], expected["loss_objective"])


@pytest.mark.parametrize("gamma", [0.99, 0.5])
def test_p3o_by_hand(gamma):
    loss = build(P3OLoss, 3, penalty_coeff=7.0).make_cost_value_estimator(gamma=gamma)
    data = estimated(loss, 3)
    step(loss, [4.0, -1000.0, 100.0])
    surrogate = surrogate_by_hand(loss, data)
    violation = torch.tensor([4.0, -1000.0, 100.0])
    each = (surrogate + (1 - gamma) * violation).clamp_min(0)
    assert (each[[0, 2]] > 0).all()
    assert each[1] == 0
    penalty = loss(data)["loss_penalty"]
    torch.testing.assert_close(penalty, 7 * each.sum())
    torch.testing.assert_close(actor_gradient(loss, penalty), actor_gradient(loss, 7 * each.sum()))


def test_ipo_by_hand():
    loss = build(IPOLoss, 3, sharpness=4.0).make_cost_value_estimator(gamma=0.5)
    data = estimated(loss, 3)
    step(loss, [-1.0, -3.0, 2.0])
    predicted = torch.tensor([-1.0, -3.0, 2.0]) + surrogate_by_hand(loss, data) / 0.5
    assert (predicted[:2] < -0.0625).all()
    assert predicted[2] > 0
    inside = -(-predicted[:2]).log().sum() / 4
    tangent = math.log(16) / 4 + 4 * (predicted[2] + 0.0625)
    expected = (1 - 0.5) * (inside + tangent)
    penalty = loss(data)["loss_penalty"]
    torch.testing.assert_close(penalty, expected)
    torch.testing.assert_close(actor_gradient(loss, penalty), actor_gradient(loss, expected))


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss])
def test_the_penalty_of_an_unmoved_policy_is_that_of_the_limit_in_every_minibatch(kind):
    """Costs of minibatches differ at random, although the policy has not changed."""
    loss = build(kind, 2)
    data = estimated(loss, 2)
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        dist = loss.actor_network.get_dist(data)
    data["action_log_prob"] = dist.log_prob(data["action"])
    step(loss, [-0.1, -0.5])
    expected = loss(data)["loss_penalty"]
    parts = data.split(4)
    assert min(part["cost_advantage"].mean(0).abs().max() for part in parts) > 0.01
    for part in parts:
        torch.testing.assert_close(loss(part)["loss_penalty"], expected)


def test_costs_without_discount_are_refused():
    """1 / (1 - gamma) is how many steps an episode is taken to have."""
    with pytest.raises(ValueError, match=r"gamma of the costs must be below 1, got 1\.0"):
        build(CUPLoss).make_cost_value_estimator(gamma=1.0)


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss])
def test_the_cost_advantage_keeps_its_unit(kind):
    """It is compared with the violation."""
    standardizing = GAE(gamma=0.9, lmbda=0.9, value_network=None, average_gae=True)
    with pytest.raises(ValueError, match="estimator must not have average_gae=True"):
        build(kind).make_cost_value_estimator(standardizing)


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss])
def test_the_penalty_is_of_the_mean_whatever_is_reduced_how(kind):
    loss = build(kind)
    data = estimated(loss)
    step(loss, [-0.01])
    expected = loss(data)["loss_penalty"]
    loss.reduction = "sum"
    assert torch.equal(loss(data)["loss_penalty"], expected)


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss])
def test_without_discount_the_length_of_an_episode_must_be_given(kind):
    with pytest.raises(ValueError, match=r"episode_length must be given.*gamma 1\.0"):
        build(kind).make_cost_value_estimator(gamma=1.0)
    loss = build(kind, episode_length=40)
    loss.make_cost_value_estimator(gamma=1.0)
    data = estimated(loss)
    step(loss, [1.0])
    assert loss(data)["loss_penalty"] > 0
    for value in (0, 0.5, -1.0, float("nan"), "long"):
        with pytest.raises(ValueError, match=rf"episode_length.*{value}"):
            build(kind, episode_length=value)


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss, CUPLoss])
def test_a_discount_that_is_loaded_is_checked_too(kind):
    saved = build(kind).state_dict()
    name = next(name for name in saved if name.endswith("cost_value_estimator.gamma"))
    saved[name] = torch.ones_like(saved[name])
    with pytest.raises(ValueError, match="gamma"):
        build(kind).load_state_dict(saved)
    if kind is not CUPLoss:
        build(kind, episode_length=40).load_state_dict(saved)


def test_the_length_of_an_episode_says_what_a_step_is_worth():
    """40 steps at gamma 0.99, which stands for 100: the effect is 2.5 times too large."""
    default, true = build(P3OLoss), build(P3OLoss, episode_length=40)
    data = estimated(true)

    def effect(loss):
        """The policy's effect on an episode's cost at which the penalty's line ends."""
        penalties = []
        for violation in (4.0, 8.0):
            step(loss, [violation])
            penalties.append(loss(data)["loss_penalty"].item())
        near, far = penalties
        return 4 * near / (far - near) - 4

    assert abs(effect(true)) > 0.1
    assert effect(default) == pytest.approx(2.5 * effect(true), rel=1e-3)


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss])
def test_the_length_of_an_episode_takes_the_place_of_the_discount(kind):
    """50 steps are 1 / (1 - 0.98)."""
    by_discount, by_length = build(kind), build(kind, episode_length=50)
    data = estimated(by_length)
    by_discount.make_cost_value_estimator(gamma=0.98)
    for loss in (by_discount, by_length):
        step(loss, [0.5])
    expected = by_discount(data)["loss_penalty"]
    torch.testing.assert_close(by_length(data)["loss_penalty"], expected)
    step(by_discount, [0.25])
    assert not torch.isclose(by_discount(data)["loss_penalty"], expected)


@pytest.mark.parametrize("violation", [[0.5, 2.0, -1.0], [2.0, 0.5, -1.0], [0.5, 0.75, -1.0]])
def test_crpo_gives_its_parent_one_advantage(violation):
    loss = build(crpo, 3, tolerance=1.0)
    data = estimated(loss, 3)
    step(loss, violation)
    losses = loss(data)
    if max(violation) > 1.0:
        worst = violation.index(max(violation))
        data["advantage"] = -data["cost_advantage"][:, worst : worst + 1]
    actor, critic, _ = make_networks(3)
    for key, value in ClipPPOLoss(actor, critic)(data).items():
        assert torch.equal(losses[key], value), key


def test_p3o_and_ipo_clip_with_the_range_of_ppo():
    for make in (P3OLoss, IPOLoss):
        narrow, wide = build(make, clip_epsilon=(0.01, 0.02)), build(make, clip_epsilon=0.9)
        data = estimated(narrow)
        step(narrow, [100.0])
        step(wide, [100.0])
        assert narrow(data)["loss_penalty"] > wide(data)["loss_penalty"]


def test_each_bound_clips_on_its_side():
    loss = build(P3OLoss, penalty_coeff=7.0, clip_epsilon=(0.1, 0.4))
    data = estimated(loss)
    step(loss, [100.0])
    current, old = policy(loss, data), old_policy(data)
    ratio = (current.log_prob(data["action"]) - old.log_prob(data["action"])).exp().unsqueeze(-1)
    cost = data["cost_advantage"] = (1 - ratio).detach()  # All that is clipped counts.
    assert ratio.min() < 0.9 < 1.4 < ratio.max()
    surrogate = (torch.maximum(ratio * cost, ratio.clamp(0.9, 1.4) * cost) - cost).mean()
    torch.testing.assert_close(loss(data)["loss_penalty"], 7 * (surrogate + 0.01 * 100))


@pytest.mark.parametrize("kind", [P3OLoss, IPOLoss])
def test_the_length_cannot_be_taken_away_without_discount(kind):
    loss = build(kind, episode_length=40).make_cost_value_estimator(gamma=1.0)
    with pytest.raises(ValueError, match="episode_length must be given"):
        loss.episode_length = None
    assert loss.episode_length == 40


@pytest.mark.parametrize("kept", [-1.0, 0.0])
def test_a_cost_of_no_size_is_lowered_if_it_alone_is_above(kept):
    reward, cost = torch.tensor([[1.0]]), torch.tensor([[3.0, 4.0]])
    violation, scale = torch.tensor([kept, 2.0]), torch.tensor([1.0, 0.0])
    assert rectified_advantage(reward, cost, violation, 0.0, scale).item() == -4.0
