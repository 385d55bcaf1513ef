"""Robot arms as data. Limits, efforts and the joint chain are read from the URDF."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torchrl_safe._checks import check_array, check_kind, check_unit, keep_numbers
from torchrl_safe.envs.regions import Region


@dataclass(frozen=True)
class Gripper:
    """A gripper for any arm, whose fingers open by the same amount.

    Args:
        urdf: path of the URDF file, as that of an :class:`ArmModel`.
        tool_link: name of the gripper's link whose frame is the tool point.
        position: where the gripper's root link is mounted, in the frame of the arm's
            ``ee_link``, m.
        rotation: how it is turned there: roll, pitch and yaw, rad.

    Raises:
        ValueError: if ``position`` or ``rotation`` is not three finite numbers. A file or link
            that does not fit raises it where the world is built.

    Examples:
        >>> Gripper("gripper.urdf", "tool", position=(0.0, 0.0, 0.045)).rotation
        (0.0, 0.0, 0.0)
    """

    urdf: str
    tool_link: str
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        keep_numbers(self, "position", 3)
        keep_numbers(self, "rotation", 3)


@dataclass(frozen=True)
class ArmModel:
    """A robot arm.

    The arm's joints are the movable joints between the base and ``ee_link``. Every other joint
    (a gripper's fingers) is fixed, unless the :class:`~torchrl_safe.envs.Scene` leaves it free.

    Args:
        urdf: path of the URDF file, absolute or relative to ``pybullet_data``, to the robots of
            ``example-robot-data`` (the ``more-arms`` extra) or to the working directory.
        ee_link: name of the end-effector link. Its frame is the tool point, unless a gripper
            is mounted on it.
        home: joint angles at the start of an episode, in radians, one for each joint of the
            arm. Cartesian actions keep the tool orientation of this pose.
        goals: box in which the arm reaches every point with the tool turned as at home, in the
            world, where the URDF's root link is at the origin, m. Defaults to the Panda's: x from
            0.6 to 0.7, y from -0.2 to 0.2, z from 0.05 to 0.15.
        finger_home: position of free finger joints at the start of an episode, m.
        gripper: what is mounted on ``ee_link``; its ``tool_link`` then is the tool point.
        handling_orientation: tool orientation, a quaternion (x, y, z, w), that keeps the arm off
            an obstacle beside the object that it pushes or picks up. Pass it to
            :class:`~torchrl_safe.envs.CartesianDelta`. ``None`` stands for the home pose's.

    Raises:
        TypeError: if ``urdf``, ``ee_link``, ``goals`` or ``gripper`` is not of its kind.
        ValueError: if ``handling_orientation`` is no unit quaternion. A file, link or home pose
            that does not fit raises it where the world is built.

    Examples:
        >>> iiwa = ArmModel("kuka_iiwa/model.urdf", "lbr_iiwa_link_7", (0, 0.4, 0, -2, 0, 0.74, 0))
        >>> iiwa.ee_link
        'lbr_iiwa_link_7'
    """

    urdf: str
    ee_link: str
    home: tuple[float, ...]
    goals: Region = Region((0.6, -0.2, 0.05), (0.7, 0.2, 0.15))
    finger_home: float = 0.0
    gripper: Gripper | None = None
    handling_orientation: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        check_kind("urdf", self.urdf, str)
        check_kind("ee_link", self.ee_link, str)
        keep_numbers(self, "home", math.prod(np.shape(self.home)))
        check_kind("goals", self.goals, Region)
        check_array("finger_home", self.finger_home, ())
        if self.gripper is not None:
            check_kind("gripper", self.gripper, Gripper)
        if self.handling_orientation is not None:
            check_unit("handling_orientation", keep_numbers(self, "handling_orientation", 4))


def check_home(arm: ArmModel, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> None:
    """Raises ValueError unless the home pose is within the limits of the joints, rad, ``(n,)``."""
    if len(arm.home) != len(lower):
        raise ValueError(
            f"home must give {len(lower)} joint angles, one for each movable joint up to "
            f"{arm.ee_link!r}, got {len(arm.home)}."
        )
    if not np.all((lower <= arm.home) & (arm.home <= upper)):
        raise ValueError(
            f"home must be within the joint limits {lower.tolist()} and {upper.tolist()}, got "
            f"{arm.home}."
        )


def check_fingers(arm: ArmModel, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> None:
    """Raises ValueError unless free fingers have one range, m, ``(f,)``, and begin within it.

    Not for motors without limits: the paper's arm begins beyond them.
    """
    if len(np.unique(lower)) > 1 or len(np.unique(upper)) > 1:
        raise ValueError(
            "gripper must have fingers that all open by the same amount, along axes that point "
            f"apart, got limits of {lower.tolist()} and {upper.tolist()}."
        )
    if not np.all((lower <= arm.finger_home) & (arm.finger_home <= upper)):
        raise ValueError(
            f"finger_home must be within the limits of the fingers, {lower.tolist()} and "
            f"{upper.tolist()}, got {arm.finger_home}."
        )


def grips(
    arm: ArmModel, lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Positions of free fingers at their limits, m, ``(f,)``, and at the start, which is last.

    Those without a limit are where they start.
    """
    home = np.full_like(lower, arm.finger_home)
    return [*(np.where(np.isfinite(limit), limit, home) for limit in (lower, upper)), home]


# Turned by a quarter, a hand has its narrow side to what is beside the object. The direction of the
# turn decides where the elbow of an arm with seven joints goes. The wrist of a UR hangs too low for
# that, so its hand leans back instead.
_LEFT, _RIGHT = (
    (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
    (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0),
)
_LEANING = (0.0, math.cos(0.3), 0.0, math.sin(0.3))


#: A small parallel gripper of our own for any flange: 0.5 kg, opens by 0.04 m to each side.
PARALLEL_GRIPPER = Gripper("gripper.urdf", tool_link="tool")

#: Franka Emika Panda with its hand closed; at home the tool points down at (0.35, 0, 0.2) m.
PANDA = ArmModel(
    urdf="franka_panda/panda.urdf",
    ee_link="panda_grasptarget",
    home=(0.0, -0.395, 0.0, -2.849, 0.0, 2.454, 0.7854),
    handling_orientation=_RIGHT,
)

#: KUKA LBR iiwa 14; at home the tool points down at (0.42, 0, 0.25) m: its elbow cannot fold
#: further, and its reach with the tool down ends at 0.8 m, which leaves a narrow strip of goals.
IIWA = ArmModel(
    urdf="kuka_iiwa/model.urdf",
    ee_link="lbr_iiwa_link_7",
    home=(0.0, 0.3292, 0.0, -2.0221, 0.0, 0.7903, 0.0),
    goals=Region((0.65, -0.2, 0.05), (0.7, 0.2, 0.15)),
    # The link's frame lies inside its body; the flange is 45 mm further out.
    gripper=replace(PARALLEL_GRIPPER, position=(0.0, 0.0, 0.045)),
    handling_orientation=_RIGHT,
)

#: UFACTORY xArm 6; at home the tool points down at (0.25, 0, 0.2) m.
XARM6 = ArmModel(
    urdf="xarm/xarm6_robot.urdf",
    ee_link="link6",
    home=(0.0, -0.7665, -0.257, 0.0, 1.0235, 0.0),
    goals=Region((0.48, -0.2, 0.05), (0.58, 0.2, 0.15)),
    gripper=PARALLEL_GRIPPER,
    handling_orientation=_RIGHT,
)

#: UFACTORY xArm 7; at home the tool points down at (0.25, 0, 0.2) m. Needs ``more-arms``.
XARM7 = ArmModel(
    urdf="xarm_description/urdf/xarm7.urdf",
    ee_link="link_eef",
    home=(0.0, -0.7224, 0.0, 0.2634, 0.0, 0.9858, 0.0),
    goals=Region((0.48, -0.2, 0.05), (0.58, 0.2, 0.15)),
    gripper=PARALLEL_GRIPPER,
    handling_orientation=_LEFT,
)

#: Universal Robots UR5; at home the tool points down at (0.35, 0, 0.2) m. Needs ``more-arms``.
UR5 = ArmModel(
    urdf="ur_description/urdf/ur5_robot.urdf",
    ee_link="tool0",
    home=(-0.3171, -1.9041, 2.1843, -1.851, -1.5708, 1.2536),
    gripper=PARALLEL_GRIPPER,
    handling_orientation=_LEANING,
)

#: Universal Robots UR10; at home the tool points down at (0.35, 0, 0.2) m. Needs ``more-arms``.
UR10 = ArmModel(
    urdf="ur_description/urdf/ur10_robot.urdf",
    ee_link="tool0",
    home=(-0.4875, -2.1153, 2.5841, -2.0396, -1.5708, 1.0833),
    gripper=PARALLEL_GRIPPER,
    handling_orientation=_LEANING,
)
