"""FOCOPS, CUP, P3O, IPO and CRPO: numbers by hand, and the parent where no limit acts."""

import copy
import math
from functools import partial

import pytest
import torch
from first_order import (
    FAR,
    actor_gradient,
    build,
    crpo,
    old_policy,
    policy,
    shift,
    step,
)
from on_policy import estimated, total, train
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch.distributions import Categorical, Independent, Normal, kl_divergence
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    MLP,
    IndependentNormal,
    MaskedCategorical,
    ProbabilisticActor,
    TruncatedNormal,
)
from torchrl.objectives import ClipPPOLoss, PPOLoss, SoftUpdate
from torchrl.objectives.value import GAE

from torchrl_safe.objectives import (
    CUPLoss,
    FOCOPSLoss,
    IPOLoss,
    P3OLoss,
    TrustRegionLoss,
    penalized_advantage,
)
from torchrl_safe.objectives.on_policy.crpo import rectified_advantage
from torchrl_safe.objectives.on_policy.ipo import log_barrier
from torchrl_safe.objectives.on_policy.policies import divergence
from torchrl_safe.objectives.on_policy.surrogate import clipped_cost_surrogate
from torchrl_safe.testing import make_batch, make_critic, make_networks

# ---------------------------------------------------------------- pure functions


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


def test_the_penalty_without_rescaling():
    reward, cost = torch.tensor([[1.0], [2.0]]), torch.tensor([[3.0, 1.0], [-2.0, 0.0]])
    multiplier = torch.tensor([1.0, 0.5])
    mixed = penalized_advantage(reward, cost, multiplier, rescale=False)
    assert mixed.tolist() == [[-2.5], [4.0]]
    assert torch.equal(mixed / 2.5, penalized_advantage(reward, cost, multiplier))


# ---------------------------------------------------------------- the losses by hand


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


def term(loss, data):
    """What a method adds to the objective of the reward, or puts in its place."""
    if isinstance(loss, CUPLoss):
        loss.start_projection()
        return loss.projection_loss(data)["loss_projection"]
    if isinstance(loss, TrustRegionLoss):
        return loss.cost_surrogate_loss(data).sum()
    losses = loss(data)
    return losses["loss_objective" if isinstance(loss, FOCOPSLoss) else "loss_penalty"]


@pytest.mark.parametrize("num_actions", [1, 3])
@pytest.mark.parametrize(
    "make", [FOCOPSLoss, CUPLoss, P3OLoss, IPOLoss, TrustRegionLoss], ids=lambda make: make.__name__
)
def test_a_log_probability_of_each_part_is_added_up(make, num_actions):
    """Of the same policy, summed or not: the same gradient. Costs meet their own states."""
    gradients = []
    for distribution in (IndependentNormal, Normal):
        torch.manual_seed(0)
        net = torch.nn.Sequential(MLP(4, 2 * num_actions), NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(net, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=distribution,
            return_log_prob=True,
        )
        loss = make(actor, make_critic(), make_critic("cost_value"), entropy_bonus=False)
        for name in loss.cost_buffers:
            getattr(loss, name).fill_(2.0)
        data = make_batch(1).exclude("action", "action_log_prob", "loc", "scale")
        with torch.no_grad():
            data = loss.estimate_advantages(actor(data)).reshape(-1)
        gradients.append(actor_gradient(loss, term(loss, data)))
    assert gradients[0].norm() > 0.1
    torch.testing.assert_close(*gradients)


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


def test_cup_does_not_project_before_the_start_of_a_projection():
    """It would go back to the policy that it was made with."""
    loss = build(CUPLoss)
    data = estimated(loss)
    with pytest.raises(RuntimeError, match="Call start_projection before projection_loss"):
        loss.projection_loss(data)
    loss.start_projection()
    assert loss.projection_loss(data)["kl"] == 0


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


def test_a_coefficient_that_is_a_whole_number_is_still_a_number():
    """A buffer of whole numbers would cut off what comes later."""
    loss = build(IPOLoss, sharpness=20)
    assert loss.sharpness.is_floating_point()
    losses = loss(estimated(loss))
    assert total(losses).isfinite()


@pytest.mark.parametrize("make", [CUPLoss, FOCOPSLoss, P3OLoss])
def test_targets_of_another_number_of_costs_are_refused(make):
    loss = build(make, 2)
    data = estimated(loss, 2)
    data["cost_value_target"] = data["cost_value_target"][..., :1]
    with pytest.raises(ValueError, match=r"'cost_value_target' must have one column .* 2 costs"):
        loss(data)


def surrogate_by_hand(loss, data):
    current, old = policy(loss, data), old_policy(data)
    ratio = (current.log_prob(data["action"]) - old.log_prob(data["action"])).exp().unsqueeze(-1)
    products = ratio * data["cost_advantage"], ratio.clamp(0.8, 1.2) * data["cost_advantage"]
    return torch.maximum(*products).mean(0)


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


# ---------------------------------------------------------------- no limit that binds


def parent_of(name, **kwargs):
    actor, critic, _ = make_networks()
    return (PPOLoss if name == "focops" else ClipPPOLoss)(actor, critic, **kwargs)


UNBOUND = {
    "focops": partial(FOCOPSLoss, temperature=1.0, kl_bound=math.inf),
    "cup": CUPLoss,
    "p3o": P3OLoss,
    "crpo": crpo,
}
OPTIONS = {
    "default": {},
    "clip_value": {"clip_value": 0.1},
    "separate_losses": {"separate_losses": True},
    "not_functional": {"functional": False},
    "max_importance_ratio": {"max_importance_ratio": 1.1},
    "delay_actor": {"delay_actor": True},
}


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
@pytest.mark.parametrize("name", UNBOUND)
def test_without_a_limit_that_binds_it_is_its_parent_bit_for_bit(
    name, options, precomputed, num_costs
):
    loss, parent = build(UNBOUND[name], num_costs, **options), parent_of(name, **options)
    if options.get("delay_actor"):
        for delayed in (loss.loss_module if name == "crpo" else loss, parent):
            SoftUpdate(delayed, eps=0.5)
    step(loss, [FAR] * num_costs)
    batch = make_batch(num_costs)
    if precomputed:
        batch = loss.estimate_advantages(batch).reshape(-1)
    losses = loss(batch.clone())
    if not precomputed:  # Where there are no advantages, the loss does this itself.
        batch = loss.estimate_advantages(batch)
    expected = parent(batch)
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    extra = set(losses.keys()) - set(expected.keys())
    assert {"loss_cost_critic", "cost_explained_variance"} < extra
    if name == "p3o":
        assert losses["loss_penalty"] == 0


def test_far_from_its_limits_ipo_has_no_force():
    loss, parent = build(IPOLoss, 2), parent_of("ipo")
    step(loss, [FAR, FAR])
    data = estimated(loss, 2)
    losses, expected = loss(data), parent(data)
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    assert actor_gradient(loss, losses["loss_penalty"]).abs().max() < 1e-20


def two_masked(logits, mask):
    """Two choices among three actions each."""
    each = MaskedCategorical(logits=logits.unflatten(-1, (2, 3)), mask=mask.unflatten(-1, (2, 3)))
    return Independent(each, 1)


@pytest.mark.parametrize(("distribution", "width"), [(MaskedCategorical, 3), (two_masked, 6)])
@pytest.mark.parametrize("make", [FOCOPSLoss, CUPLoss])
def test_a_masked_action_leaves_the_gradients_finite(make, distribution, width):
    """PyTorch's divergence of two policies that exclude the same action has a gradient of NaN."""
    net = TensorDictModule(torch.nn.Linear(4, width), ["observation"], ["logits"])
    actor = ProbabilisticActor(
        net, ["logits", "mask"], distribution_class=distribution, return_log_prob=True
    )
    loss = make(actor, make_critic(), make_critic("cost_value"), multiplier_init=1.0)
    batch = TensorDict(
        observation=torch.randn(8, 4),
        mask=torch.tensor([True, True, False]).repeat(8, width // 3),
        advantage=torch.randn(8, 1),
        cost_advantage=torch.randn(8, 1),
        value_target=torch.zeros(8, 1),
        cost_value_target=torch.zeros(8, 1),
        batch_size=8,
    )
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        actor(batch)
    phases = [loss]
    if make is CUPLoss:
        loss.start_projection()
        phases.append(loss.projection_loss)
    for phase in phases:
        losses = phase(batch)
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    assert all(parameter.grad.isfinite().all() for parameter in loss.parameters())


def test_the_divergence_of_independent_categories_is_pytorchs():
    logits = torch.randn(2, 5, 2, 3, generator=torch.Generator().manual_seed(0))
    for summed, shape in ((0, (5, 2)), (1, (5,)), (2, ())):
        old, new = (Independent(Categorical(logits=each), summed) for each in logits)
        expected = kl_divergence(old, new).unsqueeze(-1)
        torch.testing.assert_close(divergence(old, new, torch.Size(shape)), expected)


def test_the_divergence_of_categories_is_pytorchs():
    old, new = (torch.distributions.Categorical(logits=torch.randn(5, 3)) for _ in range(2))
    shape = torch.Size([5])
    assert torch.equal(divergence(old, new, shape), kl_divergence(old, new).unsqueeze(-1))
    # What the new policy excludes and the old one does not is infinitely far away.
    excluding = torch.distributions.Categorical(probs=torch.tensor([0.5, 0.5, 0.0]))
    everything = torch.distributions.Categorical(probs=torch.ones(3))
    assert divergence(everything, excluding, torch.Size([])) == math.inf
    assert kl_divergence(everything, excluding) == math.inf


def test_a_distribution_without_a_divergence_is_named():
    one = TruncatedNormal(torch.zeros(2), torch.ones(2), low=-1.0, high=1.0)
    with pytest.raises(NotImplementedError, match="no KL divergence of TruncatedNormal"):
        divergence(one, one, torch.Size([]))
