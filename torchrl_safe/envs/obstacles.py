"""Obstacles: their shapes, and layouts that say where they stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from torchrl_safe.envs.checks import check_array, check_positive
from torchrl_safe.envs.state import Array


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder.

    Args:
        radius: m.
        height: m.
        mass: kg; 0 fixes it in place, anything else can be pushed and knocked over.

    Raises:
        ValueError: if a size is not positive or the mass is negative.

    Examples:
        >>> Cylinder(radius=0.04, height=0.3).half_extents
        (0.04, 0.04, 0.15)
    """

    radius: float = 0.05
    height: float = 0.2
    mass: float = 0.0

    def __post_init__(self) -> None:
        check_positive(radius=self.radius, height=self.height)
        if not 0 <= self.mass < np.inf:
            raise ValueError(f"mass must be finite and not negative, got {self.mass}.")

    @property
    def half_extents(self) -> tuple[float, float, float]:
        """Half of the size along x, y and z, m."""
        return (self.radius, self.radius, self.height / 2)


@runtime_checkable
class Obstacles(Protocol):
    """What :class:`~torchrl_safe.envs.ArmEnv` asks of a layout of obstacles."""

    @property
    def shapes(self) -> tuple[Cylinder, ...]:
        """The shape of each obstacle; the same in every world."""

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Array:
        """Draws the centres of one world's obstacles, m, shape ``(m, 3)``.

        Args:
            rng: the generator of the world.
            start: tool point at the start of the episode, m, shape ``(3,)``.
            goal: target position, m, shape ``(3,)``.
        """


@dataclass(frozen=True)
class InFront:
    """One obstacle between the arm and the target.

    Args:
        gap: horizontal distance between the target and the obstacle's centre, m.
        shape: the obstacle; it stands on the table.
        direction: horizontal direction in which the obstacle is passed on the way to the
            target. ``None`` takes that from start to target, so that the obstacle always
            stands in the way.
        height: height of the obstacle's centre, m. ``None`` stands it on the table.

    Raises:
        ValueError: if ``gap`` is not positive or ``direction`` is not horizontal; when a goal
            is drawn that leaves no room for the obstacle before it.

    Examples:
        >>> InFront(gap=0.2).shapes
        (Cylinder(radius=0.05, height=0.2, mass=0.0),)
    """

    gap: float = 0.15
    shape: Cylinder = Cylinder()
    direction: tuple[float, float, float] | None = None
    height: float | None = None

    def __post_init__(self) -> None:
        check_positive(gap=self.gap)
        if self.direction is not None:
            direction = check_array("direction", self.direction, (3,))
            if direction[2] != 0 or not direction.any():
                raise ValueError(
                    f"direction must be horizontal and not zero, got {self.direction}."
                )
        if self.height is not None:
            check_array("height", self.height, ())

    @property
    def shapes(self) -> tuple[Cylinder, ...]:
        return (self.shape,)

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Array:
        way = np.array(goal - start if self.direction is None else self.direction, dtype=float)
        way[2] = 0
        length = np.linalg.norm(way)
        if self.direction is None and length <= self.gap:
            raise ValueError(
                f"gap must be less than the horizontal distance from the tool at home to the "
                f"goal, got a gap of {self.gap} and a distance of {length:.3f}."
            )
        centre = goal - self.gap * way / length
        centre[2] = self.shape.height / 2 if self.height is None else self.height
        return centre[None]


@dataclass(frozen=True)
class NoObstacles:
    """An empty table.

    Examples:
        >>> NoObstacles().shapes
        ()
    """

    @property
    def shapes(self) -> tuple[Cylinder, ...]:
        return ()

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Array:
        return np.zeros((0, 3))
