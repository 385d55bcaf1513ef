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
    """Turns tool poses into joint angles.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv, CartesianDelta
        >>> def half_way(position, orientation, state, simulator):
        ...     joints = DampedLeastSquares()(position, orientation, state, simulator)
        ...     return (joints + state.joint_position) / 2
        >>> env = ArmEnv(action=CartesianDelta(inverse_kinematics=half_way))
        >>> env.rollout(2)["action"].shape
        torch.Size([1, 2, 3])
        >>> env.close()
    """

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
        after = angles + _change(jacobian, error, self.damping**2)
        return np.clip(after, state.joint_lower, state.joint_upper)


class Approach(NamedTuple):
    """How near k searches have brought the tool to their poses."""

    #: Joint angles, rad, ``(k, n)``.
    angles: Array
    #: Distances from the positions, m, ``(k,)``.
    distance: Array
    #: Length of the rotation vectors to the orientations, ``(k,)``: twice the sine of half the
    #: angle; 0 where any will do.
    turn: Array


def approach(
    simulator: Simulator,
    start: Array,
    position: Array,
    orientation: Array | None = None,
    *,
    arrived: float = 1e-5,
    respect_limits: bool = True,
) -> Approach:
    """Searches joint angles that bring the tool to poses, by damped least squares.

    Each search goes downhill from its start, and may stop at a local minimum. Reset the worlds
    afterwards.

    Args:
        simulator: the worlds.
        start: joint angles to begin from, rad, ``(k, n)``.
        position: where the tool is to get, m, ``(k, 3)``.
        orientation: how it is to be turned, quaternions (x, y, z, w), ``(k, 4)``. ``None`` leaves
            it open.
        arrived: largest distance (m) and turn (rad) at which a search ends.
        respect_limits: keep to the joint limits.
    """
    angles = np.array(start, dtype=float)
    best = Approach(angles.copy(), *np.full((2, len(angles)), np.inf))
    searching = np.arange(len(angles))
    for _ in range(_ITERATIONS):
        tool, turned = simulator.tool_at(angles[searching])
        parts = [position[searching] - tool]
        if orientation is not None:
            parts.append(rotation_vector(turned, orientation[searching]))
        distance, turn = [*(_length(part)[:, 0] for part in parts), np.zeros(len(tool))][:2]
        nearer = distance + turn < best.distance[searching] + best.turn[searching]
        for kept, now in zip(best, (angles[searching], distance, turn), strict=True):
            kept[searching[nearer]] = now[nearer]
        far = np.maximum(distance, turn) >= arrived
        searching = searching[far]
        if not searching.size:
            break
        # The Jacobian holds only nearby, so steps are short.
        error = np.concatenate([_shortened(part[far]) for part in parts], axis=1)
        jacobian = simulator.jacobian(angles[searching])[:, : error.shape[1]]
        after = angles[searching] + _change(jacobian, error, _DAMPING)
        if respect_limits:
            after = np.clip(after, simulator.joint_lower, simulator.joint_upper)
        angles[searching] = after
    return best


def _change(jacobian: Array, error: Array, damping: float) -> Array:
    """Changes of the joint angles, rad, ``(k, n)``, that nearly undo errors of the tool."""
    transposed = jacobian.transpose(0, 2, 1)
    damped = jacobian @ transposed + damping * np.eye(jacobian.shape[1])
    return (transposed @ np.linalg.solve(damped, error[:, :, None]))[:, :, 0]


def _length(vectors: Array) -> Array:
    return np.linalg.norm(vectors, axis=1, keepdims=True)


def _shortened(error: Array) -> Array:
    return error * np.minimum(1.0, _LONGEST_STEP / np.maximum(_length(error), 1e-9))


def distance_to_reach(simulator: Simulator, start: Sequence[float], points: Array) -> Array:
    """Returns how far from points the tool stays, m, ``(k,)``, however it is turned.

    0 where the tool gets there. Reset the worlds afterwards.

    Args:
        simulator: the worlds.
        start: joint angles to begin from, rad, ``(n,)``.
        points: where the tool is to get, m, ``(k, 3)``.
    """
    starts = np.tile(np.array(start, dtype=float), (len(points), 1))
    distance = approach(simulator, starts, points, arrived=_ARRIVED).distance
    return np.where(distance < _ARRIVED, 0.0, distance)
