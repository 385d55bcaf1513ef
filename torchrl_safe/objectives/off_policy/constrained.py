"""What the off-policy Lagrangian losses share: an ensemble of cost critics and multipliers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.utils import distance_loss
from torchrl.objectives.value import GAE, ValueEstimatorBase

from torchrl_safe._checks import check_count, check_kind
from torchrl_safe.objectives._checks import check_terminated, get_or_raise, initial_multiplier
from torchrl_safe.objectives._reduction import report_each
from torchrl_safe.objectives.critics.cost_td0 import CostTD0
from torchrl_safe.objectives.critics.cost_values import CostValues
from torchrl_safe.objectives.functional import penalized_advantage


class ConstrainedQLoss(CostValues):
    """Adds an ensemble of critics of k costs, and their multipliers, to a loss with Q-values.

    To be mixed into TorchRL's :class:`~torchrl.objectives.SACLoss` or
    :class:`~torchrl.objectives.TD3Loss`, ahead of it. The class that does so

    - leaves the next action that the reward critics are bootstrapped with under ``"next"`` of the
      tensordict which its value loss is given: the cost critics are bootstrapped with the same;
    - passes the actor's objective through :meth:`penalized_objective`.

    Arguments, keys and outputs are described in
    :class:`~torchrl_safe.objectives.SACLagrangianLoss`.
    """

    _schedulable_buffers = frozenset({"lagrange_multiplier"})

    cost_qvalue_network: TensorDictModule
    cost_qvalue_network_params: TensorDictParams
    target_cost_qvalue_network_params: TensorDictParams
    lagrange_multiplier: Tensor
    reduction: str
    deactivate_vmap: bool
    use_prioritized_weights: str | bool

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        cost_qvalue_network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
        *,
        num_costs: int = 1,
        num_cost_qvalue_nets: int = 2,
        multiplier_init: float | Tensor = 0.0,
        **kwargs: Any,
    ) -> None:
        check_count(num_costs=num_costs, num_cost_qvalue_nets=num_cost_qvalue_nets)
        multiplier = initial_multiplier(num_costs, multiplier_init)
        networks = _as_list(cost_qvalue_network)
        if networks is not None and len(networks) != num_cost_qvalue_nets:
            raise ValueError(
                f"cost_qvalue_network must be one network or num_cost_qvalue_nets = "
                f"{num_cost_qvalue_nets} of them, got {len(networks)}."
            )
        # The parent's constructor already sets keys, before a module can be assigned.
        self._cost_qvalue_in_keys = list((networks or [cost_qvalue_network])[0].in_keys)
        self.num_costs = num_costs
        super().__init__(actor_network, qvalue_network, **kwargs)
        self.convert_to_functional(
            networks or cost_qvalue_network,
            "cost_qvalue_network",
            num_cost_qvalue_nets,
            create_target_params=self.delay_qvalue,
            compare_against=(
                list(actor_network.parameters()) if kwargs.get("separate_losses") else None
            ),
        )
        # The parent has looked for dropout in its own critics only.
        self.set_vmap_randomness("different")
        self.num_cost_qvalue_nets = num_cost_qvalue_nets
        device = next(self.parameters()).device
        self.register_buffer("lagrange_multiplier", multiplier.to(device))
        self._list_in_keys()

    def _default_cost_estimator(self, **hyperparams: Any) -> ValueEstimatorBase:
        device = self.lagrange_multiplier.device
        return CostTD0(**{"gamma": 0.99, "device": device, **hyperparams})

    def _check_cost_value_estimator(self, estimator: ValueEstimatorBase) -> None:
        if isinstance(estimator, GAE):
            raise ValueError(
                "estimator must estimate the value of an action, as CostTD0 does, got "
                f"{type(estimator).__name__}."
            )

    def _cost_estimator_keys(self) -> dict[str, NestedKey]:
        return {
            "value": self.tensor_keys.state_action_cost_value,
            "reward": self.tensor_keys.cost,
            "done": self.tensor_keys.done,
            "terminated": self.tensor_keys.terminated,
        }

    def _ensemble(
        self,
        network: TensorDictModule,
        inputs: TensorDictBase,
        params: TensorDictParams,
        copies: int | None = None,
    ) -> TensorDictBase:
        """What the N critics of an ensemble write, shape ``(N, *B)``.

        With ``copies`` each critic gets its own copy of the input. The values are the same up to
        rounding.
        """

        def evaluate(data: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
            with params.to_module(network, preserve_module_state=False):
                return network(data)

        if self.deactivate_vmap:
            return torch.stack([evaluate(inputs.copy(), each) for each in params.unbind(0)])
        if copies is not None:
            inputs = inputs.expand(copies, *inputs.batch_size)
        dims = (None if copies is None else 0, 0)
        return torch.vmap(evaluate, dims, randomness=self.vmap_randomness)(inputs, params)

    def _reduced(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mean, sum or each, over the steps that count, by their weight in the buffer."""
        weights = None
        if self.use_prioritized_weights in (True, "auto"):
            weights = tensordict.get(self.tensor_keys.priority_weight, None)
        # TorchRL's, for its weighted means; no public function has them.
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)

    def _cost_qvalue(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Values of the N critics for the k costs, shape ``(N, *B, k)``."""
        inputs = tensordict.select(*self._cost_qvalue_in_keys, strict=False)
        key = self.tensor_keys.state_action_cost_value
        value = self._ensemble(self.cost_qvalue_network, inputs, params).get(key, None)
        if value is None:
            raise KeyError(f"cost_qvalue_network does not write the key {key!r}.")
        expected = (*tensordict.batch_size, self.num_costs)
        if value.shape[1:] != expected:
            raise ValueError(
                f"cost_qvalue_network must write {key!r} of shape {expected}, one column for each "
                f"cost, got {tuple(value.shape[1:])}."
            )
        return value

    def penalized_objective(self, objective: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mixes the actor's objective with the costs that it is predicted to cause.

        Args:
            objective (Tensor): what the actor maximizes without costs, shape ``(*B,)``.
            tensordict (TensorDictBase): inputs of the cost critics with the actor's action.

        Returns:
            :func:`~torchrl_safe.objectives.penalized_advantage` of the objective and the largest
            predictions for each cost, shape ``(*B,)``. The critics get no gradient.
        """
        cost = self._cost_qvalue(tensordict, self.cost_qvalue_network_params.detach()).max(0)[0]
        mixed = penalized_advantage(objective.unsqueeze(-1), cost, self.lagrange_multiplier)
        return mixed.squeeze(-1)

    def cost_qvalue_loss(self, tensordict: TensorDictBase) -> Tensor:
        """Loss of the cost critics, summed over the ensemble and over the costs.

        Args:
            tensordict (TensorDictBase): data with the next action under ``"next"``.

        Returns:
            The loss, reduced.
        """
        keys = self.tensor_keys
        with torch.no_grad():
            next_value = self._cost_qvalue(
                tensordict.get("next"), self.target_cost_qvalue_network_params
            ).max(0)[0]
            data = tensordict.clone(False)
            data.set(unravel_key(("next", keys.state_action_cost_value)), next_value)
            target = self.cost_value_estimator.value_estimate(data)
        value = self._cost_qvalue(tensordict, self.cost_qvalue_network_params)
        loss = distance_loss(value, target.expand_as(value), loss_function=self.loss_function)
        # Summed, not averaged: each critic column then learns as fast with k costs as with one.
        loss = loss.sum(-1).sum(0)
        return self._reduced(loss, tensordict)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        cost_key = unravel_key(("next", self.tensor_keys.cost))
        cost = get_or_raise(tensordict, cost_key)
        expected = (*tensordict.batch_size, self.num_costs)
        if cost.shape != expected:
            raise ValueError(
                f"{cost_key!r} must have shape {expected}, one column for each cost, got "
                f"{tuple(cost.shape)}."
            )
        check_terminated(tensordict, self.tensor_keys.done, self.tensor_keys.terminated)
        # value_loss leaves the next action in the clone; the priority belongs to the caller.
        data = tensordict.clone(False)
        losses = self.parent_forward(self, data)
        tensordict.set(self.tensor_keys.priority, data.get(self.tensor_keys.priority))
        losses.set("loss_cost_qvalue", self.cost_qvalue_loss(data))
        self._report_multipliers(losses)
        return losses

    def _report_multipliers(self, losses: TensorDictBase) -> None:
        report_each(losses, "lagrange_multiplier", self.lagrange_multiplier)

    def _own_out_keys(self) -> list[NestedKey]:
        return ["loss_cost_qvalue", *(f"lagrange_multiplier_{i}" for i in range(self.num_costs))]

    def _own_in_keys(self) -> list[NestedKey]:
        keys = self._cost_qvalue_in_keys
        actions = self.tensor_keys.action
        actions = [_as_tuple(key) for key in (actions if isinstance(actions, list) else [actions])]
        observed = [key for key in keys if not any(_as_tuple(key)[: len(a)] == a for a in actions)]
        following = [unravel_key(("next", key)) for key in observed]
        return [*keys, *following, unravel_key(("next", self.tensor_keys.cost))]


def _as_list(
    network: TensorDictModuleBase | Sequence[TensorDictModuleBase],
) -> list[TensorDictModuleBase] | None:
    if isinstance(network, TensorDictModuleBase):
        return None
    networks = list(network) if isinstance(network, Iterable) else [network]
    for each in networks:
        check_kind("cost_qvalue_network", each, TensorDictModuleBase)
    return networks


def _as_tuple(key: NestedKey) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)
