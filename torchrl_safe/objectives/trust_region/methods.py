"""Trust-region methods: the step that each takes in the local problem."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchrl_safe._checks import check_flag
from torchrl_safe.objectives.trust_region.solver import cpo_weights, pcpo_weight, trpo_weight


@dataclass(frozen=True)
class TrustRegionProblem:
    r"""The problem around the present policy, whose parameters have n numbers.

    .. math::
        \max_x\ g^T x \quad\text{subject to}\quad c + b^T x \le 0,\quad
        \tfrac12 x^T H x \le \delta

    Args:
        gradient (Tensor): :math:`g`, of the surrogate to maximize, shape ``(n,)``.
        natural_gradient (Tensor): :math:`H^{-1} g`, shape ``(n,)``.
        max_kl (float): :math:`\delta`, in nats.
        cost_gradient (Tensor): :math:`b`, of the cost surrogate, shape ``(n,)``; zeros for a
            method without constraint, as the next.
        natural_cost_gradient (Tensor): :math:`H^{-1} b`, shape ``(n,)``.
        violation (float): :math:`c`, cost minus limit in the unit of the cost surrogate.
        product (callable): from a vector :math:`x` of shape ``(n,)`` to :math:`H x`.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import TRPO
        >>> gradient, zero = torch.tensor([3.0, 4.0]), torch.zeros(2)
        >>> problem = TrustRegionProblem(gradient, gradient, 0.02, zero, zero, 0.0, lambda x: x)
        >>> TRPO()(problem).step  # Along the gradient, of length sqrt(2 * 0.02).
        tensor([0.1200, 0.1600])
    """

    gradient: Tensor
    natural_gradient: Tensor
    max_kl: float
    cost_gradient: Tensor
    natural_cost_gradient: Tensor
    violation: float
    product: Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class TrustRegionSolution:
    """The step that a method proposes.

    Args:
        step (Tensor): change of the parameters, shape ``(n,)``.
        constraint_active (bool): whether the cost constraint shaped it.
        recovery (bool): whether it only lowers the cost. It then need not raise the reward.

    Examples:
        >>> import torch
        >>> TrustRegionSolution(step=torch.zeros(2)).recovery
        False
    """

    step: Tensor
    constraint_active: bool = False
    recovery: bool = False


class TrustRegionMethod(abc.ABC):
    """A step rule: a frozen dataclass called with a :class:`TrustRegionProblem`.

    ``constrained`` says whether the rule uses the cost limit. Only then does it get the cost.

    Examples:
        >>> from dataclasses import dataclass
        >>> from torchrl_safe.objectives import TrustRegionMethod, TrustRegionSolution
        >>> @dataclass(frozen=True)
        ... class PlainGradient(TrustRegionMethod):
        ...     lr: float = 0.1
        ...     constrained = False
        ...
        ...     def __call__(self, problem):
        ...         return TrustRegionSolution(self.lr * problem.gradient)
    """

    constrained: ClassVar[bool]

    @abc.abstractmethod
    def __call__(self, problem: TrustRegionProblem) -> TrustRegionSolution:
        """Proposes a step; the line search shortens or refuses it."""


@dataclass(frozen=True)
class TRPO(TrustRegionMethod):
    """Trust region policy optimization: the natural gradient, up to the bound of the divergence.

    Schulman et al. 2015 (https://arxiv.org/abs/1502.05477); see
    :func:`~torchrl_safe.objectives.trust_region.solver.trpo_weight`. On a
    :class:`~torchrl_safe.objectives.TrustRegionLoss` whose multipliers a
    :class:`~torchrl_safe.objectives.MultiplierUpdater` moves, it is TRPO-Lagrangian.

    Examples:
        >>> import torch
        >>> zero = torch.zeros(2)
        >>> gradient = torch.tensor([3.0, 4.0])
        >>> identity = torch.clone  # the Fisher matrix
        >>> TRPO()(TrustRegionProblem(gradient, gradient, 0.5, zero, zero, 0.0, identity)).step
        tensor([0.6000, 0.8000])
    """

    constrained = False

    def __call__(self, problem: TrustRegionProblem) -> TrustRegionSolution:
        weight = trpo_weight(_dot(problem.gradient, problem.natural_gradient), problem.max_kl)
        return TrustRegionSolution(weight * problem.natural_gradient)


@dataclass(frozen=True)
class CPO(TrustRegionMethod):
    """Constrained policy optimization: the best step that keeps the cost below its limit.

    Achiam et al. 2017 (https://arxiv.org/abs/1705.10528); the closed form and its four cases
    are those of :func:`~torchrl_safe.objectives.trust_region.solver.cpo_weights`. It takes one
    cost: with k costs the dual has 2^k sets of active constraints and no closed form. For several
    costs, add them up, or use :class:`TRPO` with a multiplier for each.

    Examples:
        >>> import torch
        >>> gradient, cost_gradient = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 1.0])
        >>> CPO()(
        ...     TrustRegionProblem(
        ...         gradient=gradient,
        ...         natural_gradient=gradient,
        ...         max_kl=0.5,
        ...         cost_gradient=cost_gradient,
        ...         natural_cost_gradient=cost_gradient,
        ...         violation=0.0,
        ...         product=torch.clone,  # the Fisher matrix is the identity
        ...     )
        ... ).step
        tensor([ 0.7071, -0.7071])
    """

    constrained = True

    def __call__(self, problem: TrustRegionProblem) -> TrustRegionSolution:
        weights = cpo_weights(
            q=_dot(problem.gradient, problem.natural_gradient),
            # As b^T H^-1 g: the cost of the reward step is exact also if few iterations solved
            # for the natural gradients.
            r=_dot(problem.cost_gradient, problem.natural_gradient),
            s=_dot(problem.cost_gradient, problem.natural_cost_gradient),
            c=problem.violation,
            max_kl=problem.max_kl,
        )
        step = weights.reward * problem.natural_gradient
        if weights.active:
            step = step - weights.cost * problem.natural_cost_gradient
        return TrustRegionSolution(step, weights.active, weights.recovery)


@dataclass(frozen=True)
class PCPO(TrustRegionMethod):
    """Projection-based constrained policy optimization: a TRPO step, projected on the limit.

    Yang et al. 2020 (https://arxiv.org/abs/2010.03152); see
    :func:`~torchrl_safe.objectives.trust_region.solver.pcpo_weight`. Far above the limit the
    projection lies outside the trust region. The step then ends at its edge, on the way there (in
    the paper nothing bounds it). It takes one cost, because the projection on several half-spaces
    has no closed form.

    Args:
        kl_projection (bool, optional): project to the point of least divergence, in the metric
            of the Fisher matrix; if ``False``, to the nearest parameters. Defaults to ``True``.

    Raises:
        TypeError: if ``kl_projection`` is no flag.

    Examples:
        >>> import torch
        >>> gradient, cost_gradient = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 1.0])
        >>> PCPO()(
        ...     TrustRegionProblem(
        ...         gradient=gradient,
        ...         natural_gradient=gradient,
        ...         max_kl=0.5,
        ...         cost_gradient=cost_gradient,
        ...         natural_cost_gradient=cost_gradient,
        ...         violation=0.0,
        ...         product=torch.clone,  # the Fisher matrix is the identity
        ...     )
        ... ).step
        tensor([ 0.5000, -0.5000])
    """

    kl_projection: bool = True
    constrained = True

    def __post_init__(self) -> None:
        check_flag(kl_projection=self.kl_projection)

    def __call__(self, problem: TrustRegionProblem) -> TrustRegionSolution:
        reward = trpo_weight(_dot(problem.gradient, problem.natural_gradient), problem.max_kl)
        step = reward * problem.natural_gradient
        normal = problem.natural_cost_gradient if self.kl_projection else problem.cost_gradient
        cost = pcpo_weight(
            reward,
            r=_dot(problem.cost_gradient, problem.natural_gradient),
            s=_dot(problem.cost_gradient, normal),
            c=problem.violation,
        )
        if cost > 0:
            step = step - cost * normal
            kl = 0.5 * _dot(step, problem.product(step))
            if kl > problem.max_kl:
                step = math.sqrt(problem.max_kl / kl) * step
        return TrustRegionSolution(step, constraint_active=cost > 0)


def _dot(left: Tensor, right: Tensor) -> float:
    return float(left @ right)
