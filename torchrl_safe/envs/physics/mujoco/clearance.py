"""How far obstacles and objects are from what is not to be touched."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.scene import FARTHEST
from torchrl_safe.envs.state import Array


class Clearance:
    """Measures the shapes of a world against each other, with those that never collide.

    Args:
        model: the ``MjModel``.
        obstacles: names of the obstacles' shapes.
        objects: names of the objects' shapes.
    """

    def __init__(self, model: Any, obstacles: Sequence[str], objects: Sequence[str]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._obstacles, self._objects = (
            np.array([model.geom(name).id for name in names], dtype=int)
            for names in (obstacles, objects)
        )
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        collides[[*self._obstacles, *_table(model)]] = False
        self._others = np.flatnonzero(collides)

    def __call__(self, state: Array, present: Array) -> float:
        """Returns how far present obstacles and objects are from arm and objects, up to 0.1 m.

        Args:
            state: the state of a world.
            present: which obstacles the world has, ``(m,)``.
        """
        model, data = self._model, self._data
        mujoco.mj_setState(model, data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_kinematics(model, data)
        nearest = FARTHEST
        for shape in [*self._obstacles[present], *self._objects]:
            others = self._others[self._others != shape]
            apart = np.linalg.norm(data.geom_xpos[others] - data.geom_xpos[shape], axis=1)
            radii = model.geom_rbound[others] + model.geom_rbound[shape]
            for other in others[apart - radii < nearest].tolist():
                distance = mujoco.mj_geomDistance(model, data, int(shape), other, nearest, None)
                nearest = min(nearest, distance)
        return nearest


def _table(model: Any) -> list[int]:
    """What stands in the world body: the table, and no part of the arm."""
    return np.flatnonzero(model.geom_bodyid == 0).tolist()
