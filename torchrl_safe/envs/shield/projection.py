"""Closest points under linear inequalities, for many small problems at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.state import Array

# Constraints are added one by one, and now and then dropped again: a few times the number of
# unknowns is enough. A problem that takes more is given up.
_ITERATIONS_PER_UNKNOWN = 8
# Tolerances for constraints of unit length: to be beyond one, and to be parallel.
_TOLERANCE, _PARALLEL = 1e-9, 1e-10
# Squared length of what active constraints do not span of another. With less, they would be so
# nearly dependent that rounding decides where they meet.
_SPANNED = 1e-6
# How far beyond a constraint rounding may leave a solution.
_ROUNDING = 1e-6


def project(
    wanted: Array,
    rows: Array,
    least: Array,
    lower: Array,
    upper: Array,
    along: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    r"""Returns the points nearest to ``wanted`` at which linear inequalities hold.

    .. math::
        \min_x \tfrac12 |x - w|^2 + \tfrac12 (k^\top (x - w))^2
        \quad \text{such that} \quad A x \ge b, \quad l \le x \le u

    Solved exactly, by the dual active-set method of Goldfarb and Idnani (1983, Mathematical
    Programming 27). As long as an inequality is violated, it moves onto the most violated one while
    those that are already active stay so, and drops those that no longer push. It ends after
    finitely many steps, and knows when there is no solution. Most problems take none or one, and
    all N take their steps together. The result of a problem does not depend on the others.

    Args:
        wanted: w, ``(N, n)``, within the bounds.
        rows: A, ``(N, r, n)``.
        least: b, ``(N, r)``; -inf for rows that do not count.
        lower: l, ``(N, n)``; may be infinite.
        upper: u, ``(N, n)``, not less than l; may be infinite.
        along: k, ``(N, n)``; without it, only :math:`|x - w|` counts.

    Returns:
        The points, ``(N, n)``, and which problems have a solution, ``(N,)``. Where there is
        none, the point has no meaning.

    Examples:
        >>> wanted, bound = np.array([[-1.0, 1.0]]), np.full((1, 2), 1.5)
        >>> project(wanted, np.array([[[1.0, 0.0]]]), np.zeros((1, 1)), -bound, bound)
        (array([[0., 1.]]), array([ True]))
    """
    point = wanted.copy()
    solved = np.asarray(((rows @ point[:, :, None])[:, :, 0] >= least - _TOLERANCE).all(axis=1))
    open_ = np.flatnonzero(~solved)
    if not len(open_):
        return point, solved
    target = wanted[open_]
    rows, least = _with_bounds(rows[open_], least[open_], lower[open_], upper[open_])
    if along is None:
        point[open_], solved[open_] = _active_set(target, *_unit(rows, least))
        return point, solved
    # With y = (1 + k k^T)^(1/2) x, the distance between y is the one that counts.
    along = along[open_]
    outer = along[:, :, None] * along[:, None]
    length = np.sqrt(1 + np.einsum("kn,kn->k", along, along))[:, None, None]
    root = np.eye(wanted.shape[1]) + outer / (1 + length)
    back = np.eye(wanted.shape[1]) - outer / (length + length**2)
    target = (root @ target[:, :, None])[:, :, 0]
    found, solved[open_] = _active_set(target, *_unit(rows @ back, least))
    point[open_] = (back @ found[:, :, None])[:, :, 0]
    return point, solved


def _with_bounds(rows: Array, least: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """All inequalities, the bounds at the end."""
    count, given, width = rows.shape
    every = np.empty((count, given + 2 * width, width))
    every[:, :given], every[:, given:] = rows, np.concatenate([np.eye(width), -np.eye(width)])
    return every, np.concatenate([least, lower, -upper], axis=1)


def _unit(rows: Array, least: Array) -> tuple[Array, Array]:
    """Inequalities with rows of unit length; or of none."""
    lengths = np.sqrt((rows * rows).sum(axis=2))
    # What does not depend on x always holds, or never: it is then a row that nothing satisfies.
    flat = lengths <= _PARALLEL
    scale = 1 / np.where(flat, 1.0, lengths)
    return np.where(flat[..., None], 0.0, rows * scale[..., None]), least * scale


def _active_set(point: Array, rows: Array, least: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Adds one constraint after the other."""
    count, width = point.shape
    each = np.arange(count)
    # Up to n active constraints of each problem: their rows, multipliers and numbers.
    normals, multipliers = np.zeros((count, width, width)), np.zeros((count, width))
    active = np.full((count, width), -1)
    # The dual basis of those rows: each has the product 1 with its own row and 0 with the others. A
    # vector's products with them are how much of each row is in it.
    duals = np.zeros_like(normals)
    # Those that are active are not looked at until they are dropped.
    watched = least.copy()
    # The constraint that is being added, and its multiplier so far.
    entering, weight = np.full(count, -1), np.zeros(count)
    never = np.full((count, width), np.inf)
    solved, open_ = np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    for _ in range(_ITERATIONS_PER_UNKNOWN * width):
        slack = (rows @ point[:, :, None])[:, :, 0] - watched
        entering = np.where(entering < 0, slack.argmin(axis=1), entering)
        missing = slack[each, entering]
        solved |= open_ & (missing >= -_TOLERANCE)
        open_ &= ~solved
        if not open_.any():
            break
        normal = rows[each, entering]
        # The part of it that the active ones do not span, and how much of each is in the rest.
        shares = (duals @ normal[:, :, None])[:, :, 0]
        free = normal - (shares[:, None] @ normals)[:, 0]
        length = (free * normal).sum(axis=1)
        # How far until the constraint holds, or the multiplier of an active one is used up.
        full = np.divide(-missing, length, out=never[:, 0].copy(), where=length > _SPANNED)
        limits = np.divide(multipliers, shares, out=never.copy(), where=shares > _PARALLEL)
        last = limits.argmin(axis=1)
        limit = limits[each, last]
        step = np.minimum(full, limit)
        # Neither will ever happen: there is no solution.
        open_ &= np.isfinite(step)
        step = np.where(open_, step, 0.0)
        point = point + np.where(length > _PARALLEL, step, 0.0)[:, None] * free
        multipliers -= step[:, None] * shares
        weight += step
        joins = np.flatnonzero(open_ & (full <= limit))
        # Into the first slot that is not taken: there is one, for the others do not span it.
        slot = (active[joins] < 0).argmax(axis=1)
        normals[joins, slot], multipliers[joins, slot] = normal[joins], weight[joins]
        dual = free[joins] / length[joins, None]
        duals[joins] -= shares[joins, :, None] * dual[:, None]
        duals[joins, slot] = dual
        active[joins, slot] = added = entering[joins]
        watched[joins, added] = -np.inf
        entering[joins], weight[joins] = -1, 0.0
        drops = np.flatnonzero(open_ & (full > limit))
        if len(drops):
            slot = last[drops]
            gone = active[drops, slot]
            watched[drops, gone] = least[drops, gone]
            active[drops, slot] = -1
            dual = duals[drops, slot]
            shared = (duals[drops] @ dual[:, :, None])[:, :, 0] / (dual * dual).sum(axis=1)[:, None]
            duals[drops] -= shared[:, :, None] * dual[:, None]
            duals[drops, slot] = 0.0
    # Those that are active have not been looked at again.
    return point, solved & ((rows @ point[:, :, None])[:, :, 0] >= least - _ROUNDING).all(axis=1)
