"""The world around the arm, and the camera that looks at it, as data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_safe.envs.checks import check_array, check_flag, check_positive

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
        merged_links: simulate links that fixed joints hold together as one, with
            the contact properties of the first link: a physics step takes 15 to 40 % less
            time. With ``urdf_inertia`` it is the same body; else its inertia is that of another
            box. Not done where the task moves objects, whose grip depends on these properties.
        motor_limits: keep the motors within the efforts and speeds of the URDF.
        motor_gain: share of the way that is left to the joint targets that the motors go in
            each physics substep. ``None`` is 1 / ``frame_skip``; with 12 substeps they have gone
            65 % of the way at the end of the control step, fastest at its beginning.
        urdf_inertia: take inertias from the URDF instead of from the collision shapes.
        fresh_links: read the tool pose of the current joint angles. ``False`` reads it one
            physics substep late, as PyBullet does unless told otherwise.

    Raises:
        ValueError: if ``gravity`` is not finite or ``motor_gain`` is not positive.

    Examples:
        >>> Scene(gravity=1.62).motor_limits
        True
    """

    gravity: float = 9.81
    furniture: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    target_urdf: str | None = None
    free_fingers: bool = False
    merged_links: bool = True
    motor_limits: bool = True
    motor_gain: float | None = None
    urdf_inertia: bool = False
    fresh_links: bool = True

    def __post_init__(self) -> None:
        check_array("gravity", self.gravity, ())
        if self.motor_gain is not None:
            check_positive(motor_gain=self.motor_gain)
        check_flag(
            free_fingers=self.free_fingers,
            merged_links=self.merged_links,
            motor_limits=self.motor_limits,
            urdf_inertia=self.urdf_inertia,
            fresh_links=self.fresh_links,
        )


@dataclass(frozen=True)
class Camera:
    """Where :meth:`~torchrl_safe.envs.ArmEnv.render` looks from.

    Args:
        eye: position of the camera, m.
        target: the point it looks at, m.
        field_of_view: vertical, degrees.

    Raises:
        ValueError: if a point is not three finite numbers, both are the same, or the field of view
            is not between 0 and 180 degrees.

    Examples:
        >>> Camera(eye=(0.4, -1.5, 0.4)).field_of_view
        45.0
    """

    eye: tuple[float, float, float] = (1.0, -1.25, 0.7)
    target: tuple[float, float, float] = (0.3, 0.0, 0.3)
    field_of_view: float = 45.0

    def __post_init__(self) -> None:
        if np.array_equal(
            check_array("eye", self.eye, (3,)), check_array("target", self.target, (3,))
        ):
            raise ValueError(f"eye must not be where it looks, got {self.eye} for both.")
        check_positive(field_of_view=self.field_of_view)
        if self.field_of_view >= 180:
            raise ValueError(f"field_of_view must be less than 180, got {self.field_of_view}.")
