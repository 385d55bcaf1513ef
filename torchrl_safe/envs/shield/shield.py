"""Changes actions as little as needed to keep the arm off what is around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_safe._checks import check_kind, check_not_negative, check_positive
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.regions import Region
from torchrl_safe.envs.rotations import cross
from torchrl_safe.envs.shield.motion import safe_motion
from torchrl_safe.envs.state import ArmState, Array

# At the end of a control step another point of a shape may be the nearest, and points move on
# curves. For each radian that the joints turn, a distance can be off by this much, m.
_ERROR = 0.1
# For joints without limits, rad.
_FAR = 1e3
# Below this, a distance counts as 0, m.
_TOLERANCE = 1e-9
# The share of the joints' braking that a distance counts on: some joints may have to keep turning.
_SURE = 1 / 3
# The share of that which is left at least where points move on curves.
_KEPT = 1 / 4
# Joints that are asked for nothing may have to give way, and for that change their velocities by
# more than is sure: by at least this much of it where there is room.
_AT_LEAST = 1 / 4


class Shielded(NamedTuple):
    """What a shield lets the motors do."""

    #: Joint targets, rad, ``(N, n)``.
    joints: Array
    #: Finger targets, m: those asked for, or where the fingers are.
    fingers: Array
    #: Which worlds brake because nothing that was asked for is safe or the arm is pressed on
    #: something, ``(N,)``.
    braked: NDArray[np.bool_]


class _Pairs(NamedTuple):
    """What is near the arm: k worlds with r pairs each, see :class:`Nearest`."""

    #: Distance above the margin, m, ``(k, r)``; infinite where there is no pair.
    room: Array
    #: By how much the obstacle will shrink it in the next step, m, ``(k, r)``; not negative.
    closing: Array
    #: By how much the joints change it, m/rad, ``(k, r, n)``, and the fingers, ``(k, r, f)``.
    joints: Array
    fingers: Array
    #: Numbers of the obstacles, then of the table, then of what holds for the tool, ``(r,)``.
    other: NDArray[np.int_]


class _Step(NamedTuple):
    """The control step that begins."""

    state: ArmState
    simulator: Simulator
    #: s.
    duration: float
    #: Of what is left of a distance, the share that may be used up.
    share: float


@dataclass(frozen=True)
class Shield:
    r"""Filters actions so that the arm touches neither obstacles nor the table.

    Before each control step it measures the distance d of every convex shape of the arm to every
    obstacle and the table. Each distance has the room :math:`r = d - \text{margin}` left, of which
    a step may use up s(r). The shield takes the joint targets :math:`q + x` that keep to this and
    are nearest to those asked for, :math:`q + w`:

    .. math::
        \min_x |x - w|^2 + (\kappa\, t^\top J (x - w))^2 \quad\text{such that}\quad
        \nabla d_i^\top x - c_i \ge -s(r_i) \quad\text{for all } i, \qquad l \le x \le u

    J is the Jacobian of the tool point, the unit vector t is where w would move it, and
    :math:`\kappa` is ``tool_weight``. If it is not 0, joints that can give way without slowing the
    tool down do so: a hand turns to pass an obstacle. The tool may move aside. No joint then turns
    further than the largest turn that was asked for. Where that has no solution, only joints count.
    T is the duration of the control step, c how far the obstacle comes nearer in it, and s a
    control barrier function in discrete time (Ames et al. 2019, arXiv 1903.11199; Agrawal and
    Sreenath 2017, RSS), with which the arm can always stop:

    .. math::
        s(r) = \min\left((1 - e^{-\text{rate} \cdot T})\, r,
        \sqrt{(b / 2 + c)^2 + 2 b \max(r - c, 0)} - b / 2\right),
        \qquad b = \tfrac13\, \text{acceleration} \cdot T^2\, |\nabla d|_1

    The first part is a share of the room. The second leaves enough room for the arm to stop, if it
    moves by b less in each following step while the obstacle keeps coming; b is a third of what all
    joints together can do. Inside the margin, where r is negative,
    :math:`s = (1 - e^{-\text{rate} \cdot T}) r` makes the arm move away.

    The bounds l and u keep joint targets within limits and speeds, and within what motors can
    follow. What is asked for is clipped to them first. A joint's velocity changes by what
    ``acceleration`` allows. Motors may miss what is asked for beyond that, so it is scaled: missing
    all of it would use up no more than half of any room. Far from everything the shield therefore
    changes nothing.

    The problem treats distances as linear, which is not exact. Where the end of the step could be
    too near, the shield measures the distances there as well and solves a second problem with them.
    In it, one more step like this one, slower by b, has to be safe too. If distances shrink faster
    at the end of the step than now, b is less by the difference, but at least a quarter of it.

    If there is no solution, the arm brakes and ``shield_braked`` is true. It takes a slow motion
    that exceeds s as little as possible, and uses up no more than all the room: each distance gives
    up the same share of the room that s would leave it. If there is none, it stands still, or, if
    an obstacle comes towards it, gives way as far as fixed obstacles allow. An arm with less than
    half of a margin left brakes too: it only withdraws, whatever is asked for, and its tool does
    not go down if it can withdraw otherwise.

    **What it guarantees.** Fixed obstacles and the table are never touched, if

    - the episode begins with all of them further away than their margins,
    - motors follow targets whose velocity changes by no more than ``acceleration``, to within the
      margin,
    - ``reach`` is enough to stop in from the arm's largest speed,
    - no shape comes near in the middle of a control step and leaves again: only the distances at
      both ends are checked,
    - there is a solution. An arm that has to brake from full speed needs some distance for it.

    From moving obstacles the arm withdraws as far as its joints allow. Their future is unknown, so
    the guarantee is weaker: the arm is not the one that moves into contact, as long as they change
    their velocity by no more than ``obstacle_acceleration``, or do not become faster than
    ``obstacle_speed``. The arm's own links and what its gripper holds are not checked.

    **Learning.** The batch holds the action that the policy sampled, and its
    log-probability. The shield is a part of the environment: it maps state and action to joint
    targets, as inverse kinematics and motors do, so the policy gradient is that of the shielded
    environment, unbiased. The executed action has no density under the policy (the filter maps many
    actions onto the same edge), so do not put it into the batch. A policy can learn to rely on the
    shield; limit the cost :class:`~torchrl_safe.envs.ShieldCorrection` to prevent that.

    Args:
        margin: distance that the arm keeps from obstacles, m.
        rate: largest rate at which the room above the margin shrinks, 1/s. With a smaller one the
            arm slows down from further away.
        table: distance that the arm keeps from the table, m. To the shield the table has no edges.
        reach: distance up to which the shield measures, m. A larger one takes longer.
        acceleration: change of velocity that the motors follow, rad/s^2.
        obstacle_acceleration: change of velocity that the shield expects of obstacles that move,
            m/s^2. With 0 they keep their velocity. A hand that reaches takes about 7.
        obstacle_speed: if given, the shield also expects that obstacles can come this fast at any
            time, m/s, and the arm is not the one that moves into contact.
        workspace: if given, the tool point stays in this box, the margin away from its walls. If
            it begins outside, it moves in. Where there is no solution, a fast tool may leave it by
            a centimetre while the arm brakes.
        tool_weight: how much a metre that the tool point falls short counts against a radian that
            a joint does, rad/m. With 0, only joints count, and policies lose more return.

    Raises:
        TypeError: if ``workspace`` is not a Region.
        ValueError: if a number is negative or not finite, ``reach`` is not larger than both
            margins, or ``workspace`` is not wider than two margins.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = ArmEnv(num_envs=2, shield=Shield(margin=0.03), seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["next", "shield_correction"].shape, rollout["next", "shield_braked"].dtype
        (torch.Size([2, 3, 1]), torch.bool)
        >>> env.close()
    """

    margin: float = 0.02
    rate: float = 20.0
    table: float = 0.02
    reach: float = 0.5
    acceleration: float = 10.0
    obstacle_acceleration: float = 0.0
    obstacle_speed: float | None = None
    workspace: Region | None = None
    tool_weight: float = 10.0

    def __post_init__(self) -> None:
        check_not_negative(
            margin=self.margin,
            table=self.table,
            obstacle_acceleration=self.obstacle_acceleration,
            tool_weight=self.tool_weight,
        )
        check_positive(rate=self.rate, reach=self.reach, acceleration=self.acceleration)
        if self.reach <= max(self.margin, self.table):
            raise ValueError(
                f"reach must be larger than margin = {self.margin} and table = {self.table}, got "
                f"{self.reach}."
            )
        if self.obstacle_speed is not None:
            check_not_negative(obstacle_speed=self.obstacle_speed)
        if self.workspace is not None:
            check_kind("workspace", self.workspace, Region)
            if np.any(np.subtract(self.workspace.high, self.workspace.low) <= 2 * self.margin):
                raise ValueError(
                    f"workspace must be wider than two margins of {self.margin} m, got "
                    f"{self.workspace}."
                )

    def __call__(
        self,
        joints: Array,
        fingers: Array,
        state: ArmState,
        simulator: Simulator,
        *,
        longest: Array,
        duration: float,
    ) -> Shielded:
        """Returns the targets nearest to those asked for that keep the arm safe.

        Args:
            joints: joint targets that are asked for, rad, ``(N, n)``.
            fingers: finger targets, m, ``(N, f)``, or ``(N, 0)`` where they are not driven.
            state: the current state.
            simulator: measures distances.
            longest: how far the joints can turn in a control step, rad, ``(n,)``.
            duration: of the control step, s.
        """
        angles, held = state.joint_position, state.finger_position
        opening = fingers - held if fingers.shape[1] else np.zeros_like(held)
        step = _Step(state, simulator, duration, 1 - np.exp(-self.rate * duration))
        near = self._measure(step, np.arange(len(angles)), angles, held)
        pressed = self._is_pressed(state, near)
        away = self._away(step, near, self._brake(step, near.joints))
        now, least = self._with_tool(step, near, away, pressed)
        asked = np.where(pressed[:, None], 0.0, joints - angles)
        lower, upper = self._bounds(step, now, asked, longest)
        asked = np.clip(asked, lower, upper)
        by_fingers = (now.fingers @ opening[:, :, None])[:, :, 0]
        least = _attainable(now.joints, least - by_fingers, lower, upper)
        # If nothing leaves enough room to stop, take what stops above the margin.
        last = np.minimum(least, now.closing - now.room)
        comes = now.closing > 0
        along = self._along(step, asked) if self.tool_weight else None
        change, solved, braked = safe_motion(
            asked, now.joints, least, last, comes, lower, upper, along
        )
        # Measure the end of the step as well where it could be too near.
        moved = (near.joints @ change[:, :, None])[:, :, 0]
        left = near.room - near.closing + moved
        left += by_fingers[:, : left.shape[1]]  # Not the rows of the tool point.
        doubt = left.min(axis=1, initial=np.inf) < _ERROR * np.abs(change).sum(axis=1)
        again = np.flatnonzero(solved & doubt)
        if len(again):
            then = self._measure(step, again, (angles + change)[again], (held + opening)[again])
            turned = (then.joints @ change[again][:, :, None])[:, :, 0]
            kept = (near.room - near.closing + away)[again]
            needed = _needed(kept, then) + turned
            # One more step like this one, slowed as far as possible, has to be safe there. Where
            # points move on curves, distances can shrink faster then: that uses up some braking.
            seen = np.isfinite(near.room[again] + then.room)
            brake = self._brake(step, then.joints)
            brake = np.maximum(brake + seen * np.minimum(turned - moved[again], 0), _KEPT * brake)
            needed = np.maximum(needed, self._away(step, then, brake, ahead=1) - brake)
            needed = _attainable(then.joints, needed, lower[again], upper[again])
            most = np.minimum(needed, then.closing - then.room + turned)
            # What satisfies these too is the solution of both.
            short = np.flatnonzero((turned < needed - _TOLERANCE).any(axis=1))
            again = again[short]
        if len(again):
            change[again], solved[again], braked[again] = safe_motion(
                asked[again],
                np.concatenate([now.joints[again], then.joints[short]], axis=1),
                np.concatenate([least[again], needed[short]], axis=1),
                np.concatenate([last[again], most[short]], axis=1),
                np.concatenate([comes[again], then.closing[short] > 0], axis=1),
                lower[again],
                upper[again],
                None if along is None else along[again],
            )
        still, braked = ~solved[:, None], braked | pressed
        if fingers.shape[1]:
            fingers = np.where(braked[:, None], held, fingers)
        return Shielded(np.where(still, angles, angles + change), fingers, braked)

    def _measure(
        self, step: _Step, rows: NDArray[np.int_], angles: Array, fingers: Array
    ) -> _Pairs:
        """Measures some worlds, with their arms where they are or will be."""
        state, count = step.state, angles.shape[1]
        near = step.simulator.nearest(rows, angles, fingers)
        table = state.obstacle_position.shape[1]
        room = near.distance - np.where(near.other == table, self.table, self.margin)
        closing = np.zeros_like(room)
        # Mostly nothing moves, and there is nothing to work out.
        if state.obstacle_velocity.any() or state.obstacle_angular_velocity.any():
            which = np.minimum(near.other, table - 1)
            position, velocity, spin = (
                part[rows][:, which]
                for part in (
                    state.obstacle_position,
                    state.obstacle_velocity,
                    state.obstacle_angular_velocity,
                )
            )
            # As fast along the normal as the nearest point of the obstacle, which is on that line.
            arm = near.point - position
            speed = ((velocity + cross(spin, arm)) * near.normal).sum(axis=2)
            moves = (velocity != 0).any(axis=2) | (spin != 0).any(axis=2)
            speed += moves * self.obstacle_acceleration * step.duration / 2
            # An obstacle that goes away may stop at any time.
            closing = np.where(near.other < table, np.maximum(speed, 0), 0.0) * step.duration
        joints, moved = near.jacobian[..., :count], near.jacobian[..., count:]
        return _Pairs(room, closing, joints, moved, near.other)

    def _is_pressed(self, state: ArmState, now: _Pairs) -> NDArray[np.bool_]:
        """Which arms have less than half of a margin left, ``(N,)``.

        They press on something, so motors do not follow: the friction of a cube under the hand can
        hold the arm to an obstacle.
        """
        table = now.other == state.obstacle_position.shape[1]
        least = -np.where(table, self.table, self.margin) / 2
        return np.any(now.room < least, axis=1)

    def _spare(self, step: _Step, room: Array, brake: Array, closing: Array | float) -> Array:
        """How much of the room may be used up in a step, m, ``(k, r)``.

        Negative where it has to grow.
        """
        share = step.share * room
        some = np.where(np.isfinite(room), np.maximum(room - closing, 0), 0.0)
        # The arm x in this step, x - brake in the next and so on: x**2 / (2 brake) + x / 2 in all.
        # Until then the obstacle keeps coming, in x / brake + 1 steps.
        stops = np.sqrt((brake / 2 + closing) ** 2 + 2 * brake * some) - brake / 2
        return np.where(room > 0, np.minimum(share, stops), share)

    def _brake(self, step: _Step, joints: Array) -> Array:
        """How much less distances can shrink in a step than in the one before, m, ``(k, r)``."""
        lever: Array = np.abs(joints) @ np.ones(joints.shape[2])  # Twice as fast as sum().
        return self.acceleration * step.duration**2 * _SURE * lever

    def _away(self, step: _Step, pairs: _Pairs, brake: Array, ahead: int = 0) -> Array:
        """By how much the arm has to change each distance at least in a step, m, ``(k, r)``.

        Negative where it may come nearer.

        Args:
            step: the control step.
            pairs: what is near the arm.
            brake: see :meth:`_brake`.
            ahead: how many steps later. What comes is nearer by then.
        """

        def away(closing: Array | float) -> Array:
            return closing - self._spare(step, pairs.room - ahead * closing, brake, closing)

        least = away(pairs.closing)
        if self.obstacle_speed is None:
            return least
        stops = np.minimum(away(step.duration * self.obstacle_speed), 0)
        table = step.state.obstacle_position.shape[1]
        return np.where(pairs.other < table, np.maximum(least, stops), least)

    def _bounds(
        self, step: _Step, now: _Pairs, asked: Array, longest: Array
    ) -> tuple[Array, Array]:
        """How far the joints may turn, rad, each ``(N, n)``."""
        state = step.state
        angles, turning = state.joint_position, state.joint_velocity * step.duration
        lower = np.clip(state.joint_lower - angles, -longest, longest)
        upper = np.clip(state.joint_upper - angles, -longest, longest)
        # Motors change velocities by this for sure, and perhaps miss the rest. That is scaled: all
        # joints together would use up no more than half of any room if they missed it.
        sure = self.acceleration * step.duration**2
        change = np.abs(np.clip(asked, lower, upper) - turning)
        rest = np.maximum(change - sure, _AT_LEAST * sure)
        missed = np.maximum((np.abs(now.joints) @ rest[:, :, None])[:, :, 0], _TOLERANCE)
        share = (np.maximum(now.room, 0) / (2 * missed)).min(axis=1, initial=np.inf)
        slack = sure + share[:, None] * rest
        return (
            np.clip(turning - slack, np.maximum(lower, -_FAR), upper),
            np.clip(turning + slack, lower, np.minimum(upper, _FAR)),
        )

    def _along(self, step: _Step, asked: Array) -> Array:
        """How far joints move the tool the way that is asked for, times its weight, ``(N, n)``."""
        linear = step.simulator.jacobian(step.state.joint_position)[:, :3]
        way = (linear @ asked[:, :, None])[:, :, 0]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        way = np.divide(way, length, out=np.zeros_like(way), where=length > _TOLERANCE)
        return self.tool_weight * (way[:, None] @ linear)[:, 0]

    def _with_tool(
        self, step: _Step, near: _Pairs, away: Array, pressed: NDArray[np.bool_]
    ) -> tuple[_Pairs, Array]:
        """Adds what holds for the tool point, also to what :meth:`_away` returns.

        It keeps away from the walls of the workspace. That of a pressed arm does not go down: it
        may be on an object, which the shield does not see and whose friction would hold the arm.
        """
        walls = self.workspace
        if walls is None and not pressed.any():
            return near, away
        linear = step.simulator.jacobian(step.state.joint_position)[:, :3]
        joints = linear[:, 2:]
        room, least = np.full((len(pressed), 1), np.inf), np.where(pressed[:, None], 0.0, -np.inf)
        if walls is not None:
            tool, ways = step.state.ee_position, np.concatenate([linear, -linear], axis=1)
            left = np.concatenate([tool - walls.low, walls.high - tool], axis=1) - self.margin
            room = np.concatenate([room, left], axis=1)
            spare = self._spare(step, left, self._brake(step, ways), 0.0)
            least = np.concatenate([least, -spare], axis=1)
            joints = np.concatenate([joints, ways], axis=1)
        number = step.state.obstacle_position.shape[1] + 1
        now = _Pairs(
            room=np.concatenate([near.room, room], axis=1),
            closing=np.concatenate([near.closing, np.zeros_like(room)], axis=1),
            joints=np.concatenate([near.joints, joints], axis=1),
            fingers=np.pad(near.fingers, [(0, 0), (0, room.shape[1]), (0, 0)]),
            other=np.append(near.other, np.full(room.shape[1], number)),
        )
        return now, np.concatenate([away, least], axis=1)


def _needed(kept: Array, then: _Pairs) -> Array:
    """How much further apart each pair at the end of a step has to be than it is, m, ``(k, r)``.

    Args:
        kept: the room that the step has to leave each pair, m, ``(k, r)``.
        then: the pairs at its end.
    """
    # Each shape may use up what the nearest one may.
    least = np.zeros_like(kept)
    for other in range(then.other.max(initial=-1) + 1):
        same = then.other == other
        nearest = kept[:, same].min(axis=1, keepdims=True, initial=np.inf)
        least[:, same] = np.where(np.isfinite(nearest), nearest, 0.0)
    return least + then.closing - then.room


def _attainable(rows: Array, least: Array, lower: Array, upper: Array) -> Array:
    """Asks for no more than half of what the joints can do beyond how they turn now.

    The middle of the bounds is how they turn now. What is left of a wish is not coming nearer.
    """
    middle = (rows @ (0.5 * (lower + upper))[:, :, None])[:, :, 0]
    best = middle + (np.abs(rows) @ (0.5 * (upper - lower))[:, :, None])[:, :, 0]
    return np.minimum(least, np.maximum((best + np.maximum(middle, 0)) / 2, 0))
