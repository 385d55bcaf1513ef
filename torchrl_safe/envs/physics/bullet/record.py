"""What brings running episodes back: the draws they began with, and all that was done since."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_safe.envs.state import Array

# The numbers in the state of numpy's PCG64, and their sizes in bytes.
_PARTS = (("state", 16), ("inc", 16), ("has_uint32", 4), ("uinteger", 4))


class EpisodeRecord:
    """The running episode of every world.

    PyBullet cannot save a world: what it saves lacks motor targets and contacts. But a reset is
    the same whatever came before it. So an episode comes back bit for bit from the state of the
    generator that it was drawn from and the targets that the motors have had since.

    Args:
        num_envs: number N of worlds.
    """

    def __init__(self, num_envs: int) -> None:
        #: State of each world's generator before its episode was drawn, shape (N, 40).
        self.draws = np.zeros((num_envs, sum(size for _, size in _PARTS)), dtype=np.uint8)
        #: Targets of joints and fingers in each step, shape (N, steps, width).
        self.targets: Array = np.zeros((num_envs, 0, 0))
        self._rows = np.arange(num_envs)

    def begin(self, row: int, generator: np.random.Generator) -> None:
        """Notes that an episode is about to be drawn."""
        self.draws[row] = pack(generator)

    def add(self, elapsed: np.ndarray, joints: Array, fingers: Array) -> None:
        """Notes a step.

        Args:
            elapsed: steps that each episode has had before, shape (N,).
            joints: joint targets, shape (N, n).
            fingers: finger targets, shape (N, f).
        """
        targets = np.concatenate([joints, fingers], axis=1)
        count, room, _ = self.targets.shape
        last = int(elapsed.max())
        if not last:  # A long episode before leaves nothing behind.
            self.targets, room = self.targets[:, :0], 0
        if last >= room:
            longer = np.zeros((count, max(32, 2 * last), targets.shape[1]))
            if room:
                longer[:, :room] = self.targets
            self.targets = longer
        self.targets[self._rows, elapsed] = targets


def pack(generator: np.random.Generator) -> np.ndarray:
    """Returns the state of a generator as 40 bytes."""
    state = generator.bit_generator.state
    numbers = {**state, **state["state"]}
    return np.frombuffer(
        b"".join(numbers[name].to_bytes(size, "little") for name, size in _PARTS), np.uint8
    )


def unpack(packed: Tensor) -> np.random.Generator:
    """Returns a generator in the state that :func:`pack` returned."""
    ends = np.cumsum([size for _, size in _PARTS])[:-1]
    parts = np.split(packed.to(torch.uint8).numpy(), ends)
    state, inc, has_uint32, uinteger = (int.from_bytes(p.tobytes(), "little") for p in parts)
    generator = np.random.default_rng(0)
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state, "inc": inc},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
    return generator
