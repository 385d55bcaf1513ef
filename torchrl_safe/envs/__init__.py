"""Robot arms with costs as TorchRL environments. Needs the ``arms`` extra (PyBullet)."""

from torchrl_safe.envs.actions import ActionMode, CartesianDelta, JointDelta
from torchrl_safe.envs.arm_env import ArmEnv
from torchrl_safe.envs.arms import PANDA, ArmModel
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
from torchrl_safe.envs.scene import Camera, Scene
from torchrl_safe.envs.state import ArmState
from torchrl_safe.envs.tasks import Reach, Task
from torchrl_safe.envs.transforms import CostToReward

__all__ = [
    "PANDA",
    "PAPER_CARTESIAN",
    "PAPER_JOINT",
    "ActionMode",
    "ArmEnv",
    "ArmModel",
    "ArmState",
    "BulletInverseKinematics",
    "Camera",
    "CartesianDelta",
    "Collision",
    "CostToReward",
    "Cylinder",
    "DampedLeastSquares",
    "InFront",
    "InverseKinematics",
    "JointDelta",
    "NoObstacles",
    "Obstacles",
    "Reach",
    "Scene",
    "Task",
    "World",
    "full_observation",
    "paper_env",
    "paper_observation",
]
