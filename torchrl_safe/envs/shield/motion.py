"""The joint motion nearest to the one asked for that is safe, or else one that brakes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.shield.projection import project
from torchrl_safe.envs.state import Array

# To use up all room counts as much as this turn of a joint, rad, and where there is none, a metre
# as much as this, rad/m. With much more, rows that only differ in it would be nearly dependent.
_ALL, _NONE = 3.0, 100.0


def safe_motion(
    asked: Array,
    rows: Array,
    least: Array,
    last: Array,
    comes: NDArray[np.bool_],
    lower: Array,
    upper: Array,
    along: Array | None,
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Projects; where there is no solution, brakes.

    Braking means a slow motion that misses ``least`` as little as possible, and ``last`` not at
    all: all rows miss it by the same share of what is between the two, so that what is near does
    not give way to what is far. Where there is none, ``last`` alone holds. Where there is none
    either, what ``comes`` may come nearer, as little as possible. The joints may then brake as hard
    as they can.

    Returns:
        The solutions, where there is one, and which are not of what was asked for.
    """
    change, solved = _give_way(asked, rows, least, lower, upper, along)
    braked = ~solved
    some = np.flatnonzero(braked)
    if len(some):
        most, end = least[some], last[some]
        # A row without a last does not give: it does not count in the end.
        between = np.subtract(most, end, out=np.zeros_like(end), where=np.isfinite(end))
        change[some], solved[some] = _slowest(
            rows[some], most, between / _ALL, _ALL, lower[some], upper[some]
        )
    # There may still be one: a row that does not give was in the way.
    some = np.flatnonzero(~solved)
    if len(some):
        still = np.clip(0.0, lower[some], upper[some])
        change[some], solved[some] = project(
            still, rows[some], last[some], lower[some], upper[some]
        )
    some = np.flatnonzero(~solved & comes.any(axis=1))
    if len(some):
        change[some], solved[some] = _slowest(
            rows[some],
            last[some],
            comes[some] / _NONE,
            np.inf,
            np.minimum(lower[some], 0),
            np.maximum(upper[some], 0),
        )
    return change, solved, braked


def _give_way(
    asked: Array,
    rows: Array,
    least: Array,
    lower: Array,
    upper: Array,
    along: Array | None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Projects; with a weight, no joint turns further than the largest turn that is asked for.

    The weight alone would ask some joints for more than their motors can stop in time. Where that
    has no solution, only joints count, up to their bounds.
    """
    if along is None:
        return project(asked, rows, least, lower, upper)
    most = np.abs(asked).max(axis=1, keepdims=True)
    slow = np.maximum(lower, -most), np.minimum(upper, most)
    change, solved = project(asked, rows, least, *slow, along)
    some = np.flatnonzero(~solved)
    if len(some):
        change[some], solved[some] = project(
            asked[some], rows[some], least[some], lower[some], upper[some]
        )
    return change, solved


def _slowest(
    rows: Array, least: Array, gives: Array, most: float, lower: Array, upper: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """The slowest motion, where rows may give way.

    There is one more unknown, from 0 to ``most``, rad. Each row is relaxed by it times its
    ``gives``, m/rad, ``(k, r)``.
    """
    none = np.zeros((len(rows), 1))
    point, solved = project(
        np.concatenate([np.clip(0.0, lower, upper), none], axis=1),
        np.concatenate([rows, gives[:, :, None]], axis=2),
        least,
        np.concatenate([lower, none], axis=1),
        np.concatenate([upper, none + most], axis=1),
    )
    return point[:, :-1], solved
