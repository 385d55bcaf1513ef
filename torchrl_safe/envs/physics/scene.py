"""The world around the arm, and the camera that looks at it, as data."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_safe._checks import check_flag, check_not_negative, check_positive, keep_numbers
from torchrl_safe.envs.obstacles.shapes import Box

#: Duration of one physics substep, s.
SUBSTEP = 1 / 240
#: The table, whose top is at height 0, and its centre, m.
TABLE_SHAPE = Box(half_extents=(0.75, 0.6, 0.025))
TABLE_CENTRE = (0.5, 0.0, -0.025)
#: Height of the floor, which is only drawn, and half its width, m.
FLOOR_HEIGHT, FLOOR_SIZE = -0.7, 10.0
#: Distance up to which the clearance at the start of an episode is measured, m.
FARTHEST = 0.1


@dataclass(frozen=True)
class Scene:
    """The world around the arm, whichever engine simulates it.

    Args:
        gravity: m/s^2, downwards. MuJoCo's motors compensate for the weight of the arm.
        free_fingers: leave the joints that are not part of the arm movable.
        motor_limits: keep the motors within the efforts and speeds of the URDF.
        motor_strength: share of the URDF's efforts that the motors have.
        link_mass: factor of the masses and inertias of the arm's links. The motors are tuned to the
            masses of the URDF.
        friction: factor of the friction between any two surfaces.

    Raises:
        TypeError: if a flag is not True or False.
        ValueError: if ``gravity`` is negative or not finite, a factor is not positive, or
            ``motor_strength`` is not 1 for motors without limits.

    Examples:
        >>> Scene(gravity=1.62).motor_limits
        True
    """

    gravity: float = 9.81
    free_fingers: bool = False
    motor_limits: bool = True
    motor_strength: float = 1.0
    link_mass: float = 1.0
    friction: float = 1.0

    def __post_init__(self) -> None:
        check_not_negative(gravity=self.gravity)
        check_positive(
            motor_strength=self.motor_strength, link_mass=self.link_mass, friction=self.friction
        )
        check_flag(free_fingers=self.free_fingers, motor_limits=self.motor_limits)
        if self.motor_strength != 1 and not self.motor_limits:
            raise ValueError(
                f"motor_strength must be 1 without motor_limits, got {self.motor_strength}."
            )


@dataclass(frozen=True)
class Camera:
    """A camera for :meth:`~torchrl_safe.envs.ArmEnv.render`.

    Args:
        eye: position of the camera, m.
        target: the point it looks at, m.
        field_of_view: vertical, degrees.
        shadows: draw shadows, which show how high things are. Pictures then take two to three times
            as long.

    Raises:
        TypeError: if ``shadows`` is not True or False.
        ValueError: if a point is not three finite numbers, both are the same, or the field of view
            is not between 0 and 180 degrees.

    Examples:
        >>> Camera(eye=(0.4, -1.5, 0.4)).field_of_view
        45.0
    """

    eye: tuple[float, float, float] = (1.0, -1.25, 0.7)
    target: tuple[float, float, float] = (0.3, 0.0, 0.3)
    field_of_view: float = 45.0
    shadows: bool = False

    def __post_init__(self) -> None:
        if (keep_numbers(self, "eye", 3) == keep_numbers(self, "target", 3)).all():
            raise ValueError(f"eye must not be where it looks, got {self.eye} for both.")
        check_positive(field_of_view=self.field_of_view)
        check_flag(shadows=self.shadows)
        if self.field_of_view >= 180:
            raise ValueError(f"field_of_view must be less than 180, got {self.field_of_view}.")
