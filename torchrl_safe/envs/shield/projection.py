"""Closest points under linear inequalities, for many small problems at once."""

from __future__ import annotations

from typing import Any

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
    image: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    r"""Returns the points nearest to ``wanted`` at which linear inequalities hold.

    .. math::
        \min_x \tfrac12 |x - w|^2 + \tfrac12 |K (x - w)|^2
        \quad \text{such that} \quad A x \ge b, \quad l \le x \le u

    Solved exactly, by the dual active-set method of Goldfarb and Idnani (1983, Mathematical
    Programming 27). It begins with the bounds, which need no search. Then, as long as an inequality
    is violated, it moves onto the most violated one while those that are already active stay so,
    and drops those that no longer push. It ends after finitely many steps, and knows when there is
    no solution. Most problems take none or one, and all N take their steps together. The result
    of a problem does not depend on the others.

    Args:
        wanted: w, ``(N, n)``.
        rows: A, ``(N, r, n)``.
        least: b, ``(N, r)``; -inf for rows that do not count.
        lower: l, ``(N, n)``; may be infinite.
        upper: u, ``(N, n)``, not less than l; may be infinite.
        image: K, ``(N, m, n)``; without it, only :math:`|x - w|` counts.

    Returns:
        The points, ``(N, n)``, and which problems have a solution, ``(N,)``. Where there is
        none, the point has no meaning.

    Examples:
        >>> wanted, bound = np.array([[-1.0, 2.0]]), np.full((1, 2), 1.5)
        >>> project(wanted, np.array([[[1.0, 0.0]]]), np.zeros((1, 1)), -bound, bound)
        (array([[0. , 1.5]]), array([ True]))
    """
    point = np.clip(wanted, lower, upper)
    solved = np.asarray(((rows @ point[:, :, None])[:, :, 0] >= least - _TOLERANCE).all(axis=1))
    if image is not None:  # The nearest of a box is then another point.
        solved &= (point == wanted).all(axis=1)
    open_ = np.flatnonzero(~solved)
    if not len(open_):
        return point, solved
    rows, least, bounds = rows[open_], least[open_], (lower[open_], upper[open_])
    if image is None:
        rows, least = _with_bounds(*_unit(rows, least), *bounds)
        point[open_], solved[open_] = _active_set(wanted[open_], point[open_], rows, least)
        return point, solved
    # With L L^T = 1 + K^T K, the distance between y = L^T x is the one that counts.
    some = image[open_]
    root = np.linalg.cholesky(np.eye(wanted.shape[1]) + some.transpose(0, 2, 1) @ some)
    back = np.linalg.inv(root).transpose(0, 2, 1)
    target = (root.transpose(0, 2, 1) @ wanted[open_, :, None])[:, :, 0]
    rows, least = _with_bounds(rows, least, *bounds)
    found, solved[open_] = _active_set(target, target, *_unit(rows @ back, least))
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


def _active_set(
    wanted: Array, point: Array, rows: Array, least: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Adds one constraint after the other, to begin with the bounds at which ``point`` is."""
    count, width = point.shape
    each, joint = np.arange(count), np.arange(width)
    # Up to n active constraints of each problem: their rows, multipliers and numbers. A bound that
    # is active at the beginning is in the slot of its unknown.
    push = point - wanted
    normals = np.sign(push)[:, :, None] * np.eye(width)
    multipliers = np.abs(push)
    active = rows.shape[1] - np.where(push > 0, 2, 1) * width + joint
    active[push == 0] = -1
    # Those that are active are not looked at until they are dropped.
    watched = least.copy()
    index, slot = (active >= 0).nonzero()
    watched[index, active[index, slot]] = -np.inf
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
        normal, held = rows[each, entering], active >= 0
        # The part of it that the active ones do not span, and how much of each is in the rest.
        gram = normals @ normals.transpose(0, 2, 1)
        np.einsum("kii->ki", gram)[:] += ~held
        shares, singular = _solve(gram, normals @ normal[:, :, None])
        free = normal - (normals * shares[:, :, None]).sum(axis=1)
        length = (free * normal).sum(axis=1)
        # How far until the constraint holds, or the multiplier of an active one is used up.
        full = np.divide(-missing, length, out=never[:, 0].copy(), where=length > _SPANNED)
        limits = np.divide(multipliers, shares, out=never.copy(), where=shares > _PARALLEL)
        last = limits.argmin(axis=1)
        limit = limits[each, last]
        step = np.minimum(full, limit)
        # Neither will ever happen: there is no solution.
        open_ &= np.isfinite(step) & ~singular
        step = np.where(open_, step, 0.0)
        point = point + np.where(length > _PARALLEL, step, 0.0)[:, None] * free
        multipliers -= step[:, None] * shares
        weight += step
        joins = np.flatnonzero(open_ & (full <= limit))
        drops = np.flatnonzero(open_ & (full > limit))
        # Into the first slot that is not taken: there is one, for the others do not span it.
        slot = held[joins].argmin(axis=1)
        normals[joins, slot], multipliers[joins, slot] = normal[joins], weight[joins]
        active[joins, slot] = added = entering[joins]
        watched[joins, added] = -np.inf
        entering[joins], weight[joins] = -1, 0.0
        slot = last[drops]
        gone = active[drops, slot]
        watched[drops, gone] = least[drops, gone]
        normals[drops, slot], multipliers[drops, slot], active[drops, slot] = 0.0, 0.0, -1
    # Those that are active have not been looked at again.
    return point, solved & ((rows @ point[:, :, None])[:, :, 0] >= least - _ROUNDING).all(axis=1)


def _solve(gram: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Solves ``(N, n, n)`` equations; also returns which have no solution, ``(N,)``."""
    try:
        return np.linalg.solve(gram, right)[:, :, 0], np.zeros(len(gram), dtype=bool)
    except np.linalg.LinAlgError:  # One such problem is not the others' end.
        singular = np.linalg.matrix_rank(gram, hermitian=True) < gram.shape[1]
        gram = np.where(singular[:, None, None], np.eye(gram.shape[1]), gram)
        return np.linalg.solve(gram, right)[:, :, 0], singular
