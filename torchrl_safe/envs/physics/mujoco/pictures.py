"""Draws worlds, with or without a screen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.physics.mujoco.canvas import Canvas
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.palette import TOUCHED
from torchrl_safe.envs.physics.scene import Camera
from torchrl_safe.envs.state import Array


class Painter:
    """Draws a world in the states of others of the same build.

    Args:
        model: an ``MjModel`` of what is to be seen.
        obstacles: names of the obstacles' shapes in it.
    """

    def __init__(self, model: Any, obstacles: Sequence[str]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._obstacles = [model.geom(name).id for name in obstacles]
        self._colours = model.geom_rgba[self._obstacles].copy()
        self._canvas: Canvas | None = None

    def paint(
        self, qpos: Array, mocap_pos: Array, mocap_quat: Array, goal: Array,
        touched: NDArray[np.bool_], camera: Camera, width: int, height: int,
    ) -> NDArray[np.uint8]:  # fmt: skip
        """Returns an RGB picture of each world, ``(N, height, width, 3)``.

        Args:
            qpos: positions of all joints, ``(N, nq)``.
            mocap_pos: places of the obstacles that are put there, m, ``(N, b, 3)``.
            mocap_quat: their orientations (w, x, y, z), ``(N, b, 4)``.
            goal: goals, m, ``(N, 3)``.
            touched: which obstacles light up, ``(N, m)``.
            camera: where to look from.
            width: in pixels.
            height: in pixels.

        Raises:
            RuntimeError: if there is nothing to draw with.
        """
        data = self._data
        if self._canvas is None or self._canvas.size != (width, height):
            self.close()
            self._canvas = Canvas(self._model, width, height)
        self._model.vis.global_.fovy = camera.field_of_view
        view = _view(camera)
        pictures = np.empty((len(qpos), height, width, 3), np.uint8)
        for row, picture in enumerate(pictures):
            data.qpos[:] = qpos[row]
            data.mocap_pos[:-1], data.mocap_pos[-1] = mocap_pos[row], goal[row]
            data.mocap_quat[:-1] = mocap_quat[row]
            self._model.geom_rgba[self._obstacles] = np.where(
                touched[row, :, None], TOUCHED, self._colours
            )
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_comPos(self._model, data)
            mujoco.mj_camlight(self._model, data)
            self._canvas.draw(self._model, data, view, picture, shadows=camera.shadows)
        return pictures

    def close(self) -> None:
        """Frees what the pictures were drawn with."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None


def _view(camera: Camera) -> Any:
    eye, target = np.array(camera.eye), np.array(camera.target)
    x, y, z = target - eye
    view = mujoco.MjvCamera()
    view.type, view.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, target
    view.distance = math.hypot(x, y, z)
    view.azimuth = math.degrees(math.atan2(y, x))
    view.elevation = math.degrees(math.asin(z / view.distance))
    return view
