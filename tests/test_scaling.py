"""How advantages are scaled, and that nothing learnt depends on the units of reward and cost."""

import copy
import math

import pytest
import torch
from on_policy import make_loss
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.objectives import (
    CPO,
    CRPOLoss,
    IPOLoss,
    LagrangianLoss,
    P3OLoss,
    PIDControl,
    PPOLagrangianLoss,
    TrustRegionLoss,
    TrustRegionStep,
    cost_advantage_scale,
    scaled_advantages,
)
from torchrl_safe.testing import make_batch, make_networks

# ---------------------------------------------------------------- the scale


def test_the_scale_is_the_deviation_of_each_cost():
    cost = torch.tensor([[1.0, 10.0], [5.0, 10.0]])
    expected = torch.tensor([math.sqrt(8), 0.0])
    torch.testing.assert_close(cost_advantage_scale(torch.zeros(2), cost), expected)
    reshaped = torch.tensor([[[1.0], [3.0]], [[5.0], [7.0]]])
    scale = cost_advantage_scale(torch.zeros(1), reshaped)
    torch.testing.assert_close(scale, reshaped.flatten().std().reshape(1))


def test_it_falls_slowly_and_rises_at_once():
    small, large = torch.tensor([[1.0], [-1.0]]), torch.tensor([[9.0], [-9.0]])
    scale = cost_advantage_scale(torch.tensor([10.0]), small, memory=0.9)
    torch.testing.assert_close(scale, torch.tensor([0.9 * 10 + 0.1 * math.sqrt(2)]))
    scale = cost_advantage_scale(scale, large, memory=0.9)
    torch.testing.assert_close(scale, torch.tensor([math.sqrt(162)]))


def test_it_falls_under_autocast_too():
    """In bfloat16 a step of 2 % of a small difference would be rounded away."""
    scale, cost = torch.ones(1), 0.85 * torch.tensor([[1.0], [-1.0]]).bfloat16() / math.sqrt(2)
    for _ in range(300):
        scale = cost_advantage_scale(scale, cost)
    assert scale.dtype == torch.float32
    assert scale.item() == pytest.approx(0.85, rel=0.01)


def test_steps_that_do_not_count_have_no_share_in_it():
    cost = torch.tensor([[1.0], [1000.0], [5.0], [float("nan")]])
    counted = torch.tensor([[True], [False], [True], [False]])
    scale = cost_advantage_scale(torch.zeros(1), cost, counted)
    torch.testing.assert_close(scale, torch.tensor([math.sqrt(8)]))


@pytest.mark.parametrize("unit", [1e-30, 1e-3, 1e3, 1e30])
def test_it_has_the_unit_of_the_cost(unit):
    cost = torch.randn(50, 1, generator=torch.Generator().manual_seed(0))
    plain = cost_advantage_scale(torch.zeros(1), cost)
    torch.testing.assert_close(cost_advantage_scale(torch.zeros(1), unit * cost), unit * plain)
    divided = scaled_advantages(cost, unit * cost, cost_scale=unit * plain)[1]
    torch.testing.assert_close(divided.std(0), torch.ones(1))


def test_a_cost_without_advantage_stays_zero():
    cost = torch.full((4, 1), 3.0)
    scale = cost_advantage_scale(torch.zeros(1), cost)
    assert scale == 0
    assert torch.equal(scaled_advantages(cost, cost, cost_scale=scale)[1], torch.zeros(4, 1))
    assert cost_advantage_scale(torch.zeros(1), torch.tensor([[3.0]])) == 0


# ---------------------------------------------------------------- in a loss


def test_estimated_advantages_are_divided_by_the_scale_that_the_loss_keeps():
    loss, plain = make_loss(2), make_loss(2, normalize_cost_advantage=False)
    batch = loss.estimate_advantages(make_batch(2))
    advantage = batch["cost_advantage"].flatten(0, 1)
    torch.testing.assert_close(advantage.std(0), torch.ones(2))
    raw = plain.estimate_advantages(make_batch(2))["cost_advantage"].flatten(0, 1)
    torch.testing.assert_close(advantage * loss.cost_advantage_scale, raw)
    # The next batch has a tenth of the costs: its advantages count for less, not for as much.
    scale, fewer = loss.cost_advantage_scale.clone(), make_batch(2)
    fewer["next", "cost"] *= 0.1
    seen = plain.estimate_advantages(fewer.clone())["cost_advantage"].flatten(0, 1)
    loss.estimate_advantages(fewer)
    torch.testing.assert_close(loss.cost_advantage_scale, 0.98 * scale + 0.02 * seen.std(0))
    torch.testing.assert_close(
        fewer["cost_advantage"].flatten(0, 1) * loss.cost_advantage_scale, seen
    )


def test_a_loss_without_advantages_scales_them_too():
    loss = make_loss(2, multiplier_init=1.0)
    twin = make_loss(2, multiplier_init=1.0)
    estimated = twin(twin.estimate_advantages(make_batch(2)))
    torch.testing.assert_close(loss(make_batch(2))["loss_objective"], estimated["loss_objective"])
    assert torch.equal(loss.cost_advantage_scale, twin.cost_advantage_scale)


def test_the_scale_is_part_of_the_state():
    loss = make_loss(2)
    loss.estimate_advantages(make_batch(2))
    restored = make_loss(2, seed=3)
    restored.load_state_dict(copy.deepcopy(loss.state_dict()))
    fewer = make_batch(2)
    fewer["next", "cost"] *= 0.1
    expected = loss.estimate_advantages(fewer.clone())["cost_advantage"]
    assert torch.equal(restored.estimate_advantages(fewer.clone())["cost_advantage"], expected)
    assert "cost_advantage_scale" not in make_loss(2, normalize_cost_advantage=False).state_dict()


def test_a_wrapped_loss_does_the_same():
    actor, critic, cost_critic = make_networks(2)
    wrapped = LagrangianLoss(
        ClipPPOLoss(actor, critic, entropy_bonus=False),
        cost_critic,
        num_costs=2,
        multiplier_init=0.7,
    )
    loss = make_loss(2, multiplier_init=0.7, entropy_bonus=False)
    ours, theirs = (each(make_batch(2))["loss_objective"] for each in (wrapped, loss))
    assert torch.equal(ours, theirs)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_crpo_takes_the_same_steps_in_any_unit_of_the_cost(unit):
    """Beside steps for the reward: their sizes are in proportion to nothing."""
    gradients = []
    for factor in (1.0, unit):
        actor, critic, cost_critic = make_networks()
        for parameter in [*cost_critic.parameters()][-2:]:  # Of its last layer.
            parameter.data.mul_(factor)
        loss = CRPOLoss(ClipPPOLoss(actor, critic, entropy_bonus=False), cost_critic)
        loss.cost_violation.fill_(factor)
        data = make_batch(1)
        data["next", "cost"] *= factor
        data = loss.estimate_advantages(data)
        gradients.append(torch.autograd.grad(loss(data)["loss_objective"], actor.parameters()))
    for one, two in zip(*gradients, strict=True):
        assert one.norm() > 1e-3
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("make", [P3OLoss, IPOLoss])
def test_losses_that_read_a_violation_keep_the_unit_of_the_cost(make):
    with pytest.raises(TypeError, match="normalize_cost_advantage is not supported"):
        make(*make_networks(), normalize_cost_advantage=True)
    with pytest.raises(TypeError, match="normalize_cost_advantage must be True or False, got 1"):
        make_loss(normalize_cost_advantage=1)


def test_cpo_takes_the_same_step_in_any_unit_of_the_cost_advantage():
    moved = []
    for normalize in (False, True):
        networks = make_networks()
        loss = TrustRegionLoss(*networks, entropy_bonus=False, normalize_cost_advantage=normalize)
        before = [p.detach().clone() for p in networks[0].parameters()]
        loss.cost_violation.fill_(3.0)
        step = TrustRegionStep(loss, CPO(), max_kl=0.01, episode_length=20.0)
        assert step.step(loss.estimate_advantages(make_batch()).reshape(-1))["step_fraction"] > 0
        after = loss.actor_network_params.parameters()
        moved.append([new - old for new, old in zip(after, before, strict=True)])
    torch.testing.assert_close(moved[0], moved[1], rtol=1e-3, atol=1e-6)


# ---------------------------------------------------------------- a whole run

STEPS = 6


class Corridor:
    """Episodes of six steps, which a policy that always hurries ends at 9 and a cost of 2.5 and 6.

    An action 1 pays the number of the step, up to 3, and costs 1 in the second half; a second cost
    is 1 for each such action. The observation is the number of the step, one-hot.
    """

    def __init__(self, reward_unit, cost_unit):
        self.reward_unit, self.cost_unit = reward_unit, torch.tensor(cost_unit)

    def collect(self, actor, episodes=64):
        observation = torch.eye(STEPS + 1).expand(episodes, -1, -1)
        data = TensorDict(observation=observation[:, :-1].clone(), batch_size=[episodes, STEPS])
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            actor(data)
        hurry, index = data["action"][..., 1:].float(), torch.arange(STEPS).unsqueeze(-1)
        cost = torch.cat([hurry * (index >= 3), hurry], -1)
        done = (index == STEPS - 1).expand(episodes, -1, -1).clone()
        data["next"] = TensorDict(
            observation=observation[:, 1:].clone(),
            reward=self.reward_unit * hurry * index.clamp_max(3),
            cost=self.cost_unit * cost,
            done=done,
            terminated=done,
            batch_size=data.batch_size,
        )
        return data


def train(reward_unit=1.0, cost_unit=(1.0, 1.0), batches=80):
    """PPO-Lagrangian with tabular critics; returns each batch's multipliers, reward and costs."""
    torch.manual_seed(0)
    corridor = Corridor(reward_unit, cost_unit)

    def table(outputs):
        net = torch.nn.Linear(STEPS + 1, outputs, bias=False)
        torch.nn.init.zeros_(net.weight)
        return net

    actor = ProbabilisticActor(
        TensorDictModule(table(2), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(table(1), in_keys=["observation"])
    cost_critic = ValueOperator(table(2), in_keys=["observation"], out_keys=["cost_value"])
    loss = PPOLagrangianLoss(
        actor,
        critic,
        cost_critic,
        num_costs=2,
        entropy_bonus=False,
        loss_critic_type="l2",
    )
    updater = PIDControl(loss, cost_limit=torch.tensor([0.8, 3.0]) * corridor.cost_unit)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
    rows = []
    for _ in range(batches):
        data = corridor.collect(actor)
        sums = data["next"].select("reward", "cost").sum(1)
        updater.step(sums["cost"])
        data = loss.estimate_advantages(data).reshape(-1)
        for _ in range(4):
            losses = loss(data)
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optimizer.step()
            optimizer.zero_grad()
        mean = torch.cat([sums["reward"].mean(0) / reward_unit, sums["cost"].mean(0)])
        mean[1:] /= corridor.cost_unit
        rows.append(torch.cat([loss.lagrange_multiplier, mean]))
    return torch.stack(rows)


@pytest.fixture(scope="module")
def plain():
    return train()


@pytest.mark.integration
def test_both_limits_are_kept(plain):
    multipliers, costs = plain[-20:, :2].mean(0), plain[-20:, 3:].mean(0)
    assert (costs <= torch.tensor([0.8, 3.0])).all()
    assert (costs > torch.tensor([0.5, 2.0])).all()
    assert multipliers.max() > 0.1
    # Without multipliers neither is.
    assert (plain[:, 3:].amax(0) > torch.tensor([0.8, 3.0])).all()


@pytest.mark.integration
@pytest.mark.parametrize(
    "units",
    [
        {"cost_unit": (1000.0, 1000.0)},
        {"cost_unit": (0.001, 0.001)},
        {"cost_unit": (1000.0, 0.001)},
        {"reward_unit": 100.0},
        {"reward_unit": 0.01, "cost_unit": (0.001, 1000.0)},
    ],
    ids=["costs-1000", "costs-0.001", "apart", "rewards-100", "all"],
)
def test_the_same_run_in_any_unit(plain, units):
    """The same multipliers, returns and costs, batch for batch, to rounding."""
    torch.testing.assert_close(train(**units), plain, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_batch_with_a_number_that_is_none_does_not_change_the_scale(value):
    """In that column: it would be NaN for ever, and nothing would be scaled any more."""
    past, cost = torch.tensor([2.0, 0.0]), torch.tensor([[1.0, 1.0], [value, 5.0]])
    expected = torch.tensor([2.0, math.sqrt(8)])
    torch.testing.assert_close(cost_advantage_scale(past, cost), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("make", [PPOLagrangianLoss, TrustRegionLoss])
def test_costs_in_double_precision(make, dtype):
    """NumPy's own; and networks in double precision, as TorchRL's losses take them."""
    networks = [network.to(dtype) for network in make_networks(2)]
    loss = make(*networks, num_costs=2)
    batch = make_batch(2).apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    batch["next", "cost"] = batch["next", "cost"].double()
    data = loss.estimate_advantages(batch)
    torch.testing.assert_close(data["cost_advantage"].flatten(0, -2).std(0), torch.ones(2).double())
    assert all(value.isfinite().all() for value in loss(data.reshape(-1)).values())
