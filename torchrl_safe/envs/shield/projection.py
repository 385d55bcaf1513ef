"""Closest points under linear inequalities, for many small problems at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.state import Array

# Constraints are added one by one, and now and then dropped again: a few times the number of
# unknowns is enough. A problem that takes more is given up.
_ITERATIONS_PER_UNKNOWN = 8
# Constraints have unit length: how far beyond one is not beyond it, and what is parallel.
_TOLERANCE, _PARALLEL = 1e-9, 1e-10


def project(wanted: Array, rows: Array, least: Array) -> tuple[Array, NDArray[np.bool_]]:
    r"""Returns the points nearest to ``wanted`` at which linear inequalities hold.

    .. math::
        \min_x \tfrac12 |x - w|^2 \quad \text{such that} \quad A x \ge b

    Solved exactly, by the dual active-set method of Goldfarb and Idnani (1983, Mathematical
    Programming 27): it begins at ``wanted``, and as long as a constraint is violated, moves onto
    the most violated one while those that are already active stay so. It ends after finitely many
    steps, and knows when there is no solution. Most problems take none or one, and all N take
    their steps together. The result of a problem does not depend on the others.

    Args:
        wanted: w, ``(N, n)``.
        rows: A, ``(N, r, n)``.
        least: b, ``(N, r)``.

    Returns:
        The points, ``(N, n)``, and which problems have a solution, ``(N,)``. Where there is
        none, the point has no meaning.

    Examples:
        >>> project(np.array([[-1.0, 2.0]]), np.eye(2)[None], np.zeros((1, 2)))
        (array([[0., 2.]]), array([ True]))
    """
    lengths = np.sqrt((rows * rows).sum(axis=2))
    flat = lengths <= _PARALLEL
    scale = 1 / np.where(flat, 1.0, lengths)
    rows, least = rows * scale[..., None], least * scale
    # What does not depend on x holds or does not.
    solved = ~(flat & (least > _TOLERANCE)).any(axis=1)
    least = np.where(flat, -np.inf, least)
    point = wanted.copy()
    violated = ((rows * wanted[:, None]).sum(axis=2) < least - _TOLERANCE).any(axis=1)
    chosen = np.flatnonzero(solved & violated)
    if len(chosen):
        point[chosen], solved[chosen] = _active_set(wanted[chosen], rows[chosen], least[chosen])
    return point, solved


def _active_set(point: Array, rows: Array, least: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Moves violated problems, one constraint at a time; rows have unit length."""
    count, width = point.shape
    each = np.arange(count)
    # Up to n active constraints of each problem: their rows, multipliers and numbers.
    normals, multipliers = np.zeros((count, width, width)), np.zeros((count, width))
    active = np.full((count, width), -1)
    # The constraint that is being added, and its multiplier so far.
    entering, weight = np.full(count, -1), np.zeros(count)
    solved, open_ = np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    for _ in range(_ITERATIONS_PER_UNKNOWN * width):
        slack = (rows * point[:, None]).sum(axis=2) - least
        held = active >= 0
        index, slot = held.nonzero()
        slack[index, active[index, slot]] = np.inf
        entering = np.where(entering < 0, slack.argmin(axis=1), entering)
        missing = slack[each, entering]
        solved |= open_ & (missing >= -_TOLERANCE)
        open_ &= ~solved
        if not open_.any():
            break
        normal = rows[each, entering]
        # The part of it that the active ones do not span, and how much of each is in the rest.
        gram = (normals[:, :, None] * normals[:, None]).sum(axis=3)
        gram[:, range(width), range(width)] += ~held
        shares = np.linalg.solve(gram, (normals * normal[:, None]).sum(axis=2)[..., None])[..., 0]
        free = normal - (normals * shares[..., None]).sum(axis=1)
        length = (free * normal).sum(axis=1)
        new = length > _PARALLEL
        # How far until the constraint holds, or the multiplier of an active one is used up.
        shrinks = held & (shares > _PARALLEL)
        limits = np.where(shrinks, multipliers / np.where(shrinks, shares, 1.0), np.inf)
        last = limits.argmin(axis=1)
        full = np.where(new, -missing / np.where(new, length, 1.0), np.inf)
        step = np.minimum(full, limits[each, last])
        # Neither will ever happen: there is no solution.
        open_ &= np.isfinite(step)
        step = np.where(open_, step, 0.0)
        point += np.where(new, step, 0.0)[:, None] * free
        multipliers -= np.where(held, step[:, None] * shares, 0.0)
        weight += step
        joins = open_ & (full <= limits[each, last])
        # Its slot: the first that is not taken. There is one, for it is not spanned by the others.
        drops, slot = open_ & ~joins, np.where(joins, held.argmin(axis=1), last)
        for where, row, multiplier, number in (
            (joins, normal, weight, entering),
            (drops, np.zeros_like(normal), np.zeros(count), np.full(count, -1)),
        ):
            chosen = np.flatnonzero(where)
            normals[chosen, slot[chosen]] = row[chosen]
            multipliers[chosen, slot[chosen]] = multiplier[chosen]
            active[chosen, slot[chosen]] = number[chosen]
        entering, weight = np.where(joins, -1, entering), np.where(joins, 0.0, weight)
    return point, solved
