"""Inverse kinematics: from tool poses to joint angles, for all worlds at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchrl_safe.envs.checks import check_positive
from torchrl_safe.envs.physics.bullet.world import World
from torchrl_safe.envs.rotations import rotation_vector
from torchrl_safe.envs.state import ArmState, Array

_ITERATIONS, _ARRIVED, _LONGEST_STEP = 100, 0.005, 0.1


class InverseKinematics(Protocol):
    """Turns tool poses into joint angles."""

    def __call__(
        self, position: Array, orientation: Array, state: ArmState, worlds: Sequence[World]
    ) -> Array:
        """Returns joint angles, rad, ``(N, n)``.

        Args:
            position: wanted tool points, m, ``(N, 3)``.
            orientation: wanted tool orientations, quaternions (x, y, z, w), ``(N, 4)``.
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
        return np.array(
            [
                world.inverse_kinematics(*pose)
                for world, *pose in zip(
                    worlds, position.tolist(), orientation.tolist(), strict=True
                )
            ]
        )


def distance_to_reach(world: World, start: Sequence[float], point: Array) -> float:
    """Returns how far from a point the tool stays, m, however it is turned; 0 if it gets there.

    Moves the arm at once, so that the world is to be reset afterwards.

    Args:
        world: the world.
        start: joint angles to begin from, rad, ``(n,)``.
        point: where the tool is to get, m, ``(3,)``.
    """
    angles, nearest = np.array(start, dtype=float), np.inf
    for _ in range(_ITERATIONS):
        error = point - world.tool_at(angles.tolist())[0]
        nearest = min(nearest, float(np.linalg.norm(error)))
        if nearest < _ARRIVED:
            return 0.0
        jacobian = np.array(world.jacobian(angles.tolist())[:3])
        # Far away the Jacobian is no guide: steps are short.
        error *= min(1.0, _LONGEST_STEP / float(np.linalg.norm(error)))
        change = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(3), error)
        angles = np.clip(angles + change, world.joint_lower, world.joint_upper)
    return nearest
