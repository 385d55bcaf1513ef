"""The closed forms against numbers worked out by hand and against a numerical solver."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize, minimize_scalar
from torch import nn
from torch.distributions import Categorical, kl_divergence
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

from torchrl_safe.objectives import CPO, PCPO, TRPO, TrustRegionProblem
from torchrl_safe.objectives.trust_region.solver import (
    NotPositiveDefiniteError,
    backtracking_line_search,
    conjugate_gradient,
    cpo_weights,
    fisher_vector_product,
    flat_gradient,
    pcpo_weight,
    trpo_weight,
)

MAX_KL = 0.02


def random_matrix(size, seed):
    torch.manual_seed(seed)
    factor = torch.randn(size, size, dtype=torch.float64)
    return factor @ factor.T + 0.1 * torch.eye(size, dtype=torch.float64)


# By the change of the cost in the TRPO step (rise) and the largest one in the trust region (reach).
CASES = {
    "region-inside": lambda rise, reach: -1.5 * reach,
    "optimum-inside": lambda rise, reach: -0.5 * (rise + reach),
    "active-below-the-limit": lambda rise, reach: -0.5 * rise,
    "active-on-the-limit": lambda rise, reach: 0.0,
    "active-above-the-limit": lambda rise, reach: 0.7 * reach,
    "recovery": lambda rise, reach: 1.5 * reach,
    "no-cost-gradient": lambda rise, reach: 0.3,
    "no-cost-gradient-below-the-limit": lambda rise, reach: -0.3,
}
RESTORED_BY_TRPO = "optimum-inside-from-above-the-limit"
ALL = [*CASES, RESTORED_BY_TRPO]


def random_problem(seed, case, size=5):
    """A problem in the given case, and its Fisher matrix."""
    hessian = random_matrix(size, seed)
    gradient, cost_gradient = torch.randn(2, size, dtype=torch.float64)
    natural = torch.linalg.solve(hessian, gradient)
    # The TRPO step raises the cost, or lowers it where it has to.
    sign = (cost_gradient @ natural).sign() * (-1 if case == RESTORED_BY_TRPO else 1)
    cost_gradient = sign * cost_gradient * (not case.startswith("no-cost-gradient"))
    natural_cost = torch.linalg.solve(hessian, cost_gradient)
    rise = trpo_weight(float(gradient @ natural), MAX_KL) * float(cost_gradient @ natural)
    reach = math.sqrt(2 * MAX_KL * float(cost_gradient @ natural_cost))
    violation = -0.5 * rise if case == RESTORED_BY_TRPO else CASES[case](rise, reach)
    problem = TrustRegionProblem(
        gradient, natural, MAX_KL, cost_gradient, natural_cost, violation, hessian.mv
    )
    return problem, hessian


def solve_numerically(problem, hessian, *, recovery):
    """The constrained maximum by SLSQP, in coordinates z that make the trust region a unit ball.

    For a recovery: the lowest cost within the trust region.
    """
    factor = np.linalg.cholesky(hessian.numpy()) / math.sqrt(2 * problem.max_kl)
    gradient = np.linalg.solve(factor, problem.gradient.numpy())
    cost_gradient = np.linalg.solve(factor, problem.cost_gradient.numpy())
    region = {"type": "ineq", "fun": lambda z: 1 - z @ z, "jac": lambda z: -2 * z}
    limit = {
        "type": "ineq",
        "fun": lambda z: -problem.violation - cost_gradient @ z,
        "jac": lambda z: -cost_gradient,
    }
    slope = cost_gradient if recovery else -gradient
    result = minimize(
        lambda z: slope @ z,
        np.zeros_like(gradient),
        jac=lambda z: slope,
        constraints=[region] if recovery or not cost_gradient.any() else [region, limit],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    # Its flag is not asked: it reports a failure too when rounding alone is left to improve on.
    return torch.from_numpy(np.linalg.solve(factor.T, result.x))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("case", ALL)
def test_cpo_solves_its_problem(case, seed):
    problem, hessian = random_problem(seed, case)
    solution = CPO()(problem)
    assert solution.recovery == (case == "recovery")
    assert solution.constraint_active == (case.startswith("active") or case == "recovery")
    expected = solve_numerically(problem, hessian, recovery=solution.recovery)
    torch.testing.assert_close(solution.step, expected, rtol=1e-4, atol=1e-5)
    kl = 0.5 * solution.step @ hessian @ solution.step
    assert kl <= MAX_KL * (1 + 1e-9)
    if case != "recovery" and problem.cost_gradient.any():
        assert problem.violation + problem.cost_gradient @ solution.step <= 1e-12


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("case", ["active-below-the-limit", "active-above-the-limit"])
def test_cpo_meets_the_dual(case, seed):
    """Weak duality turned to equality: the dual function's minimum is the primal's maximum."""
    problem, _ = random_problem(seed, case)
    q = float(problem.gradient @ problem.natural_gradient)
    r = float(problem.gradient @ problem.natural_cost_gradient)
    s = float(problem.cost_gradient @ problem.natural_cost_gradient)
    c = problem.violation
    weights = cpo_weights(q, r, s, c, MAX_KL)
    kl_multiplier, cost_multiplier = 1 / weights.reward, weights.cost / weights.reward
    assert cost_multiplier > 0

    def dual(log_kl_multiplier):
        value = math.exp(log_kl_multiplier)
        nu = max(0.0, (value * c + r) / s)
        return (q - 2 * nu * r + nu * nu * s) / (2 * value) + value * MAX_KL - nu * c

    best = minimize_scalar(dual, bounds=(-8, 8), method="bounded", options={"xatol": 1e-10})
    primal = float(problem.gradient @ CPO()(problem).step)
    assert best.fun == pytest.approx(primal, rel=1e-6)
    assert dual(math.log(kl_multiplier)) == pytest.approx(primal, rel=1e-9)


def test_cpo_by_hand():
    # H = 1, g = (1, 0), b = (1, 1), 2 max_kl = 1, on the limit: from (1, 0) down to the line
    # x + y = 0, on which the circle of radius 1 ends at (1, -1) / sqrt(2).
    identity = torch.eye(2)
    problem = TrustRegionProblem(
        identity[0], identity[0], 0.5, torch.ones(2), torch.ones(2), 0.0, torch.clone
    )
    expected = torch.tensor([1.0, -1.0]) / math.sqrt(2)
    torch.testing.assert_close(CPO()(problem).step, expected)


@pytest.mark.parametrize("violation", [-0.3, 0.0, 0.3])
def test_parallel_gradients_leave_the_nearest_point_of_the_plane(violation):
    torch.manual_seed(0)
    gradient = torch.randn(1000)
    # Three times the same direction but for rounding, which must not be scaled up to a step.
    cost_gradient = 3 * gradient / gradient.norm()
    problem = TrustRegionProblem(
        gradient, gradient, 0.5, cost_gradient, cost_gradient, violation, torch.clone
    )
    solution = CPO()(problem)
    torch.testing.assert_close(solution.step, -violation / 9 * cost_gradient)


def test_no_reward_gradient():
    zero, cost_gradient = torch.zeros(2), torch.tensor([2.0, 0.0])

    def step(violation):
        problem = TrustRegionProblem(
            zero, zero, 0.5, cost_gradient, cost_gradient, violation, torch.clone
        )
        return CPO()(problem).step

    assert torch.equal(step(-1.0), zero)  # Below the limit nothing is to be gained.
    torch.testing.assert_close(step(1.0), torch.tensor([-0.5, 0.0]))  # Above it: just back to it.
    assert torch.equal(step(3.0), torch.tensor([-1.0, 0.0]))  # Too far: as near as can be.


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("case", ALL)
@pytest.mark.parametrize("kl_projection", [True, False], ids=["fisher", "euclid"])
def test_pcpo_projects_the_trpo_step_and_stays_in_the_trust_region(kl_projection, case, seed):
    problem, hessian = random_problem(seed, case)
    solution = PCPO(kl_projection=kl_projection)(problem)
    start = TRPO()(problem).step.numpy()
    metric = hessian.numpy() if kl_projection else np.eye(len(start))
    slope = problem.cost_gradient.numpy()
    limit = {
        "type": "ineq",
        "fun": lambda x: -problem.violation - slope @ x,
        "jac": lambda x: -slope,
    }
    result = minimize(
        lambda x: 0.5 * (x - start) @ metric @ (x - start),
        start,
        jac=lambda x: metric @ (x - start),
        constraints=[limit] if slope.any() else [],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-14},
    )
    kl = 0.5 * result.x @ hessian.numpy() @ result.x
    expected = torch.from_numpy(result.x) * min(1.0, math.sqrt(MAX_KL / kl))
    torch.testing.assert_close(solution.step, expected, rtol=1e-4, atol=1e-5)
    assert solution.constraint_active == (case.startswith("active") or case == "recovery")


def test_pcpo_by_hand():
    # The reward step is (1, 0), its cost 1 over the limit. Along b = (1, 1) half of it comes off
    # each number; with a Fisher matrix diag(1, 4), H^-1 b = (1, 1/4), 1 / 1.25 of (1, 1/4).
    gradient, cost_gradient = torch.tensor([1.0, 0.0]), torch.ones(2)
    fisher = torch.tensor([1.0, 4.0])

    def problem(fisher):
        return TrustRegionProblem(
            gradient, gradient, 0.5, cost_gradient, cost_gradient / fisher, 0.0, fisher.mul
        )

    nearest = torch.tensor([0.5, -0.5])
    euclid = PCPO(kl_projection=False)
    torch.testing.assert_close(euclid(problem(torch.ones(2))).step, nearest)
    torch.testing.assert_close(PCPO()(problem(fisher)).step, torch.tensor([0.2, -0.2]))
    # Half of (1/4 + 4/4) is more than 1/2, the bound of the divergence.
    torch.testing.assert_close(euclid(problem(fisher)).step, nearest * math.sqrt(0.5 / 0.625))
    assert pcpo_weight(1.0, r=1.0, s=2.0, c=-2.0) == 0.0


def test_a_flag_of_another_kind_is_refused():
    with pytest.raises(TypeError, match="kl_projection must be True or False, got 'no'"):
        PCPO(kl_projection="no")


@pytest.mark.parametrize("method", [CPO, PCPO])
@pytest.mark.parametrize("seed", range(4))
def test_a_limit_that_does_not_bind_leaves_the_trpo_step(method, seed):
    problem, _ = random_problem(seed, "region-inside")
    assert torch.equal(method()(problem).step, TRPO()(problem).step)


@pytest.mark.parametrize("seed", range(4))
def test_trpo_solves_its_problem(seed):
    problem, hessian = random_problem(seed, "no-cost-gradient")
    expected = solve_numerically(problem, hessian, recovery=False)
    torch.testing.assert_close(TRPO()(problem).step, expected, rtol=1e-4, atol=1e-5)


def test_conjugate_gradient_by_hand():
    # One iteration from 0 along b = (1, 2): b.b / b.Hb = 5 / 20 of it; two solve the system.
    matrix, vector = torch.tensor([[4.0, 1.0], [1.0, 3.0]]), torch.tensor([1.0, 2.0])
    one = conjugate_gradient(matrix.mv, vector, max_iterations=1)
    torch.testing.assert_close(one, torch.tensor([0.25, 0.5]))
    two = conjugate_gradient(matrix.mv, vector, max_iterations=2)
    torch.testing.assert_close(two, torch.tensor([1 / 11, 7 / 11]))


@pytest.mark.parametrize("size", [1, 3, 10])
def test_conjugate_gradient_solves(size):
    matrix = random_matrix(size, seed=size)
    vector = torch.randn(size, dtype=torch.float64)
    solution = conjugate_gradient(matrix.mv, vector, max_iterations=2 * size, tolerance=1e-12)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, vector))


def test_conjugate_gradient_stops_when_it_is_there():
    calls = []

    def identity(vector):
        calls.append(vector)
        return vector

    vector = torch.tensor([3.0, 4.0])
    assert torch.equal(conjugate_gradient(identity, vector), vector)
    assert len(calls) == 1
    assert torch.equal(conjugate_gradient(identity, torch.zeros(2)), torch.zeros(2))
    assert len(calls) == 1


@pytest.mark.parametrize(
    "diagonal", [(1.0, -3.0), (0.0, 0.0), (float("nan"), 1.0), (float("inf"), 1.0)]
)
def test_conjugate_gradient_refuses_what_is_not_positive_definite(diagonal):
    matrix = torch.tensor(diagonal)
    with pytest.raises(NotPositiveDefiniteError, match="must be positive and finite, got"):
        conjugate_gradient(lambda vector: matrix * vector, torch.ones(2))


def test_line_search_takes_the_first_fraction_that_will_do():
    tried = []

    def accepts(fraction):
        tried.append(fraction)
        return fraction <= 0.25

    assert backtracking_line_search(accepts, shrink=0.5, max_backtracks=3) == 0.25
    assert tried == [1.0, 0.5, 0.25]


def test_line_search_that_fails_gives_zero():
    tried = []
    assert backtracking_line_search(tried.append, shrink=0.5, max_backtracks=2) == 0.0
    assert tried == [1.0, 0.5, 0.25]


POLICIES = {
    "normal": (4, lambda x: IndependentNormal(x[..., :2], x[..., 2:].exp())),
    "tanh-normal": (4, lambda x: TanhNormal(x[..., :2], x[..., 2:].exp())),
    "categorical": (3, lambda x: Categorical(logits=x)),
    "one-hot": (3, lambda x: OneHotCategorical(logits=x)),
}


@pytest.mark.parametrize("policy", POLICIES)
def test_fisher_vector_product_is_that_of_the_explicit_matrix(policy):
    """H = J^T M J, with J the Jacobian of the outputs and M the Fisher matrix of each of them.

    For a normal in (mean, log deviation) M is diag(1 / deviation^2, 2), for a categorical in its
    logits diag(p) - p p^T; a bijection of the action such as tanh changes neither.
    """
    outputs, distribution = POLICIES[policy]
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, outputs)).double()
    observation = torch.randn(7, 3, dtype=torch.float64)
    parameters = list(network.parameters())
    raw = network(observation)
    size = sum(parameter.numel() for parameter in parameters)
    matrix = torch.zeros(size, size, dtype=torch.float64)
    for row in raw:
        jacobian = torch.stack([flat_gradient(entry, parameters, retain=True) for entry in row])
        if policy.endswith("normal"):
            metric = torch.cat([(-2 * row[2:]).exp(), torch.full((2,), 2.0)]).diag()
        else:
            probability = row.softmax(-1)
            metric = probability.diag() - probability.outer(probability)
        matrix += (jacobian.T @ metric @ jacobian / len(raw)).detach()
    kl = kl_divergence(distribution(raw.detach()), distribution(raw)).mean()
    product = fisher_vector_product(kl, parameters, damping=0.3)
    damped = matrix + 0.3 * torch.eye(size, dtype=torch.float64)
    for vector in torch.randn(5, size, dtype=torch.float64):
        torch.testing.assert_close(product(vector), damped @ vector)


def test_conjugate_gradient_refuses_a_curvature_that_overflows():
    """Each product is finite, but not what it gives along its vector."""
    with pytest.raises(NotPositiveDefiniteError, match="got inf"):
        conjugate_gradient(lambda vector: 1e20 * vector, torch.full((2,), 1e10))
