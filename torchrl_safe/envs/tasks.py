"""Tasks: what the arm is to do, its reward and when it has succeeded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from torchrl_safe._checks import as_number, check_flag, check_kind, check_positive
from torchrl_safe.envs.obstacles.shapes import Box, Shape, check_shapes
from torchrl_safe.envs.regions import NoRoomError, Region
from torchrl_safe.envs.state import ArmState, Array

_ATTEMPTS, _PAIRS = 30, 64
# Half the width of closed fingers, m.
_HALF_A_TOOL = 0.01
# What it is worth to bring an object to its goal.
_BONUS = 10.0
# An object that is further away, m, has left the table, and falls without end.
_LOST = 1.0
# Lengths to pick up, m: how much wider than the object fingers open on each side, and how near to
# it they hold it; how high the tool comes; what the object's way counts as while nothing holds it.
_ROOM, _CLOSED, _ABOVE, _FAR = 0.02, 0.004, 0.06, 0.5


@runtime_checkable
class Task(Protocol):
    """Protocol of a task: objects to move, goals, reward and success.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv, NoObstacles
        >>> class StayAbove:
        ...     objects = ()
        ...
        ...     def sample(self, rng, goals):
        ...         return goals.sample(rng), np.zeros((0, 3))
        ...
        ...     def reward(self, state):
        ...         return -np.linalg.norm((state.goal - state.ee_position)[:, :2], axis=1)
        ...
        ...     def success(self, state):
        ...         return np.zeros(len(state.goal), dtype=bool)  # The time limit ends the episode.
        >>> env = ArmEnv(task=StayAbove(), obstacles=NoObstacles())
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([1, 3, 1])
        >>> env.close()
    """

    @property
    def objects(self) -> tuple[Shape, ...]:
        """The p objects that the arm is to move; the same in every world."""

    def sample(self, rng: np.random.Generator, goals: Region) -> tuple[Array, Array]:
        """Draws the goal, m, ``(3,)``, and the objects' centres, m, ``(p, 3)``, of one world.

        Args:
            rng: the generator of the world.
            goals: where the arm can reach goals (:attr:`~torchrl_safe.envs.ArmModel.goals`).

        Raises:
            NoRoomError: if this draw has failed. The environment draws again.
        """

    def reward(self, state: ArmState) -> Array:
        """Returns the reward of each world, shape ``(N,)``."""

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        """Returns which worlds have succeeded, shape ``(N,)``; success ends the episode."""


@dataclass(frozen=True)
class Reach:
    """Bring the tool point within ``radius`` of a target.

    The reward of a step is minus the distance between tool and target, in metres; since
    success ends the episode (``terminated``), the return is best for a fast approach.

    Args:
        region: where targets are drawn, uniformly. ``None`` takes the arm's ``goals``.
        radius: distance at which the target counts as reached, m.
        order: order of the distance's norm: 2 is Euclidean, 1 is the paper's.
        sparse: reward each step with -1 until success and 0 at success, instead.

    Raises:
        TypeError: if ``region`` is not a Region.
        ValueError: if ``radius`` is not positive or ``order`` is less than 1.

    Examples:
        >>> Reach(radius=0.03)
        Reach(region=None, radius=0.03, order=2, sparse=False)
    """

    region: Region | None = None
    radius: float = 0.05
    order: float = 2
    sparse: bool = False

    def __post_init__(self) -> None:
        _check(self.region, self.radius)
        check_flag(sparse=self.sparse)
        if not as_number(self.order) >= 1:
            raise ValueError(f"order must be at least 1, got {self.order!r}.")

    @property
    def objects(self) -> tuple[Shape, ...]:
        return ()

    def sample(self, rng: np.random.Generator, goals: Region) -> tuple[Array, Array]:
        return (self.region or goals).sample(rng), np.zeros((0, 3))

    def reward(self, state: ArmState) -> Array:
        return _reward(self._distance(state), self.radius, self.sparse)

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        return self._distance(state) < self.radius

    def _distance(self, state: ArmState) -> Array:
        return np.linalg.norm(state.ee_position - state.goal, ord=self.order, axis=1)


@dataclass(frozen=True)
class Push:
    r"""Push a cube over the table to a goal.

    Success within 0.05 m and the cube are those of panda-gym's PandaPush (Gallouédec et al. 2021,
    arXiv 2106.13687); success ends the episode (``terminated``). In contrast to PandaPush, goals
    are the arm's own, and the cube never starts near its goal, which leaves room for an obstacle.
    Pushing takes longer than reaching: give the environment ``max_episode_steps=60``, or 200 where
    the cube has to go round an obstacle.

    The reward of a step is the progress :math:`(w - w') / \text{radius}`, where w and w' are what
    is left to do before and after it, and 10 more at success. With the object at o, the goal at g
    and the tool at t,

    .. math::
        w = \min(|o - g|, 1) + \min(|t - b|, 1)

    where b is behind the object, seen from the goal, and at its upper half: panda-gym's dense
    reward :math:`-|o - g|` does not change before the first touch. An object more than 1 m away has
    left the table, and nothing changes while it falls. At success w' is 0. Progress is
    potential-based shaping (Ng et al. 1999), :math:`\gamma \Phi(s') - \Phi(s)` with :math:`\Phi =
    -w / \text{radius}`, of the reward :math:`-(1 - \gamma) w' / \text{radius}`, for every discount
    :math:`\gamma`: the same policies are best with and without it, and a critic has less to learn.

    Args:
        region: where the cube and its goal are drawn, uniformly; heights do not matter. ``None``
            takes the arm's ``goals``.
        radius: distance between cube and goal at which the task is done, m.
        distance: smallest distance between cube and goal at the start, m.
        shape: the object; it starts upright on the table.
        shaped: reward progress. ``False`` rewards with minus the distance between cube and goal,
            in metres, as panda-gym does.
        sparse: reward each step with -1 until success and 0 at success, instead.

    Raises:
        TypeError: if ``region`` or ``shape`` is not of its kind.
        ValueError: if a length is not positive or the shape has no mass.
        NoRoomError: in :meth:`sample`, if the region is too small for the distance.

    Examples:
        >>> region = Region((0.5, -0.2, 0.0), (0.6, 0.2, 0.0))
        >>> goal, cube = Push().sample(np.random.default_rng(0), region)
        >>> float(goal[2]), cube.shape
        (0.02, (1, 3))
    """

    region: Region | None = None
    radius: float = 0.05
    distance: float = 0.3
    shape: Shape = Box((0.02, 0.02, 0.02), mass=1.0)
    shaped: bool = True
    sparse: bool = False

    def __post_init__(self) -> None:
        _check(self.region, self.radius)
        check_flag(shaped=self.shaped, sparse=self.sparse)
        check_shapes("shape", (self.shape,), movable=True)
        _check_distance(self.distance, self.radius)

    @property
    def objects(self) -> tuple[Shape, ...]:
        return (self.shape,)

    def sample(self, rng: np.random.Generator, goals: Region) -> tuple[Array, Array]:
        return _apart(rng, self.region or goals, self.distance, self.shape)

    def reward(self, state: ArmState) -> Array:
        if self.shaped and not self.sparse:
            return _progress(state, self._way, self.radius)
        return _reward(_object_distance(state), self.radius, self.sparse)

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        return _object_distance(state) < self.radius

    def _way(self, state: ArmState) -> Array:
        """How far it is still to go, m."""
        place = state.object_position[:, 0]
        forward = (state.goal - place) * (1, 1, 0)
        forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
        behind = place - (max(self.shape.half_extents[:2]) + _HALF_A_TOOL) * forward
        behind[:, 2] += self.shape.half_extents[2] / 2
        to_behind = np.linalg.norm(state.ee_position - behind, axis=1)
        return np.minimum(_object_distance(state), _LOST) + np.minimum(to_behind, _LOST)


@dataclass(frozen=True)
class PickAndPlace:
    r"""Grasp a cube and bring it to a goal, in the air or on the table.

    Success within 0.05 m, the size of the cube and the share of goals on the table are
    those of panda-gym's PandaPickAndPlace (Gallouédec et al. 2021, arXiv 2106.13687); success
    ends the episode (``terminated``). As in :class:`Push`, the cube never starts near its goal.
    It weighs 0.1 kg instead of 1 kg: panda-gym's fingers press with 170 N, a Panda's URDF allows
    20 N, and 1 kg slips from such fingers when the arm starts to move fast. The action must move
    the fingers: ``CartesianDelta(finger_step=0.04)``, and an episode needs
    ``max_episode_steps=100``.

    The reward of a step is the progress and 10 more at success, as in :class:`Push`, with

    .. math::
        w = c + \min(|t - o|, 1) + h + 3 f

    - c is :math:`|o - g|` while the object is held, and 0.5 m, its largest value, while it is not,
      so pushing the object is no progress.
    - h makes the tool come from above: it is how far the tool is below the height at which it
      should be, which is the horizontal distance to the object, up to 0.06 m.
    - f is how far the fingers still have to move: to open by 0.02 m more than the object takes and,
      when the tool point is in the object, to close on it.

    Args:
        region: where the goal is drawn, uniformly, and the cube below; a goal in the air is not
            lower than one on the table. ``None`` takes the arm's ``goals``.
        radius: distance between cube and goal at which the task is done, m.
        distance: smallest horizontal distance between cube and goal at the start, m.
        on_table: share of the goals that lie on the table.
        shape: the object, as wide along x as along y; it starts upright on the table.
        shaped: reward progress. ``False`` rewards with minus the distance between cube and goal,
            in metres, as panda-gym does.
        sparse: reward each step with -1 until success and 0 at success, instead.

    Raises:
        TypeError: if ``region`` or ``shape`` is not of its kind.
        ValueError: if a length is not positive, the shape has no mass or another width than depth,
            or ``on_table`` is not a share; in :meth:`reward`, if the fingers are fixed.
        NoRoomError: in :meth:`sample`, if the region is too small for the distance.

    Examples:
        >>> PickAndPlace(on_table=0.0).objects
        (Box(half_extents=(0.02, 0.02, 0.02), mass=0.1),)
    """

    region: Region | None = None
    radius: float = 0.05
    distance: float = 0.3
    on_table: float = 0.3
    shape: Shape = Box((0.02, 0.02, 0.02), mass=0.1)
    shaped: bool = True
    sparse: bool = False

    def __post_init__(self) -> None:
        _check(self.region, self.radius)
        check_flag(shaped=self.shaped, sparse=self.sparse)
        check_shapes("shape", (self.shape,), movable=True)
        deep, wide, _ = self.shape.half_extents
        if not math.isclose(deep, wide, rel_tol=0.01):
            raise ValueError(
                "shape must be as wide along x as along y, for the fingers to close on it from any "
                f"side, got {self.shape}."
            )
        _check_distance(self.distance, self.radius)
        if not 0 <= as_number(self.on_table) <= 1:
            raise ValueError(f"on_table must be between 0 and 1, got {self.on_table!r}.")

    @property
    def objects(self) -> tuple[Shape, ...]:
        return (self.shape,)

    def sample(self, rng: np.random.Generator, goals: Region) -> tuple[Array, Array]:
        region = self.region or goals
        goal, objects = _apart(rng, region, self.distance, self.shape)
        if rng.random() >= self.on_table:
            goal[2] = max(goal[2], rng.uniform(region.low[2], region.high[2]))
        return goal, objects

    def reward(self, state: ArmState) -> Array:
        if not state.finger_position.shape[1]:
            raise ValueError(
                "action must move the fingers to pick something up, such as "
                "CartesianDelta(finger_step=0.04); this one has no finger_step."
            )
        if self.shaped and not self.sparse:
            return _progress(state, self._way, self.radius)
        return _reward(_object_distance(state), self.radius, self.sparse)

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        return _object_distance(state) < self.radius

    def _way(self, state: ArmState) -> Array:
        """How far it is still to go, m."""
        from_object = state.ee_position - state.object_position[:, 0]
        distance, half = np.linalg.norm(from_object, axis=1), self.shape.half_extents[0]
        beside = np.linalg.norm(from_object[:, :2], axis=1)
        too_low = np.maximum(0, np.minimum(beside, _ABOVE) - from_object[:, 2])
        opening = state.finger_position.mean(axis=1)
        inside, to_close = distance < half, np.abs(opening - half)
        fingers = np.where(inside, to_close, np.maximum(0, half + _ROOM - opening) + _ROOM)
        held = inside & (to_close < _CLOSED)
        carrying = np.where(held, np.minimum(_object_distance(state), _FAR), _FAR)
        return carrying + np.minimum(distance, _LOST) + too_low + 3 * fingers


def _check(region: Region | None, radius: float) -> None:
    if region is not None:
        check_kind("region", region, Region)
    check_positive(radius=radius)


def _check_distance(distance: float, radius: float) -> None:
    check_positive(distance=distance)
    if distance <= radius:
        raise ValueError(f"distance must be more than radius, {radius}, got {distance}.")


def _reward(distance: Array, radius: float, sparse: bool) -> Array:
    return -(distance >= radius).astype(float) if sparse else -distance


def _progress(state: ArmState, way: Callable[[ArmState], Array], radius: float) -> Array:
    """How much less there is left to do after a step, in radii; at success nothing, and a bonus."""
    if state.previous is None:
        return np.zeros(len(state.goal))
    success = _object_distance(state) < radius
    return (way(state.previous) - np.where(success, 0, way(state))) / radius + _BONUS * success


def _object_distance(state: ArmState) -> Array:
    return np.linalg.norm(state.object_position[:, 0] - state.goal, axis=1)


def _apart(
    rng: np.random.Generator, region: Region, distance: float, shape: Shape
) -> tuple[Array, Array]:
    """Draws a goal and an object on the table, at least some distance apart."""
    # Most pairs may be too close, and drawing many takes no longer than drawing a few.
    for _ in range(_ATTEMPTS):
        pairs = rng.uniform(region.low, region.high, (_PAIRS, 2, 3))
        pairs[:, :, 2] = shape.half_extents[2]
        wide = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1) >= distance
        if wide.any():
            goal, place = pairs[wide.argmax()]
            return goal, place[None]
    raise NoRoomError(
        f"region must be wide enough for goals at a distance of {distance} m, got {region}."
    )
