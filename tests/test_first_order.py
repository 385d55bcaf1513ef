"""FOCOPS, CUP, P3O, IPO and CRPO: numbers by hand, and the parent where no limit acts."""

import copy
import math
from functools import partial

import pytest
import torch
from on_policy import estimated, make_loss
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import unravel_key
from torch.distributions import Categorical, Independent, kl_divergence
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss, PPOLoss, SoftUpdate
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
    ViolationUpdater,
    penalized_advantage,
)
from torchrl_safe.objectives.on_policy.crpo import rectified_advantage
from torchrl_safe.objectives.on_policy.cup import projection_objective
from torchrl_safe.objectives.on_policy.ipo import log_barrier
from torchrl_safe.objectives.on_policy.p3o import exact_penalty
from torchrl_safe.objectives.on_policy.policies import divergence
from torchrl_safe.objectives.on_policy.surrogate import clipped_cost_surrogate
from torchrl_safe.testing import make_actor, make_batch, make_critic, make_networks


def crpo(actor, critic, cost_critic, *, num_costs=1, tolerance=0.0, **kwargs):
    parent = ClipPPOLoss(actor, critic, **kwargs)
    return CRPOLoss(parent, cost_critic, num_costs=num_costs, tolerance=tolerance)


# The batch is of another policy, far outside the trust region of FOCOPS.
near = partial(FOCOPSLoss, kl_bound=1.0)
LOSSES = {"focops": near, "cup": CUPLoss, "p3o": P3OLoss, "ipo": IPOLoss, "crpo": crpo}
# As far below their limits as a number can be, so that no method acts.
FAR = -1e30
every_loss = pytest.mark.parametrize("make", LOSSES.values(), ids=LOSSES.keys())


def build(make, num_costs=1, seed=0, **kwargs):
    return make(*make_networks(num_costs, seed=seed), num_costs=num_costs, **kwargs)


def step(loss, violation):
    """Violations or multipliers, whichever the loss reads, by the front door."""
    violation = torch.tensor(violation)
    if "cost_violation" in dict(loss.named_buffers()):
        ViolationUpdater(loss, cost_limit=0.0).step(violation.unsqueeze(0))
    else:
        DualAscent(loss, cost_limit=0.0, lr=1.0).step(violation.unsqueeze(0))


def total(losses):
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def train(loss, data, updates=20):
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    order = torch.Generator().manual_seed(3)
    for _ in range(updates):
        minibatch = data[torch.randperm(len(data), generator=order)[:8]]
        total(loss(minibatch)).backward()
        optimizer.step()
        optimizer.zero_grad()


def policy(loss, data):
    """The distribution that the loss's actor gives, with gradients to its parameters."""
    with loss.actor_network_params.to_module(loss.actor_network):
        return loss.actor_network.get_dist(data.select("observation"))


def old_policy(data):
    actor = make_actor()
    return actor.build_dist_from_params(data)


def actor_gradient(loss, value):
    parameters = list(loss.actor_network_params.values(True, True))
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, parameters)])


# ---------------------------------------------------------------- pure functions


def test_the_cost_surrogate_takes_the_larger_product():
    bounds = torch.tensor(0.8).log(), torch.tensor(1.2).log()
    log_weight = torch.tensor([[2.0], [0.5], [1.1]]).log()
    cost_advantage = torch.tensor([[1.0, -1.0], [1.0, -1.0], [3.0, -3.0]])
    surrogate = clipped_cost_surrogate(log_weight, cost_advantage, bounds)
    expected = torch.tensor([[2.0, -1.2], [0.8, -0.5], [3.3, -3.3]]) - cost_advantage
    torch.testing.assert_close(surrogate, expected)
    weighted = clipped_cost_surrogate(log_weight, cost_advantage, bounds, math.log(2.0))
    torch.testing.assert_close(weighted, 2 * expected)


def test_the_exact_penalty_is_nothing_below_and_linear_above_the_limit():
    surrogate, violation = torch.tensor([0.25, 0.25, -0.75]), torch.tensor([-6.0, 2.0, 4.0])
    penalty = exact_penalty(surrogate, violation, scale=0.125, coeff=20.0)
    assert penalty.tolist() == [0.0, 20 * 0.5, 0.0]


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


def test_the_projection_adds_scaled_costs_to_the_divergence():
    objective = projection_objective(
        kl=torch.tensor([[0.5], [0.0]]),
        ratio=torch.tensor([[2.0], [1.0]]),
        cost_advantage=torch.tensor([[1.0, 3.0], [-1.0, 2.0]]),
        lagrange_multiplier=torch.tensor([2.0, 0.5]),
        scale=4.0,
    )
    assert objective.tolist() == [[0.5 + 4 * 2 * 3.5], [4 * (-1.0)]]


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
def test_without_discount_the_length_of_an_episode_must_be_given(kind):
    with pytest.raises(ValueError, match=r"episode_length must be given.*gamma 1\.0"):
        build(kind).make_cost_value_estimator(gamma=1.0)
    loss = build(kind, episode_length=40)
    loss.make_cost_value_estimator(gamma=1.0)
    data = estimated(loss)
    step(loss, [1.0])
    assert loss(data)["loss_penalty"] > 0
    for value in (0, -1.0, float("nan"), "long"):
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


@pytest.mark.parametrize("name", ["cup", "p3o", "crpo"])
def test_without_a_limit_that_binds_it_trains_like_its_parent_bit_for_bit(name):
    loss, parent = build(UNBOUND[name], 2), parent_of(name)
    step(loss, [FAR, FAR])
    data = make_loss(2).estimate_advantages(make_batch(2)).reshape(-1)
    train(loss, data)
    train(parent, data)
    ours = (loss.loss_module if name == "crpo" else loss).actor_network_params
    expected = list(parent.actor_network_params.values(True, True))
    assert all(map(torch.equal, ours.values(True, True), expected))
    fresh = parent_of(name).actor_network_params.values(True, True)
    assert not any(map(torch.equal, fresh, expected))


def test_far_from_its_limits_ipo_has_no_force():
    loss, parent = build(IPOLoss, 2), parent_of("ipo")
    step(loss, [FAR, FAR])
    data = estimated(loss, 2)
    losses, expected = loss(data), parent(data)
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    assert actor_gradient(loss, losses["loss_penalty"]).abs().max() < 1e-20


# ---------------------------------------------------------------- what all of them share


@every_loss
def test_each_loss_trains_one_network(make):
    loss = build(make, 2)
    step(loss, [5.0, 1.0])
    data = estimated(loss, 2)
    expected = {"loss_critic": "critic", "loss_cost_critic": "cost_critic"}
    keys = [key for key, _ in loss(data).items() if key.startswith("loss_")]
    assert len(keys) >= 4
    for key in keys:
        loss.zero_grad()
        loss(data)[key].backward()
        reached = {
            name.removeprefix("loss_module.").split("_network")[0]
            for name, p in loss.named_parameters()
            if p.grad is not None and p.grad.any()
        }
        assert reached == {expected.get(key, "actor")}, key


@every_loss
def test_the_loss_writes_nothing_into_its_input(make):
    loss, batch = build(make, 2), make_batch(2)
    step(loss, [5.0, 1.0])
    before = batch.clone()
    loss(batch)
    assert set(batch.keys(True)) == set(before.keys(True))
    assert (batch == before).all()


NESTED = {
    "advantage": ("estimates", "a"),
    "value_target": ("estimates", "t"),
    "value": ("estimates", "v"),
    "cost_advantage": ("estimates", "ca"),
    "cost_value_target": ("estimates", "ct"),
    "cost_value": ("estimates", "cv"),
    "reward": ("info", "reward"),
    "cost": ("info", "cost"),
}


@every_loss
def test_all_keys_can_be_nested(make):
    networks = make_networks(2, keys=NESTED)
    loss, expected = make(*networks, num_costs=2), build(make, 2)
    loss.set_keys(**NESTED)
    assert ("next", "info", "cost") in loss.in_keys
    batch = make_batch(2)
    for key in ("reward", "cost"):
        batch["next"].rename_key_(key, ("info", key))
    step(loss, [5.0, 1.0])
    step(expected, [5.0, 1.0])
    losses, outputs = loss(estimated_in(loss, batch)), expected(estimated(expected, 2))
    assert set(losses.keys()) == set(outputs.keys())
    for key, value in outputs.items():
        assert torch.equal(losses[key], value), key


def estimated_in(loss, batch):
    return loss.estimate_advantages(batch).reshape(-1)


@every_loss
def test_call_with_keywords_equals_call_with_tensordict(make):
    loss, batch = build(make, 2), make_batch(2)
    step(loss, [5.0, 1.0])
    expected = loss(batch)
    keys = {"_".join(k) if isinstance(k, tuple) else k: k for k in map(unravel_key, loss.in_keys)}
    outputs = loss(**{name: batch[key] for name, key in keys.items()})
    for key, output in zip(loss.out_keys, outputs, strict=True):
        torch.testing.assert_close(output, expected[key])
    # TorchRL does not announce these two.
    assert set(expected.keys()) - set(loss.out_keys) <= {"explained_variance", "kl_approx"}


@every_loss
@pytest.mark.parametrize("used", ["saved", "loaded"])
def test_state_goes_between_a_fresh_and_a_used_loss(make, used):
    saved, loaded = build(make, 2), build(make, 2, seed=5)
    saved.make_cost_value_estimator(gamma=0.5)
    step(saved, [5.0, 1.0])
    batch = make_batch(2)
    {"saved": saved, "loaded": loaded}[used](batch)
    assert loaded.load_state_dict(saved.state_dict(), strict=True)
    expected = saved(batch)
    for twin in (loaded, copy.deepcopy(saved)):
        outputs = twin(batch)
        for key, value in expected.items():
            assert torch.equal(outputs[key], value), key


@every_loss
def test_cast_to_double(make):
    loss = build(make, 2).to(torch.float64)
    step(loss, [5.0, 1.0])
    batch = make_batch(2).apply(lambda x: x.double() if x.is_floating_point() else x)
    losses = loss(estimated_in(loss, batch))
    assert {v.dtype for k, v in losses.items() if k.startswith("loss_")} == {torch.float64}


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
    "make", [PPOLagrangianLoss, TrustRegionLoss, FOCOPSLoss, CUPLoss, P3OLoss, IPOLoss]
)
def test_an_argument_that_does_not_exist_is_refused(make):
    """TorchRL's PPOLoss would ignore it, a limit too."""
    with pytest.raises(TypeError, match=r"unexpected arguments: clip_epsilom, cost_limit"):
        make(*make_networks(), cost_limit=25.0, clip_epsilom=0.1)


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
    for summed in (0, 1, 2):
        old, new = (Independent(Categorical(logits=each), summed) for each in logits)
        torch.testing.assert_close(divergence(old, new), kl_divergence(old, new))


def test_the_divergence_of_categories_is_pytorchs():
    old, new = (torch.distributions.Categorical(logits=torch.randn(5, 3)) for _ in range(2))
    assert torch.equal(divergence(old, new), kl_divergence(old, new))
    # What the new policy excludes and the old one does not is infinitely far away.
    excluding = torch.distributions.Categorical(probs=torch.tensor([0.5, 0.5, 0.0]))
    everything = torch.distributions.Categorical(probs=torch.ones(3))
    assert divergence(everything, excluding) == kl_divergence(everything, excluding) == math.inf
