"""Saute and EarlyTermination: budgets by hand, in all kinds of environments."""

from functools import partial

import numpy as np
import pytest
import torch
from counting import CountingBatch, flagged, inside, with_costs
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import ArmEnv, CostToReward, EarlyTermination, Saute, Speed

# In step t of a CountingBatch: reward 10 t, cost t / 4; row r is truncated after r + 2 steps.
WRAPPED = {
    "plain": None,
    "serial": partial(SerialEnv, 2),
    "parallel": partial(ParallelEnv, 2, mp_start_method="fork"),
}


def build(make_env, transform, num_envs, wrap, outside, num_costs=1):
    """The transform around the worker's environment, or around all of them."""
    made = partial(with_costs, num_envs, num_costs)
    if not outside:
        made = partial(inside, transform, num_envs, num_costs)
    env = make_env(made if wrap is None else partial(wrap, made))
    # Nested, not unwrapped: outer parts see it as they see any other environment.
    return TransformedEnv(env, transform(), auto_unwrap=False) if outside else env


def columns(tensor, num_envs):
    """A rollout's entry as a list for each row, the same for every worker."""
    per_worker = tensor.reshape(-1, num_envs or 1, *tensor.shape[-2:]).squeeze(-1)
    assert (per_worker == per_worker[0]).all()
    return per_worker[0].tolist()


everywhere = [
    pytest.mark.parametrize("num_envs", [None, 2], ids=["single", "batched"]),
    pytest.mark.parametrize("wrap", WRAPPED.values(), ids=WRAPPED.keys()),
    pytest.mark.parametrize("outside", [False, True], ids=["inside", "outside"]),
]


def in_all_environments(test):
    for mark in everywhere:
        test = mark(test)
    return test


@in_all_environments
def test_saute(make_env, num_envs, wrap, outside):
    transform = partial(Saute, 0.5, unsafe_reward=-7.0)
    env = build(make_env, transform, num_envs, wrap, outside)
    check_env_specs(env)
    assert env.observation_spec["remaining_budget"] == Unbounded((*env.batch_size, 1))
    rollout = env.rollout(4, break_when_any_done=False)
    # Costs 0.25, 0.5, 0.75 against a budget of 0.5; each row starts anew where it is reset.
    left = columns(rollout["next", "remaining_budget"], num_envs)
    assert left == [[0.5, -0.5, 0.5, -0.5], [0.5, -0.5, -2.0, 0.5]][: len(left)]
    before = columns(rollout["remaining_budget"], num_envs)
    assert before == [[1.0, 0.5, 1.0, 0.5], [1.0, 0.5, -0.5, 1.0]][: len(before)]
    reward = columns(rollout["next", "reward"], num_envs)
    assert reward == [[10.0, -7.0, 10.0, -7.0], [10.0, -7.0, -7.0, 10.0]][: len(reward)]
    # The costs are as they were, and so are the ends of the episodes.
    assert columns(rollout["next", "cost"], num_envs)[0] == [0.25, 0.5, 0.25, 0.5]
    assert columns(rollout["next", "truncated"], num_envs)[0] == [False, True, False, True]
    assert not rollout["next", "terminated"].any()


def test_saute_discounts():
    """z' = (z - c / d) / gamma: above 1 where nothing is spent, and 0 just if all is."""
    env = inside(partial(Saute, 2.0, unsafe_reward=-7.0, discount=0.5), 2)
    left = env.rollout(3, break_when_any_done=False)["next", "remaining_budget"][1].flatten()
    first = (1 - 0.125) / 0.5
    second = (first - 0.25) / 0.5
    assert left.tolist() == [first, second, (second - 0.375) / 0.5]
    # It is at 0 where the discounted costs, 0.25 + 0.5 * 0.5 + 0.25 * 0.75, reach the budget.
    exact = inside(partial(Saute, 0.6875, unsafe_reward=-7.0, discount=0.5), 2)
    rollout = exact.rollout(3, break_when_any_done=False)[1]
    assert rollout["next", "remaining_budget"][-1].item() == pytest.approx(0.0, abs=1e-6)
    assert rollout["next", "reward"][-1].item() == 30.0
    below = inside(partial(Saute, 0.687, unsafe_reward=-7.0, discount=0.5), 2)
    rewards = below.rollout(3, break_when_any_done=False)["next", "reward"][1].flatten()
    assert rewards.tolist() == [10.0, 20.0, -7.0]


@pytest.mark.parametrize("budget", [10.0, 3.0, 7.0, 10_000.0])
def test_a_budget_that_is_just_used_up_is_not_exceeded_by_rounding(budget):
    saute = Saute(budget, unsafe_reward=-1.0)
    left = torch.ones(1, 1)
    for _ in range(int(budget)):
        left = saute.advance(left, torch.ones(1, 1))
        assert not saute.is_spent(left)
    assert saute.is_spent(saute.advance(left, torch.full((1, 1), 1e-3 * budget)))


@pytest.mark.parametrize(("discount", "count"), [(0.99, 4), (0.99, 200), (0.97, 50)])
def test_a_discount_does_not_let_rounding_grow(discount, count):
    """After four steps -3e-8 is left, which 0.99 would make -1e-4 in 806 more."""
    budget = sum(discount**step for step in range(count))
    saute = Saute(budget, unsafe_reward=-1.0, discount=discount)
    left = torch.ones(1, 1)
    for step in range(1500):
        left = saute.advance(left, torch.tensor([[1.0 if step < count else 0.0]]))
        assert not saute.is_spent(left)
    assert left.item() != 0
    assert saute.is_spent(saute.advance(left, torch.full((1, 1), 1e-3 * budget)))


def test_flags_use_up_a_budget_like_numbers():
    env = flagged(Saute(2.5, unsafe_reward=-7.0))
    check_env_specs(env)
    assert_close(env.rollout(3)["next", "remaining_budget"], torch.tensor([[0.6], [0.2], [-0.2]]))
    env = flagged(EarlyTermination(2.5))
    assert_close(env.rollout(3)["next", "accumulated_cost"], torch.tensor([[1.0], [2.0], [3.0]]))


def test_each_cost_has_its_budget():
    """Costs t/4, 100 + t/4 and 200 + t/4: one budget exceeded is enough."""
    budget = torch.tensor([0.25, 1000.0, 400.25])
    env = inside(partial(Saute, budget, unsafe_reward=-7.0), 2, num_costs=3)
    check_env_specs(env)
    rollout = env.rollout(3, break_when_any_done=False)[1]
    cost = rollout["next", "cost"]
    assert cost.shape == (3, 3)
    torch.testing.assert_close(
        rollout["next", "remaining_budget"], 1 - cost.cumsum(0) / budget, rtol=1e-5, atol=1e-5
    )
    assert rollout["next", "reward"].flatten().tolist() == [10.0, -7.0, -7.0]


def test_a_policy_sees_the_augmented_state(make_env):
    augment = CatTensors(["observation", "remaining_budget"], "augmented", del_keys=False)
    env = make_env(inside, partial(Saute, 0.5, unsafe_reward=-7.0), 2)
    env.append_transform(augment)
    check_env_specs(env)
    assert env.observation_spec["augmented"].shape == (2, 2)
    augmented = env.rollout(2)["augmented"]
    assert augmented[0].tolist() == [[0.0, 1.0], [1.0, 0.5]]


def test_a_missing_budget_is_named():
    env = inside(partial(Saute, 0.5, unsafe_reward=-7.0))
    env.append_transform(CatTensors(["observation", "remaining_budget"], "augmented"))
    with pytest.raises(KeyError, match=r"'remaining_budget' must come from the step .*del_keys"):
        env.rollout(2)


@in_all_environments
def test_early_termination(make_env, num_envs, wrap, outside):
    transform = partial(EarlyTermination, 0.7, termination_reward=-100.0)
    env = build(make_env, transform, num_envs, wrap, outside)
    check_env_specs(env)
    assert env.observation_spec["accumulated_cost"] == Unbounded((*env.batch_size, 1))
    rollout = env.rollout(4, break_when_any_done=False)
    # 0.25 + 0.5 exceeds 0.7: all rows end with their second step, whatever length they had.
    sums = columns(rollout["next", "accumulated_cost"], num_envs)
    assert sums == [[0.25, 0.75, 0.25, 0.75]] * len(sums)
    assert columns(rollout["accumulated_cost"], num_envs)[0] == [0.0, 0.25, 0.0, 0.25]
    for key in ("terminated", "done"):
        assert columns(rollout["next", key], num_envs) == [[False, True] * 2] * len(sums)
    # Row 0 would have been truncated in this step too; row 1 would have gone on.
    truncated = columns(rollout["next", "truncated"], num_envs)
    assert truncated == [[False, True] * 2, [False] * 4][: len(sums)]
    reward = columns(rollout["next", "reward"], num_envs)
    assert reward == [[10.0, -80.0] * 2] * len(sums)
    # The environment has been reset with the rows.
    assert columns(rollout["observation"], num_envs) == [[0.0, 1.0] * 2] * len(sums)


@pytest.mark.parametrize(("budget", "steps"), [(0.0, 1), (0.25, 2), (0.75, 3), (1.5, 3)])
def test_only_more_than_the_budget_ends_an_episode(budget, steps):
    env = inside(partial(EarlyTermination, budget), 2)
    rollout = env.rollout(3, break_when_any_done=False)[1]
    ends = rollout["next", "terminated"].flatten().tolist()
    assert ends[:steps] == [False] * (steps - 1) + [budget < 1.5]
    assert rollout["next", "reward"].flatten().tolist()[:steps] == [10.0, 20.0, 30.0][:steps]
    assert (
        rollout["next", "done"] == (rollout["next", "terminated"] | rollout["next", "truncated"])
    ).all()


@pytest.mark.parametrize(("budget", "count"), [(1.0, 10), (10.0, 1000)])
def test_a_budget_that_is_just_used_up_ends_no_episode_by_rounding(budget, count):
    """Ten times 0.1 is more than 1 in single precision."""
    ending = EarlyTermination(budget)
    tally = torch.zeros(1, 1)
    for _ in range(count):
        tally = ending.advance(tally, torch.full((1, 1), budget / count))
    assert tally > budget
    assert not ending.is_spent(tally)
    assert ending.is_spent(ending.advance(tally, torch.full((1, 1), 1e-3 * budget)))


def test_one_cost_of_several_ends_an_episode():
    budget = torch.tensor([99.0, 100.5, 1e4])
    env = inside(partial(EarlyTermination, budget), 2, num_costs=3)
    check_env_specs(env)
    rollout = env.rollout(2, break_when_any_done=False)[1]
    assert rollout["next", "accumulated_cost"][-1].tolist() == [0.75, 200.75, 400.75]
    assert rollout["next", "terminated"].flatten().tolist() == [False, True]


@pytest.mark.parametrize("first", [True, False], ids=["sum-first", "sum-last"])
@pytest.mark.parametrize("kind", ["saute", "early"])
def test_sums_are_of_the_rewards_at_their_place(make_env, kind, first):
    transform = {
        "saute": Saute(0.5, unsafe_reward=-7.0),
        "early": EarlyTermination(0.7, termination_reward=-100.0),
    }[kind]
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    env = make_env(with_costs, 2)
    for each in (sums, transform) if first else (transform, sums):
        env.append_transform(each)
    check_env_specs(env)
    rollout = env.rollout(4, break_when_any_done=False)
    done = rollout["next", "done"]
    lengths = {"saute": [2, 2, 3], "early": [2, 2, 2, 2]}[kind]
    assert rollout["next", "episode_cost"][done].tolist() == [n * (n + 1) / 8 for n in lengths]
    raw = [10.0 * n * (n + 1) / 2 for n in lengths]
    changed = {"saute": [3.0, 3.0, -4.0], "early": [-70.0] * 4}[kind]
    assert rollout["next", "episode_reward"][done].tolist() == (raw if first else changed)


def test_both_at_once(make_env):
    env = make_env(inside, partial(Saute, 0.5, unsafe_reward=-7.0), 2)
    env.append_transform(EarlyTermination(1.0))
    env.append_transform(StepCounter(max_steps=2))
    check_env_specs(env)
    rollout = env.rollout(4, break_when_any_done=False)
    assert rollout["next", "remaining_budget"][1].flatten().tolist() == [0.5, -0.5] * 2
    assert not rollout["next", "terminated"].any()


@pytest.mark.parametrize("shape", [(3, 1), (3,)], ids=str)
@pytest.mark.parametrize("kind", ["saute", "early"])
def test_a_reset_of_some_rows_leaves_the_others_alone(make_env, kind, shape):
    transform = {
        "saute": partial(Saute, 100.0, unsafe_reward=-7.0),
        "early": partial(EarlyTermination, 100.0),
    }[kind]
    # As many costs as rows: a mask along the wrong axis would fit.
    env = make_env(inside, transform, 3, num_costs=3)
    key = env.transform[-1].out_key
    following = env.step(env.rand_action(env.reset()))["next"].exclude("reward", "cost")
    moved = following[key].tolist()
    following["_reset"] = torch.tensor([False, True, False]).reshape(shape)
    after = env.reset(following.clone())[key]  # It takes the mask out of what it is given.
    start = {"saute": 1.0, "early": 0.0}[kind]
    assert after.tolist() == [moved[0], [start] * 3, moved[2]]
    # So do the transforms that come next, which see it before reset puts the rows together.
    seen = []

    class Look(Transform):
        def _reset(self, tensordict, tensordict_reset):
            seen.append(tensordict_reset[key].tolist())
            return tensordict_reset

    env.append_transform(Look())
    env.reset(following)
    assert seen == [[moved[0], [start] * 3, moved[2]]]


def test_in_a_collector(make_env):
    env = make_env(inside, partial(EarlyTermination, 0.7), 2)
    env.append_transform(RewardSum(["cost"], ["episode_cost"]))
    collector = Collector(env, frames_per_batch=8, total_frames=24)
    batches = list(collector)
    collector.shutdown()
    for batch in batches:  # Four steps of two rows: each ends an episode every other step.
        ends = batch["next", "episode_cost"][batch["next", "terminated"]]
        assert ends.tolist() == [0.75] * 4
        assert torch.equal(batch["next", "done"], batch["next", "terminated"])


def test_keys_can_be_nested(make_env):
    env = CountingBatch(2, costs={("safety", "a"): (2,)})
    env = make_env(TransformedEnv, env, CostToReward([("safety", "a")], [("limited", "cost")]))
    for transform, name in (
        (partial(Saute, 0.5, unsafe_reward=-7.0), "left"),
        (partial(EarlyTermination, 0.7), "used"),
    ):
        env.append_transform(transform(cost_key=("limited", "cost"), out_key=("budgets", name)))
    check_env_specs(env)
    rollout = env.rollout(2)[1]["next", "budgets"]
    assert rollout["left"].flatten().tolist() == [0.5, -0.5]
    assert rollout["used"].flatten().tolist() == [0.25, 0.75]


def test_budgets_are_part_of_the_state():
    saved = inside(partial(EarlyTermination, 0.7))
    loaded = inside(partial(EarlyTermination, 5.0))
    loaded.load_state_dict(saved.state_dict())
    assert loaded.transform[-1].budget == saved.transform[-1].budget


def half(state):
    """A cost of one half in every step."""
    return np.full(len(state.goal), 0.5)


def test_arms(make_env):
    """The simulated arm with two costs of its own; only what moves is too fast."""
    env = ArmEnv(
        num_envs=3,
        costs={"speed": Speed(limit=0.05), "half": half},
        max_episode_steps=6,
        seed=0,
    )
    transforms = Compose(
        Saute(torch.tensor([2.0, 100.0]), unsafe_reward=-50.0),
        EarlyTermination(torch.tensor([3.0, 100.0]), termination_reward=-100.0),
        RewardSum(["cost"], ["episode_cost"]),
        CatTensors(["observation", "remaining_budget"], "augmented", del_keys=False),
    )
    env = make_env(TransformedEnv, env, transforms)
    check_env_specs(env)
    actions = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    rollout = env.rollout(
        12, lambda td: td.set("action", actions.clone()), break_when_any_done=False
    )
    following = rollout["next"]
    assert rollout["augmented"].shape == (
        3,
        12,
        env.base_env.observation_spec["observation"].shape[-1] + 2,
    )
    used = following["accumulated_cost"]
    assert torch.equal(following["episode_cost"], used)
    assert (following["cost"][..., 1] == 0.5).all()
    torch.testing.assert_close(following["remaining_budget"], 1 - used / torch.tensor([2.0, 100.0]))
    spent = used[..., :1] > 3.0
    assert torch.equal(following["terminated"], spent | following["success"])
    # The rows that move end by themselves, while the one at rest runs until it is truncated.
    assert spent.flatten(1).any(1).tolist() == [False, True, True]
    assert following["truncated"][0].flatten().nonzero().flatten().tolist() == [5, 11]
    assert following["done"][1].flatten().nonzero().flatten().tolist() != [5, 11]
    unsafe = used[..., :1] > 2.0
    assert (following["reward"][unsafe & ~spent] == -50.0).all()
    assert (following["reward"][spent] == -150.0).all()
    assert (following["reward"][~unsafe] > -50.0).all()


@pytest.mark.parametrize(
    ("transform", "start"),
    [(partial(Saute, 100.0, unsafe_reward=-7.0), 1.0), (partial(EarlyTermination, 100.0), 0.0)],
    ids=["saute", "early"],
)
def test_a_reset_without_a_mask_begins_all_tallies_anew(make_env, transform, start):
    """Also where what it is given has the tallies of the episodes before."""
    env = make_env(inside, transform, 2)
    following = env.step(env.rand_action(env.reset()))["next"].exclude("reward", "cost")
    assert env.reset(following)[env.transform[-1].out_key].tolist() == [[start]] * 2
