"""The same random actions, played in an environment again and again."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from benchmarks.timing import Contender, timed
from torchrl_safe.envs import ActionMode, CartesianDelta, JointDelta

ACTIONS: dict[str, ActionMode] = {"joint": JointDelta(), "Cartesian": CartesianDelta()}
# An episode that no measurement reaches the end of: resets are timed apart.
ENDLESS = 10**9
PANDA_GYM_SUBSTEPS, PANDA_GYM_EPISODE = 20, 50


class Canned:
    """A policy that plays the same random actions again and again.

    Args:
        env: where it plays.
        steps: how many actions it has.
    """

    def __init__(self, env: EnvBase, steps: int) -> None:
        generator = torch.Generator().manual_seed(0)
        shape = (steps, *env.action_spec.shape)
        self._actions = 2 * torch.rand(shape, generator=generator) - 1
        self._step = 0

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict["action"] = self._actions[self._step % len(self._actions)]
        self._step += 1
        return tensordict


def rollout(env: EnvBase, steps: int, *, clock: Callable[[], float] = process_time) -> Contender:
    """Steps through ``rollout`` from a reset, which is not timed."""
    policy = Canned(env, steps)

    def contender() -> float:
        env.set_seed(0)
        start = env.reset()
        return timed(lambda: play(env, policy, steps, start), clock=clock)()

    return contender


def play(env: EnvBase, policy: Canned, steps: int, start: TensorDictBase) -> None:
    """Plays on from a state."""
    env.rollout(steps, policy, auto_reset=False, tensordict=start, break_when_any_done=False)


def episode(env: EnvBase, steps: int) -> Contender:
    """Steps through ``rollout`` with the reset before them."""
    policy = Canned(env, steps)
    return timed(lambda: env.rollout(steps, policy, break_when_any_done=False))


def play_gym(
    reset: Callable[[], Any], step: Callable[[np.ndarray], Any], actions: np.ndarray
) -> None:
    """Plays one episode."""
    reset()
    for action in actions:
        step(action)
