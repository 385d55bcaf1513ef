"""The world around the arm, and the camera that looks at it, as data."""

from __future__ import annotations

from dataclasses import dataclass

#: Duration of one physics substep, s (PyBullet's default).
SUBSTEP = 1 / 240


@dataclass(frozen=True)
class Scene:
    """How the world around the arm is simulated. The defaults are the cheapest that are right.

    Args:
        gravity: m/s^2, downwards.
        furniture: URDF files of ``pybullet_data`` with their positions. Empty gives a table
            whose top is at height 0.
        target_urdf: body of the target, free to move; the goal is then read from the
            simulator. ``None`` makes the target a mere point.
        free_fingers: leave the joints that are not part of the arm movable.
        effort_limits: limit the motors to the efforts of the URDF.
        urdf_inertia: take inertias from the URDF instead of from the collision shapes.
        fresh_links: read the tool pose of the current joint angles. ``False`` reads it one
            physics substep late, as PyBullet does unless told otherwise.
    """

    gravity: float = 9.81
    furniture: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    target_urdf: str | None = None
    free_fingers: bool = False
    effort_limits: bool = True
    urdf_inertia: bool = False
    fresh_links: bool = True


@dataclass(frozen=True)
class Camera:
    """Where :meth:`~torchrl_safe.envs.ArmEnv.render` looks from; lengths in metres."""

    eye: tuple[float, float, float] = (1.0, -1.25, 0.7)
    target: tuple[float, float, float] = (0.3, 0.0, 0.3)
    field_of_view: float = 45.0
