"""Checks of what comes in, for environments and losses; errors name the argument and the value."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from numbers import Real
from types import UnionType
from typing import Any, Protocol, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_LARGEST = np.finfo(np.float32).max


def check_positive(**values: float) -> None:
    """Raises ValueError unless each value is a number, positive and finite."""
    for name, value in values.items():
        if not 0 < as_number(value) < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {value!r}.")


def check_not_negative(**values: float) -> None:
    """Raises ValueError unless each value is a number, not negative and finite."""
    for name, value in values.items():
        if not 0 <= as_number(value) < math.inf:
            raise ValueError(f"{name} must be finite and not negative, got {value!r}.")


def check_flag(**values: bool) -> None:
    """Raises TypeError unless each value is True or False."""
    for name, value in values.items():
        if not isinstance(value, bool | np.bool_):
            raise TypeError(f"{name} must be True or False, got {value!r}.")


def check_count(*, least: int = 1, **values: Any) -> None:
    """Raises ValueError unless each value is a whole number, and not too small."""
    for name, value in values.items():
        try:
            usable = not isinstance(value, bool) and least <= operator.index(value) < 2**31
        except TypeError:
            usable = False
        if not usable:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")


def check_kind(name: str, value: Any, kind: type | UnionType, *, such_as: str = "") -> None:
    """Raises TypeError unless the value is an object of a class or protocol, not a class."""
    if isinstance(value, type) or not isinstance(value, kind):
        kinds = get_args(kind) or (kind,)
        names = " or ".join(each.__name__ for each in kinds)
        lacks = ", a class and not an object" if isinstance(value, type) else ""
        if Protocol in kinds[0].__mro__ and not isinstance(value, type):
            members = [member for member in dir(kinds[0]) if not member.startswith("_")]
            missing = [member for member in members if not hasattr(value, member)]
            lacks = f", which has no {' and no '.join(missing)}" if missing else ""
        hint = f" Pass for example {such_as}." if such_as else ""
        raise TypeError(f"{name} must be an instance of {names}, got {value!r}{lacks}.{hint}")


def check_callable(name: str, value: Any) -> None:
    """Raises TypeError unless the value is an object that can be called, not a class."""
    if isinstance(value, type) or not callable(value):
        kind = ", a class and not an object" if isinstance(value, type) else ""
        raise TypeError(f"{name} must be a callable object, got {value!r}{kind}.")


def check_array(name: str, values: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Returns the values as an array; raises ValueError unless they have a shape and are finite.

    Finite in single precision, which is what tensors of them will have.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biuf":  # Not of text or objects, which NumPy converts too.
            raise TypeError(f"no numbers: {array.dtype}")
        array = array.astype(float, copy=False)
    except (OverflowError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be numbers of shape {shape}, got {values!r}.") from error
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}.")
    if not np.abs(array).max(initial=0) <= _LARGEST:  # NaN is not finite either.
        raise ValueError(f"{name} must be finite, got {array}.")
    return array


def as_tensor(name: str, values: Any, dtype: torch.dtype) -> Tensor:
    """Returns one or more numbers as a tensor; raises ValueError if they are none."""
    try:
        if isinstance(values, bool):
            raise TypeError("a flag is no number")
        return torch.as_tensor(values, dtype=dtype).detach()
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers, got {values!r}.") from error


def check_one_each(name: str, values: Tensor, num_costs: int) -> None:
    """Raises ValueError unless there is one number, or one for each cost."""
    if values.shape not in ((), (num_costs,)):
        raise ValueError(
            f"{name} must be one number or one for each of the {num_costs} costs, got shape "
            f"{tuple(values.shape)}."
        )


def check_names(cost_names: Sequence[str] | None, num_costs: int) -> tuple[str, ...]:
    """Returns the names of the costs; raises ValueError unless there is one for each."""
    names = [str(index) for index in range(num_costs)] if cost_names is None else cost_names
    if (
        isinstance(names, str)
        or not isinstance(names, Sequence)
        or not all(isinstance(name, str) for name in names)
        or len(set(names)) != len(names)
        or len(names) != num_costs
    ):
        raise ValueError(
            f"cost_names must be a different name for each of the {num_costs} costs, got "
            f"{cost_names!r}."
        )
    return tuple(names)


def check_unit(name: str, quaternions: NDArray[Any]) -> None:
    """Raises ValueError unless each quaternion, the last dimension, has the length 1."""
    wrong = np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > 1e-3
    if wrong.any():
        raise ValueError(
            f"{name} must be a unit quaternion (x, y, z, w), got {quaternions[wrong].squeeze()}."
        )


def keep_numbers(part: Any, name: str, count: int) -> NDArray[np.float64]:
    """Makes a field of a frozen dataclass a tuple of numbers, from a list, an array or a tensor.

    Returns:
        The numbers, ``(count,)``.

    Raises:
        ValueError: unless there are so many, and they are finite.
    """
    value = getattr(part, name)
    array = check_array(name, value, (count,))
    if not isinstance(value, tuple):
        object.__setattr__(part, name, tuple(array.tolist()))
    return array


def is_number(value: Any) -> bool:
    """Whether it is a real number, and not a flag."""
    return isinstance(value, Real) and not isinstance(value, bool)


def as_number(value: Any) -> float:
    """The value of a real number, NaN of anything else."""
    try:
        return float(value) if is_number(value) else math.nan
    except OverflowError:  # Python's integers can be larger than any float.
        return math.nan
