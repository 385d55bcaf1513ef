"""Inverse kinematics: from tool poses to joint angles, for all worlds at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from torchrl_safe._checks import check_positive
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.rotations import rotation_vector
from torchrl_safe.envs.state import ArmState, Array

_ITERATIONS, _ARRIVED, _LONGEST_STEP, _DAMPING = 100, 0.005, 0.1, 1e-3


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


class Approach(NamedTuple):
    """How near a search has brought the tool to a pose."""

    #: Joint angles, rad, ``(n,)``.
    angles: Array
    #: Distance from the position, m.
    distance: float
    #: Angle from the orientation, rad; 0 where any will do.
    turn: float


def approach(
    simulator: Simulator,
    start: Sequence[float] | Array,
    position: Array,
    orientation: Array | None = None,
    *,
    arrived: float = 1e-5,
    respect_limits: bool = True,
) -> Approach:
    """Searches joint angles that bring the tool to a pose, by damped least squares.

    It goes downhill from where it starts, and may stop where only a detour leads on. The worlds
    are to be reset afterwards.

    Args:
        simulator: the worlds.
        start: joint angles to begin from, rad, ``(n,)``.
        position: where the tool is to get, m, ``(3,)``.
        orientation: how it is to be turned, a quaternion (x, y, z, w), ``(4,)``. ``None`` leaves
            it open.
        arrived: largest distance (m) and turn (rad) at which the search ends.
        respect_limits: keep to the joint limits.
    """
    angles = np.array(start, dtype=float)
    best = Approach(angles, np.inf, np.inf)
    for _ in range(_ITERATIONS):
        tool, turned = (part[0] for part in simulator.tool_at(angles[None]))
        way = position - tool
        parts = [way]
        if orientation is not None:
            parts.append(rotation_vector(turned[None], orientation[None])[0])
        now = Approach(angles, *(float(np.linalg.norm(part)) for part in [*parts, np.zeros(1)][:2]))
        if now.distance + now.turn < best.distance + best.turn:
            best = now
        if max(now.distance, now.turn) < arrived:
            break
        # Far away the Jacobian is no guide: steps are short.
        error = np.concatenate([_shortened(part) for part in parts])
        jacobian = simulator.jacobian(angles[None])[0, : len(error)]
        damped = jacobian @ jacobian.T + _DAMPING * np.eye(len(error))
        angles = angles + jacobian.T @ np.linalg.solve(damped, error)
        if respect_limits:
            angles = np.clip(angles, simulator.joint_lower, simulator.joint_upper)
    return best


def _shortened(error: Array) -> Array:
    return error * min(1.0, _LONGEST_STEP / max(float(np.linalg.norm(error)), 1e-9))


def distance_to_reach(simulator: Simulator, start: Sequence[float], point: Array) -> float:
    """Returns how far from a point the tool stays, m, however it is turned; 0 if it gets there.

    The worlds are to be reset afterwards.

    Args:
        simulator: the worlds.
        start: joint angles to begin from, rad, ``(n,)``.
        point: where the tool is to get, m, ``(3,)``.
    """
    distance = approach(simulator, start, point, arrived=_ARRIVED).distance
    return 0.0 if distance < _ARRIVED else distance
