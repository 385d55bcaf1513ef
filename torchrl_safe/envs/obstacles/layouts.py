"""Layouts of obstacles: what stands where at the start of an episode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from torchrl_safe._checks import (
    check_array,
    check_count,
    check_kind,
    check_not_negative,
    check_positive,
    check_unit,
    keep_numbers,
)
from torchrl_safe.envs.obstacles.shapes import Cylinder, Shape, footprint
from torchrl_safe.envs.regions import NoRoomError, Region
from torchrl_safe.envs.rotations import UPRIGHT, from_rotation_vector
from torchrl_safe.envs.state import Array

#: Positions ``(s, m, 3)``, m, and orientations ``(s, m, 4)`` at s times after the start, s.
Path = Callable[[Array], tuple[Array, Array]]

_ATTEMPTS = 1000


@dataclass(frozen=True)
class Placement:
    """The m obstacles of one world in one episode.

    Args:
        position: centres at the start, m, ``(m, 3)``.
        orientation: quaternions (x, y, z, w), ``(m, 4)``. ``None`` stands all upright.
        present: which obstacles this episode has, ``(m,)``; the others are out of the world.
            ``None`` stands for all.
        path: how the obstacles move, from time 0; only for fixed shapes (mass 0). ``None``
            leaves them where they are, or to physics.

    Raises:
        TypeError: if ``path`` is not callable.
        ValueError: if something has the wrong shape or is not finite, or an orientation is not a
            unit quaternion.

    Examples:
        >>> Placement([[0.5, 0.0, 0.1]]).present
        array([ True])
    """

    position: Array
    orientation: Array = None  # type: ignore[assignment]
    present: NDArray[np.bool_] = None  # type: ignore[assignment]
    path: Path | None = None

    def __post_init__(self) -> None:
        count = len(self.position) if np.iterable(self.position) else 0
        upright = np.tile(UPRIGHT, (count, 1))
        present = np.ones(count, bool) if self.present is None else np.asarray(self.present)
        if count and present.dtype != bool:
            raise ValueError(f"present must be bool, got {self.present!r}.")
        if not (self.path is None or callable(self.path)):
            raise TypeError(f"path must be callable, got {self.path!r}.")
        if present.shape != (count,):
            raise ValueError(f"present must have shape {(count,)}, got {present.shape}.")
        filled = {
            "position": check_array("position", self.position, (count, 3)),
            "orientation": check_array(
                "orientation", upright if self.orientation is None else self.orientation, (count, 4)
            ),
            "present": present,
        }
        check_unit("orientation", filled["orientation"])
        for name, value in filled.items():
            object.__setattr__(self, name, value)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Returns positions ``(s, m, 3)`` and orientations ``(s, m, 4)`` at times ``(s,)``.

        Raises:
            ValueError: if the path has the wrong shape or is not finite, or an orientation is not
                a unit quaternion.
        """
        repeats, count = len(times), len(self.position)
        if self.path is not None:
            places, turns = self.path(times)
            places = check_array("positions of the path", places, (repeats, count, 3))
            turns = check_array("orientations of the path", turns, (repeats, count, 4))
            check_unit("each orientation of the path", turns)
            # The path may keep what it returns, and simulators write where obstacles are absent.
            return places.copy(), turns.copy()
        return (
            np.repeat(self.position[None], repeats, axis=0),
            np.repeat(self.orientation[None], repeats, axis=0),
        )


@runtime_checkable
class Obstacles(Protocol):
    """Protocol of a layout of obstacles: their shapes, and where they are in an episode.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv, Box
        >>> class Gate:
        ...     shapes = (Box((0.02, 0.02, 0.15)),) * 2
        ...
        ...     def sample(self, rng, start, goal):
        ...         beside = np.array([[0, -0.15, 0], [0, 0.15, 0]])
        ...         return Placement(np.array([goal[0], goal[1], 0.15]) + beside)
        >>> env = ArmEnv(obstacles=Gate())
        >>> env.reset()["observation"].shape
        torch.Size([1, 57])
        >>> env.close()
    """

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The shape of each obstacle; the same in every world."""

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Placement:
        """Places one world's obstacles for an episode.

        While an obstacle touches the arm at home or an object, the environment draws another
        goal and asks again.

        Args:
            rng: the generator of the world.
            start: where the way to the goal begins, m, shape ``(3,)``: the tool point at home,
                or the object that the task moves.
            goal: target position, m, shape ``(3,)``.

        Raises:
            NoRoomError: if there is no room for them. The environment then draws another goal.
        """


@dataclass(frozen=True)
class NoObstacles:
    """An empty table.

    Examples:
        >>> NoObstacles().shapes
        ()
    """

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return ()

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Placement:
        return Placement(np.zeros((0, 3)))


@dataclass(frozen=True)
class InFront:
    """One obstacle on the way to the target.

    Args:
        gap: horizontal distance between the target and the obstacle's centre, m.
        shape: the obstacle.
        direction: horizontal direction in which the obstacle is passed on the way to the
            target. ``None`` takes the direction from start to target, so that the obstacle is
            always in the way.
        height: height of the obstacle's centre, m. ``None`` stands it on the table.

    Raises:
        TypeError: if ``shape`` is not a shape.
        ValueError: if ``gap`` leaves the goal inside the obstacle or ``direction`` is not
            horizontal.
        NoRoomError: in :meth:`sample`, if the goal is no further than ``gap`` from the start.

    Examples:
        >>> InFront(gap=0.2).shapes
        (Cylinder(radius=0.05, height=0.2, mass=0.0),)
    """

    gap: float = 0.15
    shape: Shape = Cylinder()
    direction: tuple[float, float, float] | None = None
    height: float | None = None

    def __post_init__(self) -> None:
        check_positive(gap=self.gap)
        check_kind("shape", self.shape, Shape)
        if self.gap <= footprint(self.shape):
            raise ValueError(
                f"gap must leave the goal free, more than the obstacle's radius of "
                f"{footprint(self.shape):.3f}, got {self.gap}."
            )
        if self.direction is not None:
            direction = keep_numbers(self, "direction", 3)
            if direction[2] != 0 or not direction.any():
                raise ValueError(
                    f"direction must be horizontal and not zero, got {self.direction}."
                )
        if self.height is not None:
            check_array("height", self.height, ())

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return (self.shape,)

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Placement:
        if self.direction is None:
            way = (goal - start) * (1, 1, 0)
        else:
            # The square of a short one could be 0.
            way = np.array(self.direction) / np.abs(self.direction).max()
        length = np.linalg.norm(way)
        if self.direction is None and length <= self.gap:
            raise NoRoomError(
                f"gap must be less than the horizontal distance from the start to the goal, got a "
                f"gap of {self.gap} and a distance of {length:.3f}."
            )
        centre = goal - self.gap * way / length
        centre[2] = self.shape.half_extents[2] if self.height is None else self.height
        return Placement(centre[None])


@dataclass(frozen=True)
class Scattered:
    """Obstacles at random places that leave start and goal free.

    They stand turned at random, each at least ``clearance`` away from start and goal: room for
    a gripper that points down. The environment draws again while the arm at home touches one.

    Args:
        count: number of obstacles, the largest if it varies.
        fewest: smallest number of obstacles; each episode draws a number up to ``count``, all
            equally likely. ``None`` always takes ``count``.
        region: where their lower ends may be. Height 0 stands them on the table.
        shape: the obstacles.
        clearance: smallest horizontal distance between an obstacle and start or goal, m.
        spacing: smallest horizontal distance between two obstacles, m.

    Raises:
        TypeError: if ``region`` or ``shape`` is not of its kind.
        ValueError: if an argument is not usable.
        NoRoomError: in :meth:`sample`, if the region has no room for ``count`` obstacles beside
            start and goal.

    Examples:
        >>> layout = Scattered(count=4, fewest=0)
        >>> start, goal = np.array([0.35, 0.0, 0.2]), np.array([0.65, 0.0, 0.1])
        >>> layout.sample(np.random.default_rng(1), start, goal).present
        array([ True,  True, False, False])
    """

    count: int = 3
    fewest: int | None = None
    region: Region = Region((0.3, -0.4, 0.0), (0.75, 0.4, 0.0))
    shape: Shape = Cylinder()
    clearance: float = 0.12
    spacing: float = 0.02

    def __post_init__(self) -> None:
        check_count(count=self.count)
        check_kind("region", self.region, Region)
        check_kind("shape", self.shape, Shape)
        check_not_negative(clearance=self.clearance, spacing=self.spacing)
        if self.fewest is not None:
            check_count(least=0, fewest=self.fewest)
            if self.fewest > self.count:
                raise ValueError(
                    f"fewest must be a whole number between 0 and count = {self.count}, got "
                    f"{self.fewest}."
                )

    @property
    def shapes(self) -> tuple[Shape, ...]:
        return (self.shape,) * self.count

    def sample(self, rng: np.random.Generator, start: Array, goal: Array) -> Placement:
        count = self.count
        if self.fewest is not None:
            count = int(rng.integers(self.fewest, self.count, endpoint=True))
        position = np.zeros((self.count, 3))
        for index in range(count):
            position[index] = self._draw(rng, start, goal, position[:index])
        yaw = np.zeros((self.count, 3))
        yaw[:, 2] = rng.uniform(-np.pi, np.pi, self.count)
        position[:, 2] += self.shape.half_extents[2]
        return Placement(position, from_rotation_vector(yaw), np.arange(self.count) < count)

    def _draw(self, rng: np.random.Generator, start: Array, goal: Array, others: Array) -> Array:
        radius = footprint(self.shape)
        ends = np.array([start, goal])[:, :2]
        for _ in range(_ATTEMPTS):
            place = self.region.sample(rng)
            from_ends = np.linalg.norm(ends - place[:2], axis=1) - radius
            from_others = np.linalg.norm(others[:, :2] - place[:2], axis=1) - 2 * radius
            if (from_ends >= self.clearance).all() and (from_others >= self.spacing).all():
                return place
        raise NoRoomError(
            f"region must have room for {self.count} obstacles, {self.clearance} m from start "
            f"{start.round(3).tolist()} and goal {goal.round(3).tolist()}, got {self.region}."
        )
