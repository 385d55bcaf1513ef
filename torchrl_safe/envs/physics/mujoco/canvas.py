"""Something to draw on, with or without a screen."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

from torchrl_safe.envs.physics.mujoco.engine import mujoco

_SCREENS = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
# Without a screen, in the order in which they are tried.
_SCREENLESS = ("mujoco.egl", "mujoco.osmesa")


def make_canvas(width: int, height: int) -> Any:
    """Returns an OpenGL context, current: MuJoCo's own choice, or without a screen what there is.

    MuJoCo chooses when it is imported, which may have happened before, and assumes that there is a
    screen.

    Raises:
        RuntimeError: if there is none.
    """
    failures = []
    screenless = sys.platform == "linux" and not any(map(os.environ.get, _SCREENS))
    for module in _SCREENLESS if screenless else ("mujoco",):
        try:
            canvas = import_module(module).GLContext(width, height)
            canvas.make_current()
        except Exception as error:  # Each fails with other errors.
            failures.append(f"{module}: {error}")
        else:
            return canvas
    raise RuntimeError(
        "MuJoCo cannot draw here. Without a screen it needs EGL (Debian: apt-get install libegl1 "
        f"libgl1-mesa-dri) or OSMesa (apt-get install libosmesa6). Tried: {'; '.join(failures)}."
    )


class Canvas:
    """Where one model is drawn in one size.

    Args:
        model: the ``MjModel``.
        width: in pixels.
        height: in pixels.

    Raises:
        RuntimeError: if there is nothing to draw with.
    """

    def __init__(self, model: Any, width: int, height: int) -> None:
        #: Width and height in pixels.
        self.size = (width, height)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl = make_canvas(width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._option, self._rectangle = mujoco.MjvOption(), mujoco.MjrRect(0, 0, width, height)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def draw(self, model: Any, data: Any, view: Any, picture: Any, *, shadows: bool) -> None:
        """Draws a world into an array, ``(height, width, 3)``."""
        self._gl.make_current()
        mujoco.mjv_updateScene(
            model, data, self._option, None, view, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, self._rectangle, self._context)
        # OpenGL counts lines from below.
        picture[:] = picture[::-1].copy()

    def close(self) -> None:
        """Frees it."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
