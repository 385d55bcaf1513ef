"""Robot arms with costs as TorchRL environments. Needs the ``arms`` extra (PyBullet)."""

from torchrl_safe.envs.actions import ActionMode, CartesianDelta, JointDelta
from torchrl_safe.envs.arm_env import ArmEnv
from torchrl_safe.envs.arms import (
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
from torchrl_safe.envs.bullet import World
from torchrl_safe.envs.costs import Collision
from torchrl_safe.envs.kinematics import (
    BulletInverseKinematics,
    DampedLeastSquares,
    InverseKinematics,
)
from torchrl_safe.envs.observations import full_observation, paper_observation
from torchrl_safe.envs.obstacles import Cylinder, InFront, NoObstacles, Obstacles
from torchrl_safe.envs.paper import PAPER_CARTESIAN, PAPER_JOINT, paper_env
from torchrl_safe.envs.regions import Region
from torchrl_safe.envs.scene import Camera, Scene
from torchrl_safe.envs.state import ArmState
from torchrl_safe.envs.tasks import Reach, Task

__all__ = [
    "IIWA",
    "PANDA",
    "PAPER_CARTESIAN",
    "PAPER_JOINT",
    "PARALLEL_GRIPPER",
    "UR5",
    "UR10",
    "XARM6",
    "XARM7",
    "ActionMode",
    "ArmEnv",
    "ArmModel",
    "ArmState",
    "BulletInverseKinematics",
    "Camera",
    "CartesianDelta",
    "Collision",
    "Cylinder",
    "DampedLeastSquares",
    "Gripper",
    "InFront",
    "InverseKinematics",
    "JointDelta",
    "NoObstacles",
    "Obstacles",
    "Reach",
    "Region",
    "Scene",
    "Task",
    "World",
    "full_observation",
    "paper_env",
    "paper_observation",
]
