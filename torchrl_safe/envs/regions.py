"""Regions of space as data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_safe._checks import keep_numbers
from torchrl_safe.envs.state import Array


class NoRoomError(ValueError):
    """A draw has found no room; :class:`~torchrl_safe.envs.ArmEnv` then draws again.

    Raise it in the ``sample`` of a task or a layout of your own where another goal, or the next
    numbers of the generator, may do better. Any other error ends the run.

    Examples:
        >>> raise NoRoomError("gap must be less than the way to the goal.")
        Traceback (most recent call last):
        torchrl_safe.envs.regions.NoRoomError: gap must be less than the way to the goal.
    """


@dataclass(frozen=True)
class Region:
    """A box with its sides along the axes of the world.

    Args:
        low: lower corner, m.
        high: upper corner, m; a side may have no length.

    Raises:
        ValueError: if a corner is not three finite numbers or ``low`` exceeds ``high``.

    Examples:
        >>> Region(low=(0.6, -0.2, 0.05), high=(0.7, 0.2, 0.15)).contains([0.65, 0.0, 0.1])
        array(True)
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        low, high = keep_numbers(self, "low", 3), keep_numbers(self, "high", 3)
        if not np.all(low <= high):
            raise ValueError(f"low must not exceed high, got {self.low} and {self.high}.")

    def sample(self, rng: np.random.Generator) -> Array:
        """Draws a point uniformly, m, shape ``(3,)``."""
        return rng.uniform(self.low, self.high)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Returns which of the points, m, ``(..., 3)``, lie in the box or on its sides, ``(...)``.

        Raises:
            ValueError: if the points do not have three coordinates each.
        """
        points = np.asarray(points, dtype=float)
        if points.shape[-1:] != (3,):
            raise ValueError(f"points must have shape (..., 3), got {points.shape}.")
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=-1))
