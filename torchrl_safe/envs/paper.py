"""The environment of Kovač & Farkaš 2023, as their code has it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from torchrl_safe.envs.actions import ActionMode, CartesianDelta, JointDelta
from torchrl_safe.envs.arm_env import ArmEnv
from torchrl_safe.envs.arms import PANDA
from torchrl_safe.envs.observations import paper_observation
from torchrl_safe.envs.obstacles import InFront
from torchrl_safe.envs.obstacles.shapes import Cylinder
from torchrl_safe.envs.physics.bullet import Bullet, BulletInverseKinematics
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.regions import Region
from torchrl_safe.envs.state import ArmState, Array
from torchrl_safe.envs.tasks import Reach

#: AR1: displacements of the tool point and the position of the fingers, not clipped.
PAPER_CARTESIAN = CartesianDelta(
    step=0.05,
    bound=math.inf,
    inverse_kinematics=BulletInverseKinematics(),
    orientation=(math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0),
    finger_step=1.0,
)

#: AR2: increments of the seven joints, not clipped.
PAPER_JOINT = JointDelta(step=0.1, bound=math.inf, respect_limits=False)


@dataclass(frozen=True)
class AnyContactPoint:
    """Costs 1 for every control step with a contact point, also one that is still a gap.

    Bullet has contact points a millimetre or two before a touch, further for large shapes.
    """

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        return np.isfinite(state.contact_distance).any(axis=1).astype(float)


#: Arguments of :class:`~torchrl_safe.envs.ArmEnv`, all but the action.
PAPER_SETTINGS: Mapping[str, Any] = MappingProxyType(
    {
        "arm": replace(PANDA, home=(0, -0.215, 0, -2.57, 0, 2.356, 2.356), finger_home=0.08),
        "task": Reach(Region((0.6, -0.2, 0.05), (0.8, 0.2, 0.05)), radius=0.09, order=1),
        "obstacles": InFront(gap=0.2, shape=Cylinder(mass=1.0), direction=(1, 0, 0), height=0.05),
        "costs": {"collision": AnyContactPoint()},
        "observation": paper_observation,
        "frame_skip": 1,
        "max_episode_steps": 500,
        "scene": Scene(gravity=10.0, free_fingers=True, motor_limits=False),
        "physics": Bullet(
            furniture=(("plane.urdf", (0, 0, -0.65)), ("table/table.urdf", (0.5, 0, -0.65))),
            target_urdf="lego/lego.urdf",
            merged_links=False,
            motor_gain=0.1,
            urdf_inertia=True,
            fresh_links=False,
        ),
    }
)


def paper_env(action: ActionMode = PAPER_CARTESIAN, **kwargs: Any) -> ArmEnv:
    """Makes the environment of "Safe Reinforcement Learning in a Simulated Robotic Arm".

    One substep of 1/240 s for each action, motors without effort limits, eight numbers to
    observe (which hide the obstacle and the joints), the L1 distance as negative reward, success
    within an L1 distance of 0.09 m, a free cylinder of 1 kg that starts 2.5 cm inside the
    table, a free brick as target, at most 500 steps. The tool pose is read one substep late.
    A cost of 1 counts every step with a contact point, even one that is still a gap.

    Left out: the original also ends an episode, with reward +1, when the brick is above
    0.45 m, which nothing in the task can bring about.

    Args:
        action (ActionMode, optional): ``PAPER_CARTESIAN`` (AR1) or ``PAPER_JOINT`` (AR2).
            Defaults to ``PAPER_CARTESIAN``.
        **kwargs: arguments of :class:`~torchrl_safe.envs.ArmEnv`, for example ``num_envs``.

    Returns:
        The environment.

    Examples:
        >>> env = paper_env(PAPER_JOINT)
        >>> env.observation_spec["observation"].shape, env.action_spec.shape
        (torch.Size([1, 8]), torch.Size([1, 7]))
        >>> env.close()
    """
    return ArmEnv(**{**PAPER_SETTINGS, "action": action, **kwargs})
