"""What a constrained on-policy loss needs beside its parent: a critic of the costs."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _clip_value_loss, _get_default_device, distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_count
from torchrl_safe.objectives._checks import check_number
from torchrl_safe.objectives.cost_gae import CostGAE, centred

Self = TypeVar("Self", bound="CostCriticMixin")


@dataclass
class CostKeys:
    """The keys of the costs, to stand before a parent's own ``_AcceptedKeys``."""

    cost: NestedKey = "cost"
    cost_value: NestedKey = "cost_value"
    cost_advantage: NestedKey = "cost_advantage"
    cost_value_target: NestedKey = "cost_value_target"


class CostCriticMixin(LossModule):
    """Adds a critic of k costs, its advantages and its loss to an on-policy loss.

    It stands before a TorchRL loss among the bases, whose constructor gets all arguments but
    ``cost_critic_network``, ``num_costs`` and ``cost_critic_coeff``. The final class declares
    ``_AcceptedKeys(CostKeys, Parent._AcceptedKeys)`` and ``default_keys``. Of the parent are
    read ``actor_network``, ``functional``, ``separate_losses``, ``clip_value``,
    ``loss_critic_type`` and, where it has that option, ``log_explained_variance``.
    """

    log_explained_variance = True

    _schedulable_buffers = frozenset({"cost_critic_coeff"})

    cost_critic_network: TensorDictModule
    cost_critic_network_params: TensorDictParams
    target_cost_critic_network_params: TensorDictParams
    cost_critic_coeff: Tensor
    _out_keys: list[NestedKey] | None

    def __init__(
        self,
        *args: Any,
        cost_critic_network: TensorDictModuleBase,
        num_costs: int = 1,
        cost_critic_coeff: float = 1.0,
        device: torch.device | None = None,
        **kwargs: Any,
    ) -> None:
        check_count(num_costs=num_costs)
        cost_critic_coeff = check_number("cost_critic_coeff", cost_critic_coeff)
        # The parent's constructor already asks for in_keys, before a module can be assigned.
        self._cost_critic_in_keys = list(cost_critic_network.in_keys)
        self._cost_value_estimator: ValueEstimatorBase | None = None
        if device is not None:
            kwargs["device"] = device
        super().__init__(*args, **kwargs)
        self.num_costs = num_costs
        if self.functional:
            policy = list(self.actor_network.parameters()) if self.separate_losses else None
            self.convert_to_functional(
                cost_critic_network, "cost_critic_network", compare_against=policy
            )
        else:
            self.cost_critic_network = cost_critic_network
            self.cost_critic_network_params = None
            self.target_cost_critic_network_params = None
        device = _get_default_device(self) if device is None else device
        self.register_coeff_buffer("cost_critic_coeff", cost_critic_coeff, device=device)
        self.register_state_dict_pre_hook(build_value_estimators)
        self.register_load_state_dict_pre_hook(build_value_estimators)

    def make_cost_value_estimator(
        self: Self, estimator: ValueEstimatorBase | None = None, **hyperparams: Any
    ) -> Self:
        """Chooses the value estimator of the costs.

        Args:
            estimator (ValueEstimatorBase, optional): an estimator that handles k columns.
                Defaults to a :class:`~torchrl_safe.objectives.CostGAE`.
            **hyperparams: arguments of ``CostGAE``, for example ``gamma`` (default ``0.99``)
                and ``lmbda`` (default ``0.95``). They act on the costs alone; the reward's are
                those of :meth:`make_value_estimator`.

        Returns:
            The loss itself.

        Raises:
            TypeError: if ``estimator`` is no estimator.
            ValueError: if both an estimator and hyperparameters are given.
        """
        if not isinstance(estimator, ValueEstimatorBase | None):
            raise TypeError(f"estimator must be a ValueEstimatorBase, got {estimator!r}.")
        if estimator is None:
            device = self.cost_critic_coeff.device
            hyperparams = {"gamma": 0.99, "lmbda": 0.95, "device": device, **hyperparams}
            estimator = CostGAE(value_network=self.cost_critic_network, **hyperparams)
        elif hyperparams:
            raise ValueError(
                f"Pass an estimator or hyperparameters, not both: got {estimator} and "
                f"{sorted(hyperparams)}."
            )
        self._check_cost_value_estimator(estimator)
        self._cost_value_estimator = estimator
        self._forward_value_estimator_keys()
        return self

    def _check_cost_value_estimator(self, estimator: ValueEstimatorBase) -> None:
        """Raises ValueError if the loss cannot use it; any that handles k columns will do."""

    @property
    def cost_value_estimator(self) -> ValueEstimatorBase:
        """The value estimator of the costs."""
        if self._cost_value_estimator is None:
            self.make_cost_value_estimator()
        return self._cost_value_estimator

    @torch.no_grad()
    def estimate_advantages(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes advantages and value targets of reward and costs, for a whole batch.

        The reward advantage is standardized to mean 0 and standard deviation 1, the cost
        advantages are centred only, all over the whole batch. Steps that the loss leaves out, as
        those that pad a trajectory (``("collector", "mask")``), do not count.

        Args:
            tensordict (TensorDictBase): a batch as collectors return it, shape ``(*B, T)``.

        Returns:
            The same tensordict with the keys ``advantage``, ``value_target``,
            ``cost_advantage`` and ``cost_value_target`` added (and both critics' values).

        Raises:
            KeyError: if the batch has no cost.
        """
        with set_recurrent_mode(True):  # As TorchRL has it around a loss.
            self._estimate_advantage(tensordict)
            advantage = tensordict.get(self.tensor_keys.advantage)
            if advantage.numel() > 1:
                # Where TorchRL's looks for what counts.
                counted = tensordict.select()
                if (mask := self._mask(tensordict, advantage)) is not None:
                    counted.set("shifted_valid", mask)
                advantage = self._standardize_advantage(advantage, counted)
            tensordict.set(self.tensor_keys.advantage, advantage)
            return self._estimate_cost_advantage(tensordict)

    def _mask(self, tensordict: TensorDictBase, values: Tensor) -> Tensor | None:
        """The steps that the loss counts, expanded to the values, or None if all."""
        found = (tensordict.get(key, None) for key in self._loss_mask_keys())
        masks = [self._expand_loss_mask(mask, values) for mask in found if mask is not None]
        return torch.stack(masks).all(0) if masks else None

    def _estimate_advantage(self, tensordict: TensorDictBase) -> None:
        self.value_estimator(
            tensordict,
            params=self.critic_network_params.detach() if self.functional else None,
            target_params=self.target_critic_network_params,
        )

    def _estimate_cost_advantage(self, tensordict: TensorDictBase) -> TensorDictBase:
        key, estimator = unravel_key(("next", self.tensor_keys.cost)), self.cost_value_estimator
        self._check_width(key, get_or_raise(tensordict, key))
        tensordict = estimator(
            tensordict,
            params=self.cost_critic_network_params.detach() if self.functional else None,
            target_params=self.target_cost_critic_network_params,
        )
        advantage = tensordict.get(self.tensor_keys.cost_advantage)
        mask = self._mask(tensordict, advantage)
        if mask is not None and isinstance(estimator, CostGAE) and estimator.average_gae:
            tensordict.set(self.tensor_keys.cost_advantage, centred(advantage, mask))
        return tensordict

    def _check_width(self, key: NestedKey, values: Tensor) -> None:
        if values.shape[-1] != self.num_costs:
            raise ValueError(
                f"{key!r} must have one column for each of the {self.num_costs} costs of "
                f"num_costs, got shape {tuple(values.shape)}."
            )

    def loss_cost_critic(
        self, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Loss of the cost critic, summed over the costs.

        Args:
            tensordict (TensorDictBase): data with the cost critic's inputs and
                ``cost_value_target``.

        Returns:
            The loss times ``cost_critic_coeff``, shape ``(*B, 1)``; the clipped fraction of the
            values (``None`` without ``clip_value``); the explained variance, shape ``(k,)``
            (``None`` without ``log_explained_variance``).
        """
        if self.separate_losses:
            tensordict = tensordict.detach()
        key = self.tensor_keys.cost_value_target
        target = get_or_raise(tensordict, key)
        self._check_width(key, target)
        old_value = None
        if self.clip_value:
            old_value = get_or_raise(tensordict, self.tensor_keys.cost_value)
        with (
            self.cost_critic_network_params.to_module(
                self.cost_critic_network, preserve_module_state=False
            )
            if self.functional
            else contextlib.nullcontext()
        ):
            # Of what it reads alone: a value that the data hold is not what it writes.
            data = tensordict.select(*self._cost_critic_in_keys, strict=False)
            value = get_or_raise(self.cost_critic_network(data), self.tensor_keys.cost_value)
        self._check_width(self.tensor_keys.cost_value, value)
        loss = distance_loss(target, value, loss_function=self.loss_critic_type)
        clip_fraction = None
        if old_value is not None:
            loss, clip_fraction = _clip_value_loss(
                old_value, value, self.clip_value, target, loss, self.loss_critic_type
            )
        explained_variance = None
        if self.log_explained_variance:
            with torch.no_grad():
                flat_target, flat_error = target.flatten(0, -2), (target - value).flatten(0, -2)
                total = flat_target.var(0, correction=0) + torch.finfo(target.dtype).eps
                explained_variance = 1 - flat_error.var(0, correction=0) / total
        # Summed, not averaged: each critic column then learns as fast with k costs as with one.
        loss = self.cost_critic_coeff * loss.sum(-1, keepdim=True)
        return loss, clip_fraction, explained_variance

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = tensordict.clone(False)
        if not self._has_advantages(tensordict):
            self._estimate_cost_advantage(tensordict)
        losses = super().forward(tensordict)
        self._set_cost_outputs(losses, tensordict)
        self._clear_weakrefs(
            tensordict,
            losses,
            "cost_critic_network_params",
            "target_cost_critic_network_params",
        )
        return losses

    def _has_advantages(self, tensordict: TensorDictBase) -> bool:
        """Whether both are there. One alone would be joined by one of shuffled steps."""
        keys = (self.tensor_keys.advantage, self.tensor_keys.cost_advantage)
        missing = [key for key in keys if tensordict.get(key, None) is None]
        if len(missing) == 1:
            raise KeyError(
                f"The key {missing[0]!r} was not found in the input tensordict, which has only the "
                "other advantage: call estimate_advantages on the whole batch."
            )
        return not missing

    def _set_cost_outputs(self, losses: TensorDictBase, tensordict: TensorDictBase) -> None:
        """Adds to the parent's outputs; a loss with more of them extends this and the next."""
        loss, clip_fraction, explained_variance = self.loss_cost_critic(tensordict)
        losses.set("loss_cost_critic", self._reduce_loss(loss, tensordict).squeeze(-1))
        if explained_variance is not None:
            losses.set("cost_explained_variance", explained_variance.mean())
        if clip_fraction is not None:
            losses.set("cost_value_clip_fraction", clip_fraction)

    def _cost_out_keys(self) -> list[NestedKey]:
        keys: list[NestedKey] = ["loss_cost_critic"]
        if self.log_explained_variance:
            keys.append("cost_explained_variance")
        if self.clip_value:
            keys.append("cost_value_clip_fraction")
        return keys

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        keys = self._cost_critic_in_keys
        keys = [*keys, *(unravel_key(("next", key)) for key in keys)]
        keys.append(unravel_key(("next", self.tensor_keys.cost)))
        self._in_keys += [key for key in dict.fromkeys(keys) if key not in self._in_keys]

    @property
    def out_keys(self) -> list[NestedKey]:
        if self._out_keys is None:
            # The parent keeps its own list as soon as it is asked for it.
            self._out_keys = [*super().out_keys, *self._cost_out_keys()]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        super()._forward_value_estimator_keys(**kwargs)
        if self._cost_value_estimator is not None:
            self._cost_value_estimator.set_keys(
                advantage=self.tensor_keys.cost_advantage,
                value_target=self.tensor_keys.cost_value_target,
                value=self.tensor_keys.cost_value,
                reward=self.tensor_keys.cost,
                done=self.tensor_keys.done,
                terminated=self.tensor_keys.terminated,
            )


def get_or_raise(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """The entry, or an error that names it."""
    tensor = tensordict.get(key, None)
    if tensor is None:
        raise KeyError(f"The key {key!r} was not found in the input tensordict.")
    return tensor


def report_each(losses: TensorDictBase, name: str, values: Tensor) -> None:
    """Adds an output for each cost, from a buffer of shape ``(k,)``."""
    # Scalars, since trainers and loggers keep no others; cloned, since buffers change in place.
    for index, value in enumerate(values.clone().unbind()):
        losses.set(f"{name}_{index}", value)


def build_value_estimators(loss: CostCriticMixin, *_: Any) -> None:
    # Their buffers are part of the state: a fresh and a used loss then have the same entries.
    _ = loss.value_estimator, loss.cost_value_estimator
