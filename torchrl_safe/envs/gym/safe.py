"""Gymnasium environments with their cost beside the reward.

Import from :mod:`torchrl_safe.envs.gym`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.data.utils import torch_to_numpy_dtype_dict
from torchrl.envs import EnvBase, GymEnv, GymWrapper
from torchrl.envs.gym_like import BaseInfoDictReader
from torchrl.envs.libs.gym import terminal_obs_reader

from torchrl_safe._checks import check_array, check_count, check_flag
from torchrl_safe.envs.gym import autoreset, safety_gymnasium


# TorchRL has no public hook between a Gymnasium environment and its tensordicts. What is private
# here, it calls or sets itself: _build_env and _async_env make the environment, _is_batched and
# _convert_actions_to_numpy say of what kind it is.
class _CostBesideReward(GymWrapper):
    """What :class:`SafeGymWrapper` and :class:`SafeGymEnv` add to TorchRL's classes."""

    def __init__(
        self, *args: Any, cost_keys: Sequence[NestedKey] = ("cost",), **kwargs: Any
    ) -> None:
        if isinstance(cost_keys, str) or not cost_keys:
            raise ValueError(
                f"cost_keys must be a sequence of at least one key, got {cost_keys!r}."
            )
        if wrong := [key for key in cost_keys if not _is_key(key)]:  # unravel_key leaves parts out.
            raise ValueError(f"cost_keys must be strings or tuples of strings, got {wrong}.")
        keys = [unravel_key(key) for key in cost_keys]
        if len(set(keys)) < len(keys):
            raise ValueError(f"cost_keys must be different keys, got {cost_keys!r}.")
        self._cost_paths = [(key,) if isinstance(key, str) else key for key in keys]
        self._reported: set[tuple[str, ...]] = set()  # Which of them a step has had.
        check_count(frame_skip=kwargs.get("frame_skip", 1))
        super().__init__(*args, **kwargs)

    @property
    def cost_names(self) -> tuple[str, ...]:
        """Names of the costs, one for each column of ``cost``: ``cost_keys``, joined by dots."""
        return tuple(".".join(path) for path in self._cost_paths)

    @property
    def reward_key(self) -> str:
        """Key of the reward alone: TorchRL's own code writes the reward there."""
        return "reward"

    def _make_specs(self, env: gymnasium.Env) -> None:
        self._vectorized = self._is_batched
        _check_spaces(env, vectorized=self._vectorized)
        super()._make_specs(env)
        # For _step: asking an environment for its specs takes longer than encoding a value.
        box = isinstance(self.action_spec, Bounded | Unbounded) and self._convert_actions_to_numpy
        self._box_action_key = self.action_key if box else None
        self._one_observation = next(iter(self.observation_spec.items(True, True)))
        reward = self.full_reward_spec["reward"]
        self._one_reward = reward
        if reward.shape != (shape := (*self.batch_size, 1)):
            raise ValueError(
                f"env must have one reward, of shape {tuple(shape)}, got reward_space of shape "
                f"{tuple(reward.shape)}. If its reward is one number after all, set "
                "env.reward_space = gymnasium.spaces.Box(-inf, inf, ())."
            )
        self._flag_shape = (*self.batch_size, 1)
        self.reward_spec = Composite(
            reward=reward,
            cost=Unbounded(
                (*self.batch_size, len(self._cost_paths)), dtype=torch.float32, device=self.device
            ),
            shape=self.batch_size,
        )
        self._cost = np.zeros(self.full_reward_spec["cost"].shape)
        # Which environments have reset themselves in the last step, and all observations and info.
        self._started: tuple[NDArray[np.bool_], Any, Any] | None = None
        if self._vectorized and self.wrapper_frame_skip > 1:
            raise ValueError(
                "frame_skip must be 1 for several environments, whose episodes end at different "
                f"frames, got {self.wrapper_frame_skip}: put single ones in a SerialEnv or a "
                "ParallelEnv."
            )
        self._resets_itself = self._vectorized and autoreset.resets_itself(self._env)

    def read_reward(self, reward: Any) -> Tensor:
        return _encode(self._one_reward, reward)

    def read_obs(self, observations: Any) -> dict[str, Any]:
        if isinstance(observations, Mapping):
            # Environments may write the next observation into the same arrays.
            return super().read_obs(deepcopy(observations))
        key, spec = self._one_observation
        return {key: _encode(spec, observations)}

    def _replace_reset(self, reset: Tensor | None, kwargs: dict[str, Any]) -> dict[str, Any]:
        # TorchRL 0.14.1 takes it for granted that a tensordict has a mask.
        return kwargs if reset is None else super()._replace_reset(reset, kwargs)

    def auto_register_info_dict(
        self,
        ignore_private: bool = True,
        *,
        info_dict_reader: BaseInfoDictReader | None = None,
    ) -> EnvBase:
        # Where environments reset themselves, TorchRL registers this reader to find the last
        # observations. It also makes an observation of every entry of info, fails on nested ones,
        # lets a full reset return observations of the episode before, and finds nothing under the
        # names of Gymnasium 0.28: NaN then. Here _output_transform finds them.
        if isinstance(info_dict_reader, terminal_obs_reader):
            return self
        return super().auto_register_info_dict(ignore_private, info_dict_reader=info_dict_reader)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        started, self._started = self._started, None
        if started is not None and mask is not None and not kwargs:
            done, observation, info = started
            if np.array_equal(mask.numpy(force=True).reshape(done.shape), done):
                source = self.read_obs(observation)
                start = TensorDict(source, self.batch_size, device=self.device)
                return self._with_info(start, info)
        if not self._resets_itself or mask is None or mask.all():
            return super()._reset(tensordict, **kwargs)
        raise RuntimeError(
            "They reset themselves: only environments that are done can be reset apart from the "
            f"others. Where a transform ends episodes, {autoreset.SINGLE_RESETS}."
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._action_of(tensordict)
        reward: Any = 0
        self._cost.fill(0)  # _output_transform adds to it.
        for _ in range(self.wrapper_frame_skip):
            outcome = self._output_transform(self._env.step(action))
            observation, frame_reward, terminated, truncated, done, info = outcome
            reward = reward + frame_reward
            if done.any() if self._vectorized else done:
                break
        source = self.read_obs(observation)
        source["reward"] = self.read_reward(reward)
        source["cost"] = torch.from_numpy(self._cost.astype(np.float32))
        for name, flag in (("terminated", terminated), ("truncated", truncated), ("done", done)):
            source[name] = torch.from_numpy(np.array(flag, np.bool_).reshape(self._flag_shape))
        after = TensorDict(source, self.batch_size)
        if self.device is not None:
            after = after.to(self.device)
        if self._resets_itself:
            # Tells TorchRL's VecGymEnvTransform that nothing is left to be replaced.
            after["final"] = TensorDict(batch_size=self.batch_size)
        return self._with_info(after, info)

    def _with_info(self, tensordict: TensorDict, info: Any) -> TensorDict:
        """What the registered readers make of an info, added."""
        for reader in self.info_dict_reader:
            read = reader(info, tensordict)
            tensordict = tensordict if read is None else read
        return tensordict

    def _action_of(self, tensordict: TensorDictBase) -> Any:
        if self._box_action_key is not None:
            return tensordict.get(self._box_action_key).detach().cpu().numpy()
        keys = self.action_keys
        action = tensordict[keys[0]] if len(keys) == 1 else tensordict.select(*keys).to_dict()
        return self.read_action(action) if self._convert_actions_to_numpy else action

    def _output_transform(self, step_outputs_tuple: tuple) -> tuple:
        # Safety-Gymnasium returns the cost between the reward and the flags.
        observation, reward, *cost, terminated, truncated, info = step_outputs_tuple
        done = terminated | truncated
        self._started = None
        if self._resets_itself and done.any():
            self._started = done, observation, info
            observation = autoreset.last_observation(self._env, observation, info, done)
            info = autoreset.last_info(info, done)
        for column, path in enumerate(self._cost_paths):
            if cost and path == ("cost",):
                value = cost[0]
            else:
                # Safety-Gymnasium leaves cost_buttons out for ten steps after a button is pressed.
                may_lack = "cost_sum" in info and path in self._reported
                value = _look_up(info, path, may_lack=may_lack)
                self._reported.add(path)
            self._cost[..., column] += self._checked(path, value)
        return observation, reward, terminated, truncated, done, info

    def _checked(self, path: tuple[str, ...], value: Any) -> Any:
        # What a single environment nearly always returns is told from the rest without an array.
        if type(value) is float and not self._vectorized and abs(value) <= 1:
            return value
        name = f"cost {'.'.join(path)!r}"
        if isinstance(value, Mapping):
            entries = [(*path, key) for key in _names(value)]
            raise ValueError(f"{name} must be a number, got a group: name its entries, {entries}.")
        if isinstance(value, np.ndarray) and value.dtype == object:
            value = value.tolist()  # Gymnasium puts NumPy's bools and tensors into such an array.
        return check_array(name, value, self._cost.shape[:-1])


def _check_spaces(env: Any, *, vectorized: bool) -> None:
    """Raises ValueError for spaces of which TorchRL's specs say something else."""
    action_space = env.single_action_space if vectorized else env.action_space
    for space in _parts(action_space):
        # Gymnasium 0.28's MultiDiscrete has no start.
        if np.any(getattr(space, "start", 0)):
            raise ValueError(
                f"env must number its actions from 0, got {space}: wrap it in Gymnasium's "
                "TransformAction."
            )
    if not vectorized:
        return
    for space in (env.single_observation_space, action_space):
        if any(isinstance(part, gymnasium.spaces.Tuple) for part in _parts(space)):
            raise ValueError(
                f"env must have no Tuple space if it is vectorized, got {space}: its parts would "
                "be taken for environments. Use a Dict, or put single environments in a SerialEnv "
                "or a ParallelEnv."
            )


def _parts(space: gymnasium.Space) -> Iterator[gymnasium.Space]:
    """A space, and those that it is made of."""
    yield space
    if isinstance(space, gymnasium.spaces.Dict):
        for part in space.values():
            yield from _parts(part)
    if isinstance(space, gymnasium.spaces.Tuple):
        for part in space:
            yield from _parts(part)


def _is_key(key: Any) -> bool:
    """Whether it is a string, or a tuple of strings and such tuples."""
    if isinstance(key, tuple):
        return bool(key) and all(map(_is_key, key))
    return isinstance(key, str)


def _encode(spec: TensorSpec, value: Any) -> Tensor:
    """The tensor for a value; numbers by a copy, which is faster than ``spec.encode``."""
    if not isinstance(spec, Bounded | Unbounded):
        return spec.encode(value, ignore_device=True)
    dtype = torch_to_numpy_dtype_dict[spec.dtype]
    return torch.from_numpy(np.array(value, dtype).reshape(spec.shape))


def _look_up(info: Any, path: tuple[str, ...], *, may_lack: bool) -> Any:
    """The entry of an info. Where it is missing, 0 if it may be; else raises KeyError."""
    entry, present = info, True
    for name in path:
        known = autoreset.entries(entry)
        if name not in known:
            if may_lack:
                return np.zeros_like(info["cost_sum"])
            nested = tuple(name.split("."))
            hint = f" An entry of an entry is a tuple: {nested}." if len(nested) > 1 else ""
            raise KeyError(f"info must have {path} in every step, got only {_names(info)}.{hint}")
        entry, present = known[name], known.get(f"_{name}", True)
    # Gymnasium's mask of the environments that have the entry, if the info is of several. Its array
    # has 0 for the others.
    if not may_lack and isinstance(present, np.ndarray) and not present.all():
        rows = np.flatnonzero(~present).tolist()
        raise KeyError(f"info must have {path} in every step, environments {rows} have none.")
    return entry


def _names(info: Mapping) -> list[Any]:
    """The entries of an info, without Gymnasium's masks of the environments that have one."""
    return [key for key in info if f"{key}"[:1] != "_" or f"{key}"[1:] not in info]


class _FloatCosts(gymnasium.Wrapper):
    """Makes each cost of an environment a float.

    Gymnasium gives an entry of a vectorized info the type that it has in the first environment. If
    that is an integer, the others would lose their fractions.
    """

    def __init__(self, env: gymnasium.Env, paths: Sequence[tuple[str, ...]]) -> None:
        super().__init__(env)
        self.paths = paths

    def step(self, action: Any) -> Any:
        *outputs, info = self.env.step(action)  # Five, or six with a cost.
        for path in self.paths:
            info = _with_float(info, path)
        return (*outputs, info)


def _with_float(info: Any, path: tuple[str, ...]) -> Any:
    """An info in which the entry is a float, if it is there and a number."""
    if not path:
        value = np.asarray(info)
        return float(value) if value.ndim == 0 and value.dtype.kind in "biuf" else info
    name, *rest = path
    if not isinstance(info, Mapping) or name not in info:
        return info
    return {**info, name: _with_float(info[name], (*rest,))}


def _make_with_floats(
    make: Callable[[], gymnasium.Env], paths: Sequence[tuple[str, ...]]
) -> gymnasium.Env:
    return _FloatCosts(make(), paths)


class SafeGymWrapper(_CostBesideReward):
    """TorchRL's :class:`~torchrl.envs.GymWrapper` for environments that report costs.

    ``cost`` of shape ``(*batch, k)``, float32, is part of the reward spec, beside ``reward``. It is
    read from the info of ``step``, or, for the name ``"cost"``, from its third output where there
    are six, as in Safety-Gymnasium. ``reset`` returns no cost.

    Vectorized environments may use the autoreset modes that TorchRL supports, ``DISABLED`` and
    ``SAME_STEP``. In both, and in the vectorized environments of Gymnasium 0.28 and
    Safety-Gymnasium, which have no modes, you get the true last observation, reward and cost of an
    episode. In an ``AsyncVectorEnv``, make each cost a float: Gymnasium gives an entry of a
    vectorized info the type that it has in the first environment, and fractions are lost if that is
    an integer. In a ``SyncVectorEnv`` the wrapper does so.

    Args:
        env (gymnasium.Env or gymnasium.vector.VectorEnv): the environment.

    Keyword Args:
        cost_keys (Sequence[NestedKey], optional): the entries of ``info`` that are costs, k keys
            for k columns; a tuple names an entry of an entry. Defaults to ``("cost",)``.
        **kwargs: arguments of :class:`~torchrl.envs.GymWrapper`.

    Raises:
        TypeError: if ``env`` is a name.
        ValueError: if ``cost_keys`` is empty or has a key twice, a cost is not a finite number,
            discrete actions are not numbered from 0, the reward is not one number, or a vectorized
            environment has a ``Tuple`` space.
        KeyError: if a step does not report a cost. What Safety-Gymnasium leaves out of some steps
            costs 0 there.

    Warns:
        UserWarning: if a cost of an ``AsyncVectorEnv`` is an integer or a flag.

    Examples:
        >>> from torchrl_safe.envs.gym import ArmGymEnv
        >>> env = SafeGymWrapper(ArmGymEnv(), cost_keys=["cost", ("costs", "collision")])
        >>> env.rollout(3)["next", "cost"].shape
        torch.Size([3, 2])
        >>> env.close()
    """

    def __init__(self, env: Any = None, **kwargs: Any) -> None:
        if isinstance(env, str):
            raise TypeError(f"env must be an environment, got {env!r}: SafeGymEnv takes a name.")
        if isinstance(env, gymnasium.vector.VectorEnv):
            autoreset.set_mode(env)
        super().__init__(env=env, **kwargs)
        if isinstance(env.unwrapped, SyncVectorEnv):
            singles = env.unwrapped.envs
            singles[:] = [_FloatCosts(single, self._cost_paths) for single in singles]

    def _checked(self, path: tuple[str, ...], value: Any) -> Any:
        if (
            isinstance(value, np.ndarray)
            and value.dtype.kind in "biu"
            and isinstance(self._env.unwrapped, AsyncVectorEnv)
        ):
            warnings.warn(
                f"cost {'.'.join(path)!r} is {value.dtype} in the first environment, and so in all "
                "others: fractions are lost. Return float(cost), or make the environment by "
                "SafeGymEnv.",
                stacklevel=2,
            )
        return super()._checked(path, value)


class SafeGymEnv(_CostBesideReward, GymEnv):
    """TorchRL's :class:`~torchrl.envs.GymEnv` for environments that report costs.

    As :class:`SafeGymWrapper`, with the name of a registered environment.

    Args:
        env_name (str): name in Gymnasium's registry, or of Safety-Gymnasium, which is imported
            for it: ``"SafetyPointGoal1-v0"``, ``"SafetyPointGoal1Gymnasium-v0"``.

    Keyword Args:
        cost_keys (Sequence[NestedKey], optional): the entries of ``info`` that are costs.
            Defaults to ``("cost",)``.
        num_envs (int, optional): number of environments in a batch. Defaults to ``0``: one
            environment without a batch dimension. (TorchRL takes ``num_workers`` away before this
            class sees it; use :class:`~torchrl.envs.ParallelEnv`.)
        asynchronous (bool, optional): with ``num_envs``, whether each environment has a process of
            its own. If not, they step one after the other in this process, which is faster if a
            step takes less than about a millisecond. Defaults to ``True``.
        **kwargs: arguments of :class:`~torchrl.envs.GymEnv` and of the environment.

    Raises:
        TypeError: if ``env_name`` is not a string, or ``asynchronous`` no flag.
        ValueError: if ``cost_keys`` is empty or has a key twice, or ``num_envs`` is not a whole
            number of at least 0.

    Examples:
        >>> env = SafeGymEnv("torchrl_safe.envs.gym:torchrl_safe/PandaReachInFront-v0")
        >>> rollout = env.rollout(3)
        >>> rollout["next", "reward"].shape, rollout["next", "cost"].shape
        (torch.Size([3, 1]), torch.Size([3, 1]))
        >>> env.close()
    """

    def __init__(self, env_name: str, *, asynchronous: bool = True, **kwargs: Any) -> None:
        if not isinstance(env_name, str):
            raise TypeError(
                f"env_name must be a registered name, got {env_name!r}: SafeGymWrapper takes an "
                "environment."
            )
        check_count(least=0, num_envs=kwargs.get("num_envs", 0))
        check_flag(asynchronous=asynchronous)
        self._asynchronous = asynchronous
        super().__init__(env_name, **{"backend": "gymnasium", **kwargs})

    @property
    def lib(self) -> Any:
        # All that TorchRL 0.14.1 takes from it is `make`.
        return SimpleNamespace(make=partial(_make, self._maker))

    def _build_env(self, env_name: str, **kwargs: Any) -> Any:
        self._maker, name = safety_gymnasium.find_maker(env_name)
        return super()._build_env(name, **kwargs)

    def _async_env(self, factories: Sequence[Callable[[], gymnasium.Env]]) -> Any:
        # TorchRL calls it for any number of environments, also for those of this process.
        maker = autoreset if self._maker is gymnasium.make else safety_gymnasium
        factories = [partial(_make_with_floats, make, self._cost_paths) for make in factories]
        return maker.vector_env(factories, asynchronous=self._asynchronous)


def _make(make: Callable[..., gymnasium.Env], env_name: str, **kwargs: Any) -> gymnasium.Env:
    try:
        return make(env_name, **kwargs)
    except TypeError as error:
        # TorchRL tries an argument of this name, and then without it if the error says so. A class
        # without a constructor of its own says only that it takes none.
        if "frameskip" in kwargs and "takes no arguments" in str(error):
            raise TypeError("unexpected keyword argument 'frameskip'") from error
        raise
