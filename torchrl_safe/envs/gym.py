"""Gymnasium, both ways: arms for Gymnasium's users, and Gymnasium's environments with a cost.

Importing this module registers the ready-made combinations of an arm, a task, obstacles and an
action as ``torchrl_safe/<Arm><Task><Obstacles><Action>-v0``; the names are the keys of ``ARMS``,
``TASKS``, ``OBSTACLES`` and ``ACTIONS``. Gymnasium's own syntax imports it on the way:
``gymnasium.make("torchrl_safe.envs.gym:torchrl_safe/PandaReachInFront-v0")``.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from tensordict import TensorDict

from torchrl_safe.envs.actions import CartesianDelta, JointDelta
from torchrl_safe.envs.arm_env import ArmEnv
from torchrl_safe.envs.arms import IIWA, PANDA, UR5, UR10, XARM6, XARM7
from torchrl_safe.envs.human import Human
from torchrl_safe.envs.moving import Moving
from torchrl_safe.envs.obstacles import InFront, NoObstacles, Obstacles, Scattered
from torchrl_safe.envs.safe_gym import SafeGymEnv, SafeGymWrapper
from torchrl_safe.envs.tasks import PickAndPlace, Push, Reach, Task

__all__ = [
    "ACTIONS",
    "ARMS",
    "OBSTACLES",
    "TASKS",
    "ArmGymEnv",
    "SafeGymEnv",
    "SafeGymWrapper",
    "combination",
]

#: The parts of the registered names, and what they stand for.
ARMS = {
    "Panda": PANDA,
    "Iiwa": IIWA,
    "XArm6": XARM6,
    "XArm7": XARM7,
    "UR5": UR5,
    "UR10": UR10,
}
TASKS: dict[str, Task] = {"Reach": Reach(), "Push": Push(), "PickAndPlace": PickAndPlace()}
# Control steps of an episode, at 20 Hz; mostly enough for the scripted pilots of the tests.
_TIME_LIMITS = {"Reach": 40, "Push": 200, "PickAndPlace": 100}
OBSTACLES: dict[str, Obstacles] = {
    "": NoObstacles(),
    "InFront": InFront(),
    "Scattered": Scattered(),
    "Moving": Moving(),
    "Human": Human(),
}
ACTIONS: dict[str, CartesianDelta | JointDelta] = {"": CartesianDelta(), "Joint": JointDelta()}


class ArmGymEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of an :class:`~torchrl_safe.envs.ArmEnv` as a Gymnasium environment.

    Observations and actions are float32 of shape ``(width,)``; actions beyond the bound of the
    action mode are clipped. ``step`` gives in its info ``cost`` (the sum of the costs),
    ``costs`` (each by its name) and ``is_success``. ``reset(seed=...)`` decides on everything
    that follows, bit for bit.

    The time limit is the arm's own and sets ``truncated``. ``gymnasium.make`` keeps the argument
    ``max_episode_steps`` for a wrapper of its own, which can shorten the limit, not lengthen it.

    Args:
        render_mode (str, optional): ``"human"`` shows a window, with ``"rgb_array"``
            ``render`` returns a picture. Defaults to ``None``: nothing is drawn.
        **kwargs: arguments of :class:`~torchrl_safe.envs.ArmEnv` except ``num_envs``, which is
            1, and ``gui``, on which ``render_mode`` decides.

    Raises:
        TypeError: if ``num_envs`` or ``gui`` is among the arguments.
        ValueError: if ``render_mode`` or another argument is not usable, ``reset`` is given
            options, or an action has the wrong shape or is not finite.

    Examples:
        >>> env = gymnasium.make("torchrl_safe/PandaReachInFront-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(np.zeros(3, np.float32))
        >>> info
        {'cost': 0.0, 'costs': {'collision': 0.0}, 'is_success': False}
        >>> env.close()
    """

    # Gymnasium declares it for the class; the control rate is known for the instance only.
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **kwargs: Any) -> None:
        modes = self.metadata["render_modes"]
        if render_mode not in (None, *modes):
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}.")
        for name, reason in (
            ("num_envs", "an ArmGymEnv is one world; gymnasium.make_vec makes several"),
            ("gui", 'render_mode="human" shows the window'),
        ):
            if name in kwargs:
                raise TypeError(f"{name} must not be given, got {kwargs[name]!r}: {reason}.")
        self.render_mode = render_mode
        self.arm_env = ArmEnv(**kwargs, gui=render_mode == "human")
        self.metadata = {**self.metadata, "render_fps": self.arm_env.control_rate}
        # ArmEnv raises unless observations are finite. Gymnasium's checker warns of an infinite
        # bound, and the largest float32 says the same.
        largest = np.finfo(np.float32).max
        width = self.arm_env.observation_spec["observation"].shape[1:]
        self.observation_space = Box(-largest, largest, width, np.float32)
        bound = self.arm_env.action_mode.bound
        self.action_space = Box(-bound, bound, self.arm_env.action_spec.shape[1:], np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        if options:
            raise ValueError(f"options must be empty, got {options}: an ArmGymEnv has none.")
        super().reset(seed=seed)
        if seed is not None:
            self.arm_env.set_seed(seed)
        return self._observation(self.arm_env.reset()), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        batch = torch.tensor(np.asarray(action, dtype=np.float32))[None]
        after = self.arm_env.step(TensorDict({"action": batch}, batch_size=[1]))["next"]
        costs = after["cost"][0].tolist()
        info = {
            "cost": sum(costs),
            "costs": dict(zip(self.arm_env.cost_names, costs, strict=True)),
            "is_success": after["success"].item(),
        }
        return (
            self._observation(after),
            after["reward"].item(),
            after["terminated"].item(),
            after["truncated"].item(),
            info,
        )

    def render(self) -> np.ndarray | None:
        """Returns an RGB picture, uint8 of shape ``(240, 320, 3)``, if that is the render mode."""
        if self.render_mode != "rgb_array":
            return None
        return self.arm_env.render()[0].numpy()

    def close(self) -> None:
        # Gymnasium may close more than once.
        self.arm_env.close(raise_if_closed=False)

    @staticmethod
    def _observation(tensordict: TensorDict) -> np.ndarray:
        return tensordict["observation"][0].cpu().numpy()


def combination(arm: str, task: str, obstacles: str, action: str) -> dict[str, Any]:
    """Returns the arguments of :class:`~torchrl_safe.envs.ArmEnv` for the parts of a name.

    Args:
        arm: key of ``ARMS``.
        task: key of ``TASKS``; decides on the time limit too: 40 control steps for ``Reach``, 200
            for ``Push``, 100 for ``PickAndPlace``.
        obstacles: key of ``OBSTACLES``.
        action: key of ``ACTIONS``. To pick something up, it moves the fingers too.

    Examples:
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


def _register() -> None:
    for parts in product(ARMS, TASKS, OBSTACLES, ACTIONS):
        gymnasium.register(
            f"torchrl_safe/{''.join(parts)}-v0",
            entry_point=f"{__name__}:{ArmGymEnv.__name__}",
            kwargs=combination(*parts),
        )


_register()
