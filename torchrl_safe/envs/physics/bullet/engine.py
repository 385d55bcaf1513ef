"""PyBullet. If it is not installed, an object that says so when a world is made.

Transforms, the other engine and the wrappers of Gymnasium environments do not need it.
"""

from __future__ import annotations

from typing import Any

try:
    import pybullet
    import pybullet_data
except ImportError:

    class _Missing:
        def __getattr__(self, name: str) -> Any:
            raise ImportError('physics=Bullet() needs PyBullet: pip install "torchrl-safe[arms]".')

    pybullet = pybullet_data = _Missing()

__all__ = ["connect", "pybullet", "pybullet_data"]


def connect(*, gui: bool = False) -> int:
    """Opens a server of PyBullet and returns its number.

    Raises:
        RuntimeError: if the process holds as many as it can.
    """
    client: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
    if client < 0:
        raise RuntimeError(
            "PyBullet opened no world: a process can hold 1024, one of them with a window."
        )
    return client
