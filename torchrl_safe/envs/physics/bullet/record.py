"""The motors' targets in the running episodes, from which they can be replayed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchrl_safe.envs.physics.simulator import Saved
from torchrl_safe.envs.state import Array


class TargetRecord:
    """The motors' targets in the running episode of every world.

    Args:
        num_envs: number N of worlds.
    """

    def __init__(self, num_envs: int) -> None:
        #: Steps of each episode, shape (N,).
        self.steps = np.zeros(num_envs, dtype=int)
        # Targets of joints and fingers in each of them, shape (N, steps, width).
        self._targets: Array = np.zeros((num_envs, 0, 0))
        self._rows = np.arange(num_envs)

    def begin(self, row: int) -> None:
        """Notes that an episode begins."""
        self.steps[row] = 0

    def add(self, joints: Array, fingers: Array) -> None:
        """Notes a step of all worlds.

        Args:
            joints: joint targets, shape (N, n).
            fingers: finger targets, shape (N, f).
        """
        targets = np.concatenate([joints, fingers], axis=1)
        count, room, _ = self._targets.shape
        last = int(self.steps.max())
        if not last:  # Free what a long episode has taken.
            self._targets, room = self._targets[:, :0], 0
        if last >= room:
            longer = np.zeros((count, max(32, 2 * last), targets.shape[1]))
            if room:
                longer[:, :room] = self._targets
            self._targets = longer
        self._targets[self._rows, self.steps] = targets
        self.steps += 1

    def rows(self) -> Iterator[Array]:
        """The targets of each world since its reset, each ``(steps, width)``."""
        for targets, steps in zip(self._targets, self.steps, strict=True):
            yield targets[:steps]

    def save(self) -> Saved:
        """Returns all that was noted."""
        longest = self.steps.max()
        return {"steps": self.steps.copy(), "targets": self._targets[:, :longest].copy()}

    def restore(self, saved: Saved) -> None:
        """Takes what :meth:`save` returned."""
        self.steps, self._targets = saved["steps"].copy(), saved["targets"].copy()
