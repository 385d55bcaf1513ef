"""The multipliers of a Lagrangian loss, and the advantage that they mix."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_safe.objectives._checks import as_tensor
from torchrl_safe.objectives._cost_critic import CostCriticMixin, report_each
from torchrl_safe.objectives.functional import penalized_advantage


class LagrangeMultiplierMixin(CostCriticMixin):
    """Adds the buffer that every ``MultiplierUpdater`` moves, and reports it."""

    _schedulable_buffers = frozenset({"lagrange_multiplier"})

    lagrange_multiplier: Tensor

    def __init__(
        self,
        *args: Any,
        num_costs: int = 1,
        multiplier_init: float | Tensor = 0.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, num_costs=num_costs, **kwargs)
        multiplier = initial_multiplier(num_costs, multiplier_init)
        self.register_buffer("lagrange_multiplier", multiplier.to(self.cost_critic_coeff.device))

    def _set_cost_outputs(self, losses: TensorDictBase, tensordict: TensorDictBase) -> None:
        super()._set_cost_outputs(losses, tensordict)
        report_each(losses, "lagrange_multiplier", self.lagrange_multiplier)

    def _cost_out_keys(self) -> list[NestedKey]:
        multipliers = [f"lagrange_multiplier_{i}" for i in range(len(self.lagrange_multiplier))]
        return [*super()._cost_out_keys(), *multipliers]


class MixedAdvantageMixin(LagrangeMultiplierMixin):
    """Lets a PPO loss maximize a mixture of the advantages, by default the penalized one."""

    def _mix(self, advantage: Tensor, cost_advantage: Tensor) -> Tensor:
        return penalized_advantage(advantage, cost_advantage, self.lagrange_multiplier)

    def _maybe_normalize_advantage(
        self, advantage: Tensor, tensordict: TensorDictBase, *, update_norm: bool
    ) -> Tensor:
        # Mixed after the parent's options have acted on the reward advantage, and nowhere else.
        advantage = super()._maybe_normalize_advantage(
            advantage, tensordict, update_norm=update_norm
        )
        return self._mix(advantage, tensordict.get(self.tensor_keys.cost_advantage))


def initial_multiplier(num_costs: int, multiplier_init: float | Tensor) -> Tensor:
    multiplier = as_tensor("multiplier_init", multiplier_init, torch.get_default_dtype())
    if multiplier.shape not in ((), (num_costs,)):
        raise ValueError(
            f"multiplier_init must be one number or one for each of the {num_costs} costs, got "
            f"shape {tuple(multiplier.shape)}."
        )
    # Near the end of single precision its product with an advantage would be infinite.
    if not ((multiplier >= 0) & (multiplier <= 1e18)).all():
        raise ValueError(
            "multiplier_init must be finite and not negative, and at most 1e18, got "
            f"{multiplier_init}."
        )
    return multiplier.expand(num_costs).clone()
