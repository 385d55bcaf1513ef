"""Random generators as arrays, for checkpoints."""

from __future__ import annotations

import numpy as np

# The numbers in the state of numpy's PCG64, and their sizes in bytes.
_PARTS = (("state", 16), ("inc", 16), ("has_uint32", 4), ("uinteger", 4))

#: Size of a packed state, bytes.
PACKED_SIZE = sum(size for _, size in _PARTS)


def pack(generator: np.random.Generator) -> np.ndarray:
    """Returns the state of a generator as 40 bytes."""
    state = generator.bit_generator.state
    numbers = {**state, **state["state"]}
    return np.frombuffer(
        b"".join(numbers[name].to_bytes(size, "little") for name, size in _PARTS), np.uint8
    )


def unpack(packed: np.ndarray) -> np.random.Generator:
    """Returns a generator in the state that :func:`pack` returned."""
    ends = np.cumsum([size for _, size in _PARTS])[:-1]
    parts = np.split(packed.astype(np.uint8), ends)
    state, inc, has_uint32, uinteger = (int.from_bytes(p.tobytes(), "little") for p in parts)
    generator = np.random.default_rng(0)
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state, "inc": inc},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
    return generator
