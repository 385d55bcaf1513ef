"""Robot arms: what they are (``models``) and how their URDF files are read."""

from torchrl_safe.envs.arms.models import (
    IIWA,
    PANDA,
    PARALLEL_GRIPPER,
    UR5,
    UR10,
    XARM6,
    XARM7,
    ArmModel,
    Gripper,
)

__all__ = [
    "IIWA",
    "PANDA",
    "PARALLEL_GRIPPER",
    "UR5",
    "UR10",
    "XARM6",
    "XARM7",
    "ArmModel",
    "Gripper",
]
