"""Environments that count steps, so that what they return can be worked out by hand.

In step t of an episode of n steps: observation t, reward 10 t, cost t / 4.
"""

from functools import partial
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper, Transform, TransformedEnv

from torchrl_safe.envs import CostToReward

FLAGS = ("done", "terminated", "truncated")
MODES = [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]
by_mode = pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)


class Counting(gymnasium.Env):
    """Ends after n steps: truncated, or terminated if n is odd."""

    metadata: ClassVar = {"render_modes": []}
    observation_space = Box(0, 1000, (1,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)
    render_mode = None

    def __init__(self, steps=4):
        self.steps = steps

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        self.count = 0
        # Costs at a reset belong to no step: nobody may read them.
        return np.zeros(1, np.float32), {"cost": -99.0}

    def info(self):
        return {"cost": self.count / 4, "costs": {"one": 1.0, "count": float(self.count)}}

    def step(self, action):
        self.count += 1
        over = self.count >= self.steps
        odd = self.steps % 2 == 1
        observation = np.full(1, self.count, np.float32)
        return observation, 10.0 * self.count, over and odd, over and not odd, self.info()


class SixTuple(Counting):
    """Returns the cost as Safety-Gymnasium does."""

    def step(self, action):
        *outcome, terminated, truncated, info = super().step(action)
        cost = info.pop("cost")
        return *outcome, cost, terminated, truncated, info


class Forgetful(Counting):
    """Reports no cost in its second step."""

    def info(self):
        return {} if self.count == 2 else super().info()


class Torque(Counting):
    """Costs depend on the action, in types that users write: NumPy's bool; 0, or a fraction."""

    def step(self, action):
        *outcome, info = super().step(action)
        pushes = action[0] > 0
        torque = float(action[0])
        push = bool(pushes) and torque
        costs = {"pushes": pushes, "torque": torque if pushes else 0, "push": push}
        return *outcome, {**info, "costs": costs}


class WithoutConstructor(gymnasium.Env):
    """Counts to four, without an ``__init__`` of its own."""

    metadata = Counting.metadata
    observation_space = Counting.observation_space
    action_space = Counting.action_space
    steps = 4
    reset, info, step = Counting.reset, Counting.info, Counting.step


for kind in (Counting, SixTuple, Forgetful, Torque, WithoutConstructor):
    gymnasium.register(f"{kind.__name__}-v0", entry_point=f"{__name__}:{kind.__name__}")


class CountingBatch(EnvBase):
    """The same as a TorchRL environment that takes its costs for observations.

    Row r ends, truncated, after r + 2 steps. Costs t / 4 as asked for by the specs.
    """

    def __init__(self, num_envs=None, costs=None):
        batch = () if num_envs is None else (num_envs,)
        super().__init__(batch_size=batch)
        costs = {"cost": batch} if costs is None else costs
        self.costs = {key: Unbounded(shape, dtype=torch.float64) for key, shape in costs.items()}
        self.observation_spec = Composite(
            {"observation": Unbounded((*batch, 1)), **self.costs}, shape=batch
        )
        self.action_spec = Unbounded((*batch, 1))
        self.reward_spec = Unbounded((*batch, 1))
        self.done_spec = Composite(
            {key: Unbounded((*batch, 1), dtype=torch.bool) for key in FLAGS},
            shape=batch,
        )
        self.count = torch.zeros(*batch, 1)
        self.steps = torch.arange(self.count.numel()).view_as(self.count) + 2

    def _observe(self, **others):
        out = TensorDict({"observation": self.count.clone(), **others}, self.batch_size)
        for place, (key, spec) in enumerate(self.costs.items()):
            column = (self.count.double() / 4 + 100 * place).reshape(self.batch_size)
            shaped = column if spec.ndim == len(self.batch_size) else column.unsqueeze(-1)
            out[key] = shaped.expand(spec.shape).clone()
        return out

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.count, dtype=torch.bool) if mask is None else mask
        self.count = torch.where(mask.view_as(self.count), 0.0, self.count)
        return self._observe()

    def _step(self, tensordict):
        self.count = self.count + 1
        over = self.count >= self.steps
        never = torch.zeros_like(over)
        return self._observe(
            reward=10 * self.count, done=over, terminated=never, truncated=over.clone()
        )

    def _set_seed(self, seed):
        pass


class Flag(Transform):
    """A cost that is true in each step, and no number."""

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set("cost", torch.ones(1, dtype=torch.bool))

    def transform_reward_spec(self, reward_spec):
        reward_spec["cost"] = Binary(shape=(1,), dtype=torch.bool)
        return reward_spec


def flagged(*transforms):
    """A single :class:`Counting` whose cost is a flag."""
    env = TransformedEnv(GymWrapper(Counting()), Flag())
    for transform in transforms:
        env.append_transform(transform)
    return env


def with_costs(num_envs=None, num_costs=1):
    shape = () if num_envs is None else (num_envs,)
    costs = {f"cost_{index}": shape for index in range(num_costs)}
    return TransformedEnv(CountingBatch(num_envs, costs=costs), CostToReward(list(costs)))


def inside(transform, num_envs=None, num_costs=1):
    return with_costs(num_envs, num_costs).append_transform(transform())


def vector(mode, *factories, kind=SyncVectorEnv):
    factories = factories or (partial(Counting, 4), partial(Counting, 3))
    return kind(factories, autoreset_mode=mode)


def check_counts(rollout, lengths):
    """Compares a rollout of episodes of these lengths, a row each, with what they must be."""
    steps = rollout.shape[-1]
    count = torch.stack([torch.arange(steps) % length for length in lengths]).float()
    after, over = count + 1, count + 1 == torch.tensor(lengths)[:, None]
    odd = torch.tensor(lengths)[:, None] % 2 == 1
    rollout = rollout.reshape(len(lengths), steps)
    for key, expected in {
        "observation": count,
        ("next", "observation"): after,
        ("next", "reward"): 10 * after,
        ("next", "done"): over,
        ("next", "terminated"): over & odd,
        ("next", "truncated"): over & ~odd,
    }.items():
        assert torch.equal(rollout[key].squeeze(-1), expected), key
    assert torch.equal(rollout["next", "cost"][..., 0], after / 4)
    assert rollout["next", "cost"].dtype == torch.float32
    assert "cost" not in rollout
