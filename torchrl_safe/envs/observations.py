"""Observations: functions that map an ArmState to named fields, each of shape (N, width)."""

from __future__ import annotations

import numpy as np

from torchrl_safe.envs.state import ArmState, Array


def full_observation(state: ArmState) -> dict[str, Array]:
    """What reaching past fixed obstacles needs to be Markov.

    Of an obstacle that is free to fall over, its orientation is left out.

    Returns:
        The fields, in order: ``joint_position`` (rad), ``joint_velocity`` (rad/s),
        ``ee_position`` (m), ``ee_velocity`` (m/s), ``to_goal`` (from the tool point, m), and for
        all obstacles ``to_obstacle`` (from the tool point, m), ``obstacle_size`` (half extents,
        m) and ``obstacle_velocity`` (m/s).

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = ArmEnv(observation=full_observation)
        >>> env.observation_fields["to_goal"]
        slice(20, 23, None)
        >>> env.close()
    """
    rows = len(state.ee_position)
    relative = state.obstacle_position - state.ee_position[:, None]
    return {
        "joint_position": state.joint_position,
        "joint_velocity": state.joint_velocity,
        "ee_position": state.ee_position,
        "ee_velocity": state.ee_velocity,
        "to_goal": state.goal - state.ee_position,
        "to_obstacle": relative.reshape(rows, -1),
        "obstacle_size": np.tile(state.obstacle_size.reshape(1, -1), (rows, 1)),
        "obstacle_velocity": state.obstacle_velocity.reshape(rows, -1),
    }


def paper_observation(state: ArmState) -> dict[str, Array]:
    """The eight numbers of Kovač & Farkaš 2023: tool point, both fingers, target, all in m."""
    return {
        "ee_position": state.ee_position,
        "finger_position": state.finger_position,
        "goal": state.goal,
    }
