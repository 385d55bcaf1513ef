"""MuJoCo where it is installed, and elsewhere what says so as soon as a world is to be made."""

from __future__ import annotations

from typing import Any

try:
    import mujoco
    from mujoco import batch
except ImportError:

    class _Missing:
        def __getattr__(self, name: str) -> Any:
            raise ImportError(
                'MuJoCo is not installed: pip install "torchrl-safe[mujoco]" (Python 3.11 or newer).'
            )

    mujoco = batch = _Missing()

__all__ = ["batch", "mujoco"]
