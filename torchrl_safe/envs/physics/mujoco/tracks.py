"""Where the obstacles that are placed from outside are, in all worlds."""

from __future__ import annotations

import numpy as np

from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.physics.paths import Ways, limbo, look_ahead
from torchrl_safe.envs.rotations import UPRIGHT

# Substeps, about, for which ways are computed at once: as cheap as for a single control step.
_AHEAD = 240


class Tracks:
    """Poses and velocities of m obstacles in N worlds.

    Args:
        num_envs: number N of worlds.
        count: number m of obstacles.
        frame_skip: substeps of a control step.
    """

    def __init__(self, num_envs: int, count: int, frame_skip: int) -> None:
        self._frame_skip = frame_skip
        self._ahead = frame_skip * max(1, _AHEAD // frame_skip)
        self._placements: list[Placement | None] = [None] * num_envs
        self._limbo = np.array([limbo(index) for index in range(count)]).reshape(-1, 3)
        #: Which obstacles a world has, ``(N, m)``.
        self.present = np.zeros((num_envs, count), dtype=bool)
        #: Whether an obstacle of any world is on its way.
        self.moving = False
        #: Where they are now, each ``(N, m, width)``.
        self.now = Ways.zeros(num_envs, count)
        # The ways of each world from some substep on, which substep that is, and how far it has
        # gone since.
        self._ways: Ways | None = None
        self._begin, self._gone = np.zeros((2, num_envs), dtype=int)

    def reset(self, row: int, placement: Placement) -> None:
        """Begins an episode in one world."""
        self._placements[row], self.present[row] = placement, placement.present
        if placement.path is not None and not self.moving:
            self.moving = True
            self._ways = Ways.zeros(len(self.present), self._ahead + 1, self.present.shape[1])
            for other, begun in enumerate(self._placements):
                if begun is not None:
                    self.seek(other, 0)
        self.seek(row, 0)

    def seek(self, row: int, elapsed: int) -> None:
        """Puts the obstacles of one world where they are some substeps after its reset."""
        # At the end of a stretch, as in a run that was not interrupted, not at the beginning of
        # one.
        self._begin[row] = max(0, elapsed - 1) // self._ahead * self._ahead
        self._gone[row] = elapsed - self._begin[row]
        ways = self._look(row, self._ahead if self.moving else 1)
        for now, part in zip(self.now, ways, strict=True):
            now[row] = part[self._gone[row] if self.moving else 0]

    def _look(self, row: int, substeps: int) -> Ways:
        placement = self._placements[row]
        assert placement is not None
        ways = look_ahead(placement, int(self._begin[row]), substeps)
        absent = ~placement.present
        ways.position[:, absent], ways.orientation[:, absent] = self._limbo[absent], UPRIGHT
        ways.velocity[:, absent] = ways.angular_velocity[:, absent] = 0
        if self._ways is not None:
            for all_ways, part in zip(self._ways, ways, strict=True):
                all_ways[row] = part
        return ways

    def ahead(self) -> Ways:
        """Returns the ways of all worlds, now and after each substep, ``(N, s + 1, m, width)``."""
        assert self._ways is not None
        for row in np.flatnonzero(self._gone + self._frame_skip > self._ahead):
            self._begin[row] += self._gone[row]
            self._gone[row] = 0
            self._look(int(row), self._ahead)
        rows = np.arange(len(self._gone))[:, None]
        substeps = self._gone[:, None] + np.arange(self._frame_skip + 1)
        return Ways(*(part[rows, substeps] for part in self._ways))

    def go(self, ways: Ways) -> None:
        """Notes that the obstacles of all worlds have gone a control step along their ways."""
        self._gone += self._frame_skip
        for now, part in zip(self.now, ways, strict=True):
            now[:] = part[:, -1]
