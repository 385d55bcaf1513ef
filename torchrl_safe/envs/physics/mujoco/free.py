"""Bodies that physics moves: objects, and obstacles with a mass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.physics.mujoco.quaternions import FROM_MUJOCO, TO_MUJOCO
from torchrl_safe.envs.physics.paths import Ways
from torchrl_safe.envs.rotations import turn
from torchrl_safe.envs.state import Array

Indices = NDArray[np.int_]


class FreeBodies:
    """Where bodies that physics moves are in a state.

    Args:
        model: the ``MjModel``.
        names: their names.
    """

    def __init__(self, model: Any, names: Sequence[str]) -> None:
        joints = [model.joint(name).id for name in names]
        self._position = model.jnt_qposadr[joints].reshape(-1, 1) + np.arange(7)
        self._velocity = model.jnt_dofadr[joints].reshape(-1, 1) + np.arange(6)

    def put(self, qpos: Array, position: Array, orientation: Array) -> None:
        """Writes their poses, ``(b, 3)`` and ``(b, 4)``, into the positions of one world."""
        qpos[self._position[:, :3]] = position
        qpos[self._position[:, 3:]] = orientation[..., TO_MUJOCO]

    def hold(self, qpos: Array, qvel: Array, row: Indices, index: Indices, position: Array) -> None:
        """Puts some of them in places, upright and at rest."""
        qpos[row[:, None], self._position[index]] = np.hstack(
            [position, np.tile((1.0, 0.0, 0.0, 0.0), (len(row), 1))]
        )
        qvel[row[:, None], self._velocity[index]] = 0

    def read(self, qpos: Array, qvel: Array) -> Ways:
        """Returns their poses and velocities, each ``(..., b, width)``."""
        if not len(self._position):
            return Ways.zeros(*qpos.shape[:-1], 0)
        # Other ways of indexing lay the numbers out anew, and the last bit of what is computed with
        # them depends on that.
        poses, moves = qpos.take(self._position, axis=-1), qvel.take(self._velocity, axis=-1)
        orientation = poses[..., 3:].take(FROM_MUJOCO, axis=-1)
        # MuJoCo tells the angular velocity in the frame of the body.
        return Ways(poses[..., :3], orientation, moves[..., :3], turn(orientation, moves[..., 3:]))
