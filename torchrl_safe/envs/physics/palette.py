"""The colours in which both engines draw, and the ring that marks the goal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.state import Array

Colour = tuple[float, float, float, float]

# They differ in lightness as well as in hue, for readers who do not see all hues.
TABLE: Colour = (0.86, 0.80, 0.70, 1.0)
FLOOR: Colour = (0.70, 0.74, 0.80, 1.0)
SKY: Colour = (0.93, 0.95, 0.98, 1.0)
#: Links of an arm that brings no shapes to show.
ARM: Colour = (0.8, 0.8, 0.82, 1.0)
OBSTACLE: Colour = (0.24, 0.27, 0.34, 1.0)
#: An obstacle in the control step in which the arm touches it.
TOUCHED: Colour = (0.90, 0.07, 0.07, 1.0)
OBJECT: Colour = (0.12, 0.42, 0.85, 1.0)
GOAL: Colour = (0.0, 0.62, 0.35, 1.0)

#: Radius of the ball at the goal, m.
GOAL_RADIUS = 0.025
#: Radius of the ring around it, m: the distance within which the tasks count a success.
RING_RADIUS = 0.05
_TUBE = 0.008
# Around the ring, and around its tube.
_EDGES = 32, 8


def ring() -> tuple[Array, NDArray[np.int32]]:
    """Returns a ring that lies flat: vertices, m, ``(v, 3)``, and triangles, ``(t, 3)``."""
    around, across = _EDGES
    turn, tilt = np.meshgrid(
        np.linspace(0, 2 * np.pi, around, endpoint=False),
        np.linspace(0, 2 * np.pi, across, endpoint=False),
        indexing="ij",
    )
    radius = RING_RADIUS + _TUBE * np.cos(tilt)
    vertices = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), _TUBE * np.sin(tilt)], axis=-1
    )
    index = np.arange(around * across).reshape(around, across)
    beside, above = np.roll(index, -1, axis=0), np.roll(index, -1, axis=1)
    corner = np.roll(beside, -1, axis=1)
    halves = [np.stack(half, axis=-1) for half in ((index, beside, corner), (index, corner, above))]
    return vertices.reshape(-1, 3), np.concatenate(halves).reshape(-1, 3).astype(np.int32)


def colour(shape: Shape, default: Colour) -> Colour:
    """Returns the colour of a shape: that of its look, or else the default."""
    return default if shape.look is None else (*shape.look.colour, 1.0)
