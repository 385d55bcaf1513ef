"""What Saute and EarlyTermination refuse."""

from functools import partial

import numpy as np
import pytest
import torch
from counting import CountingBatch, inside, with_costs
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    Compose,
    DTypeCastTransform,
    ObservationNorm,
    StepCounter,
    Transform,
    TransformedEnv,
)

from torchrl_safe.envs import ArmEnv, CostToReward, EarlyTermination, Saute
from torchrl_safe.envs.transforms.budget import CostTally

SAUTE = partial(Saute, unsafe_reward=-1.0)


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
@pytest.mark.parametrize(
    "budget",
    [float("nan"), float("inf"), -1.0, torch.tensor([1.0, -1.0]), torch.ones(2, 1)],
    ids=["nan", "inf", "negative", "one-negative", "matrix"],
)
def test_wrong_budgets(transform, budget):
    with pytest.raises(ValueError, match=r"budget must be one number or one for each cost, fin"):
        transform(budget)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SAUTE(0.0), r"budget must be above 0, got 0\.0"),
        (lambda: SAUTE(torch.tensor([1.0, 0.0])), r"budget must be above 0, got tensor"),
        (lambda: SAUTE(1.0, discount=0.0), r"discount must be above 0 and at most 1, got 0\.0"),
        (lambda: SAUTE(1.0, discount=1.1), r"discount must be above 0 and at most 1, got 1\.1"),
        (lambda: SAUTE(1.0, discount=True), "discount must be .* got True"),
        (lambda: SAUTE(1.0, discount=float("nan")), "discount must be .* got nan"),
        (lambda: Saute(1.0, unsafe_reward=float("nan")), "unsafe_reward must be finite, got nan"),
        (
            lambda: EarlyTermination(1.0, termination_reward=float("inf")),
            "termination_reward must be finite, got inf",
        ),
    ],
)
def test_wrong_numbers(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_rewards_of_numpy_are_numbers():
    assert type(Saute(1.0, unsafe_reward=np.array(-1)).unsafe_reward) is float
    early = EarlyTermination(1.0, termination_reward=np.float64(-1))
    assert type(early.termination_reward) is float


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
@pytest.mark.parametrize("shape", [(2,), (4,)], ids=str)
def test_there_must_be_one_budget_for_each_cost(transform, shape):
    env = inside(partial(transform, torch.ones(shape)), 2, num_costs=3)
    with pytest.raises(ValueError, match=rf"each of the 3 costs, got shape \({shape[0]},\)"):
        env.observation_spec  # noqa: B018


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (partial(SAUTE, cost_key="hazard"), r"cost_key must be among the rewards .* 'hazard'"),
        (partial(SAUTE, reward_key="r"), r"reward_key must be among the rewards .* got 'r'"),
        (partial(SAUTE, out_key="observation"), r"out_key must not be among .* 'observation'"),
        (
            partial(EarlyTermination, terminated_key="over"),
            r"terminated_key must be among the done flags .* got 'over'",
        ),
        (
            partial(EarlyTermination, done_key=("agents", "done")),
            r"done_key must be among the done flags .* got \('agents', 'done'\)",
        ),
    ],
)
def test_wrong_keys(transform, message):
    env = inside(partial(transform, 1.0))
    with pytest.raises(KeyError, match=message):
        env.observation_spec  # noqa: B018


class Team(CountingBatch):
    """Three rows, each with as many agents, which have rewards of their own and share the cost."""

    def __init__(self):
        super().__init__(3)
        agents = Composite(reward=Unbounded((3, 3, 1)), shape=(3, 3))
        self.reward_spec = Composite(agents=agents, shape=(3,))


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
def test_rewards_of_agents_are_refused(transform):
    """They would be changed in one agent of each row, not in each agent of one row."""
    env = TransformedEnv(Team(), CostToReward())
    env.append_transform(transform(1.0, reward_key=("agents", "reward")))
    message = r"reward_key must have shape \(3, 1\), .* got \(3, 3, 1\) for \('agents', 'reward'\)"
    with pytest.raises(ValueError, match=message):
        env.observation_spec  # noqa: B018


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
def test_a_tally_that_no_reset_would_reach_is_refused(transform):
    env = CountingBatch(2)
    flag = Unbounded((2, 1), dtype=torch.bool)
    flags = Composite({key: flag.clone() for key in env.done_keys}, shape=(2,))
    env.done_spec = Composite(agents=flags, shape=(2,))
    env = TransformedEnv(env, CostToReward())
    keys = {}
    if transform is EarlyTermination:
        keys = {"terminated_key": ("agents", "terminated"), "done_key": ("agents", "done")}
    env.append_transform(transform(1.0, **keys))
    with pytest.raises(KeyError, match=r"out_key must stand beside done flags, .*\('agents',\)"):
        env.observation_spec  # noqa: B018


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
def test_is_for_environments(transform):
    with pytest.raises(RuntimeError, match="append it to one"):
        transform(1.0)(TensorDict())


class Spoiled(Transform):
    """Makes the costs NaN."""

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set("cost", next_tensordict["cost"] * float("nan"))


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
def test_costs_that_are_nan_are_refused(make_env, transform):
    env = make_env(with_costs).append_transform(Spoiled()).append_transform(transform(3.0))
    with pytest.raises(ValueError, match="'cost' must be numbers, got NaN"):
        env.step(env.rand_action(env.reset()))


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
def test_rewards_that_are_whole_numbers_are_refused(make_env, transform):
    env = make_env(CountingBatch, costs={"cost_0": ()})
    env.reward_spec = Unbounded((1,), dtype=torch.int64)
    env = TransformedEnv(env, CostToReward(["cost_0"])).append_transform(transform(3.0))
    with pytest.raises(ValueError, match=r"reward_key must be of floating-point numbers, got tor"):
        env.reward_spec  # noqa: B018


@pytest.mark.parametrize("transform", [SAUTE, EarlyTermination], ids=["saute", "early"])
def test_later_transforms_may_not_change_the_tally(make_env, transform):
    """The next step starts from it: one that is normalized in place exceeds no budget."""
    key = transform(1.0).out_key
    normalize = partial(ObservationNorm, 0.5, 2.0, in_keys=[key])
    env = make_env(lambda: TransformedEnv(ArmEnv(), transform(1.0)))
    env.rollout(2)
    env.append_transform(DTypeCastTransform(torch.float32, torch.float64, in_keys=[key]))
    env.append_transform(normalize(out_keys=["normalized"]))
    assert env.rollout(2)["normalized"].dtype == torch.float64
    env.append_transform(Compose(StepCounter(), normalize()))
    with pytest.raises(ValueError, match=f"out_key must not .* got {key!r} and ObservationNorm"):
        env.rollout(2)


def test_the_base_class_needs_its_rules():
    with pytest.raises(TypeError, match="abstract"):
        CostTally(1.0, start=0.0, cost_key="cost", reward_key="reward", out_key="tally")


def test_a_budget_is_copied():
    budget = torch.tensor([0.5])
    transform = EarlyTermination(budget)
    budget.zero_()
    assert transform.budget.tolist() == [0.5]
