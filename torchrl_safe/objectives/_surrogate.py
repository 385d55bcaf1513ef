"""The clipped surrogate of the costs, for losses that penalize it."""

from __future__ import annotations

import abc
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives.violation import (
    ViolationMixin,
    check_episode_length,
    check_length_known,
)


def clipped_cost_surrogate(
    log_weight: Tensor,
    cost_advantage: Tensor,
    bounds: tuple[Tensor, Tensor],
    log_is_weight: Tensor | float = 0.0,
) -> Tensor:
    r"""PPO's surrogate with the sign of a cost, the larger of two products, from where it starts.

    .. math::
        \max(r A_c,\ \mathrm{clip}(r) A_c) - A_c

    The last term has mean zero over the batch that was collected, not over a minibatch. Left in,
    the noise of its mean there would be taken for a change of the policy, and a convex penalty
    makes that a bias.

    Args:
        log_weight (Tensor): logarithm of the ratio r that is clipped, shape ``(*B, 1)``.
        cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.
        bounds (tuple of Tensor): logarithms of the smallest and the largest clipped ratio.
        log_is_weight (Tensor or float, optional): logarithm of what both products are weighted
            by, shape ``(*B, 1)``. Defaults to ``0.0``.

    Returns:
        The surrogate of each sample and cost, shape ``(*B, k)``.
    """
    ratio, clipped = log_weight.exp(), log_weight.clamp(*bounds).exp()
    products = torch.maximum(ratio * cost_advantage, clipped * cost_advantage)
    return torch.as_tensor(log_is_weight).exp() * (products - cost_advantage)


class CostSurrogateMixin(ViolationMixin):
    """Adds ``loss_penalty``, a function of the mean cost surrogates, to ``ClipPPOLoss``."""

    def __init__(self, *args: Any, episode_length: float | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.episode_length = check_episode_length(episode_length)
        if self.reduction != "mean":
            raise ValueError(
                "reduction must be 'mean', since the penalty is a function of the batch mean, got "
                f"{self.reduction!r}."
            )
        self._log_ratios: Any = None

    def _check_cost_value_estimator(self, estimator: ValueEstimatorBase) -> None:
        check_length_known(self.episode_length, estimator.gamma)

    @abc.abstractmethod
    def _penalty(self, surrogate: Tensor) -> Tensor:
        """The penalty of each cost, shape ``(k,)``, from its mean surrogate, shape ``(k,)``."""

    def _log_weight(self, tensordict: TensorDictBase, adv_shape: torch.Size) -> tuple[Any, ...]:
        # Kept for the penalty, so that the policy is evaluated once.
        evaluated = super()._log_weight(tensordict, adv_shape)
        self._log_ratios = evaluated[0], evaluated[3]
        return evaluated

    def _set_cost_outputs(self, losses: TensorDictBase, tensordict: TensorDictBase) -> None:
        log_weight, log_is_weight = self._log_ratios
        self._log_ratios = None
        cost_advantage = tensordict.get(self.tensor_keys.cost_advantage)
        self._check_width(self.tensor_keys.cost_advantage, cost_advantage)
        surrogate = clipped_cost_surrogate(
            log_weight,
            cost_advantage,
            self._clip_bounds,
            0.0 if log_is_weight is None else log_is_weight,
        )
        means = [self._reduce_loss(column, tensordict) for column in surrogate.unbind(-1)]
        losses.set("loss_penalty", self._penalty(torch.stack(means)).sum())
        super()._set_cost_outputs(losses, tensordict)

    def _cost_out_keys(self) -> list[NestedKey]:
        return ["loss_penalty", *super()._cost_out_keys()]
