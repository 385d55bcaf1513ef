"""A check that environments and losses share."""

from __future__ import annotations

import operator
from typing import Any


def check_count(*, least: int = 1, **values: Any) -> None:
    """Raises ValueError unless each value is a whole number, and not too small."""
    for name, value in values.items():
        try:
            usable = not isinstance(value, bool) and least <= operator.index(value) < 2**31
        except TypeError:
            usable = False
        if not usable:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")
