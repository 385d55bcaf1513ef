"""Action representations: what the numbers of an action do to the joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from torchrl_safe._checks import (
    as_number,
    check_callable,
    check_flag,
    check_positive,
    check_unit,
    keep_numbers,
)
from torchrl_safe.envs.kinematics import DampedLeastSquares, InverseKinematics
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.rotations import UPRIGHT, from_rotation_vector, multiply
from torchrl_safe.envs.state import ArmState, Array


@runtime_checkable
class ActionMode(Protocol):
    """Protocol of an action mode: turns actions into targets of joints and fingers.

    The motors' targets move evenly over the substeps of the control step, from where the joints
    are to what :meth:`targets` returns. At its end the joints have arrived, as far as their efforts
    and speeds allow, with every physics engine.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> class Lift:
        ...     bound, moves_fingers = 1.0, False
        ...
        ...     def width(self, num_joints):
        ...         return 1
        ...
        ...     def targets(self, action, state, simulator):
        ...         up = np.pad(action, [(0, 0), (2, 0)])  # (N, 3): along z only
        ...         return CartesianDelta().targets(up, state, simulator)
        >>> env = ArmEnv(action=Lift(), num_envs=4)
        >>> env.action_spec.shape
        torch.Size([4, 1])
        >>> env.close()
    """

    @property
    def bound(self) -> float:
        """Largest magnitude of an action component; the environment clips to it."""

    @property
    def moves_fingers(self) -> bool:
        """Whether actions move the fingers. If not, the fingers are fixed."""

    def width(self, num_joints: int) -> int:
        """Returns the number of components of an action."""

    def targets(self, action: Array, state: ArmState, simulator: Simulator) -> tuple[Array, Array]:
        """Returns joint targets, rad, ``(N, n)``, and finger targets, m, ``(N, f or 0)``.

        Args:
            action: the action, ``(N, width)``, within the bound.
            state: the current state.
            simulator: gives Jacobians and the home pose, see
                :class:`~torchrl_safe.envs.Simulator`.
        """


@dataclass(frozen=True)
class CartesianDelta:
    """Moves the tool point by ``step`` metres times the action (the paper's AR1).

    The first three components are displacements along x, y and z. Components that turn the tool
    come next, the one that moves the fingers last. Without a component that turns it, the tool
    keeps the orientation of the home pose (pointing down).

    Args:
        step: displacement that an action of 1 asks for, m. The tool does it until the next
            action, as far as the joints' efforts, speeds and limits allow.
        bound: largest magnitude of a component; infinity leaves actions unclipped.
        inverse_kinematics: turns tool poses into joint angles.
        orientation: tool orientation to keep, a quaternion (x, y, z, w). ``None`` keeps that of
            the home pose.
        yaw_step: if given, a component turns the tool about the vertical, in rad per unit of
            action. The tool keeps pointing down.
        rotation_step: if given, three components turn the tool about x, y and z, in rad per
            unit of action. No orientation is kept then.
        finger_step: if given, the last component sets the free fingers' position, in metres
            per unit of action: 1 opens them by that much, 0 or less closes them.

    Raises:
        TypeError: if ``inverse_kinematics`` is not callable.
        ValueError: if ``bound`` or a step is not positive, a finite ``bound`` is too large for
            float32, ``orientation`` is not a unit quaternion, or ``rotation_step`` is given beside
            ``yaw_step`` or ``orientation``.

    Examples:
        >>> CartesianDelta(step=0.03).width(num_joints=7)
        3
        >>> CartesianDelta(yaw_step=0.2, finger_step=0.04).width(num_joints=7)
        5
    """

    step: float = 0.05
    bound: float = 1.0
    inverse_kinematics: InverseKinematics = DampedLeastSquares()
    orientation: tuple[float, float, float, float] | None = None
    yaw_step: float | None = None
    rotation_step: float | None = None
    finger_step: float | None = None

    def __post_init__(self) -> None:
        check_positive(step=self.step)
        check_bound(self.bound)
        check_callable("inverse_kinematics", self.inverse_kinematics)
        if self.orientation is not None:
            check_unit("orientation", keep_numbers(self, "orientation", 4))
        for name in ("yaw_step", "rotation_step", "finger_step"):
            if getattr(self, name) is not None:
                check_positive(**{name: getattr(self, name)})
        if self.yaw_step is not None and self.rotation_step is not None:
            raise ValueError(
                f"yaw_step is a part of rotation_step: give one of them, got {self.yaw_step} and "
                f"{self.rotation_step}."
            )
        if self.orientation is not None and self.rotation_step is not None:
            raise ValueError(
                "orientation is what the tool keeps, and rotation_step turns it: give one of them, "
                f"got {self.orientation} and {self.rotation_step}."
            )

    @property
    def moves_fingers(self) -> bool:
        return self.finger_step is not None

    def width(self, num_joints: int) -> int:
        turns = 3 if self.rotation_step is not None else int(self.yaw_step is not None)
        return 3 + turns + self.moves_fingers

    def targets(self, action: Array, state: ArmState, simulator: Simulator) -> tuple[Array, Array]:
        position = state.ee_position + self.step * action[:, :3]
        home = simulator.home_orientation
        kept = np.asarray(home if self.orientation is None else self.orientation)
        joints = self.inverse_kinematics(
            position, self._orientation(action, state, kept), state, simulator
        )
        return joints, _finger_targets(action, state, self.finger_step)

    def _orientation(self, action: Array, state: ArmState, kept: Array) -> Array:
        if self.rotation_step is not None:
            turn = from_rotation_vector(self.rotation_step * action[:, 3:6])
            return multiply(turn, state.ee_orientation)
        orientation = np.broadcast_to(kept, state.ee_orientation.shape)
        if self.yaw_step is None:
            return orientation
        # How far the tool has turned about the vertical: the twist of its rotation from the
        # kept orientation. Any other rotation is to be undone.
        twist = multiply(state.ee_orientation, kept * (-1, -1, -1, 1)) * (0, 0, 1, 1)
        # Upside down the twist is not defined: take none.
        length = np.linalg.norm(twist, axis=1, keepdims=True)
        twist = np.where(length < 1e-6, UPRIGHT, twist / np.maximum(length, 1e-6))
        turn = np.zeros((len(action), 3))
        turn[:, 2] = self.yaw_step * action[:, 3]
        return multiply(multiply(from_rotation_vector(turn), twist), orientation)


@dataclass(frozen=True)
class JointDelta:
    """Turns each joint by ``step`` radians times the action (the paper's AR2).

    Args:
        step: rotation that an action of 1 asks for, rad. The joints do it until the next action,
            as far as their efforts and speeds allow.
        bound: largest magnitude of a component; infinity leaves actions unclipped.
        respect_limits: never ask for an angle beyond the joint limits.
        finger_step: if given, a last component sets the free fingers' position, in metres per
            unit of action: 1 opens them by that much, 0 or less closes them.

    Raises:
        TypeError: if ``respect_limits`` is not True or False.
        ValueError: if ``step``, ``bound`` or ``finger_step`` is not positive, or a finite ``bound``
            is too large for float32.

    Examples:
        >>> JointDelta().width(num_joints=7)
        7
    """

    step: float = 0.1
    bound: float = 1.0
    respect_limits: bool = True
    finger_step: float | None = None

    def __post_init__(self) -> None:
        check_positive(step=self.step)
        check_bound(self.bound)
        check_flag(respect_limits=self.respect_limits)
        if self.finger_step is not None:
            check_positive(finger_step=self.finger_step)

    @property
    def moves_fingers(self) -> bool:
        return self.finger_step is not None

    def width(self, num_joints: int) -> int:
        return num_joints + self.moves_fingers

    def targets(self, action: Array, state: ArmState, simulator: Simulator) -> tuple[Array, Array]:
        joints = state.joint_position
        joints = joints + self.step * action[:, : joints.shape[1]]
        if self.respect_limits:
            joints = np.clip(joints, state.joint_lower, state.joint_upper)
        return joints, _finger_targets(action, state, self.finger_step)


def _finger_targets(action: Array, state: ArmState, step: float | None) -> Array:
    if step is None:
        return np.zeros((len(action), 0))
    fingers = state.finger_position.shape[1]
    if not fingers:
        raise ValueError(f"finger_step moves fingers, got {step} and an arm that has none.")
    return np.repeat(step * action[:, -1:], fingers, axis=1)


def check_bound(bound: float) -> None:
    """Raises ValueError unless a bound is positive, and infinite or a number of float32."""
    if not as_number(bound) > 0:
        raise ValueError(f"bound must be positive, got {bound!r}.")
    # Random actions are drawn from an interval, whose length must be a number of the spec's dtype.
    largest = float(np.finfo(np.float32).max) / 2
    if largest < bound < np.inf:
        raise ValueError(f"bound must be at most {largest:.4g} or infinite, got {bound!r}.")
