"""MuJoCo's quaternions: (w, x, y, z), where all others here are (x, y, z, w)."""

from __future__ import annotations

import numpy as np

from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.state import Array

#: Indices that turn one order into the other.
TO_MUJOCO, FROM_MUJOCO = [3, 0, 1, 2], [1, 2, 3, 0]


def rotation_matrix(quaternion: Array) -> Array:
    """The rotation matrix, ``(3, 3)``, of one of MuJoCo's quaternions."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=float))
    return matrix.reshape(3, 3)
