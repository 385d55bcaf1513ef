"""Motion for any layout of obstacles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from torchrl_safe._checks import check_array, check_kind, check_positive, keep_numbers
from torchrl_safe.envs.obstacles.layouts import InFront, Obstacles, Placement
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.state import Array


def _check_direction(motion: Swing | Patrol) -> None:
    if motion.direction is not None and not keep_numbers(motion, "direction", 3).any():
        raise ValueError(f"direction must not be zero, got {motion.direction}.")


def _unit(direction: tuple[float, float, float] | None, across: Array) -> Array:
    return across if direction is None else np.array(direction) / np.linalg.norm(direction)


@runtime_checkable
class Motion(Protocol):
    """Protocol of a motion for :class:`Moving`."""

    def sample(self, rng: np.random.Generator, across: Array) -> Callable[[Array], Array]:
        """Draws one obstacle's motion: maps times, s, ``(s,)``, to displacements, m, ``(s, 3)``.

        Args:
            rng: the generator of the world.
            across: horizontal unit vector across the way from start to goal, ``(3,)``.
        """


@dataclass(frozen=True)
class Swing:
    r"""A sine, :math:`a \sin(2 \pi t / T + \varphi)`, with a random phase.

    Args:
        amplitude: a, m, to each side.
        period: T, s. The largest speed is :math:`2 \pi a / T`.
        direction: of the motion; its length does not matter. ``None`` takes the horizontal
            across the way from start to goal.

    Raises:
        ValueError: if an argument is not positive or ``direction`` is zero.

    Examples:
        >>> rng, across = np.random.default_rng(0), np.array([0.0, 1.0, 0.0])
        >>> displacement = Swing(amplitude=0.1, period=2.0).sample(rng, across)
        >>> displacement(np.array([0.0, 1.0, 2.0])).shape
        (3, 3)
    """

    amplitude: float = 0.1
    period: float = 2.0
    direction: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        check_positive(amplitude=self.amplitude, period=self.period)
        _check_direction(self)

    def sample(self, rng: np.random.Generator, across: Array) -> Callable[[Array], Array]:
        phase, along = rng.uniform(0, 2 * np.pi), _unit(self.direction, across)

        def displacement(times: Array) -> Array:
            swing = np.sin(2 * np.pi * times / self.period + phase)
            return self.amplitude * swing[:, None] * along

        return displacement


@dataclass(frozen=True)
class Patrol:
    """Back and forth at constant speed, from a random point of the way.

    Args:
        distance: length of the way, m; its middle is where the layout puts the obstacle.
        speed: m/s.
        direction: of the way; its length does not matter. ``None`` takes the horizontal across
            the way from start to goal.

    Raises:
        ValueError: if an argument is not positive or ``direction`` is zero.

    Examples:
        >>> rng, across = np.random.default_rng(0), np.array([0.0, 1.0, 0.0])
        >>> displacement = Patrol(distance=0.2, speed=0.1).sample(rng, across)
        >>> bool((abs(displacement(np.linspace(0, 9, 50))) <= 0.1 + 1e-12).all())
        True
    """

    distance: float = 0.3
    speed: float = 0.2
    direction: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        check_positive(distance=self.distance, speed=self.speed)
        _check_direction(self)

    def sample(self, rng: np.random.Generator, across: Array) -> Callable[[Array], Array]:
        begin, along = rng.uniform(0, 2 * self.distance), _unit(self.direction, across)

        def displacement(times: Array) -> Array:
            way = (begin + self.speed * times) % (2 * self.distance)
            return (np.abs(way - self.distance) - self.distance / 2)[:, None] * along

        return displacement


@dataclass(frozen=True)
class Moving:
    """Any layout, in motion. The obstacles follow their way whatever they hit.

    Only their places at the start are checked to leave the arm at home and the objects free.

    Args:
        layout: where the obstacles are; must be fixed shapes (mass 0).
        motion: how each of them moves, drawn anew for each obstacle and episode.

    Raises:
        TypeError: if an argument is not of its kind.
        ValueError: if a shape has a mass.

    Examples:
        >>> layout = Moving(InFront(), Swing(amplitude=0.15))
        >>> placement = layout.sample(np.random.default_rng(0), np.zeros(3), np.ones(3))
        >>> placement.at(np.array([0.0, 0.5]))[0].shape
        (2, 1, 3)
    """

    layout: Obstacles = InFront()
    motion: Motion = Swing()

    def __post_init__(self) -> None:
        check_kind("layout", self.layout, Obstacles)
        check_kind("motion", self.motion, Motion)
        # Layouts and tasks have a method of that name too.
        try:
            displacement = self.motion.sample(np.random.default_rng(0), np.array([0.0, 1.0, 0.0]))
            check_array("displacement", displacement(np.zeros(1)), (1, 3))
        except (AttributeError, TypeError, ValueError) as error:
            raise TypeError(
                f"motion must map times to displacements, got {self.motion!r}."
            ) from error
        if any(shape.mass for shape in self.layout.shapes):
            raise ValueError(
                f"layout must have shapes of mass 0, which follow their way, got {self.layout}."
            )

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return self.layout.shapes

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Placement:
        base = self.layout.sample(rng, start, goal)
        way = goal - start
        # Straight up there is no across.
        across = np.array([-way[1], way[0], 0.0]) if way[:2].any() else np.array([0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        displacements = [self.motion.sample(rng, across) for _ in self.shapes]

        def path(times: Array) -> tuple[Array, Array]:
            positions, orientations = base.at(times)
            moved = positions.copy()
            for index, displacement in enumerate(displacements):
                moved[:, index] += displacement(times)
            return moved, orientations

        position, orientation = path(np.zeros(1))
        return Placement(position[0], orientation[0], base.present, path)
