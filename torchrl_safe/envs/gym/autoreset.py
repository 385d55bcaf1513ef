"""What a vectorized environment returned in a step before it reset itself.

Since Gymnasium 1.1 a vectorized environment names its mode; before, as in the 0.28 that
Safety-Gymnasium needs, each of them resets in the step that ends an episode. The last observation
and info of the episode then stand in the info, under names and in a form that also changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from numpy.typing import NDArray
from packaging.version import Version

Info = Mapping[str, Any]

_HAS_MODES = Version(gymnasium.__version__) >= Version("1.1")
#: How to get environments that can be reset one by one.
SINGLE_RESETS = (
    "make them with AutoresetMode.DISABLED"
    if _HAS_MODES
    else "put single ones in a SerialEnv or a ParallelEnv"
)
_LAST_OBSERVATION = "final_obs" if _HAS_MODES else "final_observation"


def set_mode(env: Any) -> None:
    """Gives an environment the attribute that TorchRL reads: wrappers have it in their metadata."""
    if not _HAS_MODES:
        return
    mode = getattr(env, "autoreset_mode", env.metadata.get("autoreset_mode"))
    if mode is None:
        raise ValueError(
            "env must say how it resets itself, by metadata['autoreset_mode'], for example "
            f"AutoresetMode.DISABLED, got {env}."
        )
    env.autoreset_mode = mode


def resets_itself(env: Any) -> bool:
    """Whether an environment resets in the step that ends an episode."""
    return not _HAS_MODES or env.autoreset_mode == gymnasium.vector.AutoresetMode.SAME_STEP


def vector_env(
    factories: Sequence[Callable[[], gymnasium.Env]], *, asynchronous: bool
) -> VectorEnv:
    """Several environments, in a mode in which last observations are not lost."""
    kind = AsyncVectorEnv if asynchronous else SyncVectorEnv
    if not _HAS_MODES:
        return kind(factories)
    # In Gymnasium's default mode TorchRL 0.14.1 overwrites the last observations with zeros.
    return kind(factories, autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED)


def last_observation(env: VectorEnv, observation: Any, info: Info, done: NDArray[np.bool_]) -> Any:
    """The observations of a step, also where the environment has been reset since."""
    rows = [
        last if over else now
        for over, last, now in zip(
            done,
            info[_LAST_OBSERVATION],
            iterate(env.observation_space, observation),
            strict=True,
        )
    ]
    space = env.single_observation_space
    empty: Any = create_empty_array(space, len(rows))
    return concatenate(space, rows, empty)


def last_info(info: Info, done: NDArray[np.bool_]) -> dict[str, Any]:
    """The info of a step; where the environment has been reset, that of ``final_info``."""
    return _merge(info, entries(info.get("final_info", {})), done)


def entries(info: Any) -> Info:
    """The entries of an info, or of an entry of one, each with a row for each environment.

    An array of dictionaries, which is what Gymnasium made of them before 1.0, becomes a
    dictionary of arrays, which is what it has made of them since; of anything else there are none.
    """
    if isinstance(info, Mapping):
        return info
    if not isinstance(info, np.ndarray) or info.dtype != object:
        return {}
    rows = [row if isinstance(row, Mapping) else {} for row in info]
    found: dict[str, Any] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        values = [row.get(name, 0) for row in rows]
        found[name] = np.array(values, None if _are_numbers(values) else object)
        found[f"_{name}"] = np.array([name in row for row in rows])
    return found


def _are_numbers(values: list[Any]) -> bool:
    return all(np.isscalar(value) and np.asarray(value).dtype.kind in "biuf" for value in values)


def _merge(info: Info, last: Info, done: NDArray[np.bool_]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for name in {*info, *last} - {"final_info", _LAST_OBSERVATION}:
        if isinstance(name, str) and name.startswith("_"):
            continue
        entry, last_entry = info.get(name), last.get(name)
        if isinstance(entry, Mapping) or isinstance(last_entry, Mapping):
            merged[name] = _merge(entry or {}, last_entry or {}, done)
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
