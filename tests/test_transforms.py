"""CostToReward: costs leave the observations and stand beside the reward."""

from functools import partial

import pytest
import torch
from counting import CountingBatch, SixTuple
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import ParallelEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.libs.safety_gymnasium import SafetyGymnasiumWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import CostToReward


def moved(env, *args, **kwargs):
    return TransformedEnv(env, CostToReward(*args, **kwargs))


def summed(env):
    return env.append_transform(RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


def test_safety_gymnasium_of_torchrl(make_env):
    env = make_env(lambda: moved(SafetyGymnasiumWrapper(SixTuple(steps=3))))
    check_env_specs(env)
    assert set(env.reward_spec.keys()) == {"reward", "cost"}
    assert env.reward_spec["cost"] == Unbounded((1,), dtype=torch.float32)
    assert list(env.observation_spec.keys()) == ["observation"]
    assert "cost" not in env.reset()

    rollout = env.rollout(5, break_when_any_done=False)
    cost = rollout["next", "cost"]
    assert torch.equal(cost, torch.tensor([[0.25], [0.5], [0.75], [0.25], [0.5]]))
    assert cost.dtype == torch.float32
    assert rollout["next", "reward"].flatten().tolist() == [10, 20, 30, 10, 20]
    assert "cost" not in rollout


@pytest.mark.parametrize("num_envs", [None, 2], ids=["single", "batched"])
@pytest.mark.parametrize("wrap", [None, SerialEnv, ParallelEnv])
def test_episode_sums(make_env, num_envs, wrap):
    make = partial(CountingBatch, num_envs)
    base = make if wrap is None else partial(wrap, 2, make, **FORK.get(wrap, {}))
    env = make_env(lambda: summed(moved(base())))
    check_env_specs(env)
    rollout = env.rollout(4, break_when_any_done=False)
    assert rollout["next", "cost"].shape == (*env.batch_size, 4, 1)
    # Rows of two steps an episode, and of three.
    expected = torch.tensor([[0.25, 0.75, 0.25, 0.75], [0.25, 0.75, 1.5, 0.25]])[..., None]
    episode_cost = rollout["next", "episode_cost"].reshape(-1, num_envs or 1, 4, 1)
    for sums in episode_cost:
        assert torch.equal(sums, expected[: num_envs or 1])
    assert torch.equal(rollout["next", "episode_reward"], rollout["next", "episode_cost"] * 40)


FORK = {ParallelEnv: {"mp_start_method": "fork"}}


def test_in_a_collector(make_env):
    env = make_env(lambda: summed(moved(CountingBatch(2))))
    collector = Collector(env, frames_per_batch=12, total_frames=24)
    first, second = list(collector)
    collector.shutdown()
    ends = [batch["next", "episode_cost"][batch["next", "done"]] for batch in (first, second)]
    # Episodes of two steps cost 1/4 + 2/4, of three steps 3/4 more.
    assert [sorted(end.tolist()) for end in ends] == [[0.75, 0.75, 0.75, 1.5, 1.5]] * 2
    assert "cost" not in first


@pytest.mark.parametrize("batch", [(), (3,)], ids=["single", "batched"])
def test_several_costs_of_any_form(make_env, batch):
    """Columns keep the order of the keys, not that of the observations."""
    shapes = {"b": (*batch,), ("safety", "a"): (*batch, 1), "pair": (*batch, 2)}
    env = CountingBatch(*batch, costs=shapes)
    env = make_env(
        moved, env, in_keys=["pair", ("safety", "a"), "b"], out_keys=[("constraint", "cost")]
    )
    check_env_specs(env)
    assert list(env.observation_spec.keys(True, True)) == ["observation"]
    cost = env.rollout(2)["next", "constraint", "cost"]
    assert cost.shape == (*batch, 2, 4)
    expected = torch.tensor([[200.25, 200.25, 100.25, 0.25], [200.5, 200.5, 100.5, 0.5]])
    assert torch.equal(cost, expected.expand(cost.shape))
    sums = RewardSum(["reward", ("constraint", "cost")], ["sum", "costs"])
    total = env.append_transform(sums).rollout(2)["next", "costs"][..., -1, :]
    assert torch.equal(total, cost.sum(-2))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"in_keys": "cost"}, ValueError, "in_keys must be a sequence of at least one key, got 'c"),
        ({"in_keys": []}, ValueError, r"in_keys must be a sequence of at least one key, got \[\]"),
        (
            {"out_keys": ["a", "b"]},
            ValueError,
            r"out_keys must be a sequence of one key, .* got \[",
        ),
        (
            {"in_keys": ["hazard"]},
            KeyError,
            r"in_keys must be among the observations \['observation', 'cost'\], got 'hazard'",
        ),
        (
            {"out_keys": ["reward"]},
            KeyError,
            r"out_keys must not be among the rewards \['reward'\], got 'reward'",
        ),
    ],
)
def test_wrong_keys(arguments, error, message):
    with pytest.raises(error, match=message):
        moved(CountingBatch(), **arguments).reward_spec  # noqa: B018


def test_wrong_shape():
    env = CountingBatch(2, costs={"cost": (2, 1, 1)})
    with pytest.raises(ValueError, match=r"cost 'cost' must have shape \(2,\) or .* \(2, 1, 1\)"):
        moved(env).reward_spec  # noqa: B018


def test_is_for_environments():
    with pytest.raises(RuntimeError, match="append it to one"):
        CostToReward()(CountingBatch().reset())


def test_a_group_that_becomes_empty_is_gone(make_env):
    """Left empty, it would stand in what reset returns and not in the specs."""
    keys = [("costs", "heat"), ("costs", "wear")]
    env = make_env(
        moved, CountingBatch(2, costs=dict.fromkeys(keys, (2,))), keys, [("costs", "all")]
    )
    check_env_specs(env)
    assert "costs" not in env.reset()
    collector = Collector(env, frames_per_batch=8, total_frames=8)
    (batch,) = collector
    collector.shutdown()
    assert batch["next", "costs", "all"].shape == (2, 4, 2)
    assert "costs" not in batch
