"""Checks of what comes in; each error names the argument and the value."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_safe import _checks
from torchrl_safe._checks import as_tensor, check_count, check_one_each

_T = TypeVar("_T")

# Their squares are neither 0 nor infinite in single precision, in which losses compute.
SMALLEST, LARGEST = 1e-18, 1e18


def uncompiled(loss_module: Any) -> Any:
    """The loss itself, of one that :func:`torch.compile` wraps: no public attribute has it."""
    return getattr(loss_module, "_orig_mod", loss_module)


def check_number(name: str, value: Any, least: float = 0.0, most: float = LARGEST) -> float:
    """Returns the value; raises ValueError unless it is a number from ``least`` to ``most``.

    Always a float: a buffer made of an integer would hold integers for ever.
    """
    number = as_scalar(value)
    if not least <= number <= most:
        raise ValueError(f"{name} must be a number from {least:g} to {most:g}, got {value!r}.")
    return number


def check_fraction(name: str, value: Any, least: float = 0.0) -> float:
    """Returns the value; raises ValueError unless it is a number from ``least`` to below 1."""
    number = as_scalar(value)
    if not least <= number < 1:
        raise ValueError(f"{name} must be at least {least:g} and less than 1, got {value!r}.")
    return number


def check_whole(name: str, value: Any, least: int = 1) -> int:
    """Returns the value; raises ValueError unless it is a whole number of at least ``least``."""
    check_count(least=least, **{name: value})
    return int(value)


class Checked(Generic[_T]):
    """An attribute that is checked whenever it is set.

    Args:
        check (callable): takes the name and the value, and returns what to keep or raises.
    """

    def __init__(self, check: Callable[[str, Any], _T]) -> None:
        self._check = check

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Checked[_T]: ...

    @overload
    def __get__(self, instance: object, owner: type) -> _T: ...

    def __get__(self, instance: object | None, owner: type) -> Checked[_T] | _T:
        if instance is None:
            return self
        if self._name not in instance.__dict__:
            raise AttributeError(f"{type(instance).__name__} has not set {self._name} yet.")
        return instance.__dict__[self._name]

    def __set__(self, instance: object, value: Any) -> None:
        instance.__dict__[self._name] = self._check(self._name, value)


def coefficients(name: str, value: Any, num_costs: int, least: float = 0.0) -> Tensor:
    """One number, shape ``()``, or one for each cost, ``(k,)``; see :func:`check_number`."""
    numbers = as_tensor(name, value, torch.get_default_dtype())
    check_one_each(name, numbers, num_costs)
    for number in value if numbers.ndim else [value]:
        check_number(name, number, least)
    return numbers.clone()


def check_episode_length(name: str, episode_length: float | None) -> float | None:
    """Returns the value; raises ValueError unless it is at least one step, or None."""
    return None if episode_length is None else check_number(name, episode_length, 1)


def check_length_known(episode_length: float | None, gamma: Tensor) -> None:
    """Raises ValueError if neither the option nor the discount tells the length of an episode."""
    if episode_length is None and not gamma < 1:
        raise ValueError(
            "episode_length must be given if gamma of the costs is 1 or more, got None and gamma "
            f"{gamma.item()}."
        )


def as_scalar(value: Any) -> float:
    """The value of a number or of a tensor with one element, NaN of anything else."""
    if isinstance(value, Tensor):
        return float(value.detach()) if value.numel() == 1 and not value.is_complex() else math.nan
    return _checks.as_number(value)


def initial_multiplier(num_costs: int, multiplier_init: float | Tensor) -> Tensor:
    """The multipliers to start with, shape ``(k,)``, checked."""
    return coefficients("multiplier_init", multiplier_init, num_costs).expand(num_costs).clone()


def get_or_raise(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The entry, or an error that names it."""
    tensor = tensordict.get(key, None)
    if tensor is None:
        raise KeyError(f"The key {key!r} was not found in the input tensordict.")
    return tensor


def check_terminated(tensordict: TensorDictBase, done: NestedKey, terminated: NestedKey) -> None:
    """Raises KeyError if keys were set and ``terminated`` is missing.

    TorchRL's estimators take ``done`` for it, so that every time limit would be a termination.
    """
    done, terminated = unravel_key(done), unravel_key(terminated)
    key = unravel_key(("next", terminated))
    if (done, terminated) != ("done", "terminated") and tensordict.get(key, None) is None:
        raise KeyError(
            f"The key {key!r} was not found in the input tensordict. If no time limit ends its "
            f"episodes, call set_keys(terminated={done!r})."
        )


def refuse_options(owner: str, options: dict[str, Any], *names: str, reason: str) -> None:
    """Takes options off that are not set; raises ValueError for one that is."""
    for name in names:
        if options.pop(name, None):
            raise ValueError(f"{name} is not supported by {owner}: {reason}.")


def check_columns(cost_advantage: Tensor, kind: str, values: Tensor) -> None:
    """Raises ValueError unless there is one column of shape ``(*B, k)`` for each of k values."""
    if values.ndim != 1 or cost_advantage.shape[-1:] != values.shape:
        raise ValueError(
            f"cost_advantage must have one column for each {kind}, got cost_advantage of shape "
            f"{tuple(cost_advantage.shape)} and {kind}s of shape {tuple(values.shape)}."
        )


def check_rows(advantage: Tensor, cost_advantage: Tensor) -> None:
    """Raises ValueError unless the shapes are ``(*B, 1)`` and ``(*B, k)``."""
    if advantage.shape != (*cost_advantage.shape[:-1], 1):
        raise ValueError(
            "advantage must have shape (*B, 1) and cost_advantage (*B, k) with the same *B, got "
            f"{tuple(advantage.shape)} and {tuple(cost_advantage.shape)}."
        )
