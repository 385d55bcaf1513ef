"""The parts of the benchmarks by name."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from typing import Literal, get_args

from benchmarks.report import Figure

Part = Literal[
    "env", "bullet", "reset", "update", "training", "make_train", "scaling", "control"
]  # fmt: skip
PARTS: tuple[Part, ...] = get_args(Part)


def measure(part: Part, *, quick: bool) -> list[Figure]:
    """Measures one part in this process."""
    run: Callable[..., list[Figure]] = import_module(f"benchmarks.{part}").run
    return run(quick=quick)


def measure_apart(part: Part, *, quick: bool) -> list[Figure]:
    """Measures one part in a fresh process, which no other part has left anything in."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure, part, quick=quick).result()
