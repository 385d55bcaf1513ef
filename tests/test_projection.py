"""The projection of the shield: closest points under linear inequalities."""

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog, nnls

from torchrl_safe.envs.shield.projection import project


def brute_force(wanted, rows, least):
    """The nearest point at which all inequalities hold, of all that some of them determine."""
    best = None
    for count in range(len(wanted) + 1):
        for active in combinations(range(len(rows)), count):
            chosen, bound = rows[list(active)], least[list(active)]
            point = wanted + np.linalg.pinv(chosen) @ (bound - chosen @ wanted)
            nearer = best is None or np.linalg.norm(point - wanted) < np.linalg.norm(best - wanted)
            if nearer and (rows @ point >= least - 1e-9).all():
                best = point
    return best


def with_bounds(rows, least, lower, upper):
    """All inequalities of a problem, and what they ask for at least."""
    box = np.eye(len(lower))
    return np.concatenate([rows, box, -box]), np.concatenate([least, lower, -upper])


def problems(seed, count=40, unknowns=3, rows=5):
    """Some with a solution and some without."""
    rng = np.random.default_rng(seed)
    wanted = 2 * rng.normal(size=(count, unknowns))
    given = rng.normal(size=(count, rows, unknowns)), 0.5 * rng.normal(size=(count, rows))
    bounds = -rng.uniform(0, 1, (count, unknowns)), rng.uniform(0, 1, (count, unknowns))
    return np.clip(wanted, *bounds), *given, *bounds


@pytest.mark.parametrize("seed", range(3))
def test_projections_are_the_nearest_points(seed):
    points, solved = project(*problems(seed))
    assert 10 < solved.sum() < 35
    for index, (wanted, rows, least, lower, upper) in enumerate(zip(*problems(seed), strict=True)):
        expected = brute_force(wanted, *with_bounds(rows, least, lower, upper))
        assert solved[index] == (expected is not None)
        if expected is not None:
            np.testing.assert_allclose(points[index], expected, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_projections_also_count_what_happens_along_a_vector(seed):
    """In the coordinates of the symmetric square root the distance is the Euclidean one."""
    along = np.random.default_rng(seed).normal(size=(40, 3))
    points, solved = project(*problems(seed), along)
    np.testing.assert_array_equal(solved, project(*problems(seed))[1])
    for index in np.flatnonzero(solved):
        wanted, *inequalities = (part[index] for part in problems(seed))
        all_rows, bounds = with_bounds(*inequalities)
        values, vectors = np.linalg.eigh(np.eye(3) + np.outer(along[index], along[index]))
        root = vectors * np.sqrt(values) @ vectors.T
        expected = brute_force(root @ wanted, all_rows @ np.linalg.inv(root), bounds)
        np.testing.assert_allclose(root @ points[index], expected, atol=1e-7)


def nearly_dependent(seed, count=200, apart=1e-5):
    """Half of the rows are all but combinations of the others."""
    rng = np.random.default_rng(seed)
    wanted, rows, _, lower, upper = problems(seed, count, unknowns=7, rows=12)
    rows[:, 6:] = rng.normal(size=(count, 6, 6)) @ rows[:, :6] + apart * rows[:, 6:]
    return wanted, rows, 0.3 * rng.normal(size=(count, 12)), lower, upper


@pytest.mark.parametrize("apart", [1e-2, 1e-3, 1e-4])
def test_projections_are_the_nearest_points_of_nearly_dependent_rows(apart):
    """The distance to a polyhedron is a problem of non-negative least squares."""
    arguments = nearly_dependent(0, apart=apart)
    points, solved = project(*arguments)
    assert solved.sum() > 50
    for index in np.flatnonzero(solved):
        wanted, *inequalities = (part[index] for part in arguments)
        all_rows, bounds = with_bounds(*inequalities)
        beyond = bounds - all_rows @ wanted
        # Lawson and Hanson 1974, chapter 23: least distance programming.
        stacked = np.vstack([all_rows.T, beyond])
        residual = stacked @ nnls(stacked, [*np.zeros(7), 1.0])[0] - [*np.zeros(7), 1.0]
        nearest = wanted - residual[:-1] / residual[-1]
        np.testing.assert_allclose(points[index], nearest, atol=1e-5)


@pytest.mark.parametrize("weight", [0.0, 10.0, 1000.0])
@pytest.mark.parametrize(
    "arguments",
    [problems(0, unknowns=7, rows=12), nearly_dependent(3)],
    ids=["any", "nearly-dependent"],
)
def test_projections_know_when_there_is_no_solution(arguments, weight):
    """Of seven joints, as SciPy's linear programs have it."""
    wanted, rows, least, lower, upper = arguments
    along = weight * np.random.default_rng(0).normal(size=wanted.shape)
    points, solved = project(wanted, rows, least, lower, upper, along)
    for index in range(len(wanted)):
        bounds = list(zip(lower[index], upper[index], strict=True))
        program = linprog(np.zeros(7), -rows[index], -least[index], bounds=bounds)
        assert solved[index] == (program.status == 0)
    assert (np.einsum("kri,ki->kr", rows, points) >= least - 1e-7)[solved].all()
    assert 0 < solved.sum() < len(solved)


@pytest.mark.parametrize("along", [(), (np.random.default_rng(0).normal(size=(40, 7)),)])
def test_projections_do_not_depend_on_each_other(along):
    arguments = (*problems(1, unknowns=7, rows=12), *along)
    points, solved = project(*arguments)
    for index in range(len(points)):
        alone, solves = project(*(part[index : index + 1] for part in arguments))
        assert solves[0] == solved[index]
        np.testing.assert_array_equal(alone[0], points[index])


def test_rows_of_zeros_hold_always_or_never():
    zeros, wide = np.zeros((2, 1, 2)), np.full((2, 2), 9.0)
    _, solved = project(np.ones((2, 2)), zeros, np.array([[-1.0], [1.0]]), -wide, wide)
    assert solved.tolist() == [True, False]


@pytest.mark.parametrize("part", [0, 1, 2, 5], ids=["wanted", "rows", "least", "along"])
def test_what_is_not_a_number_has_no_solution(part):
    arguments = [*problems(0), np.ones((40, 3))]
    points, solved = project(*arguments)
    moved = solved & (points != arguments[0]).any(axis=1)
    assert moved.any()
    arguments[part] = arguments[part].copy()
    arguments[part][moved] = np.nan
    np.testing.assert_array_equal(project(*arguments)[1], solved & ~moved)
