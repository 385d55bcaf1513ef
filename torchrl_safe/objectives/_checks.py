"""Checks of what comes in; each error names the argument and the value."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_safe._checks import as_tensor, check_one_each, is_number

# Losses compute in single precision, also with squares of what is positive, and divide by them.
_LARGEST = torch.finfo(torch.float32).max
_SMALLEST, _LARGE = 1e-18, 1e18


def uncompiled(loss_module: Any) -> Any:
    """The loss itself, of one that :func:`torch.compile` wraps: no public attribute has it."""
    return getattr(loss_module, "_orig_mod", loss_module)


def check_number(name: str, value: Any, *, positive: bool = False) -> float:
    """Returns the value; raises ValueError unless it is finite, not negative or even positive.

    Always a float: a buffer made of an integer would hold integers for ever.
    """
    number = as_number(value)
    if positive and not _SMALLEST <= number <= _LARGE:
        raise ValueError(f"{name} must be positive, from 1e-18 to 1e18, got {value!r}.")
    if not 0 <= number <= _LARGEST:
        raise ValueError(f"{name} must be finite and not negative, got {value!r}.")
    if number > _LARGE:  # Times a loss it would soon be infinite.
        raise ValueError(f"{name} must be at most 1e18, got {value!r}.")
    return number


def coefficients(name: str, value: Any, num_costs: int, *, positive: bool = False) -> Tensor:
    """One number, shape ``()``, or one for each cost, ``(k,)``; see :func:`check_number`."""
    numbers = as_tensor(name, value, torch.get_default_dtype())
    check_one_each(name, numbers, num_costs)
    for number in value if numbers.ndim else [value]:
        check_number(name, number, positive=positive)
    return numbers.clone()


def check_share(name: str, value: Any) -> float:
    """Returns the value; raises ValueError unless it is a number from 0 to 1."""
    number = as_number(value)
    if not 0 <= number <= 1:
        raise ValueError(f"{name} must be a number from 0 to 1, got {value!r}.")
    return number


def check_discount(gamma: Tensor) -> None:
    """Raises ValueError unless an episode has 1 / (1 - gamma) steps, a finite number."""
    if not gamma < 1:
        raise ValueError(f"gamma of the costs must be below 1, got {gamma.item()}.")


def check_episode_length(episode_length: float | None) -> float | None:
    """Returns the value; raises ValueError unless it is at least one step, or None."""
    if episode_length is None:
        return None
    length = check_number("episode_length", episode_length, positive=True)
    if length < 1:
        raise ValueError(f"episode_length must be at least 1, got {episode_length!r}.")
    return length


def check_length_known(episode_length: float | None, gamma: Tensor) -> None:
    """Raises ValueError if neither the option nor the discount tells the length of an episode."""
    if episode_length is None and not gamma < 1:
        raise ValueError(
            "episode_length must be given if gamma of the costs is 1 or more, got None and gamma "
            f"{gamma.item()}."
        )


def as_number(value: Any) -> float:
    """The value of a number or of a tensor with one element, NaN of anything else."""
    if isinstance(value, Tensor):
        return float(value.detach()) if value.numel() == 1 and not value.is_complex() else math.nan
    try:
        return float(value) if is_number(value) else math.nan
    except OverflowError:
        return math.nan


def initial_multiplier(num_costs: int, multiplier_init: float | Tensor) -> Tensor:
    """The multipliers to start with, shape ``(k,)``, checked."""
    return coefficients("multiplier_init", multiplier_init, num_costs).expand(num_costs).clone()


def get_or_raise(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The entry, or an error that names it."""
    tensor = tensordict.get(key, None)
    if tensor is None:
        raise KeyError(f"The key {key!r} was not found in the input tensordict.")
    return tensor


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
