"""Gymnasium environments with their cost beside the reward.

Import from :mod:`torchrl_safe.envs.gym`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, GymWrapper
from torchrl.envs.gym_like import BaseInfoDictReader
from torchrl.envs.libs.gym import terminal_obs_reader

from torchrl_safe._checks import check_array

Info = Mapping[str, Any]


class _CostBesideReward(GymWrapper):
    """What :class:`SafeGymWrapper` and :class:`SafeGymEnv` add to TorchRL's classes."""

    def __init__(
        self, *args: Any, cost_keys: Sequence[NestedKey] = ("cost",), **kwargs: Any
    ) -> None:
        if isinstance(cost_keys, str) or not cost_keys:
            raise ValueError(
                f"cost_keys must be a sequence of at least one key, got {cost_keys!r}."
            )
        keys = [unravel_key(key) for key in cost_keys]
        self._cost_paths = [(key,) if isinstance(key, str) else key for key in keys]
        super().__init__(*args, **kwargs)

    @property
    def reward_key(self) -> str:
        """Key of the reward alone: TorchRL's own code writes the reward there."""
        return "reward"

    def read_reward(self, reward: Any) -> Tensor:
        return self.full_reward_spec["reward"].encode(reward, ignore_device=True)

    def _make_specs(self, env: gymnasium.Env) -> None:
        super()._make_specs(env)
        self.reward_spec = Composite(
            reward=self.full_reward_spec["reward"],
            cost=Unbounded(
                (*self.batch_size, len(self._cost_paths)), dtype=torch.float32, device=self.device
            ),
            shape=self.batch_size,
        )
        self._started: Any = None
        self._same_step = self._is_batched and self._env.autoreset_mode == AutoresetMode.SAME_STEP

    def _replace_reset(self, reset: Tensor | None, kwargs: dict[str, Any]) -> dict[str, Any]:
        # TorchRL 0.14.1 takes it for granted that a tensordict has a mask.
        return kwargs if reset is None else super()._replace_reset(reset, kwargs)

    def auto_register_info_dict(
        self,
        ignore_private: bool = True,
        *,
        info_dict_reader: BaseInfoDictReader | None = None,
    ) -> EnvBase:
        # For SAME_STEP, TorchRL registers this reader to find the last observations. It also makes
        # an observation of every entry of info, fails on nested ones, and lets a full reset return
        # observations of the episode before. Here _output_transform finds them.
        if isinstance(info_dict_reader, terminal_obs_reader):
            return self
        return super().auto_register_info_dict(ignore_private, info_dict_reader=info_dict_reader)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if not self._same_step or mask is None or mask.all():
            return super()._reset(tensordict, **kwargs)
        if self._started is None:
            raise RuntimeError("In SAME_STEP, only environments that are done can be reset apart.")
        return TensorDict(self.read_obs(self._started), self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # With a frame_skip, _output_transform is called several times; costs add up as rewards do.
        self._cost = np.zeros(self.full_reward_spec["cost"].shape)
        after = super()._step(tensordict)
        if self._same_step:
            # Tells TorchRL's VecGymEnvTransform that nothing is left to be replaced.
            after["final"] = TensorDict(batch_size=self.batch_size)
        return after.set("cost", torch.from_numpy(self._cost).to(torch.float32))

    def _output_transform(self, step_outputs_tuple: tuple) -> tuple:
        # Safety-Gymnasium returns the cost between the reward and the flags.
        observation, reward, *cost, terminated, truncated, info = step_outputs_tuple
        done = terminated | truncated
        if self._same_step and done.any():
            self._started = observation
            observation = self._last_observation(observation, info, done)
            info = _last_info(info, info.get("final_info", {}), done)
        for column, path in enumerate(self._cost_paths):
            own = cost and path == ("cost",)
            value = cost[0] if own else _look_up(info, path)
            shape = self._cost[..., column].shape
            self._cost[..., column] += check_array(f"cost {'.'.join(path)!r}", value, shape)
        return observation, reward, terminated, truncated, done, info

    def _last_observation(self, observation: Any, info: Info, done: np.ndarray) -> Any:
        """The observations of the step, also where the environment has been reset since."""
        rows = [
            last if over else now
            for over, last, now in zip(
                done,
                info["final_obs"],
                iterate(self._env.observation_space, observation),
                strict=True,
            )
        ]
        space = self._env.single_observation_space
        empty: Any = create_empty_array(space, len(rows))
        return concatenate(space, rows, empty)


def _last_info(info: Info, last: Info, done: np.ndarray) -> dict[str, Any]:
    """The info of the step, which stands in ``final_info`` where the environment has been reset."""
    merged: dict[str, Any] = {}
    for name in {*info, *last} - {"final_info", "final_obs"}:
        if name.startswith("_"):
            continue
        entry, last_entry = info.get(name), last.get(name)
        if isinstance(entry, Mapping) or isinstance(last_entry, Mapping):
            merged[name] = _last_info(entry or {}, last_entry or {}, done)
            continue
        example = np.asarray(entry if last_entry is None else last_entry)
        absent = np.zeros_like(example)
        merged[name] = np.where(
            done.reshape(-1, *(1,) * (example.ndim - 1)),
            absent if last_entry is None else last_entry,
            absent if entry is None else entry,
        )
        # The mask of the environments that have the entry.
        merged[f"_{name}"] = np.where(
            done,
            last.get(f"_{name}", last_entry is not None),
            info.get(f"_{name}", entry is not None),
        )
    return merged


def _look_up(info: Info, path: tuple[str, ...]) -> Any:
    """The entry of an info; raises unless every environment has it."""
    entry: Any = info
    present: Any = True
    for name in path:
        if not isinstance(entry, Mapping) or name not in entry:
            raise KeyError(f"info must have {path} in every step, got only {[*info]}.")
        entry, present = entry[name], entry.get(f"_{name}", True)
    # Gymnasium's mask of the environments that have the entry, if the info is of several.
    if isinstance(present, np.ndarray) and not present.all():
        rows = np.flatnonzero(~present).tolist()
        raise KeyError(f"info must have {path} in every step, environments {rows} have none.")
    return entry


class SafeGymWrapper(_CostBesideReward):
    """TorchRL's :class:`~torchrl.envs.GymWrapper` for environments that report costs.

    ``cost`` of shape ``(*batch, k)``, float32, stands in the reward spec beside ``reward``. It is
    read from the info of ``step``, or, for the name ``"cost"``, from its third output where there
    are six, as in Safety-Gymnasium. ``reset`` returns none.

    Vectorized environments may reset in the modes that TorchRL supports, ``DISABLED`` and
    ``SAME_STEP``; the last observation, reward and cost of an episode are the true ones in both.
    Gymnasium gives an entry of a vectorized info the type it has in the first environment: a cost
    must be a float everywhere, or its fractions are lost.

    Args:
        env (gymnasium.Env or gymnasium.vector.VectorEnv): the environment.

    Keyword Args:
        cost_keys (Sequence[NestedKey], optional): the entries of ``info`` that are costs, k keys
            for k columns; a tuple names an entry of an entry. Defaults to ``("cost",)``.
        **kwargs: arguments of :class:`~torchrl.envs.GymWrapper`.

    Raises:
        ValueError: if ``cost_keys`` is empty, or a cost is not a finite number.
        KeyError: if a step does not report a cost.

    Examples:
        >>> from torchrl_safe.envs.gym import ArmGymEnv
        >>> env = SafeGymWrapper(ArmGymEnv(), cost_keys=["cost", ("costs", "collision")])
        >>> env.rollout(3)["next", "cost"].shape
        torch.Size([3, 2])
        >>> env.close()
    """

    def __init__(self, env: Any = None, **kwargs: Any) -> None:
        super().__init__(env=env, **kwargs)


class SafeGymEnv(_CostBesideReward, GymEnv):
    """TorchRL's :class:`~torchrl.envs.GymEnv` for environments that report costs.

    As :class:`SafeGymWrapper`, with the name of a registered environment.

    Args:
        env_name (str): name in Gymnasium's registry.

    Keyword Args:
        cost_keys (Sequence[NestedKey], optional): the entries of ``info`` that are costs.
            Defaults to ``("cost",)``.
        num_envs (int, optional): number of processes with an environment each. Defaults to ``0``:
            one environment in this process, without a batch dimension. TorchRL's ``num_workers``
            acts on its own ``GymEnv`` only; :class:`~torchrl.envs.ParallelEnv` does the same.
        **kwargs: arguments of :class:`~torchrl.envs.GymEnv` and of the environment.

    Examples:
        >>> env = SafeGymEnv("torchrl_safe.envs.gym:torchrl_safe/PandaReachInFront-v0")
        >>> rollout = env.rollout(3)
        >>> rollout["next", "reward"].shape, rollout["next", "cost"].shape
        (torch.Size([3, 1]), torch.Size([3, 1]))
        >>> env.close()
    """

    def __init__(self, env_name: str, **kwargs: Any) -> None:
        super().__init__(env_name, **{"backend": "gymnasium", **kwargs})

    @property
    def lib(self) -> Any:
        # All that TorchRL 0.14.1 takes from it is `make`.
        return SimpleNamespace(make=partial(_make, super().lib))

    def _async_env(self, factories: Sequence[Callable[[], gymnasium.Env]]) -> AsyncVectorEnv:
        # In Gymnasium's default mode TorchRL 0.14.1 overwrites the last observations with zeros.
        return AsyncVectorEnv(factories, autoreset_mode=AutoresetMode.DISABLED)


def _make(lib: Any, env_name: str, **kwargs: Any) -> gymnasium.Env:
    try:
        return lib.make(env_name, **kwargs)
    except TypeError as error:
        # TorchRL tries an argument of this name, and then without it if the error says so. A class
        # without a constructor of its own says only that it takes none.
        if "frameskip" in kwargs and "takes no arguments" in str(error):
            raise TypeError("unexpected keyword argument 'frameskip'") from error
        raise
