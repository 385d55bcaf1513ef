"""Rules that move the Lagrange multipliers of a loss."""

from __future__ import annotations

import abc
import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions.transforms import Transform, identity_transform
from torchrl.objectives import LossModule

from torchrl_safe._checks import check_flag, check_kind
from torchrl_safe.objectives._checks import SMALLEST, Checked, as_scalar, check_number
from torchrl_safe.objectives.rules.cost_updater import CostUpdater

# A relative violation is divided by at least this share of the limit.
_SHARE_OF_LIMIT = 0.2
# Share of the scale of violations that each batch forgets.
_FORGOTTEN = 0.2


def _check_bound(name: str, bound: float | None) -> float | None:
    if bound is None or as_scalar(bound) == math.inf:
        return bound
    return check_number(name, bound, SMALLEST)


class MultiplierUpdater(CostUpdater):
    """Moves the multipliers of a loss towards its cost limits, once for each collected batch.

    A rule is one method, :meth:`next_multiplier`. This class checks the costs, projects the
    multipliers on ``[0, max_multiplier]`` and writes the buffer in place, like
    ``SoftUpdate(loss).step()``. The multipliers are in the ``lagrange_multiplier`` buffer of the
    loss and nowhere else.

    Args:
        loss_module (LossModule): a loss with a ``lagrange_multiplier`` buffer of shape ``(k,)``.

    Keyword Args:
        cost_limit (float, Tensor or Mapping): limit of each expected episode cost, one number,
            k, or one by name, ``{"collision": 0.5, "speed": 2.0}``, in the unit of the
            undiscounted episode cost.
        max_multiplier (float, optional): upper bound of every multiplier. Defaults to no bound.
        pessimism (float, optional): standard errors of the batch's mean episode cost that are
            added to it. Without it a limit that binds is met on average only: policies end above
            it as often as below. The margin grows if episodes are few or uneven; a batch of one
            episode has no standard error and adds none. Defaults to ``0.0``.
        normalize (bool, optional): make the violation relative, with no unit: divide it by a scale
            and clip it to [-1, 1]. The scale is the standard deviation of the episode costs, and
            at least a fifth of the limit. It rises at once, and falls by a fifth of the difference
            in each batch. Costs and limit times 1,000 then give the same multipliers. Needs limits
            that are not negative. Defaults to ``False``.
        cost_names (sequence of str, optional): names of the k costs in their order, for example
            ``env.cost_names``: those of limits by name, and those that errors and logs use.
            Defaults to ``("0", "1", ...)``.

    Raises:
        ValueError: if the loss has no such buffer, or a limit, bound or pessimism is not usable.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import LossModule
        >>> from torchrl_safe.objectives import MultiplierUpdater
        >>> class Exponentiated(MultiplierUpdater):
        ...     def next_multiplier(self, multiplier, violation):
        ...         # By a factor of at most 1.22. From 0 it could not rise: at least 0.01.
        ...         step = 0.2 * (violation / self.cost_limit).clamp(-1, 1)
        ...         return multiplier.clamp_min(0.01) * step.exp()
        >>> loss = LossModule()
        >>> loss.register_buffer("lagrange_multiplier", torch.zeros(1))
        >>> updater = Exponentiated(loss, cost_limit=2.0, max_multiplier=10.0)
        >>> for _ in range(5):
        ...     updater.step(torch.tensor([[30.0]]))
        >>> loss.lagrange_multiplier
        tensor([0.0272])
    """

    buffer_name = "lagrange_multiplier"

    max_multiplier = Checked(_check_bound)

    def __init__(
        self,
        loss_module: LossModule,
        *,
        cost_limit: float | Tensor | Mapping[str, float],
        max_multiplier: float | None = None,
        pessimism: float = 0.0,
        normalize: bool = False,
        cost_names: Sequence[str] | None = None,
    ) -> None:
        check_flag(normalize=normalize)
        self._normalize = normalize
        super().__init__(
            loss_module, cost_limit=cost_limit, pessimism=pessimism, cost_names=cost_names
        )
        self.max_multiplier = max_multiplier
        # The largest so far, slowly forgotten.
        self.cost_scale = torch.zeros_like(self.cost_limit)

    @property
    def normalize(self) -> bool:
        """Whether violations are relative. Fixed once made: the state depends on it."""
        return self._normalize

    def _check_state(self, state_dict: dict[str, Any]) -> None:
        super()._check_state(state_dict)
        _check_bound("max_multiplier", state_dict["max_multiplier"])

    def _as_limit(self, cost_limit: float | Tensor | Mapping[str, float]) -> Tensor:
        limit = super()._as_limit(cost_limit)
        if self.normalize and (limit < 0).any():
            raise ValueError(f"cost_limit must not be negative with normalize, got {cost_limit}.")
        return limit

    def _move(self, buffer: Tensor, episode_cost: Tensor) -> None:
        if buffer.dtype not in (torch.float32, torch.float64):
            raise TypeError(
                f"{self.buffer_name} must be float32 or float64, got {buffer.dtype}, which loses "
                "small steps: keep the loss in float32 and use torch.autocast."
            )
        violation, cost_scale = self._violation(episode_cost), self.cost_scale
        if self.normalize:
            current, past = self._scale_of(episode_cost), cost_scale.to(episode_cost)
            # Not the scale of this batch alone: a batch with few costs would count more than one
            # with many, and rare costs would exceed the limit on average.
            scale = torch.maximum(current, past)
            violation = torch.where(scale > 0, violation / scale, 0.0).clamp(-1, 1)
            cost_scale = torch.maximum(current, past.lerp(current, _FORGOTTEN))
        proposal = self.next_multiplier(buffer.clone(), violation)
        if not isinstance(proposal, Tensor):
            raise TypeError(
                f"next_multiplier must return a tensor of shape ({len(buffer)},), got {proposal!r}."
            )
        # A proposal of infinity is one beyond the bound, if there is one.
        projected = proposal.clamp(0, self.max_multiplier)
        if projected.shape != buffer.shape or not projected.isfinite().all():
            raise ValueError(
                f"next_multiplier must return {len(buffer)} finite numbers, got {proposal} for a "
                f"violation of {violation}."
            )
        buffer.copy_(projected)
        self.cost_scale = cost_scale

    def _scale_of(self, episode_cost: Tensor) -> Tensor:
        scale = _SHARE_OF_LIMIT * self.cost_limit
        if len(episode_cost) > 1:
            scale = torch.maximum(scale, episode_cost.std(0))
        # Under a limit of 0 costs that are all the same have no other scale.
        return torch.where(scale > 0, scale, episode_cost.mean(0).abs())

    @abc.abstractmethod
    def next_multiplier(self, multiplier: Tensor, violation: Tensor) -> Tensor:
        """Proposes the next multipliers; ``step`` projects them on ``[0, max_multiplier]``.

        Args:
            multiplier (Tensor): current multipliers, shape ``(k,)``.
            violation (Tensor): mean episode cost minus limit, shape ``(k,)``, with ``pessimism``
                and ``normalize`` as they were chosen.

        Returns:
            The proposed multipliers, shape ``(k,)``.
        """

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the updater; the multipliers are in the state of the loss."""
        return {
            **super().state_dict(),
            "max_multiplier": self.max_multiplier,
            "normalize": self.normalize,
            "cost_scale": self.cost_scale.clone(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads a state that :meth:`state_dict` returned, with its limits and options.

        To continue with another limit, set ``cost_limit`` afterwards.

        Raises:
            ValueError: if the state is of another kind of updater, another number of costs, or
                costs of other names or in another order.
        """
        super().load_state_dict(state_dict)
        self.max_multiplier = state_dict["max_multiplier"]
        self._normalize = state_dict["normalize"]
        self.cost_scale = state_dict["cost_scale"].clone()


class DualAscent(MultiplierUpdater):
    r"""Projected gradient ascent on the dual: the step is proportional to the violation.

    .. math::
        \lambda \leftarrow \mathrm{clip}(\lambda + \mathrm{lr} \, (J_c - d),\ 0,\ \mathrm{max})

    ``optimizer`` and ``parametrization`` give the published variants: Adam on the raw
    multiplier (OmniSafe, SafePO), Adam on a softplus parameter (Safety Gym: Ray et al. 2019).
    Adam's step is about ``lr`` whatever the size of the violation.

    Args:
        loss_module (LossModule): see :class:`MultiplierUpdater`.

    Keyword Args:
        cost_limit (float, Tensor or Mapping): see :class:`MultiplierUpdater`.
        lr (float): step size, in multiplier per unit of violated cost.
        max_multiplier (float, optional): see :class:`MultiplierUpdater`.
        pessimism (float, optional): see :class:`MultiplierUpdater`.
        normalize (bool, optional): see :class:`MultiplierUpdater`. ``lr`` is then the largest step
            of a batch. Defaults to ``False``.
        optimizer (callable, optional): called as ``optimizer([parameter], lr=lr)``.
            Defaults to :class:`torch.optim.SGD`.
        parametrization (Transform, optional): the multiplier as a function of the parameter
            that the gradient step acts on, for example
            ``torch.distributions.transforms.SoftplusTransform()``. As published, the gradient
            is that of the parameter times the violation, without the transform's derivative.
            Defaults to the identity: the multiplier itself.
        cost_names (sequence of str, optional): see :class:`MultiplierUpdater`.

    Raises:
        ValueError: if ``lr`` is not positive, or ``parametrization`` cannot give the multiplier
            to start with.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import LossModule
        >>> loss = LossModule()
        >>> loss.register_buffer("lagrange_multiplier", torch.zeros(2))
        >>> limits = {"collision": 1.0, "speed": 5.0}
        >>> updater = DualAscent(loss, cost_limit=limits, cost_names=["collision", "speed"], lr=0.5)
        >>> updater.step(torch.tensor([[2.0, 0.0], [4.0, 0.0]]))
        >>> loss.lagrange_multiplier
        tensor([1., 0.])
    """

    def __init__(
        self,
        loss_module: LossModule,
        *,
        cost_limit: float | Tensor | Mapping[str, float],
        lr: float,
        max_multiplier: float | None = None,
        pessimism: float = 0.0,
        normalize: bool = False,
        optimizer: Callable[..., torch.optim.Optimizer] = torch.optim.SGD,
        parametrization: Transform = identity_transform,
        cost_names: Sequence[str] | None = None,
    ) -> None:
        super().__init__(
            loss_module,
            cost_limit=cost_limit,
            max_multiplier=max_multiplier,
            pessimism=pessimism,
            normalize=normalize,
            cost_names=cost_names,
        )
        lr = check_number("lr", lr, SMALLEST)
        check_kind("parametrization", parametrization, Transform, such_as="SoftplusTransform()")
        multiplier = loss_module.lagrange_multiplier
        if not parametrization.inv(multiplier).isfinite().all():
            raise ValueError(
                f"parametrization {parametrization} cannot give the multiplier to start with, "
                f"{multiplier.tolist()}: pass another multiplier_init to the loss."
            )
        self.parametrization = parametrization
        self._parameter = torch.zeros_like(multiplier)
        if not callable(optimizer):
            raise TypeError(
                f"optimizer must be a class such as torch.optim.Adam, got {optimizer!r}."
            )
        self.optimizer = optimizer([self._parameter], lr=lr)

    def _move(self, buffer: Tensor, episode_cost: Tensor) -> None:
        before = copy.deepcopy(self.optimizer.state_dict())
        try:
            super()._move(buffer, episode_cost)
        except Exception:
            self.optimizer.load_state_dict(before)
            raise

    def next_multiplier(self, multiplier: Tensor, violation: Tensor) -> Tensor:
        # The buffer is the only home of the multiplier: the parameter is read from it each time,
        # so that a loaded or assigned multiplier is never overwritten by a stale one. The bound
        # lets a softplus that has underflowed to zero come back.
        self._parameter.copy_(self.parametrization.inv(multiplier).clamp_min(-80))
        self._parameter.grad = -violation.to(self._parameter)
        self.optimizer.step()
        return self.parametrization(self._parameter).to(multiplier)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "optimizer": copy.deepcopy(self.optimizer.state_dict())}

    def _check_state(self, state_dict: dict[str, Any]) -> None:
        super()._check_state(state_dict)
        own, (group,) = self.optimizer.param_groups[0], state_dict["optimizer"]["param_groups"]
        if own.keys() != group.keys():
            raise ValueError(
                f"The state is of another optimizer than {type(self.optimizer).__name__}: it has "
                f"the options {sorted(group)}."
            )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        # The optimizer would go on in the tensors that it is given.
        self.optimizer.load_state_dict(copy.deepcopy(state_dict["optimizer"]))
