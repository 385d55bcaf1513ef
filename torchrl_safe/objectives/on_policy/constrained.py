"""How every on-policy loss is put under constraints: its advantages, one method, its critics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from inspect import Parameter, signature
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    dispatch,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import PPOLoss

from torchrl_safe._checks import check_flag
from torchrl_safe.objectives._checks import get_or_raise, initial_multiplier
from torchrl_safe.objectives._reduction import counted, expanded_mask, report_each
from torchrl_safe.objectives.critics.cost_critic import CostCritic, CostKeys
from torchrl_safe.objectives.functional import cost_advantage_scale, penalized_advantage
from torchrl_safe.objectives.on_policy.policies import Evaluated, Policy, evaluate


class ConstrainedLoss(CostCritic):
    """A loss of TorchRL for the policy, under constraints on k costs.

    :meth:`policy_losses` is the method, as its paper has it: here the mixed advantage, which a
    subclass may replace. It calls ``unconstrained(tensordict, advantage)``, TorchRL's own loss for
    an advantage, which the class beside this one brings: :class:`ConstrainedPPO` for a parent,
    ``WrappedLoss`` for an object.
    """

    # What tells the loss of its constraints: buffers of shape (k,) that an updater writes. Each
    # call reports them.
    cost_buffers: ClassVar[tuple[str, ...]] = ("lagrange_multiplier",)
    # Whether the method compares cost advantages with violations: they keep the unit of the cost.
    keeps_cost_unit: ClassVar[bool] = False
    # What policy_losses returns beside the outputs of the unconstrained loss.
    policy_out_keys: ClassVar[tuple[str, ...]] = ()

    _schedulable_buffers = frozenset({"lagrange_multiplier"})

    lagrange_multiplier: Tensor
    cost_violation: Tensor
    cost_advantage_scale: Tensor

    def __init__(
        self,
        *args: Any,
        multiplier_init: float | Tensor = 0.0,
        normalize_cost_advantage: bool | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        if normalize_cost_advantage is None:
            normalize_cost_advantage = not self.keeps_cost_unit
        check_flag(normalize_cost_advantage=normalize_cost_advantage)
        if normalize_cost_advantage and self.keeps_cost_unit:
            raise TypeError(
                f"{type(self).__name__} compares the cost advantage with a violation, in the unit "
                "of the cost: normalize_cost_advantage is not supported."
            )
        self._normalize_cost_advantage = normalize_cost_advantage
        multiplier = initial_multiplier(self.num_costs, multiplier_init)
        if multiplier.any() and "lagrange_multiplier" not in self.cost_buffers:
            raise TypeError(
                f"{type(self).__name__} has no multipliers, got multiplier_init={multiplier_init}."
            )
        for name in self.cost_buffers:
            start = multiplier if name == "lagrange_multiplier" else torch.zeros_like(multiplier)
            self.register_buffer(name, start.to(self.cost_critic_coeff.device))
        if normalize_cost_advantage:
            scale = torch.zeros_like(multiplier, device=self.cost_critic_coeff.device)
            self.register_buffer("cost_advantage_scale", scale)

    @property
    def normalize_cost_advantage(self) -> bool:
        """Whether cost advantages are divided by their standard deviation. Fixed once made."""
        return self._normalize_cost_advantage

    def _next_cost_scale(self, cost_advantage: Tensor, mask: Tensor | None) -> Tensor | None:
        if not self.normalize_cost_advantage:
            return None
        scale = cost_advantage_scale(self.cost_advantage_scale, cost_advantage, mask)
        return self.cost_advantage_scale.copy_(scale)

    def policy_losses(
        self, tensordict: TensorDictBase, advantage: Tensor, cost_advantage: Tensor
    ) -> TensorDictBase:
        """Returns all outputs but those of the cost critic. A loss of your own overrides it.

        It may call ``self.evaluate(tensordict)``, the present policy of a PPO loss, and
        ``self.unconstrained(tensordict, advantage)``, the outputs of TorchRL's loss for any
        advantage of shape ``(*B, 1)``; a PPO loss takes that policy as a third argument. Reduce
        terms of your own with :func:`~torchrl_safe.objectives.reduced`, and name them in the class
        attribute ``policy_out_keys``.

        Args:
            tensordict (TensorDictBase): the data, a copy that may be written to.
            advantage (Tensor): reward advantage, shape ``(*B, 1)``.
            cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.

        Returns:
            A tensordict of losses named ``"loss_..."``, reduced, and of numbers to log.
        """
        mixed = penalized_advantage(advantage, cost_advantage, self.lagrange_multiplier)
        return self.unconstrained(tensordict, mixed)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.clone(False)
        advantage, cost_advantage = self._advantages(tensordict)
        self._fill_padding(tensordict, advantage)
        losses = self.policy_losses(tensordict, advantage, cost_advantage)
        self._set_cost_critic_outputs(losses, tensordict)
        for name in self.cost_buffers:
            report_each(losses, name, getattr(self, name))
        return losses

    def _advantages(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        if not self._has_advantages(tensordict):
            self._estimate_advantages(tensordict)
        cost_advantage = tensordict.get(self.tensor_keys.cost_advantage)
        self._check_width(self.tensor_keys.cost_advantage, cost_advantage)
        return tensordict.get(self.tensor_keys.advantage), cost_advantage

    def _fill_padding(self, tensordict: TensorDictBase, advantage: Tensor) -> None:
        """Makes the stored policy usable where steps do not count.

        Padding holds zeros. A divergence from a deviation of 0 is infinite, and infinity times 0 is
        NaN in the gradient. 1 is a usable deviation, concentration, logit and action mask.
        """
        mask, actor = counted(self, tensordict, advantage), self.actor_network
        if mask is None or not isinstance(actor, ProbabilisticTensorDictSequential):
            return

        def filled(values: Tensor) -> Tensor:
            empty = (values.reshape(*mask.shape[:-1], -1) == 0).all(-1, keepdim=True)
            return torch.where(
                expanded_mask(empty & ~mask, values), torch.ones_like(values), values
            )

        stored = tensordict.select(*actor[-1].in_keys, strict=False)
        tensordict.update(stored.apply(filled))

    def _own_out_keys(self) -> list[NestedKey]:
        reported = [f"{name}_{i}" for name in self.cost_buffers for i in range(self.num_costs)]
        return [*self.policy_out_keys, *super()._own_out_keys(), *reported]


@dataclass
class PPOKeys(CostKeys, PPOLoss._AcceptedKeys):
    """The keys of the costs and those of PPO."""


class ConstrainedPPO(ConstrainedLoss):
    """Puts a parent under constraints: :class:`~torchrl.objectives.PPOLoss` or one made of it.

    It stands before that parent among the bases: ``class Mine(ConstrainedPPO, ClipPPOLoss)``.
    """

    _AcceptedKeys = PPOKeys
    default_keys = PPOKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase,
        cost_critic_network: TensorDictModuleBase,
        *,
        num_costs: int = 1,
        multiplier_init: float | Tensor = 0.0,
        cost_critic_coeff: float = 1.0,
        **kwargs: Any,
    ) -> None:
        self._check_arguments(kwargs)
        super().__init__(
            actor_network,
            critic_network,
            cost_critic_network=cost_critic_network,
            num_costs=num_costs,
            multiplier_init=multiplier_init,
            cost_critic_coeff=cost_critic_coeff,
            **kwargs,
        )

    @classmethod
    def _check_arguments(cls, kwargs: Mapping[str, Any]) -> None:
        """Refuses what no constructor takes: TorchRL's would ignore it."""
        constructors = [vars(base)["__init__"] for base in cls.__mro__ if "__init__" in vars(base)]
        parameters = [each for init in constructors for each in signature(init).parameters.values()]
        catch_all = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
        known = {each.name for each in parameters if each.kind not in catch_all}
        if unknown := sorted(kwargs.keys() - known):
            raise TypeError(f"{cls.__name__} got unexpected arguments: {', '.join(unknown)}.")

    def evaluate(self, tensordict: TensorDictBase) -> Policy:
        """The present policy. What critics read of it is in the data then."""
        cost_advantage = get_or_raise(tensordict, self.tensor_keys.cost_advantage)
        return evaluate(self, tensordict, cost_advantage.shape[:-1], self._shared_keys)

    def unconstrained(
        self, tensordict: TensorDictBase, advantage: Tensor, policy: Policy | None = None
    ) -> TensorDictBase:
        """The parent's outputs, for this advantage of shape ``(*B, 1)``."""
        policy = self.evaluate(tensordict) if policy is None else policy
        tensordict = tensordict.set(self.tensor_keys.advantage, advantage)
        return self.parent_forward(Evaluated(self, policy), tensordict)

    def _advantages(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        estimated = not self._has_advantages(tensordict)
        advantage, cost_advantage = super()._advantages(tensordict)
        # normalize_advantage and advantage_norm are about the reward. The parent applies them
        # within its forward only, where the costs are mixed in already.
        advantage = self._maybe_normalize_advantage(advantage, tensordict, update_norm=estimated)
        return advantage, cost_advantage
