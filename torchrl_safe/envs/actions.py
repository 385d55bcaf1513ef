"""Action representations: what the numbers of an action do to the joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from torchrl_safe.envs.bullet import World
from torchrl_safe.envs.checks import check_array, check_positive
from torchrl_safe.envs.kinematics import DampedLeastSquares, InverseKinematics
from torchrl_safe.envs.state import ArmState, Array


@runtime_checkable
class ActionMode(Protocol):
    """What :class:`~torchrl_safe.envs.ArmEnv` asks of an action representation."""

    @property
    def bound(self) -> float:
        """Largest magnitude of an action component; the environment clips to it."""

    def width(self, num_joints: int) -> int:
        """Returns the number of components of an action."""

    def targets(
        self, action: Array, state: ArmState, worlds: Sequence[World]
    ) -> tuple[Array, Array]:
        """Returns joint targets, rad, ``(N, n)``, and finger targets, m, ``(N, f or 0)``."""


@dataclass(frozen=True)
class CartesianDelta:
    """Moves the tool point by ``step`` metres times the action (the paper's AR1).

    The three components are displacements along x, y and z; the orientation of the tool stays
    that of the home pose (pointing down).

    Args:
        step: displacement that an action of 1 asks for, m.
        bound: largest magnitude of a component; infinity leaves actions unclipped.
        inverse_kinematics: turns tool poses into joint angles.
        orientation: tool orientation to keep, a quaternion (x, y, z, w). ``None`` keeps that of
            the home pose.
        finger_step: if given, a fourth component sets the free fingers' position, in metres
            per unit of action.

    Raises:
        ValueError: if ``step``, ``bound`` or ``finger_step`` is not positive, or
            ``orientation`` is not a unit quaternion.

    Examples:
        >>> CartesianDelta(step=0.03).width(num_joints=7)
        3
    """

    step: float = 0.05
    bound: float = 1.0
    inverse_kinematics: InverseKinematics = DampedLeastSquares()
    orientation: tuple[float, float, float, float] | None = None
    finger_step: float | None = None

    def __post_init__(self) -> None:
        check_positive(step=self.step)
        _check_bound(self.bound)
        if self.orientation is not None:
            length = np.linalg.norm(check_array("orientation", self.orientation, (4,)))
            if not np.isclose(length, 1, atol=1e-3):
                raise ValueError(
                    f"orientation must be a unit quaternion (x, y, z, w), got {self.orientation}."
                )
        if self.finger_step is not None:
            check_positive(finger_step=self.finger_step)

    def width(self, num_joints: int) -> int:
        return 3 if self.finger_step is None else 4

    def targets(
        self, action: Array, state: ArmState, worlds: Sequence[World]
    ) -> tuple[Array, Array]:
        position = state.ee_position + self.step * action[:, :3]
        orientation = self.orientation or worlds[0].home_orientation
        joints = self.inverse_kinematics(position, np.asarray(orientation), state, worlds)
        if self.finger_step is None:
            return joints, np.zeros((len(action), 0))
        fingers = state.finger_position.shape[1]
        if not fingers:
            raise ValueError(
                f"finger_step moves free fingers, got {self.finger_step} and a Scene without "
                "free_fingers."
            )
        return joints, np.repeat(self.finger_step * action[:, 3:], fingers, axis=1)


@dataclass(frozen=True)
class JointDelta:
    """Turns each joint by ``step`` radians times the action (the paper's AR2).

    Args:
        step: rotation that an action of 1 asks for, rad.
        bound: largest magnitude of a component; infinity leaves actions unclipped.
        respect_limits: never ask for an angle beyond the joint limits.

    Raises:
        ValueError: if ``step`` or ``bound`` is not positive.

    Examples:
        >>> JointDelta().width(num_joints=7)
        7
    """

    step: float = 0.1
    bound: float = 1.0
    respect_limits: bool = True

    def __post_init__(self) -> None:
        check_positive(step=self.step)
        _check_bound(self.bound)

    def width(self, num_joints: int) -> int:
        return num_joints

    def targets(
        self, action: Array, state: ArmState, worlds: Sequence[World]
    ) -> tuple[Array, Array]:
        joints = state.joint_position + self.step * action
        if self.respect_limits:
            joints = np.clip(joints, state.joint_lower, state.joint_upper)
        return joints, np.zeros((len(action), 0))


def _check_bound(bound: float) -> None:
    if not bound > 0:
        raise ValueError(f"bound must be positive, got {bound}.")
