"""PPOLagrangianLoss: what it shares with ClipPPOLoss and what it adds."""

import re
from functools import partial

import pytest
import torch
from on_policy import (
    TRAINS,
    assert_close_outputs,
    assert_same_outputs,
    estimated,
    make_loss,
    make_trunk,
    networks_with_gradient,
    parameters,
    train,
)
from torch.nn.functional import smooth_l1_loss
from torchrl.objectives import ClipPPOLoss, SoftUpdate
from torchrl.objectives.value import GAE

from torchrl_safe.objectives import CostGAE, PPOLagrangianLoss, penalized_advantage
from torchrl_safe.objectives.functional import centred
from torchrl_safe.testing import check_equals_at_zero, make_batch, make_critic, make_networks


def make_clip_loss(seed=0, **kwargs):
    actor, critic, _ = make_networks(seed=seed)
    return ClipPPOLoss(actor, critic, **kwargs)


def gradient(loss, network):
    return torch.cat([p.grad.flatten() for p in parameters(loss, network)])


# ---------------------------------------------------------------- multiplier zero: ClipPPOLoss


OPTIONS = {
    "default": {},
    "normalize_advantage": {"normalize_advantage": True},
    "clip_value": {"clip_value": 0.1},
    "clip_value_as_epsilon": {"clip_value": True},
    "asymmetric_clip": {"clip_epsilon": (0.1, 0.3)},
    "reduction_none": {"reduction": "none"},
    "reduction_sum": {"reduction": "sum"},
    "not_functional": {"functional": False},
    "separate_losses": {"separate_losses": True},
    "no_entropy": {"entropy_bonus": False},
    "entropy_coeff": {"entropy_coeff": 0.3},
    "critic_l2": {"loss_critic_type": "l2"},
    "critic_coeff": {"critic_coeff": 0.25},
    "delay_actor": {"delay_actor": True},
    "max_importance_ratio": {"max_importance_ratio": 1.1},
}


def make_pair(num_costs, **options):
    pair = make_loss(num_costs, **options), make_clip_loss(**options)
    if options.get("delay_actor"):
        for loss in pair:
            SoftUpdate(loss, eps=0.5)
            with torch.no_grad():  # A proximal policy that differs from the trained one.
                for parameter in parameters(loss, "actor"):
                    parameter.add_(0.05)
    return pair


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_multiplier_zero_is_clip_ppo_bit_for_bit(options, precomputed, num_costs):
    loss, clip_loss = make_pair(num_costs, **options)
    batch = make_batch(num_costs)
    if precomputed:
        batch = loss.estimate_advantages(batch).reshape(-1)
    losses = loss(batch.clone())
    if not precomputed:  # Where there are no advantages, the loss does this itself.
        batch = loss.estimate_advantages(batch)
    expected = clip_loss(batch)
    assert_same_outputs(losses, expected)
    # The data exercise what is compared: ratios are clipped, nothing is zero by accident.
    assert expected["clip_fraction"] > 0 or "delay_actor" in options
    assert expected["loss_objective"].abs().max() > 0
    extra = {"loss_cost_critic", "cost_explained_variance"}
    extra |= {f"lagrange_multiplier_{index}" for index in range(num_costs)}
    extra |= {"cost_value_clip_fraction"} if "clip_value" in options else set()
    assert set(losses.keys()) == set(expected.keys()) | extra


@pytest.mark.parametrize(
    "options",
    [{}, {"normalize_advantage": True, "clip_value": 0.1}, {"functional": False}],
    ids=["default", "normalized-and-clipped", "not-functional"],
)
def test_multiplier_zero_trains_like_clip_ppo_bit_for_bit(options):
    """And trains the critic of the costs."""
    check_equals_at_zero(partial(PPOLagrangianLoss, **options), partial(ClipPPOLoss, **options))
    loss = make_loss(2, **options)
    before = [p.detach().clone() for p in parameters(loss, "cost_critic")]
    train(loss, estimated(loss, 2), updates=1)
    assert not any(map(torch.equal, before, parameters(loss, "cost_critic")))


# ---------------------------------------------------------------- the mixed objective


@pytest.mark.parametrize("normalize", [False, True], ids=["as-given", "normalize_advantage"])
def test_three_costs_mix_into_one_advantage(normalize):
    multiplier = torch.tensor([0.5, 0.0, 2.0])
    loss = make_loss(3, multiplier_init=multiplier, normalize_advantage=normalize)
    data = estimated(loss, 3)
    advantage = data["advantage"] = 3 * data["advantage"] + 1
    if normalize:  # The reward advantage is normalized, then mixed: never the mixture.
        advantage = (advantage - advantage.mean()) / advantage.std()
    losses = loss(data)
    data["advantage"] = penalized_advantage(advantage, data["cost_advantage"], multiplier)
    expected = make_clip_loss()(data)
    assert_close_outputs(losses.select(*expected.keys()), expected)


@pytest.mark.parametrize("column", [0, 2])
def test_a_very_large_multiplier_minimizes_its_cost(column):
    loss, clip_loss = make_loss(3), make_clip_loss()
    data = estimated(loss, 3)
    loss.lagrange_multiplier[column] = 1e7
    loss(data)["loss_objective"].backward()
    data["advantage"] = -data["cost_advantage"][:, column : column + 1]
    clip_loss(data)["loss_objective"].backward()
    ours, theirs = gradient(loss, "actor"), gradient(clip_loss, "actor")
    assert theirs.norm() > 1e-3
    torch.testing.assert_close(ours / ours.norm(), theirs / theirs.norm(), atol=1e-4, rtol=1e-4)


def test_the_multiplier_means_the_same_in_every_minibatch():
    loss = make_loss(3, multiplier_init=torch.tensor([2.0, 0.0, 0.5]))
    data = estimated(loss, 3)
    whole = loss(data)
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(0))
    parts = [loss(data[rows]) for rows in order.split(len(data) // 4)]
    for key in TRAINS:
        mean = torch.stack([part[key] for part in parts]).mean()
        torch.testing.assert_close(mean, whole[key])


# ---------------------------------------------------------------- advantages


@pytest.mark.parametrize("num_costs", [1, 3])
def test_reward_is_standardized_and_costs_are_centred_over_the_whole_batch(num_costs):
    loss = make_loss(num_costs, normalize_cost_advantage=False)
    batch = make_batch(num_costs)
    assert loss.estimate_advantages(batch) is batch
    raw = make_batch(num_costs)
    _, critic, cost_critic = make_networks(num_costs)
    with torch.no_grad():
        GAE(gamma=0.99, lmbda=0.95, value_network=critic)(raw)
        CostGAE(gamma=0.99, lmbda=0.95, value_network=cost_critic)(raw)
    reward, cost = raw["advantage"], raw["cost_advantage"]
    torch.testing.assert_close(batch["advantage"], (reward - reward.mean()) / reward.std())
    torch.testing.assert_close(batch["cost_advantage"], cost - cost.mean((0, 1)))
    # The whole batch, not each row; and the costs keep a spread of their own.
    assert (batch["cost_advantage"].mean(1).abs() > 1e-3).all()
    assert ((batch["cost_advantage"].flatten(0, 1).std(0) - 1).abs() > 0.02).all()
    for key in ("value_target", "cost_value_target"):
        torch.testing.assert_close(batch[key], raw[key])
    assert not any(value.requires_grad for value in batch.values(True, True))


def test_estimating_changes_nothing_else_in_the_batch():
    loss, batch = make_loss(2), make_batch(2)
    loss.estimate_advantages(batch)
    untouched = make_batch(2)
    assert (batch.select(*untouched.keys(True, True)) == untouched).all()
    assert batch.names == [None, "time"]


def test_estimating_again_follows_the_critics():
    loss, batch = make_loss(2), make_batch(2)
    before = loss.estimate_advantages(batch).clone()
    again = loss.estimate_advantages(batch).clone()
    loss.cost_critic_network_params.apply_(lambda p: p.data.mul_(2.0))
    after = loss.estimate_advantages(batch)
    for key in ("cost_advantage", "cost_value_target"):
        assert torch.equal(again[key], before[key])
        assert ((after[key] - before[key]).abs() > 1e-3).any()
    assert torch.equal(after["advantage"], before["advantage"])


@pytest.mark.parametrize("parameter", ["gamma", "lmbda"])
@pytest.mark.parametrize("moved", ["advantage", "cost_advantage"])
def test_discount_and_trace_decay_act_on_their_own_advantage_only(moved, parameter):
    loss = make_loss(2)
    before = loss.estimate_advantages(make_batch(2))
    if moved == "advantage":
        loss.make_value_estimator(**{parameter: 0.5})
    else:
        loss.make_cost_value_estimator(**{parameter: 0.5})
    after = loss.estimate_advantages(make_batch(2))
    for key, target in (("advantage", "value_target"), ("cost_advantage", "cost_value_target")):
        for name in (key, target):
            change = (after[name] - before[name]).abs()
            assert (change.max() > 0.05) if key == moved else (change == 0).all()


def test_the_cost_discount_is_the_one_asked_for():
    loss = make_loss(2, normalize_cost_advantage=False)
    loss.make_cost_value_estimator(gamma=0.5, lmbda=0.25)
    batch, expected = loss.estimate_advantages(make_batch(2)), make_batch(2)
    _, _, cost_critic = make_networks(2)
    with torch.no_grad():
        CostGAE(gamma=0.5, lmbda=0.25, value_network=cost_critic)(expected)
    expected = centred(expected["cost_advantage"])
    torch.testing.assert_close(batch["cost_advantage"], expected)


def test_an_estimator_can_be_passed():
    loss = make_loss(normalize_cost_advantage=False)
    loss.set_keys(cost_advantage="renamed")
    estimator = GAE(gamma=0.9, lmbda=0.5, value_network=loss.cost_critic_network)
    loss.make_cost_value_estimator(estimator)
    assert loss.cost_value_estimator is estimator
    batch = loss.estimate_advantages(make_batch())
    expected = make_batch()
    _, _, cost_critic = make_networks()
    with torch.no_grad():
        CostGAE(gamma=0.9, lmbda=0.5, value_network=cost_critic)(expected)
    torch.testing.assert_close(batch["renamed"], centred(expected["cost_advantage"]))


def test_estimator_and_hyperparameters_exclude_each_other():
    estimator = CostGAE(gamma=0.9, lmbda=0.5, value_network=None)
    with pytest.raises(ValueError, match="'gamma'"):
        make_loss().make_cost_value_estimator(estimator, gamma=0.9)


# ---------------------------------------------------------------- the cost critic's loss


def cost_values(data, num_costs):
    _, _, cost_critic = make_networks(num_costs)
    return cost_critic(data.select("observation"))["cost_value"]


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_cost_critic_loss_is_the_sum_over_costs(reduction):
    loss = make_loss(3, cost_critic_coeff=0.5, reduction=reduction)
    data = estimated(loss, 3)
    value, target = cost_values(data, 3), data["cost_value_target"]
    each = 0.5 * smooth_l1_loss(value, target, reduction="none").sum(-1)
    expected = {"mean": each.mean(), "sum": each.sum(), "none": each}[reduction]
    torch.testing.assert_close(loss(data)["loss_cost_critic"], expected)


def test_cost_values_are_clipped_like_values():
    loss = make_loss(3, clip_value=0.1)
    data = estimated(loss, 3)
    old = data["cost_value"] = data["cost_value"] + 0.2 * torch.randn(len(data), 3)
    value, target = cost_values(data, 3), data["cost_value_target"]
    clipped = old + (value - old).clamp(-0.1, 0.1)
    worst = torch.maximum(
        smooth_l1_loss(value, target, reduction="none"),
        smooth_l1_loss(clipped, target, reduction="none"),
    )
    losses = loss(data)
    torch.testing.assert_close(losses["loss_cost_critic"], worst.sum(-1).mean())
    fraction = ((value - old).abs() > 0.1).float().mean()
    assert 0 < fraction < 1
    torch.testing.assert_close(losses["cost_value_clip_fraction"], fraction)


def test_cost_explained_variance_is_the_mean_over_costs():
    loss = make_loss(3)
    data = estimated(loss, 3)
    error = data["cost_value_target"] - cost_values(data, 3)
    expected = (1 - error.var(0) / data["cost_value_target"].var(0)).mean()
    torch.testing.assert_close(loss(data)["cost_explained_variance"], expected.detach())


def test_coefficient_can_be_scheduled():
    loss = make_loss()
    data = estimated(loss)
    whole = loss(data)["loss_cost_critic"]
    loss.cost_critic_coeff = 0.25
    torch.testing.assert_close(loss(data)["loss_cost_critic"], 0.25 * whole)
    assert "cost_critic_coeff" in loss.state_dict()


def test_reward_and_costs_have_one_dimension_of_time():
    loss = make_loss(2)
    loss.make_value_estimator(time_dim=0)
    batch = make_batch(2)
    batch.names = None
    with pytest.raises(ValueError, match=r"time_dim must be the same .* costs, got 0 and 1: pass"):
        loss.estimate_advantages(batch)
    loss.make_cost_value_estimator(time_dim=-2)
    loss.estimate_advantages(batch)


def test_one_advantage_without_the_other_is_refused():
    loss = make_loss()
    for key in ("advantage", "cost_advantage"):
        data = estimated(loss)
        del data[key]
        with pytest.raises(KeyError, match=f"'{key}'.* only the other advantage"):
            loss(data)


def test_a_cost_critic_that_does_not_fit_is_refused():
    """Also with targets given, and with the values of another critic in the data."""
    actor, critic, _ = make_networks()
    data = estimated(make_loss(2), 2)
    narrow = PPOLagrangianLoss(actor, critic, make_critic("cost_value", 1), num_costs=2)
    with pytest.raises(ValueError, match=r"'cost_value' must .* 2 costs .* \(24, 1\)"):
        narrow(data)
    astray = PPOLagrangianLoss(actor, critic, make_critic("state_value", 2), num_costs=2)
    with pytest.raises(KeyError, match="'cost_value'"):
        astray(data)


def test_advantages_need_a_critic_of_the_reward():
    actor, _, cost_critic = make_networks()
    loss = PPOLagrangianLoss(actor, None, cost_critic)
    with pytest.raises(ValueError, match="critic_network must be given to estimate advantages"):
        loss.estimate_advantages(make_batch())


def test_explained_variance_can_be_left_out():
    loss = make_loss(log_explained_variance=False)
    losses = loss(estimated(loss))
    assert not any("explained_variance" in key for key in [*losses.keys(), *loss.out_keys])


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
@pytest.mark.parametrize("name", TRAINS)
def test_each_loss_trains_one_network(name, precomputed, functional):
    loss = make_loss(2, multiplier_init=0.7, functional=functional)
    batch = estimated(loss, 2) if precomputed else make_batch(2)
    losses = loss(batch)
    assert {key for key, value in losses.items() if value.requires_grad} == set(TRAINS)
    losses[name].sum().backward()
    assert networks_with_gradient(loss) == {TRAINS[name]}


@pytest.mark.parametrize("separate", [True, False], ids=["separate_losses", "joint"])
@pytest.mark.parametrize("name", ["loss_critic", "loss_cost_critic"])
def test_critics_train_no_encoder_outside_the_loss_with_separate_losses(name, separate):
    loss = make_loss(2, separate_losses=separate)
    data = estimated(loss, 2)
    encoded = data["observation"] = data["observation"].requires_grad_()
    loss(data)[name].backward()
    assert (encoded.grad is None) == separate


def test_separate_losses_change_no_value():
    """test_ppo_cases.py has what a shared trunk is trained by."""
    joint, separate = (
        PPOLagrangianLoss(*make_trunk(2)[0], num_costs=2, separate_losses=each)
        for each in (False, True)
    )
    data = estimated(joint, 2)
    assert_same_outputs(separate(data), joint(data))


# ---------------------------------------------------------------- the multiplier


def test_the_multiplier_is_a_buffer_and_no_parameter():
    loss = make_loss(2, multiplier_init=1.5)
    assert "lagrange_multiplier" in dict(loss.named_buffers())
    assert not any("multiplier" in name for name, _ in loss.named_parameters())
    optimizer = torch.optim.Adam(loss.parameters(), lr=1.0)
    losses = loss(estimated(loss, 2))
    sum(losses[key] for key in TRAINS).backward()
    optimizer.step()
    assert loss.lagrange_multiplier.tolist() == [1.5, 1.5]
    assert loss.lagrange_multiplier.grad is None


def test_a_number_can_be_assigned_to_the_multiplier():
    loss = make_loss(2)
    address = loss.lagrange_multiplier.data_ptr()
    loss.lagrange_multiplier = 0.5
    assert loss.lagrange_multiplier.tolist() == [0.5, 0.5]
    assert loss.lagrange_multiplier.data_ptr() == address


def test_multipliers_are_reported_as_scalars_of_their_own():
    loss = make_loss(3, multiplier_init=torch.tensor([0.1, 0.2, 0.3]))
    losses = loss(estimated(loss, 3))
    loss.lagrange_multiplier.fill_(9.0)
    reported = torch.stack([losses[f"lagrange_multiplier_{index}"] for index in range(3)])
    torch.testing.assert_close(reported, torch.tensor([0.1, 0.2, 0.3]))


@pytest.mark.parametrize("init", [0.5, torch.tensor(0.5), torch.full((2,), 0.5)])
def test_multiplier_init_is_one_number_or_one_for_each_cost(init):
    loss = make_loss(2, multiplier_init=init)
    loss.lagrange_multiplier.add_(1.0)
    assert loss.lagrange_multiplier.tolist() == [1.5, 1.5]
    assert torch.as_tensor(init).eq(0.5).all()


@pytest.mark.parametrize(
    "init",
    [-0.1, float("nan"), float("inf"), torch.tensor([1.0, -1.0])],
    ids=["negative", "nan", "inf", "one-negative"],
)
def test_multiplier_init_must_be_finite_and_not_negative(init):
    with pytest.raises(ValueError, match="multiplier_init must be a number from 0 to"):
        make_loss(2, multiplier_init=init)


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 1)], ids=str)
def test_multiplier_init_must_have_one_number_for_each_cost(shape):
    with pytest.raises(ValueError, match=rf"multiplier_init.* 2 costs.*{re.escape(str(shape))}"):
        make_loss(2, multiplier_init=torch.ones(shape))


@pytest.mark.parametrize("num_costs", [0, -1])
def test_there_is_at_least_one_cost(num_costs):
    with pytest.raises(ValueError, match=f"num_costs must be a whole number .* got {num_costs}"):
        PPOLagrangianLoss(*make_networks(), num_costs=num_costs)
