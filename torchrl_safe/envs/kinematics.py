"""Inverse kinematics: from tool poses to joint angles, for all worlds at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchrl_safe._checks import check_positive
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.rotations import rotation_vector
from torchrl_safe.envs.state import ArmState, Array

_ITERATIONS, _ARRIVED, _LONGEST_STEP = 100, 0.005, 0.1


class InverseKinematics(Protocol):
    """Turns tool poses into joint angles."""

    def __call__(
        self, position: Array, orientation: Array, state: ArmState, simulator: Simulator
    ) -> Array:
        """Returns joint angles, rad, ``(N, n)``.

        Args:
            position: wanted tool points, m, ``(N, 3)``.
            orientation: wanted tool orientations, quaternions (x, y, z, w), ``(N, 4)``.
            state: the current state.
            simulator: gives Jacobians, see
                :class:`~torchrl_safe.envs.Simulator`.
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
        self, position: Array, orientation: Array, state: ArmState, simulator: Simulator
    ) -> Array:
        angles = state.joint_position
        jacobian = simulator.jacobian(angles)
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


def distance_to_reach(simulator: Simulator, start: Sequence[float], point: Array) -> float:
    """Returns how far from a point the tool stays, m, however it is turned; 0 if it gets there.

    The worlds are to be reset afterwards.

    Args:
        simulator: the worlds.
        start: joint angles to begin from, rad, ``(n,)``.
        point: where the tool is to get, m, ``(3,)``.
    """
    angles, nearest = np.array(start, dtype=float), np.inf
    for _ in range(_ITERATIONS):
        error = point - simulator.tool_at(angles[None])[0][0]
        nearest = min(nearest, float(np.linalg.norm(error)))
        if nearest < _ARRIVED:
            return 0.0
        jacobian = simulator.jacobian(angles[None])[0, :3]
        # Far away the Jacobian is no guide: steps are short.
        error *= min(1.0, _LONGEST_STEP / float(np.linalg.norm(error)))
        change = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(3), error)
        angles = np.clip(angles + change, simulator.joint_lower, simulator.joint_upper)
    return nearest
