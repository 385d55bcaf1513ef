"""What no environment in MuJoCo can do without: its batch, and TorchRL's own part of a step."""

from __future__ import annotations

from time import process_time
from typing import Any
from unittest import mock

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from benchmarks.rollouts import Canned, play
from benchmarks.timing import Contender
from torchrl_safe.envs import ArmEnv


class Recording:
    """The physics of a rollout, to be done again.

    Args:
        env: whose physics is MuJoCo's.
        steps: control steps to record.
    """

    def __init__(self, env: ArmEnv, steps: int) -> None:
        self._batch = batch = env._simulator._batch  # type: ignore[attr-defined]
        self._advance, self._next = batch.rollout, 0
        self._calls: list[tuple[int, np.ndarray, dict[str, Any]]] = []
        self._out: Any = None

        def record(nstep: int, control: np.ndarray, **options: Any) -> Any:
            self._calls.append((nstep, control.copy(), {**options, "out": None}))
            return self._advance(nstep, control, **options)

        env.set_seed(0)
        start = env.reset()
        self._state = batch.state.copy()
        with mock.patch.object(batch, "rollout", record):
            play(env, Canned(env, steps), steps, start)

    def rewind(self) -> None:
        """Goes back to where the recording began."""
        self._batch.state[:] = self._state
        self._next = 0

    def step(self) -> None:
        """Takes the next control step."""
        nstep, control, options = self._calls[self._next]
        self._out = self._advance(nstep, control, **{**options, "out": self._out})
        self._next += 1


class Hollow(EnvBase):
    """An environment with the specs of another that only takes its physics' steps.

    What else a step takes is TorchRL's, with the caches as physics leaves them.

    Args:
        env: whose specs it has.
        recording: the physics.

    Attributes:
        seconds: what the physics has taken, in processor time.
    """

    def __init__(self, env: ArmEnv, recording: Recording) -> None:
        super().__init__(batch_size=env.batch_size)
        for name in ("observation_spec", "action_spec", "reward_spec", "done_spec"):
            setattr(self, name, getattr(env, name).clone())
        self._recording, self.seconds = recording, 0.0
        specs = (self.full_observation_spec, self.full_reward_spec, self.full_done_spec)
        self._made = {name: part for spec in specs for name, part in spec.zero().items()}

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._recording.rewind()
        return self.full_observation_spec.zero()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        before = process_time()
        self._recording.step()
        self.seconds += process_time() - before
        made = {name: part.clone() for name, part in self._made.items()}
        return TensorDict(made, batch_size=self.batch_size)


def torchrl_alone(env: ArmEnv, steps: int) -> Contender:
    """What a step takes beside physics in an environment that does nothing else."""
    hollow = Hollow(env, Recording(env, steps))
    policy = Canned(hollow, steps)

    def contender() -> float:
        start = hollow.reset()
        hollow.seconds, begin = 0.0, process_time()
        play(hollow, policy, steps, start)
        return (process_time() - begin - hollow.seconds) / steps

    return contender


def bare_batch(env: ArmEnv, steps: int) -> Contender:
    """The same model, controls and sensors as in a rollout, in MuJoCo's own batch."""
    recording = Recording(env, steps)

    def contender() -> float:
        recording.rewind()
        begin = process_time()
        for _ in range(steps):
            recording.step()
        return process_time() - begin

    return contender
