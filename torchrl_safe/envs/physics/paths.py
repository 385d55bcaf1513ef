"""Where moving obstacles are in each substep, the same for every engine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.physics.scene import SUBSTEP
from torchrl_safe.envs.rotations import rotation_vector
from torchrl_safe.envs.state import Array


class Ways(NamedTuple):
    """The ways of m obstacles through s substeps: now, and after each substep."""

    #: Centres, m, ``(s + 1, m, 3)``.
    position: Array
    #: Quaternions (x, y, z, w), ``(s + 1, m, 4)``.
    orientation: Array
    #: Velocities of the centres, m/s, ``(s + 1, m, 3)``; those of now are those of the first
    #: substep.
    velocity: Array
    #: rad/s, ``(s + 1, m, 3)``.
    angular_velocity: Array

    @classmethod
    def zeros(cls, *shape: int) -> Ways:
        """Zeros in all parts, each ``(*shape, width)``."""
        return cls(*(np.zeros((*shape, width)) for width in WIDTHS))


#: Numbers in each part of :class:`Ways`.
WIDTHS = (3, 4, 3, 3)


def limbo(index: int) -> tuple[float, float, float]:
    """Out of the world, at a place where nothing else is."""
    return (10.0 * index, 0.0, -100.0)


def look_ahead(placement: Placement, elapsed: int, substeps: int) -> Ways:
    """Returns the obstacles' ways through the next substeps.

    Args:
        placement: the obstacles of a world, and their path.
        elapsed: substeps since the world's reset.
        substeps: number s of substeps to look ahead, at least 1.
    """
    times = SUBSTEP * np.arange(elapsed, elapsed + substeps + 1, dtype=float)
    positions, orientations = placement.at(times)
    if placement.path is None:
        return Ways(positions, orientations, *np.zeros((2, *positions.shape)))
    velocities = np.diff(positions, axis=0) / SUBSTEP
    spins = rotation_vector(orientations[:-1], orientations[1:]) / SUBSTEP
    moves = (np.concatenate([part[:1], part]) for part in (velocities, spins))
    return Ways(positions, orientations, *moves)
