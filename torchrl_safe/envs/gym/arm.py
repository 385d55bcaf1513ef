"""An arm for Gymnasium's users."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from tensordict import TensorDict

from torchrl_safe.envs.arm_env import ArmEnv
from torchrl_safe.envs.physics.mujoco import MuJoCo


class ArmGymEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of an :class:`~torchrl_safe.envs.ArmEnv` as a Gymnasium environment.

    Observations and actions are float32 of shape ``(width,)``; actions beyond the bound of the
    action mode are clipped. ``step`` gives in its info ``cost`` (the sum of the costs),
    ``costs`` (each by its name) and ``is_success``, with a shield also ``shield_correction``, rad,
    and ``shield_braked``. Everything after ``reset(seed=...)`` follows from that seed,
    bit for bit.

    The time limit is the arm's own and sets ``truncated``. ``gymnasium.make`` keeps the argument
    ``max_episode_steps`` for a wrapper of its own, which can shorten the limit, not lengthen it.

    Args:
        render_mode (str, optional): ``"human"`` shows a window (with ``physics=Bullet()``); with
            ``"rgb_array"`` ``render`` returns a picture. Defaults to ``None``: nothing is drawn.
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
        # MuJoCo has no window here.
        modes = ["rgb_array"] if isinstance(self.arm_env.physics, MuJoCo) else modes
        self.metadata = {"render_modes": modes, "render_fps": self.arm_env.control_rate}
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
        array = np.asarray(action, dtype=np.float32)
        if array.shape != self.action_space.shape:
            raise ValueError(
                f"action must have shape {self.action_space.shape}, got {array.shape}."
            )
        batch = torch.tensor(array)[None]
        after = self.arm_env.step(TensorDict({"action": batch}, batch_size=[1]))["next"]
        costs = after["cost"][0].tolist()
        info = {
            "cost": sum(costs),
            "costs": dict(zip(self.arm_env.cost_names, costs, strict=True)),
            "is_success": after["success"].item(),
        }
        if self.arm_env.shield is not None:
            info["shield_correction"] = after["shield_correction"].item()
            info["shield_braked"] = after["shield_braked"].item()
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
