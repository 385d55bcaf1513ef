"""The ready-made combinations: the parts of their names, and what they stand for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl_safe.envs.actions import CartesianDelta, JointDelta
from torchrl_safe.envs.arms import IIWA, PANDA, UR5, UR10, XARM6, XARM7
from torchrl_safe.envs.obstacles import Human, InFront, Moving, NoObstacles, Obstacles, Scattered
from torchrl_safe.envs.tasks import PickAndPlace, Push, Reach, Task

#: Arms, by the first part of a registered name.
ARMS = {
    "Panda": PANDA,
    "Iiwa": IIWA,
    "XArm6": XARM6,
    "XArm7": XARM7,
    "UR5": UR5,
    "UR10": UR10,
}
#: Tasks, by the second part.
TASKS: dict[str, Task] = {"Reach": Reach(), "Push": Push(), "PickAndPlace": PickAndPlace()}
# Control steps of an episode at 20 Hz. The scripted policies of the tests mostly need no more.
_TIME_LIMITS = {"Reach": 40, "Push": 200, "PickAndPlace": 100}
#: Layouts of obstacles, by the third part, which may be empty.
OBSTACLES: dict[str, Obstacles] = {
    "": NoObstacles(),
    "InFront": InFront(),
    "Scattered": Scattered(),
    "Moving": Moving(),
    "Human": Human(),
}
#: Action modes, by the last part: empty for Cartesian actions, ``Joint`` for joint actions.
ACTIONS: dict[str, CartesianDelta | JointDelta] = {"": CartesianDelta(), "Joint": JointDelta()}


def combination(arm: str, task: str, obstacles: str, action: str) -> dict[str, Any]:
    """Returns the arguments of :class:`~torchrl_safe.envs.ArmEnv` for the parts of a name.

    Args:
        arm: key of ``ARMS``.
        task: key of ``TASKS``; sets the time limit too: 40 control steps for ``Reach``, 200
            for ``Push``, 100 for ``PickAndPlace``.
        obstacles: key of ``OBSTACLES``.
        action: key of ``ACTIONS``. For ``PickAndPlace`` the action also moves the fingers.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv
        >>> env = ArmEnv(num_envs=2, **combination("Panda", "PickAndPlace", "Human", "Joint"))
        >>> env.action_spec.shape, env.max_episode_steps
        (torch.Size([2, 8]), 100)
        >>> env.close()
    """
    grasps = isinstance(TASKS[task], PickAndPlace)
    return {
        "arm": ARMS[arm],
        "task": TASKS[task],
        "obstacles": OBSTACLES[obstacles],
        "action": replace(ACTIONS[action], finger_step=0.04 if grasps else None),
        "max_episode_steps": _TIME_LIMITS[task],
    }
