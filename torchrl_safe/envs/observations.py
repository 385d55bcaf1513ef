"""Observations: callables that map an ArmState to named fields, each of shape (N, width)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_safe._checks import check_count
from torchrl_safe.envs.state import ArmState, Array


@dataclass(frozen=True)
class FullObservation:
    """Observes where everything is and how it moves, for any arm, task and obstacles.

    The task is Markov if obstacles are at rest. The plans of moving obstacles stay hidden, such as
    when a patrol turns round, or what a person reaches for next.

    The fields, in order; those of free fingers and objects are empty where there are none:

    - ``joint_position`` (rad), ``joint_velocity`` (rad/s), ``finger_position`` (m)
    - ``ee_position`` (m), ``ee_velocity`` (m/s), ``to_goal`` (from the tool point, m)
    - for all objects ``to_object`` (from the tool point, m), ``object_orientation``,
      ``object_velocity`` (m/s), ``object_angular_velocity`` (rad/s)
    - for all obstacles ``to_obstacle`` (from the tool point, m), ``obstacle_size`` (half
      extents, m), ``obstacle_orientation``, ``obstacle_velocity`` (m/s),
      ``obstacle_angular_velocity`` (rad/s) and ``obstacle_present`` (the mask: 1 or 0)

    Orientations are quaternions (x, y, z, w) with w not negative. Obstacles that are not present
    are all zeros.

    Args:
        nearest: number of obstacles to show: those whose centres are nearest to the tool point,
            nearest first, and zeros where a world has fewer. A policy then fits any number of
            obstacles. ``None`` shows all, in their own order.

    Raises:
        ValueError: if ``nearest`` is not a whole number of at least 1.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = ArmEnv(observation=FullObservation(nearest=3))
        >>> env.observation_fields["to_goal"], env.observation_fields["obstacle_present"]
        (slice(20, 23, None), slice(71, 74, None))
        >>> env.close()
    """

    nearest: int | None = None

    def __post_init__(self) -> None:
        if self.nearest is not None:
            check_count(nearest=self.nearest)

    def __call__(self, state: ArmState) -> dict[str, Array]:
        """Returns the fields, each of shape ``(N, width)``."""
        rows = len(state.ee_position)
        tool = state.ee_position[:, None]
        relative = state.obstacle_position - tool
        obstacles = {
            "to_obstacle": relative,
            "obstacle_size": np.repeat(state.obstacle_size[None], rows, axis=0),
            "obstacle_orientation": _canonical(state.obstacle_orientation),
            "obstacle_velocity": state.obstacle_velocity,
            "obstacle_angular_velocity": state.obstacle_angular_velocity,
            "obstacle_present": np.ones((*relative.shape[:2], 1)),
        }
        present = state.obstacle_present[:, :, None]
        if not present.all():
            obstacles = {name: np.where(present, part, 0) for name, part in obstacles.items()}
        if self.nearest is not None:
            distance = np.where(present[:, :, 0], np.linalg.norm(relative, axis=2), np.inf)
            order = np.argsort(distance, axis=1, kind="stable")[:, : self.nearest, None]
            missing = self.nearest - order.shape[1]
            obstacles = {
                name: np.pad(np.take_along_axis(part, order, 1), ((0, 0), (0, missing), (0, 0)))
                for name, part in obstacles.items()
            }
        return {
            "joint_position": state.joint_position,
            "joint_velocity": state.joint_velocity,
            "finger_position": state.finger_position,
            "ee_position": state.ee_position,
            "ee_velocity": state.ee_velocity,
            "to_goal": state.goal - state.ee_position,
            "to_object": (state.object_position - tool).reshape(rows, -1),
            "object_orientation": _canonical(state.object_orientation).reshape(rows, -1),
            "object_velocity": state.object_velocity.reshape(rows, -1),
            "object_angular_velocity": state.object_angular_velocity.reshape(rows, -1),
            **{name: part.reshape(rows, -1) for name, part in obstacles.items()},
        }


def paper_observation(state: ArmState) -> dict[str, Array]:
    """The eight numbers of Kovač & Farkaš 2023: tool point, both fingers, target, all in m.

    Examples:
        >>> from torchrl_safe.envs import paper_env
        >>> env = paper_env()
        >>> list(env.observation_fields)
        ['ee_position', 'finger_position', 'goal']
        >>> env.close()
    """
    return {
        "ee_position": state.ee_position,
        "finger_position": state.finger_position,
        "goal": state.goal,
    }


def _canonical(quaternion: Array) -> Array:
    """Of the two quaternions of an orientation, the one whose w is not negative."""
    return np.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
