"""PyBullet where it is installed, and elsewhere what says so as soon as a world is to be made.

The transforms of this package, other engines and environments of others need none.
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

__all__ = ["pybullet", "pybullet_data"]
