"""Robot arms as data. Limits, efforts and the joint chain are read from the URDF."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ArmModel:
    """A robot arm.

    The arm's joints are the movable joints between the base and ``ee_link``. Every other joint
    (a gripper's fingers) is fixed, unless the :class:`~torchrl_safe.envs.Scene` leaves it free.

    Args:
        urdf: path of the URDF file, absolute or relative to ``pybullet_data``.
        ee_link: name of the end-effector link, whose frame is the tool point.
        home: joint angles at the start of an episode, in radians, one for each joint of the
            arm. Cartesian actions keep the tool orientation of this pose.
        finger_home: position of the joints that are not part of the arm, in metres, where they
            are free.

    A file, link or home pose that does not fit raises ValueError where the world is built.

    Examples:
        >>> iiwa = ArmModel("kuka_iiwa/model.urdf", "lbr_iiwa_link_7", (0, 0.4, 0, -2, 0, 0.74, 0))
        >>> iiwa.ee_link
        'lbr_iiwa_link_7'
    """

    urdf: str
    ee_link: str
    home: tuple[float, ...]
    finger_home: float = 0.0


#: Franka Emika Panda with its hand closed; at home the tool points down at (0.35, 0, 0.2) m.
PANDA = ArmModel(
    urdf="franka_panda/panda.urdf",
    ee_link="panda_grasptarget",
    home=(0.0, -0.395, 0.0, -2.849, 0.0, 2.454, 0.7854),
)
