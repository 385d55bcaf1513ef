"""Closest points under linear inequalities, for many small problems at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.state import Array

try:
    import daqp
except ImportError:
    daqp = None

# How far a point may be beyond an inequality, and how far rounding may leave it.
_TOLERANCE, _ROUNDING = 1e-9, 1e-6


def check_solver() -> None:
    """Raises an ImportError where DAQP is missing."""
    if daqp is None:
        raise ImportError('A shield needs DAQP: pip install "torchrl-safe[arms]".')


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

    Solved exactly, by the dual active-set method of DAQP (Arnström et al. 2022, IEEE Transactions
    on Automatic Control 67). The result of a problem does not depend on the others.

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

    Raises:
        ImportError: if DAQP is missing.

    Examples:
        >>> wanted, bound = np.array([[-1.0, 1.0]]), np.full((1, 2), 1.5)
        >>> project(wanted, np.array([[[1.0, 0.0]]]), np.zeros((1, 1)), -bound, bound)
        (array([[0., 1.]]), array([ True]))
    """
    check_solver()
    point = wanted.copy()
    solved = _hold(rows, point, least - _TOLERANCE)
    open_ = np.flatnonzero(~solved)
    if not len(open_):
        return point, solved
    metric = np.eye(wanted.shape[1])[None].repeat(len(open_), axis=0)
    if along is not None:
        metric += along[open_, :, None] * along[open_, None]
    linear = -(metric @ wanted[open_, :, None])[:, :, 0]
    lowest = np.concatenate([lower[open_], least[open_]], axis=1)
    highest = np.concatenate([upper[open_], np.full((len(open_), rows.shape[1]), np.inf)], axis=1)
    for problem, index in enumerate(open_):
        found, _, flag, _ = daqp.solve(
            metric[problem],
            linear[problem],
            rows[index],
            highest[problem],
            lowest[problem],
            primal_tol=_TOLERANCE,
        )
        point[index], solved[index] = found, flag > 0
    # DAQP lets NaN pass.
    return point, solved & _hold(rows, point, least - _ROUNDING)


def _hold(rows: Array, point: Array, least: Array) -> NDArray[np.bool_]:
    """In which problems all inequalities hold, ``(N,)``."""
    return np.asarray(((rows @ point[:, :, None])[:, :, 0] >= least).all(axis=1))
