"""Robot arms with costs as TorchRL environments, and transforms for any environment with costs.

Only arms need a physics engine: ``physics=Bullet()`` the extra ``arms``, ``physics=MuJoCo()`` the
extra ``mujoco``. The files of the arms come with ``arms`` and ``more-arms``.
"""

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
from torchrl_safe.envs.costs import (
    Collision,
    ContactForce,
    JointLimit,
    Proximity,
    ShieldCorrection,
    Speed,
    SpeedAndSeparation,
    Workspace,
)
from torchrl_safe.envs.home import find_home
from torchrl_safe.envs.kinematics import DampedLeastSquares, InverseKinematics
from torchrl_safe.envs.observations import FullObservation, paper_observation
from torchrl_safe.envs.obstacles import (
    Box,
    Capsule,
    Cylinder,
    Human,
    InFront,
    Look,
    Motion,
    Moving,
    NoObstacles,
    Obstacles,
    Part,
    Patrol,
    Placement,
    Scattered,
    Shape,
    Sphere,
    Swing,
)
from torchrl_safe.envs.paper import PAPER_CARTESIAN, PAPER_JOINT, PAPER_SETTINGS, paper_env
from torchrl_safe.envs.physics.bullet import Bullet, BulletInverseKinematics
from torchrl_safe.envs.physics.mujoco import MuJoCo
from torchrl_safe.envs.physics.scene import Camera, Scene
from torchrl_safe.envs.physics.simulator import Nearest, Physics, Simulator
from torchrl_safe.envs.regions import NoRoomError, Region
from torchrl_safe.envs.shield import Shield
from torchrl_safe.envs.state import ArmState, Sensing, Sensor
from torchrl_safe.envs.suite import SUITE, SuiteTask
from torchrl_safe.envs.tasks import PickAndPlace, Push, Reach, Task
from torchrl_safe.envs.transforms import CostToReward, EarlyTermination, FrameSkip, Saute

__all__ = [
    "IIWA",
    "PANDA",
    "PAPER_CARTESIAN",
    "PAPER_JOINT",
    "PAPER_SETTINGS",
    "PARALLEL_GRIPPER",
    "SUITE",
    "UR5",
    "UR10",
    "XARM6",
    "XARM7",
    "ActionMode",
    "ArmEnv",
    "ArmModel",
    "ArmState",
    "Box",
    "Bullet",
    "BulletInverseKinematics",
    "Camera",
    "Capsule",
    "CartesianDelta",
    "Collision",
    "ContactForce",
    "CostToReward",
    "Cylinder",
    "DampedLeastSquares",
    "EarlyTermination",
    "FrameSkip",
    "FullObservation",
    "Gripper",
    "Human",
    "InFront",
    "InverseKinematics",
    "JointDelta",
    "JointLimit",
    "Look",
    "Motion",
    "Moving",
    "MuJoCo",
    "Nearest",
    "NoObstacles",
    "NoRoomError",
    "Obstacles",
    "Part",
    "Patrol",
    "Physics",
    "PickAndPlace",
    "Placement",
    "Proximity",
    "Push",
    "Reach",
    "Region",
    "Saute",
    "Scattered",
    "Scene",
    "Sensing",
    "Sensor",
    "Shape",
    "Shield",
    "ShieldCorrection",
    "Simulator",
    "Speed",
    "SpeedAndSeparation",
    "Sphere",
    "SuiteTask",
    "Swing",
    "Task",
    "Workspace",
    "find_home",
    "paper_env",
    "paper_observation",
]
