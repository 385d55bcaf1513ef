"""Pure functions of the trust-region methods: products, solves, closed forms, line search."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

# Squared sine of the angle between two gradients below which they count as parallel: what single
# precision leaves of their difference is rounding, and would be scaled up to a full step.
_PARALLEL = 1e-6


class NotPositiveDefiniteError(ArithmeticError):
    """A quadratic form is not positive along a direction, or its product is not finite."""


def flat_gradient(
    output: Tensor,
    parameters: Iterable[Tensor],
    *,
    create_graph: bool = False,
    retain: bool = False,
) -> Tensor:
    """Gradient of a scalar by all parameters, one after the other in a vector.

    Args:
        output (Tensor): scalar. Where it does not depend on a parameter the gradient is zero.
        parameters (iterable of Tensor): leaves with n numbers in all.
        create_graph (bool, optional): let the gradient be differentiated. Defaults to ``False``.
        retain (bool, optional): keep the graph of ``output``. Defaults to ``create_graph``.

    Returns:
        The gradient, shape ``(n,)``.

    Examples:
        >>> import torch
        >>> x, y = torch.ones(2, requires_grad=True), torch.ones(1, requires_grad=True)
        >>> flat_gradient((3 * x).sum(), [x, y])
        tensor([3., 3., 0.])
    """
    gradients = torch.autograd.grad(
        output,
        list(parameters),
        create_graph=create_graph,
        retain_graph=create_graph or retain,
        materialize_grads=True,
    )
    return torch.cat([gradient.reshape(-1) for gradient in gradients])


def fisher_vector_product(
    kl: Tensor, parameters: Iterable[Tensor], *, damping: float = 0.0
) -> Callable[[Tensor], Tensor]:
    r"""Multiplies vectors by the Fisher matrix of a policy, without ever forming it.

    The Fisher matrix is the Hessian of the mean KL divergence at the parameters themselves,
    :math:`H = \nabla^2_\theta\, \mathrm{E}_s D_{KL}(\pi_{\theta_k} \| \pi_\theta)` at
    :math:`\theta = \theta_k` (Schulman et al. 2015, https://arxiv.org/abs/1502.05477,
    appendix C); its product with a vector is taken by double backward.

    Args:
        kl (Tensor): scalar mean divergence of the policy from its own detached copy.
        parameters (iterable of Tensor): the policy's parameters, n numbers in all.
        damping (float, optional): multiple of the identity added to H. Defaults to ``0.0``.

    Returns:
        A function from a vector of shape ``(n,)`` to :math:`H v + \mathrm{damping}\, v`.

    Examples:
        >>> import torch
        >>> from torch.distributions import Normal, kl_divergence
        >>> loc = torch.zeros(2, requires_grad=True)
        >>> scale = torch.tensor([1.0, 2.0])
        >>> kl = kl_divergence(Normal(loc.detach(), scale), Normal(loc, scale)).sum()
        >>> fisher_vector_product(kl, [loc])(torch.ones(2))  # the inverse variances
        tensor([1.0000, 0.2500])
    """
    parameters = list(parameters)
    gradient = flat_gradient(kl, parameters, create_graph=True)

    def product(vector: Tensor) -> Tensor:
        return flat_gradient(gradient @ vector, parameters, retain=True) + damping * vector

    return product


def conjugate_gradient(
    product: Callable[[Tensor], Tensor],
    vector: Tensor,
    *,
    max_iterations: int = 10,
    tolerance: float = 1e-5,
) -> Tensor:
    """Solves ``H x = vector`` for a symmetric positive definite ``H`` by its products alone.

    Hestenes and Stiefel 1952; in exact arithmetic n iterations solve n equations.

    Args:
        product (callable): maps a vector ``v`` of shape ``(n,)`` to ``H v``.
        vector (Tensor): right-hand side, shape ``(n,)``.
        max_iterations (int, optional): upper bound on the products taken. Defaults to ``10``.
        tolerance (float, optional): size of the residual, relative to ``vector``, at which the
            iterations end. Defaults to ``1e-5``.

    Returns:
        The solution ``x``, shape ``(n,)``; zeros for a zero ``vector``.

    Raises:
        NotPositiveDefiniteError: if ``v @ H v`` is zero, negative or not finite for a ``v`` met
            on the way.

    Examples:
        >>> import torch
        >>> matrix = torch.tensor([[4.0, 1.0], [1.0, 3.0]])
        >>> conjugate_gradient(lambda v: matrix @ v, torch.tensor([9.0, 5.0]))
        tensor([2., 1.])
    """
    solution = torch.zeros_like(vector)
    residual, direction = vector, vector
    squared = vector @ vector
    enough = tolerance**2 * squared
    for _ in range(max_iterations):
        if squared <= enough:  # At once for a zero vector.
            break
        image = product(direction)
        curvature = direction @ image
        if not 0 < curvature < math.inf:
            raise NotPositiveDefiniteError(
                f"v @ H v must be positive and finite, got {curvature.item()} for a v with "
                f"v @ v = {(direction @ direction).item()}."
            )
        length = squared / curvature
        solution = solution + length * direction
        residual = residual - length * image
        previous, squared = squared, residual @ residual
        direction = residual + squared / previous * direction
    return solution


def backtracking_line_search(
    accepts: Callable[[float], bool], *, shrink: float = 0.8, max_backtracks: int = 10
) -> float:
    """Tries the fractions 1, ``shrink``, ``shrink**2`` ... of a step.

    Args:
        accepts (callable): tells whether a fraction of the step will do.
        shrink (float, optional): factor between two fractions, between 0 and 1.
            Defaults to ``0.8``.
        max_backtracks (int, optional): number of times that the step is shortened.
            Defaults to ``10``.

    Returns:
        The first fraction accepted, or ``0.0`` if none of the ``max_backtracks + 1`` is.

    Examples:
        >>> backtracking_line_search(lambda fraction: fraction < 0.3, shrink=0.5)
        0.25
        >>> backtracking_line_search(lambda fraction: False)
        0.0
    """
    for exponent in range(max_backtracks + 1):
        fraction = shrink**exponent
        if accepts(fraction):
            return fraction
    return 0.0


def trpo_weight(q: float, max_kl: float) -> float:
    r"""Length of the TRPO step along the natural gradient.

    Maximizes :math:`g^T x` subject to :math:`\tfrac12 x^T H x \le \delta`: the solution is
    :math:`x = \alpha H^{-1} g` with :math:`\alpha = \sqrt{2 \delta / q}` and
    :math:`q = g^T H^{-1} g` (Schulman et al. 2015, https://arxiv.org/abs/1502.05477,
    appendix C).

    Args:
        q (float): squared length of the gradient in the metric of the inverse Fisher matrix.
        max_kl (float): the bound :math:`\delta`, in nats.

    Returns:
        The factor :math:`\alpha`; ``0.0`` without a gradient.

    Examples:
        >>> trpo_weight(8.0, 0.01)
        0.05
    """
    return math.sqrt(2 * max_kl / q) if q > 0 else 0.0


@dataclass(frozen=True)
class CPOWeights:
    r"""The step :math:`\alpha H^{-1} g - \beta H^{-1} b` that solves CPO's problem.

    The dual solution of the paper is :math:`\lambda = 1 / \alpha` (of the divergence) and
    :math:`\nu = \beta / \alpha` (of the cost), except in a recovery, which has none.

    Args:
        reward (float): :math:`\alpha`.
        cost (float): :math:`\beta`.
        active (bool): whether the cost constraint shapes the step.
        recovery (bool): whether no step within the trust region meets the constraint.
    """

    reward: float
    cost: float = 0.0
    active: bool = False
    recovery: bool = False


def cpo_weights(q: float, r: float, s: float, c: float, max_kl: float) -> CPOWeights:
    r"""Solves CPO's problem of one cost in closed form.

    .. math::
        \max_x\ g^T x \quad\text{subject to}\quad c + b^T x \le 0,\quad
        \tfrac12 x^T H x \le \delta

    (Achiam et al. 2017, https://arxiv.org/abs/1705.10528, section 6.1 and appendix 10.2.) With
    :math:`q = g^T H^{-1} g`, :math:`r = g^T H^{-1} b`, :math:`s = b^T H^{-1} b`:

    - **inside**: the trust region lies within the constraint (:math:`c < 0`,
      :math:`c^2 \ge 2 \delta s`), or the TRPO step meets it: the TRPO step;
    - **active**: the plane cuts the trust region and the TRPO step violates it: the best point
      of the cut, :math:`\alpha = \sqrt{(2\delta - c^2 / s) / (q - r^2 / s)}`,
      :math:`\beta = (\alpha r + c) / s`. Parallel gradients (:math:`q = r^2 / s`) leave nothing
      to choose on the plane: its nearest point, :math:`\alpha = 0`;
    - **recovery**: no step meets the constraint (:math:`c > 0`, :math:`c^2 \ge 2 \delta s`): the
      steepest descent of the cost, :math:`\beta = \sqrt{2 \delta / s}` (equation 14);
    - **no cost gradient** (:math:`s = 0`): no small step changes the cost: the TRPO step.

    Args:
        q (float): see above, not negative.
        r (float): see above.
        s (float): see above, not negative.
        c (float): violation: cost minus limit, in the unit of the cost surrogate.
        max_kl (float): the bound :math:`\delta`, in nats.

    Returns:
        The weights of the two natural gradients.

    Examples:
        >>> cpo_weights(q=1.0, r=1.0, s=2.0, c=0.0, max_kl=0.5)  # along the plane
        CPOWeights(reward=1.4142135623730951, cost=0.7071067811865476, active=True, recovery=False)
        >>> cpo_weights(q=1.0, r=1.0, s=1.0, c=3.0, max_kl=0.5)  # too far away
        CPOWeights(reward=0.0, cost=1.0, active=True, recovery=True)
    """
    free = trpo_weight(q, max_kl)
    if not s > 0:
        return CPOWeights(free)
    reach = 2 * max_kl - c * c / s  # Squared half-width of the plane's cut through the region.
    if reach <= 0:
        if c > 0:
            return CPOWeights(0.0, math.sqrt(2 * max_kl / s), active=True, recovery=True)
        return CPOWeights(free)
    if c + free * r <= 0:
        return CPOWeights(free)
    along = q - r * r / s  # Squared length of the part of the gradient within the plane.
    reward = math.sqrt(reach / along) if along > _PARALLEL * q else 0.0
    return CPOWeights(reward, (reward * r + c) / s, active=True)


def pcpo_weight(reward_weight: float, r: float, s: float, c: float) -> float:
    r"""Length of PCPO's projection of a reward step onto the constraint.

    The projection of :math:`\alpha H^{-1} g` on :math:`\{x : c + b^T x \le 0\}` in the metric of
    a matrix L subtracts :math:`\beta L^{-1} b` from it, with

    .. math::
        \beta = \max\left(0, \frac{\alpha r + c}{s}\right),\quad
        r = b^T H^{-1} g,\quad s = b^T L^{-1} b

    (Yang et al. 2020, https://arxiv.org/abs/2010.03152, the update in closed form).

    Args:
        reward_weight (float): :math:`\alpha`.
        r (float): see above.
        s (float): see above, not negative.
        c (float): violation: cost minus limit, in the unit of the cost surrogate.

    Returns:
        The factor :math:`\beta`; ``0.0`` without a cost gradient.

    Examples:
        >>> pcpo_weight(2.0, r=1.0, s=4.0, c=-1.0)
        0.25
    """
    return max(0.0, (reward_weight * r + c) / s) if s > 0 else 0.0
