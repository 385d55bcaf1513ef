"""How many cores this process may use."""

from __future__ import annotations

import os


def cores() -> int:
    """Fewer than the machine has, if a container or ``taskset`` says so."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
