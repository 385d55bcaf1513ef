"""Contenders timed in turn, so that what slows the machine down slows all of them down."""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping
from time import process_time

import numpy as np

from benchmarks.report import Figure

#: Does its work once and returns the seconds that it took.
Contender = Callable[[], float]
Times = Mapping[str, np.ndarray]


def timed(
    work: Callable[[], object], *, calls: int = 1, clock: Callable[[], float] = process_time
) -> Contender:
    """Makes a contender of a function: the seconds of one of ``calls`` calls.

    Args:
        work: what is timed.
        calls: how often it is called between two looks at the clock.
        clock: CPU time of this process by default.
    """

    def contender() -> float:
        start = clock()
        for _ in range(calls):
            work()
        return (clock() - start) / calls

    return contender


def race(contenders: Mapping[str, Contender], *, rounds: int, warm_up: bool = True) -> Times:
    """Times contenders one after the other, round by round.

    Args:
        contenders: what is timed, by name.
        rounds: how often.
        warm_up: whether there is a round before that does not count.

    Returns:
        The seconds of each contender, ``(rounds,)``.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for index in range(not warm_up, rounds + 1):
        # Garbage is collected between the rounds and in none of them.
        gc.collect()
        gc.disable()
        try:
            turns = {name: contender() for name, contender in contenders.items()}
        finally:
            gc.enable()
        for name, elapsed in turns.items():
            if index:
                seconds[name].append(elapsed)
    return {name: np.array(values) for name, values in seconds.items()}


def ratio(
    name: str,
    numerator: np.ndarray,
    denominator: np.ndarray,
    *,
    at_least: float | None = None,
    at_most: float | None = None,
) -> Figure:
    """The ratio of two contenders' seconds, taken in each round."""
    return quartiles(name, numerator / denominator, "x", at_least=at_least, at_most=at_most)


def quartiles(
    name: str,
    values: np.ndarray,
    unit: str,
    *,
    at_least: float | None = None,
    at_most: float | None = None,
) -> Figure:
    """Median and quartiles of what was measured in each round."""
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
    return Figure(name, median, low, high, unit, at_least, at_most)
