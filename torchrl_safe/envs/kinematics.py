"""Inverse kinematics: from tool poses to joint angles, for all worlds at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchrl_safe.envs.bullet import World
from torchrl_safe.envs.checks import check_positive
from torchrl_safe.envs.state import ArmState, Array


class InverseKinematics(Protocol):
    """Turns tool poses into joint angles."""

    def __call__(
        self, position: Array, orientation: Array, state: ArmState, worlds: Sequence[World]
    ) -> Array:
        """Returns joint angles, rad, ``(N, n)``.

        Args:
            position: wanted tool points, m, ``(N, 3)``.
            orientation: wanted tool orientation, a quaternion (x, y, z, w), ``(4,)``.
            state: the current state.
            worlds: the N worlds.
        """


@dataclass(frozen=True)
class DampedLeastSquares:
    r"""One damped least-squares step on the Jacobian, within the joint limits.

    .. math::
        q' = q + J^\top (J J^\top + \mu^2 I)^{-1} e

    with e the error in position (m) and orientation (rad) (Wampler 1986; Nakamura and Hanafusa
    1986). For the small displacements of one control step a single step is more accurate, and
    several times cheaper, than twenty iterations of Bullet's solver.

    Args:
        damping: mu; larger is smoother near singular poses and less exact elsewhere.

    Raises:
        ValueError: if ``damping`` is not positive.

    Examples:
        >>> DampedLeastSquares(damping=0.1)
        DampedLeastSquares(damping=0.1)
    """

    damping: float = 0.05

    def __post_init__(self) -> None:
        check_positive(damping=self.damping)

    def __call__(
        self, position: Array, orientation: Array, state: ArmState, worlds: Sequence[World]
    ) -> Array:
        angles = state.joint_position
        jacobian = np.array(
            [world.jacobian(row) for world, row in zip(worlds, angles.tolist(), strict=True)]
        )
        error = np.concatenate(
            [
                position - state.ee_position,
                rotation_vector(state.ee_orientation, orientation),
            ],
            axis=1,
        )
        transposed = jacobian.transpose(0, 2, 1)
        damped = jacobian @ transposed + self.damping**2 * np.eye(6)
        change = transposed @ np.linalg.solve(damped, error[:, :, None])
        return np.clip(angles + change[:, :, 0], state.joint_lower, state.joint_upper)


@dataclass(frozen=True)
class BulletInverseKinematics:
    """PyBullet's own solver with its defaults: 20 iterations, no joint limits.

    Only for the paper's environment: it is slower and less exact than
    :class:`DampedLeastSquares`.
    """

    def __call__(
        self, position: Array, orientation: Array, state: ArmState, worlds: Sequence[World]
    ) -> Array:
        wanted = orientation.tolist()
        return np.array(
            [
                world.inverse_kinematics(point, wanted)
                for world, point in zip(worlds, position.tolist(), strict=True)
            ]
        )


def rotation_vector(current: Array, wanted: Array) -> Array:
    """Returns the rotation from current orientations to a wanted one, in world coordinates.

    Exact in direction; its length is twice the sine of half the angle, which equals the angle
    to third order.

    Args:
        current: quaternions (x, y, z, w), ``(N, 4)``.
        wanted: quaternion, ``(4,)``.

    Returns:
        Rotation vectors, rad, ``(N, 3)``.

    Examples:
        >>> quarter = np.array([0.0, 0.0, np.sin(0.05), np.cos(0.05)])
        >>> rotation_vector(np.array([[0.0, 0.0, 0.0, 1.0]]), quarter).round(4)
        array([[0. , 0. , 0.1]])
    """
    vector, scalar = wanted[:3], wanted[3]
    current_vector, current_scalar = current[:, :3], current[:, 3:]
    # The product of the wanted quaternion and the conjugate of the current one.
    product = current_scalar * vector - scalar * current_vector - np.cross(vector, current_vector)
    cosine = (current_vector @ vector)[:, None] + current_scalar * scalar
    return 2 * np.where(cosine < 0, -product, product)
