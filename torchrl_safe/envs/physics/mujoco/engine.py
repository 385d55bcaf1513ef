"""MuJoCo. If it is not installed, an object that says so when a world is made."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakSet

try:
    import mujoco
    from mujoco import batch
except (ImportError, AttributeError) as _error:
    # It raises AttributeError if a library is missing that the variable MUJOCO_GL names.
    _reason = (
        f"MuJoCo does not load, see the variable MUJOCO_GL: {_error}."
        if isinstance(_error, AttributeError)
        else 'physics=MuJoCo() needs MuJoCo 4: pip install "torchrl-safe[mujoco]"'
    )

    class _Missing:
        def __getattr__(self, name: str) -> Any:
            raise ImportError(_reason)

    mujoco = batch = _Missing()

__all__ = ["make_batch", "mujoco", "quiet"]

# A forked process has the batches of its parent, but not their threads, and freeing a batch waits
# for these for ever (MuJoCo 4.0): there, they are kept to the end.
_made: WeakSet[Any] = WeakSet()
_inherited: list[Any] = []
if sys.platform != "win32":
    os.register_at_fork(after_in_child=lambda: _inherited.extend(_made))


def make_batch(model: Any, num_envs: int, threads: int) -> Any:
    """Makes a ``mujoco.batch.Batch`` that a forked process can forget.

    Args:
        model: the model of every world.
        num_envs: number of worlds.
        threads: threads that they are shared between.
    """
    made = batch.Batch(model, num_envs, min(threads, num_envs))
    _made.add(made)
    return made


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps MuJoCo from writing warnings to a file: they are raised as errors."""
    before, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    silent.logto_file = silent.logto_console = False
    silent.set()
    try:
        yield
    finally:
        before.set()
