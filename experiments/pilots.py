"""Scripted policies to learn from, which know what to do next in any state.

A pilot maps the state of all worlds to where each tool is to go next and how far its fingers are to
be open. It has no memory. What it does is a function of the state, so a network can learn it, and
it can advise that network in any state (:mod:`experiments.demonstrations`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from torchrl_safe.envs import (
    IIWA,
    PANDA,
    ArmEnv,
    ArmState,
    CartesianDelta,
    Human,
    Moving,
    PickAndPlace,
    Push,
    Reach,
)
from torchrl_safe.envs.state import Array

# Where the fingers' ends, 1 cm below the tool point, take the upper half of a cube, m.
_LOW = 0.033
# How far above the table the tool goes over to the object where there are no obstacles, m.
_ABOVE_TABLE = 0.12
# How far the tool goes in a control step beside what moves, m. Where that is not far off, it slows
# down, m.
_PACE, _SLOWER = 0.027, 0.1
# How far an object is pushed in a control step, m.
_PUSH = 0.02
# What of the hand is to be out of the way: heights above the tool point, and half its width, m.
_HAND, _HALF_WIDTH = (0.0, 0.1, 0.2), 0.07
# How high an obstacle is that the hand passes over while the fingers are at the table, and how far
# from its side the object then keeps, m.
_UNDER_HAND, _BESIDE = 0.07, 0.11
# Share of the largest action: a policy that squashes its output can give it.
_SHARE = 0.9


@dataclass(frozen=True)
class Care:
    """How far a pilot keeps off what it should not touch.

    Args:
        over: how far above obstacles the tool goes over them, m.
        slope: how steeply it comes down to a place, m up for each m sideways.
        aside: how far from the goal an object is put, away from the nearest obstacle, m.
        narrower: how much narrower the way round an obstacle is on which an object is pushed, m
            along x, where the hand is wide, and y.
        room: how far off what moves is to be, or the tool goes back, m.
        time: how far ahead it looks, s: an obstacle that comes nearer counts as where it will be
            then.
    """

    over: float
    slope: float
    aside: float
    narrower: tuple[float, float]
    room: float
    time: float


#: Keeps the limits of the suite with something to spare.
CAREFUL = Care(over=0.13, slope=5, aside=0.035, narrower=(0, 0), room=0.11, time=0.5)
#: Does the task as reliably and sooner, and does not keep the limits.
HURRIED = Care(over=0.1, slope=1.5, aside=-0.01, narrower=(0.03, 0.01), room=0.075, time=0.4)


class Pilot(Protocol):
    """What tells each tool where to go."""

    def __call__(self, state: ArmState) -> tuple[Array, Array]:
        """Returns where the tools go, m, ``(N, 3)``, and how far fingers open, 0 to 1, ``(N,)``."""


def act(env: ArmEnv, pilot: Pilot) -> Array:
    """Returns the actions of a pilot in the present state, ``(N, width)``."""
    target, opening = pilot(env.arm_state)
    mode = env.action_mode
    assert isinstance(mode, CartesianDelta)  # ``make_pilot`` checks it.
    move = (target - env.arm_state.ee_position) / mode.step
    move *= _SHARE / np.maximum(_SHARE, np.abs(move).max(1, keepdims=True))
    if not mode.moves_fingers:
        return move
    return np.column_stack([move, _SHARE * (2 * opening - 1)])


@dataclass(frozen=True)
class ReachPilot:
    """Up, over everything, and down to the goal.

    Args:
        care: how far it keeps off obstacles.
    """

    care: Care = CAREFUL

    def __call__(self, state: ArmState) -> tuple[Array, Array]:
        top = np.maximum(_safe_height(state, self.care), state.goal[:, 2])
        way = _from_above(state.ee_position, state.goal, top, self.care)
        return way, np.zeros(len(state.goal))


@dataclass(frozen=True)
class PickAndPlacePilot:
    """From above to the object, over everything to the goal, and down.

    Args:
        care: how far it keeps off obstacles.
    """

    care: Care = CAREFUL

    def __call__(self, state: ArmState) -> tuple[Array, Array]:
        tool, place = state.ee_position, state.object_position[:, 0]
        goal, top = _beside_goal(state, self.care.aside), _safe_height(state, self.care)
        from_object = tool - place
        near = (_length(from_object[:, :2]) < 0.012) & (np.abs(tool[:, 2] - _LOW) < 0.012)
        opening = state.finger_position.mean(axis=1)
        held = (_length(from_object) < 0.03) & (opening < 0.024)
        low = np.column_stack([place[:, :2], np.maximum(_LOW, place[:, 2])])
        pick = _from_above(tool, low, top, self.care)
        put = _from_above(tool, goal, np.maximum(top, goal[:, 2]), self.care)
        # A tool that rests on an obstacle leaves it towards the goal. If it pressed on, it would
        # stay there.
        touches = (state.contact_distance <= 0).any(axis=1, keepdims=True)
        put = np.where(touches, _off(tool, _beside_goal(state, CAREFUL.aside)), put)
        target = np.where(held[:, None], put, pick)
        return target, np.where(held | near, 0.0, 1.0)


@dataclass(frozen=True)
class PushPilot:
    """Round the obstacles on the side of the base, always behind the object.

    Args:
        room: half axes of the ellipse around each obstacle that the object stays out of, m, along
            x, where the hand is wide, and y.
        care: how far it keeps off obstacles; less makes the room narrower.
    """

    room: tuple[float, float]
    care: Care = CAREFUL

    def __call__(self, state: ArmState) -> tuple[Array, Array]:
        tool, place = state.ee_position, state.object_position[:, 0]
        goal = _beside_goal(state, 0.03)
        ahead = self._course(place[:, :2], goal[:, :2], state)
        # Where the tool is around the object: how far from being behind it, as an angle.
        out = tool[:, :2] - place[:, :2]
        distance = _length(out)
        side = ahead[:, 0] * out[:, 1] - ahead[:, 1] * out[:, 0]
        along = (out * ahead).sum(1)
        angle = np.arctan2(side, -along)
        low = (tool[:, 2] < 0.065) & (distance < 0.12)
        behind = place[:, :2] - 0.06 * ahead
        down = np.column_stack([behind, np.full(len(tool), _LOW)])
        above = _from_above(tool, down, _safe_height(state, CAREFUL), CAREFUL)
        # Around the object at the table, until it is behind it.
        sign = np.sign(angle)
        turn = angle - sign * np.minimum(np.abs(angle), 0.6)
        direction = np.arctan2(-ahead[:, 1], -ahead[:, 0]) - turn
        ring = place[:, :2] + 0.065 * np.column_stack([np.cos(direction), np.sin(direction)])
        # Pushing on the side to which the object has strayed brings it back to the line.
        across = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        forward = _PUSH * np.clip(1 - np.abs(angle) / 0.6, 0.2, 1)[:, None]
        push = tool[:, :2] + forward * ahead - side[:, None] * across
        straight = (np.abs(angle) < 0.5)[:, None]
        flat = np.where(straight, push, ring)
        table = np.column_stack([flat, np.full(len(tool), _LOW)])
        return np.where(low[:, None], table, above), np.zeros(len(tool))

    def _course(self, place: Array, goal: Array, state: ArmState) -> Array:
        """Which way the object is to go, unit vectors ``(N, 2)``."""
        course = _unit(goal - place)
        if not state.obstacle_present.any():
            return course
        # In units of the ellipse around it each obstacle is a circle of radius 1.
        middle, room = state.obstacle_position[..., :2], self._rooms(state)
        here, there = (place[:, None] - middle) / room, (goal[:, None] - middle) / room
        way = there - here
        share = np.clip(-(here * way).sum(-1) / (way**2).sum(-1), 0, 1)[..., None]
        nearest = _length(here + share * way)
        # On the side of the base: to which side of the line from the obstacle the goal is.
        turn = np.where(there[..., 1] < 0, -1.0, 1.0)[..., None]
        out, radius = _unit(here), _length(here)[..., None]
        around = turn * np.stack([out[..., 1], -out[..., 0]], axis=-1)
        # Along the tangent of the circle, and outwards within it.
        sine = np.minimum(1, 1 / np.maximum(radius, 1e-6))
        tangent = np.sqrt(1 - sine**2) * -out + sine * around
        tangent += np.maximum(0, 1 - radius) * 5 * out
        detour = _unit(tangent * room)
        blocked = (nearest < np.minimum(0.95, 0.95 * _length(there))) & state.obstacle_present
        # Past all of them is where the longest way round leads.
        cosine = np.where(blocked, (detour * course[:, None]).sum(-1), np.inf)
        detour = detour[np.arange(len(detour)), cosine.argmin(1)]
        return np.where(blocked.any(1, keepdims=True), detour, course)

    def _rooms(self, state: ArmState) -> Array:
        """Half axes of the ellipse around each obstacle that the object stays out of, m."""
        room = np.array(self.room) - self.care.narrower
        top = (state.obstacle_position + state.obstacle_size)[..., 2:]
        # The hand passes over a low one; object and fingers go round it.
        beside = state.obstacle_size[..., :1] + _BESIDE
        return np.where(top < _UNDER_HAND, np.minimum(beside, room), room)


def make_pilot(env: ArmEnv, care: Care = CAREFUL) -> Pilot:
    """Makes the pilot of an environment's task.

    It goes round or over obstacles at rest, and steps back from those that move.

    Args:
        env: the environment.
        care: how far it keeps off obstacles.

    Raises:
        ValueError: if the task has none, or its actions do not move the tool.
    """
    if not isinstance(env.action_mode, CartesianDelta):
        raise ValueError(f"demonstrations need Cartesian actions, got {env.action_mode}.")
    # A Panda's own hand is wider than the gripper of the others, whose elbows fold less, and an
    # iiwa's least.
    along = {PANDA: 0.27, IIWA: 0.18}.get(env.arm, 0.22)
    pilots: dict[type, Pilot] = {
        Reach: ReachPilot(care),
        Push: PushPilot((along, 0.15), care),
        PickAndPlace: PickAndPlacePilot(care),
    }
    if type(env.task) not in pilots:
        raise ValueError(f"demonstrations need a task with a pilot, got {env.task}.")
    pilot = pilots[type(env.task)]
    return _stepping_back(pilot, care) if isinstance(env.obstacles, (Human, Moving)) else pilot


def _stepping_back(pilot: Pilot, care: Care) -> Pilot:
    """A pilot for moving obstacles only, which gets out of their way."""

    def fly(state: ArmState) -> tuple[Array, Array]:
        nothing = np.zeros_like(state.obstacle_present)
        target, opening = pilot(replace(state, obstacle_present=nothing))
        room, away = _room(state, care)
        step = target - state.ee_position
        step *= np.minimum(1, _PACE / np.maximum(_length(step), 1e-9))[:, None]
        ahead, back = np.clip(room / _SLOWER, 0, 1), np.clip(-room / _SLOWER, 0, 1)
        step = ahead[:, None] * step + back[:, None] * _PACE * away
        return state.ee_position + step, opening

    return fly


def _room(state: ArmState, care: Care) -> tuple[Array, Array]:
    """Room beyond what is required that all moving obstacles leave, m, and the way off them."""
    points = state.ee_position[:, None] + np.array([[0, 0, height] for height in _HAND])
    points = points[:, :, None]
    half = state.obstacle_size[:, 2] - state.obstacle_size[:, 0]
    x, y, z, w = np.moveaxis(state.obstacle_orientation, -1, 0)
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    off = points - state.obstacle_position[:, None]
    along = np.clip((off * axis[:, None]).sum(-1), -half, half)[..., None] * axis[:, None]
    velocity = state.obstacle_velocity[:, None] + np.cross(
        state.obstacle_angular_velocity[:, None], along
    )
    way = off - along
    gap = _length(way) - state.obstacle_size[:, 0] - _HALF_WIDTH
    coming = np.maximum(0, (velocity * _unit(way)).sum(-1))
    room = np.where(state.obstacle_present[:, None], gap - care.time * coming - care.room, np.inf)
    room = room.reshape(len(room), -1)
    nearest = room.argmin(1)
    away = way.reshape(len(room), -1, 3)[np.arange(len(room)), nearest] * (1, 1, 0)
    return room.min(1), _unit(_unit(away) + np.array([-1.0, 0, 0]))


def _from_above(tool: Array, place: Array, top: Array, care: Care) -> Array:
    """The next stop on the way up, over and down to a place."""
    off = _length(tool[:, :2] - place[:, :2])
    floor = np.minimum(top, place[:, 2] + care.slope * np.maximum(0, off - 0.012))
    # Sideways only as far as it is high enough.
    free = np.clip(1 - (floor - tool[:, 2]) / 0.05, 0, 1)[:, None]
    flat = tool[:, :2] + free * (place - tool)[:, :2]
    return np.column_stack([flat, floor])


def _safe_height(state: ArmState, care: Care) -> Array:
    """Where the hand is above all obstacles, m, ``(N,)``."""
    if not state.obstacle_present.shape[1]:
        return np.full(len(state.goal), _ABOVE_TABLE)
    tops = state.obstacle_position[..., 2] + state.obstacle_size[:, 2]
    return np.where(state.obstacle_present, tops + care.over, _ABOVE_TABLE).max(1)


def _beside_goal(state: ArmState, aside: float) -> Array:
    """The goal, moved away from the nearest obstacle within what counts as reached."""
    return state.goal + aside * _away(state.goal, state)


def _away(place: Array, state: ArmState) -> Array:
    """The direction off the obstacle nearest to a place, ``(N, 3)``; 0 without one."""
    if not state.obstacle_present.shape[1]:
        return np.zeros_like(place)
    off = (place[:, None] - state.obstacle_position) * (1, 1, 0)
    distance = np.where(state.obstacle_present, _length(off), np.inf)
    away = _unit(off[np.arange(len(off)), distance.argmin(1)])
    return np.where(state.obstacle_present.any(1, keepdims=True), away, 0)


def _off(tool: Array, place: Array) -> Array:
    """The next stop on the way from an obstacle to a place: up, and down where it is near."""
    way = (place - tool)[:, :2]
    far = _length(way)
    flat = tool[:, :2] + np.minimum(1, 0.025 / np.maximum(far, 1e-9))[:, None] * way
    return np.column_stack([flat, np.where(far > 0.06, tool[:, 2] + 0.02, place[:, 2])])


def _length(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=-1)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
