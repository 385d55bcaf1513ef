"""MuJoCo. If it is not installed, an object that says so when a world is made."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

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

__all__ = ["batch", "mujoco", "quiet"]


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
