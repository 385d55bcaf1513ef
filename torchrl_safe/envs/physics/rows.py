"""Where named numbers are in a flat row, in which an engine gives them all at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import accumulate
from typing import NamedTuple

from torchrl_safe.envs.state import Array


class Place(NamedTuple):
    """Where the numbers of one name are in a row."""

    #: Their indices in the row.
    columns: slice
    #: Their shape.
    shape: tuple[int, ...]

    def of(self, rows: Array) -> Array:
        """Cuts them out of rows ``(..., width)``; a view."""
        return rows[..., self.columns].reshape(*rows.shape[:-1], *self.shape)


def places(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Place]:
    """Where the numbers of each name are in a row that has them one after the other."""
    widths = [math.prod(shape) for shape in shapes.values()]
    ends = accumulate(widths)
    return {
        name: Place(slice(end - width, end), shape)
        for (name, shape), width, end in zip(shapes.items(), widths, ends, strict=True)
    }


def split(rows: Array, places: Mapping[str, Place]) -> dict[str, Array]:
    """Cuts rows ``(..., width)`` into what they hold, by name."""
    return {name: place.of(rows) for name, place in places.items()}
