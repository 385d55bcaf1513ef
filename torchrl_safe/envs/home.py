"""The search for joint angles to start from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_safe._checks import check_array, check_kind, check_unit
from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.kinematics import Approach, approach
from torchrl_safe.envs.physics.bullet import Bullet
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.physics.simulator import Physics, Simulator
from torchrl_safe.envs.state import Array

# The search has arrived within this distance (m) and angle (rad). Below this singular value of the
# Jacobian the arm has lost a direction: a tool motion of 1 m/s or 1 rad/s takes 50 rad/s of a
# joint.
_ARRIVED, _SINGULAR = 1e-3, 0.02
# Further starts for a point that the search from home has not found.
_STARTS = 20


def find_home(
    arm: ArmModel,
    position: Sequence[float],
    orientation: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    *,
    physics: Physics = Bullet(),
) -> tuple[float, ...]:
    """Searches joint angles at which the tool is at a pose: the ``home`` of a new arm.

    It starts at the arm's ``home``, a guess that has elbow and wrist on the side where you want
    them, and keeps to the joint limits. It does not check that the pose is a good start: look at it
    with ``render``. (``tests/test_arms.py`` measures how far the poses of ``ARMS`` are from limits,
    singular poses and the table.)

    Args:
        arm (ArmModel): the arm, with a guess as its ``home``.
        position (sequence of float): the tool point, m, 3 numbers.
        orientation (sequence of float, optional): the tool orientation, a unit quaternion
            (x, y, z, w). Defaults to ``(1, 0, 0, 0)``, at which the tool's z axis points down;
            ``(0, 1, 0, 0)`` does too, turned by half a turn. ``(0, 0.7071, 0, 0.7071)`` points its
            x axis down, ``(-0.7071, 0, 0, 0.7071)`` its y axis.

    Keyword Args:
        physics (Physics, optional): the engine that tells where the tool is. Defaults to
            ``Bullet()``.

    Returns:
        The joint angles, rad; the tool is within 1 mm and 1 mrad of the pose.

    Raises:
        TypeError: if ``arm`` is no ArmModel or ``physics`` no Physics.
        ValueError: if a pose is not usable, or the search does not get there. The error says what
            has stopped it: the point is out of reach, a joint limit, a singular pose, or a guess
            from which no way leads straight there.

    Examples:
        >>> from dataclasses import replace
        >>> from torchrl_safe.envs import XARM6
        >>> guess = replace(XARM6, home=(0.0, -0.7, -0.5, 0.0, 1.0, 0.0))
        >>> home = find_home(guess, (0.25, 0.0, 0.2))
        >>> print(np.round(home, 2) + 0.0)
        [ 0.   -0.77 -0.26  0.    1.02  0.  ]
    """
    check_kind("arm", arm, ArmModel)
    check_kind("physics", physics, Physics)
    point = check_array("position", position, (3,))
    turned = check_array("orientation", orientation, (4,))
    check_unit("orientation", turned)
    simulator = physics.build(arm, Scene(), num_envs=1)
    try:
        found, free = (
            _search(simulator, arm.home, (point, turned), respect_limits=limits)
            for limits in (True, False)
        )
        for end in (found, free):
            if _has_arrived(end) and not _beyond_limits(simulator, end.angles):
                return tuple(end.angles.tolist())
        angle = 2 * np.arcsin(np.minimum(found.turn / 2, 1))
        raise ValueError(
            f"position and orientation must be a pose that the arm gets to from its home, got "
            f"{point.tolist()} and {turned.tolist()}, from which the tool stays "
            f"{found.distance:.3f} m and {angle:.3f} rad away: "
            f"{_what_stopped(arm, simulator, point, found, free)}"
        )
    finally:
        simulator.close()


def _search(
    simulator: Simulator, home: Sequence[float], pose: tuple[Array, Array], *, respect_limits: bool
) -> Approach:
    """One search alone: its parts without their first axis."""
    start, point, turned = (np.array(part, dtype=float)[None] for part in (home, *pose))
    found = approach(simulator, start, point, turned, respect_limits=respect_limits)
    return Approach(*(part[0] for part in found))


def _has_arrived(found: Approach) -> bool:
    return bool(max(found.distance, found.turn) < _ARRIVED)


def _what_stopped(
    arm: ArmModel, simulator: Simulator, point: Array, found: Approach, free: Approach
) -> str:
    nearest = _nearest(simulator, arm.home, point)
    if nearest > _ARRIVED:
        return (
            f"it is out of reach, {nearest:.3f} m beyond all that the tool gets to however it is "
            "turned and whatever the joint limits."
        )
    if _has_arrived(free):
        beyond = ", ".join(_beyond_limits(simulator, free.angles))
        return (
            f"a joint limit stopped it: {beyond}. Guess another home, or let the tool be turned "
            "otherwise."
        )
    values = np.linalg.svd(simulator.jacobian(found.angles[None])[0], compute_uv=False)
    weakest = values.min() if len(values) == 6 else 0.0  # With fewer than six joints.
    if weakest < _SINGULAR:
        return (
            f"a singular pose stopped it, {found.angles.round(3).tolist()} rad, where the tool "
            f"cannot move or turn in every direction (smallest singular value of the Jacobian "
            f"{weakest:.3f}). Guess another home, or let the tool be turned otherwise."
        )
    return "no way leads there from the guess. Guess another home."


def _nearest(simulator: Simulator, home: Sequence[float], point: Array) -> float:
    """How near the tool gets to a point, m, from several starts and beyond all limits."""
    generator = np.random.default_rng(0)
    lower = np.maximum(simulator.joint_lower, -np.pi)
    upper = np.minimum(simulator.joint_upper, np.pi)
    starts = np.stack([home, *generator.uniform(lower, upper, (_STARTS, len(lower)))])
    points = np.tile(point, (len(starts), 1))
    return float(approach(simulator, starts, points, respect_limits=False).distance.min())


def _beyond_limits(simulator: Simulator, angles: Array) -> list[str]:
    """Which joints would have to go beyond their limits, and where to."""
    limits = zip(simulator.joint_lower, simulator.joint_upper, strict=True)
    return [
        f"joint {number}, counted from the base, would have to be at {angle:.3f} rad and goes from "
        f"{lower:.3f} to {upper:.3f}"
        for number, (angle, (lower, upper)) in enumerate(zip(angles, limits, strict=True), 1)
        if not lower <= angle <= upper
    ]
