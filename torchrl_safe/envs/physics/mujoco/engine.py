"""MuJoCo where it is installed, and elsewhere what says so as soon as a world is to be made."""

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
    """Keeps MuJoCo from writing a file of what goes wrong, which is raised as an error."""
    before, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    silent.logto_file = silent.logto_console = False
    silent.set()
    try:
        yield
    finally:
        before.set()
