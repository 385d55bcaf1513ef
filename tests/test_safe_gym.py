"""SafeGymWrapper and SafeGymEnv: what Gymnasium's environments return, with costs beside rewards.

All numbers are those of counting.py: in step t, observation t, reward 10 t, cost t / 4.
"""

import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from counting import MODES, Counting, by_mode, check_counts, vector
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import (
    ParallelEnv,
    RewardSum,
    SerialEnv,
    default_info_dict_reader,
)
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs.gym import SafeGymEnv, SafeGymWrapper
from torchrl_safe.envs.gym.autoreset import entries


def test_an_environment_can_be_pickled(make_env):
    env = make_env(SafeGymEnv, "counting:Counting-v0", steps=3)
    again = make_env(pickle.loads, pickle.dumps(env))
    check_counts(again.rollout(3), [3])


@pytest.mark.parametrize("kind", ["Counting", "SixTuple"])
@pytest.mark.parametrize("steps", [3, 4], ids=["terminated", "truncated"])
def test_single(make_env, kind, steps):
    env = make_env(SafeGymEnv, f"counting:{kind}-v0", steps=steps)
    check_env_specs(env)
    assert set(env.reward_spec.keys()) == {"reward", "cost"}
    assert env.reward_spec["cost"] == Unbounded((1,), dtype=torch.float32)
    assert "cost" not in env.reset()
    check_counts(env.rollout(10, break_when_any_done=False), [steps])


@by_mode
@pytest.mark.parametrize(
    "kind", [SyncVectorEnv, partial(AsyncVectorEnv, context="fork")], ids=["sync", "async"]
)
def test_vectorized(make_env, mode, kind):
    env = make_env(SafeGymWrapper, vector(mode, kind=kind))
    check_env_specs(env)
    assert env.reward_spec["cost"].shape == (2, 1)
    assert "cost" not in env.reset()
    # Rows end apart in most steps, and both at once in the twelfth.
    check_counts(env.rollout(26, break_when_any_done=False), [4, 3])


@by_mode
def test_made_by_gymnasium(make_env, mode):
    vectorized = gymnasium.make_vec(
        "counting:Counting-v0",
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        steps=2,
    )
    env = make_env(SafeGymWrapper, vectorized)
    check_counts(env.rollout(5, break_when_any_done=False), [2, 2, 2])


@by_mode
def test_wrapped_by_gymnasium(make_env, mode):
    """Wrappers have the mode in their metadata only."""
    env = make_env(SafeGymWrapper, RecordEpisodeStatistics(vector(mode)))
    check_counts(env.rollout(9, break_when_any_done=False), [4, 3])


def test_an_unknown_mode_is_refused():
    env = RecordEpisodeStatistics(vector(MODES[0]))
    env.metadata = {}
    with pytest.raises(ValueError, match=r"how it resets itself, by metadata\['autoreset_mode'\]"):
        SafeGymWrapper(env)


@pytest.mark.parametrize("asynchronous", [True, False])
def test_made_by_name_and_vectorized(make_env, forked_workers, asynchronous):
    """TorchRL's own GymEnv returns zeros for the last observations here."""
    env = make_env(
        SafeGymEnv, "counting:Counting-v0", num_envs=2, asynchronous=asynchronous, steps=4
    )
    assert isinstance(env.unwrapped, AsyncVectorEnv if asynchronous else SyncVectorEnv)
    check_counts(env.rollout(9, break_when_any_done=False), [4, 4])


def test_default_autoreset_is_refused():
    with pytest.raises(RuntimeError, match="SAME_STEP or DISABLED"):
        SafeGymWrapper(vector(AutoresetMode.NEXT_STEP))


@by_mode
def test_resets_in_the_middle(make_env, mode):
    env = make_env(SafeGymWrapper, vector(mode))
    assert env.rollout(5)["next", "done"][:, -1].flatten().tolist() == [False, True]
    assert env.reset()["observation"].flatten().tolist() == [0, 0]
    last = env.rollout(5)[:, -1]
    env.step(env.rand_action(env.reset()))
    everything = last.empty().set("_reset", torch.ones(2, 1, dtype=torch.bool))
    assert env.reset(everything)["observation"].flatten().tolist() == [0, 0]
    # Also with a tensordict that has no mask.
    assert env.reset(env.reset())["observation"].flatten().tolist() == [0, 0]
    check_counts(env.rollout(7, break_when_any_done=False), [4, 3])


def test_same_step_resets_only_what_is_done(make_env):
    env = make_env(SafeGymWrapper, vector(AutoresetMode.SAME_STEP))
    started = env.reset()
    started["_reset"] = torch.tensor([[True], [False]])
    with pytest.raises(RuntimeError, match="only environments that are done can be reset apart"):
        env.reset(started)


def test_environments_that_end_together_are_reset_once(make_env):
    """They have reset themselves; a reset of a simulator may take a second."""
    resets = []

    class Resets(Counting):
        def reset(self, **kwargs):
            resets.append(self)
            return super().reset(**kwargs)

    env = make_env(
        SafeGymWrapper, vector(AutoresetMode.SAME_STEP, partial(Resets, 3), partial(Resets, 3))
    )
    resets.clear()
    check_counts(env.rollout(8, break_when_any_done=False), [3, 3])
    # For the rollout, and for the two ends in it.
    assert len(resets) == 2 * 3
    # Asked for, a reset is one.
    env.reset()
    assert len(resets) == 2 * 4


def test_an_array_that_is_used_again(make_env):
    class Reuses(Counting):
        def __init__(self):
            super().__init__()
            self.array = np.zeros(1, np.float32)

        def reset(self, **kwargs):
            self.array[:] = 0
            return self.array, super().reset(**kwargs)[1]

        def step(self, action):
            observation, *others = super().step(action)
            self.array[:] = observation
            return self.array, *others

    check_counts(make_env(SafeGymWrapper, Reuses()).rollout(9, break_when_any_done=False), [4])


KEYS = [("costs", "count"), "cost", ("costs", "one")]


@pytest.mark.parametrize("mode", [None, *MODES], ids=str)
def test_several_costs(make_env, mode):
    env = make_env(SafeGymWrapper, Counting(4) if mode is None else vector(mode), cost_keys=KEYS)
    check_env_specs(env)
    rollout = env.rollout(9, break_when_any_done=False)
    check_counts(rollout.exclude(("next", "cost")).set(("next", "cost"), own(rollout)), row(mode))
    count = rollout["next", "observation"]
    expected = torch.cat([count, count / 4, torch.ones_like(count)], dim=-1)
    assert torch.equal(rollout["next", "cost"], expected)


def own(rollout):
    return rollout["next", "cost"][..., 1:2]


def row(mode):
    return [4] if mode is None else [4, 3]


@by_mode
def test_named_observations(make_env, mode):
    class Named(Counting):
        observation_space = Dict(count=Counting.observation_space, pair=Box(0, 1000, (2,)))

        def name(self, count, *others):
            return {"count": count, "pair": count.repeat(2)}, *others

        def reset(self, **kwargs):
            return self.name(*super().reset(**kwargs))

        def step(self, action):
            return self.name(*super().step(action))

    env = make_env(SafeGymWrapper, vector(mode, partial(Named, 4), partial(Named, 3)))
    check_env_specs(env)
    rollout = env.rollout(13, break_when_any_done=False)
    for part in (rollout, rollout["next"]):
        assert torch.equal(part["pair"], part["count"].expand(2, 13, 2))
        part["observation"] = part["count"]
    check_counts(rollout, [4, 3])


@pytest.mark.parametrize("named", [False, True], ids=["array", "dict"])
def test_an_environment_may_return_the_same_array_again(make_env, named):
    class Frugal(Counting):
        array = np.zeros(1, np.float32)
        box = Counting.observation_space
        observation_space = Dict(observation=box) if named else box

        def written(self, count, *others):
            self.array[:] = count
            return {"observation": self.array} if named else self.array, *others

        def reset(self, **kwargs):
            return self.written(*super().reset(**kwargs))

        def step(self, action):
            return self.written(*super().step(action))

    check_counts(make_env(SafeGymWrapper, Frugal(4)).rollout(9, break_when_any_done=False), [4])


def test_costs_of_skipped_frames_add_up(make_env):
    env = make_env(SafeGymEnv, "counting:Counting-v0", steps=5, frame_skip=2)
    rollout = env.rollout(3)
    assert rollout["next", "reward"].flatten().tolist() == [10 + 20, 30 + 40, 50]
    assert rollout["next", "cost"].flatten().tolist() == [0.25 + 0.5, 0.75 + 1, 1.25]


@pytest.mark.parametrize("count", [0, -1, 2.5])
def test_as_many_frames_as_can_be(count):
    with pytest.raises(ValueError, match=f"frame_skip must be a whole number .*, got {count}"):
        SafeGymWrapper(Counting(), frame_skip=count)


def test_frames_of_several_environments_are_not_skipped_together():
    """When one ends, the others would lose their frames."""
    with pytest.raises(ValueError, match=r"frame_skip must be 1 for several environments, .* 4"):
        SafeGymEnv("counting:Counting-v0", num_envs=2, asynchronous=False, frame_skip=4)


@pytest.mark.parametrize("num_envs", [0, 2])
def test_a_class_without_a_constructor(make_env, forked_workers, num_envs):
    """Python's error for it does not name the argument that TorchRL tries."""
    env = make_env(SafeGymEnv, "counting:WithoutConstructor-v0", num_envs=num_envs)
    check_counts(env.rollout(9, break_when_any_done=False), [4] * (num_envs or 1))


def test_frames_of_a_class_without_a_constructor_are_skipped(make_env):
    env = make_env(SafeGymEnv, "counting:WithoutConstructor-v0", frame_skip=2)
    cost = env.rollout(3)["next", "cost"]
    assert cost.flatten().tolist() == [0.25 + 0.5, 0.75 + 1]


def test_an_argument_that_no_constructor_takes_is_an_error():
    with pytest.raises(TypeError, match=r"takes no arguments .* kwargs \({'steps': 3"):
        SafeGymEnv("counting:WithoutConstructor-v0", steps=3)


def test_actions_may_have_gradients(make_env):
    env = make_env(SafeGymWrapper, Counting())
    action = env.rand_action()["action"].requires_grad_()
    after = env.step(env.reset().set("action", action))
    assert after["next", "cost"].tolist() == [0.25]


def test_other_info_can_still_be_read(make_env):
    class Flag(Counting):
        def info(self):
            return {**super().info(), "twice": np.float64(2 * self.count)}

        def reset(self, **kwargs):
            observation, info = super().reset(**kwargs)
            return observation, {**info, "twice": np.float64(-1)}

    single = make_env(SafeGymWrapper, Flag(4))
    single.set_info_dict_reader(default_info_dict_reader(["twice"]))
    assert single.rollout(4)["next", "twice"].flatten().tolist() == [2, 4, 6, 8]
    several = vector(AutoresetMode.SAME_STEP, partial(Flag, 3), Flag)
    # Nobody asked for it, so it is no observation.
    assert list(make_env(SafeGymWrapper, several).observation_spec.keys()) == ["observation"]
    same_step = make_env(SafeGymWrapper, several)
    reader = default_info_dict_reader(["twice"], spec=[Unbounded((2,), dtype=torch.float64)])
    same_step.set_info_dict_reader(reader)
    rollout = same_step.rollout(5, break_when_any_done=False)
    assert rollout["next", "twice"].tolist() == [[2, 4, 6, 2, 4], [2, 4, 6, 8, 2]]
    assert rollout["twice"].tolist() == [[-1, 2, 4, -1, 2], [-1, 2, 4, 6, -1]]


@by_mode
def test_info_may_have_numbers_for_names(make_env, mode):
    class Numbered(Counting):
        def info(self):
            return {**super().info(), 7: 1.0}

    env = make_env(SafeGymWrapper, vector(mode, Numbered, partial(Numbered, 3)))
    check_counts(env.rollout(5, break_when_any_done=False), [4, 3])


def test_info_may_hold_arrays(make_env):
    class Placed(Counting):
        def info(self):
            return {**super().info(), "place": self.count + np.arange(3.0)}

    env = make_env(SafeGymWrapper, vector(AutoresetMode.SAME_STEP, partial(Placed, 3), Placed))
    reader = default_info_dict_reader(["place"], spec=[Unbounded((2, 3), dtype=torch.float64)])
    env.set_info_dict_reader(reader)
    places = env.rollout(5, break_when_any_done=False)["next", "place"]
    count = torch.tensor([[1, 2, 3, 1, 2], [1, 2, 3, 4, 1]])
    assert torch.equal(places, count.unsqueeze(-1) + torch.arange(3.0, dtype=torch.float64))


def summed(env):
    return env.append_transform(RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


MAKERS = {
    "single": partial(SafeGymEnv, "counting:Counting-v0"),
    "serial": partial(SerialEnv, 2, partial(SafeGymEnv, "counting:Counting-v0")),
    "parallel": partial(
        ParallelEnv, 2, partial(SafeGymEnv, "counting:Counting-v0"), mp_start_method="fork"
    ),
    "same step": lambda: SafeGymWrapper(vector(MODES[0], Counting, Counting)),
    "disabled": lambda: SafeGymWrapper(vector(MODES[1], Counting, Counting)),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
def test_in_a_collector(make_env, make):
    env = make_env(lambda: summed(make()))
    rows = max(1, env.batch_size.numel())
    collector = Collector(env, frames_per_batch=10 * rows, total_frames=20 * rows)
    batches = list(collector)
    collector.shutdown()
    data = torch.cat(batches, dim=-1)
    check_counts(data, [4] * rows)
    done = data["next", "done"]
    assert data["next", "episode_cost"][done].tolist() == [2.5] * 5 * rows
    assert data["next", "episode_reward"][done].tolist() == [100] * 5 * rows


def test_a_name_and_an_environment_are_told_apart():
    with pytest.raises(
        TypeError, match=r"env_name must be a registered name, got <counting.Counting"
    ):
        SafeGymEnv(Counting())
    with pytest.raises(TypeError, match=r"env must be an environment, got 'counting:Counting-v0'"):
        SafeGymWrapper("counting:Counting-v0")


def test_a_flag_of_another_kind_is_refused():
    with pytest.raises(TypeError, match="asynchronous must be True or False, got 'no'"):
        SafeGymEnv("counting:Counting-v0", asynchronous="no")


def test_device_is_that_of_the_tensors(make_env):
    env = make_env(SafeGymWrapper, Counting(), device="cpu")
    assert env.rollout(2)["next", "cost"].device == torch.device("cpu")


def test_only_the_step_before_tells_what_has_reset_itself(make_env):
    """A step later the environments have moved on: what a reset gives then is a new beginning."""
    both = vector(AutoresetMode.SAME_STEP, partial(Counting, 2), partial(Counting, 2))
    env = make_env(SafeGymWrapper, both)
    td = env.reset()
    for _ in range(3):  # The second ends both episodes, and nobody resets them.
        td = env.step(env.rand_action(td))["next"]
    again = env.reset(td.set("_reset", torch.ones(2, 1, dtype=torch.bool)))
    assert again["observation"].flatten().tolist() == [0, 0]
    after = env.step(env.rand_action(again))["next"]
    assert after["observation"].flatten().tolist() == [1, 1]


def test_same_step_refuses_to_reset_another_than_what_is_done(make_env):
    env = make_env(SafeGymWrapper, vector(AutoresetMode.SAME_STEP))
    td = env.reset()
    for _ in range(3):  # The second row ends.
        td = env.step(env.rand_action(td))["next"]
    assert td["done"].flatten().tolist() == [False, True]
    with pytest.raises(RuntimeError, match=r"make them with AutoresetMode\.DISABLED"):
        env.reset(td.set("_reset", ~td["done"]))


def test_an_old_info_names_those_that_have_an_entry():
    """An array of dictionaries, which Gymnasium made before 1.0."""
    found = entries(np.array([{"cost": 0.5}, {}, None], dtype=object))
    assert found["cost"].tolist() == [0.5, 0, 0]
    assert found["_cost"].tolist() == [True, False, False]
