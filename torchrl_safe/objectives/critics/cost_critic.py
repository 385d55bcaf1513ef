"""A critic of k costs beside an on-policy loss: network, keys, estimator, loss."""

from __future__ import annotations

import abc
import contextlib
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_count, check_kind
from torchrl_safe.objectives._checks import check_number, check_terminated, get_or_raise, uncompiled
from torchrl_safe.objectives._reduction import counted, expanded_mask, reduced, variances
from torchrl_safe.objectives.critics.cost_gae import CostGAE
from torchrl_safe.objectives.critics.cost_values import CostValues
from torchrl_safe.objectives.functional import scaled_advantages


@dataclass
class CostKeys:
    """The keys of the costs, to stand before a parent's own ``_AcceptedKeys``."""

    cost: NestedKey = "cost"
    cost_value: NestedKey = "cost_value"
    cost_advantage: NestedKey = "cost_advantage"
    cost_value_target: NestedKey = "cost_value_target"


class CostCritic(CostValues):
    """Adds a critic of k costs, its advantages and its loss to an on-policy loss of TorchRL.

    It stands before that loss among the bases, whose constructor gets all arguments but
    ``cost_critic_network``, ``num_costs`` and ``cost_critic_coeff``. The class that joins the two
    declares ``_AcceptedKeys(CostKeys, ...)`` and ``default_keys``. It reads the loss's networks,
    ``functional``, ``separate_losses``, ``reduction``, ``clip_value``, ``loss_critic_type``,
    ``log_explained_variance``, ``advantage_norm`` and ``normalize_advantage_exclude_dims``.
    """

    _schedulable_buffers = frozenset({"cost_critic_coeff"})

    cost_critic_network: TensorDictModule
    cost_critic_network_params: TensorDictParams
    target_cost_critic_network_params: TensorDictParams
    cost_critic_coeff: Tensor

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
        check_kind("cost_critic_network", uncompiled(cost_critic_network), TensorDictModuleBase)
        # The parent's constructor already sets keys, before a module can be assigned.
        self._cost_critic_in_keys = list(cost_critic_network.in_keys)
        self._shared_keys: list[NestedKey] = []
        if device is not None:
            kwargs["device"] = device
        super().__init__(*args, **kwargs)
        if self.separate_losses and not self.functional:
            raise ValueError(
                "separate_losses must be False with functional=False, got True: only a functional "
                "loss can leave shared parameters out of a critic's loss."
            )
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
        if device is None:
            device = next((p.device for p in self.parameters()), torch.get_default_device())
        self.register_coeff_buffer("cost_critic_coeff", cost_critic_coeff, device=device)
        self._shared_keys = _written_by_actor(self)
        self._list_in_keys()

    def _default_cost_estimator(self, **hyperparams: Any) -> ValueEstimatorBase:
        device = self.cost_critic_coeff.device
        hyperparams = {"gamma": 0.99, "lmbda": 0.95, "device": device, **hyperparams}
        return CostGAE(value_network=self.cost_critic_network, **hyperparams)

    def _cost_estimator_keys(self) -> dict[str, NestedKey]:
        return {
            "advantage": self.tensor_keys.cost_advantage,
            "value_target": self.tensor_keys.cost_value_target,
            "value": self.tensor_keys.cost_value,
            "reward": self.tensor_keys.cost,
            "done": self.tensor_keys.done,
            "terminated": self.tensor_keys.terminated,
        }

    def estimate_advantages(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes advantages and value targets of reward and costs, for a whole batch.

        It scales them over the whole batch with
        :func:`~torchrl_safe.objectives.scaled_advantages`. The reward advantage is standardized,
        unless the loss has an ``advantage_norm``, which scales it instead (as TorchRL asks, update
        it yourself, once for each batch). The cost advantages are centred and, with
        ``normalize_cost_advantage``, divided by a scale that the loss keeps from call to call.
        Steps that the loss leaves out do not count. Those that pad a trajectory, by
        ``("collector", "mask")``, also end it. What critics read of them must be finite, as the
        zeros of TorchRL's padding are.

        Call it on the batch as it was collected. A call of the loss with data without advantages
        does the same first. Neither can tell whether you have shuffled a dimension of time.

        Args:
            tensordict (TensorDictBase): a batch as collectors return it, shape ``(*B, T)``.

        Returns:
            The same tensordict with the keys ``advantage``, ``value_target``,
            ``cost_advantage`` and ``cost_value_target`` added (and both critics' values).

        Raises:
            KeyError: if the batch has no cost, reward or done, or, where keys were set, no
                termination.
            ValueError: if the cost critic does not write ``cost_value``, ``num_costs`` is not
                the width of the cost, or the batch has one dimension that is not named ``"time"``.
        """
        with set_recurrent_mode(True):  # As TorchRL has it around a loss.
            self._estimate_advantages(tensordict)
        return tensordict

    # With gradients, a call of the loss would train a shared trunk through the value targets.
    @torch.no_grad()
    def _estimate_advantages(self, tensordict: TensorDictBase) -> None:
        keys = self.tensor_keys
        if tensordict.ndim < 2 and "time" not in tensordict.names:
            raise ValueError(
                "The data must have a dimension of time for advantages to be estimated, got "
                f"shape {tuple(tensordict.shape)} without one named 'time'. Call "
                "estimate_advantages on the whole batch before you take minibatches of it. If "
                "these steps are in order, set data.names = ['time']."
            )
        if self.critic_network is None:
            raise ValueError("critic_network must be given to estimate advantages, got None.")
        cost_key = unravel_key(("next", keys.cost))
        self._check_width(cost_key, get_or_raise(tensordict, cost_key))
        for key in (keys.reward, keys.done):  # TorchRL's estimator would not name them.
            get_or_raise(tensordict, unravel_key(("next", key)))
        check_terminated(tensordict, keys.done, keys.terminated)
        written = [unravel_key(key) for key in self.cost_critic_network.out_keys]
        if unravel_key(keys.cost_value) not in written:
            raise ValueError(
                f"cost_critic_network must write {keys.cost_value!r}, got one that writes "
                f"{written}: choose its out_keys, or call loss.set_keys(cost_value=...)."
            )
        time = [
            self._time_of(estimator, tensordict)
            for estimator in (self.value_estimator, self.cost_value_estimator)
        ]
        if time[0] != time[1]:
            raise ValueError(
                f"time_dim must be the same for reward and costs, got {time[0]} and {time[1]}: "
                "pass it to make_value_estimator and make_cost_value_estimator, or name the "
                "dimension 'time'."
            )
        data = self._with_ends(self._with_features(tensordict), time[0])
        self.value_estimator(
            data,
            params=self.critic_network_params.detach() if self.functional else None,
            target_params=self.target_critic_network_params,
        )
        self.cost_value_estimator(
            data,
            params=self.cost_critic_network_params.detach() if self.functional else None,
            target_params=self.target_cost_critic_network_params,
        )
        cost_advantage = data.get(keys.cost_advantage)
        mask = counted(self, data, data.get(keys.advantage))
        advantage, cost_advantage = scaled_advantages(
            data.get(keys.advantage),
            cost_advantage,
            cost_scale=self._next_cost_scale(cost_advantage, mask),
            counted=mask,
            standardize=self.advantage_norm is None,
            exclude_dims=self.normalize_advantage_exclude_dims,
        )
        data.set(keys.advantage, advantage)
        data.set(keys.cost_advantage, cost_advantage)
        if mask is not None:  # NaN that counts for nothing would still reach the gradients.
            targets = keys.value_target, keys.cost_value_target
            for key in (keys.advantage, keys.cost_advantage, *targets):
                values = data.get(key)
                data.set(key, torch.where(expanded_mask(mask, values), values, 0.0))
        if data is not tensordict:
            hidden = [*self._shared_keys, *(unravel_key(("next", k)) for k in self._shared_keys)]
            tensordict.update(data.exclude(*hidden, *self._replaced_keys()))

    @abc.abstractmethod
    def _next_cost_scale(self, cost_advantage: Tensor, mask: Tensor | None) -> Tensor | None:
        """What the cost advantages of this batch are divided by; None if by nothing."""

    def actor_features(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What the critics read of the actor, computed anew; empty if they read nothing of it."""
        if not self._shared_keys:
            return tensordict.empty()
        trunk = self.actor_network.det_part.select_subsequence(out_keys=self._shared_keys)
        with self._with_params(self.actor_network, "actor_network_params"):
            return trunk(tensordict.select(*trunk.in_keys)).select(*self._shared_keys)

    def _with_params(
        self, network: nn.Module, params: str
    ) -> contextlib.AbstractContextManager[Any]:
        """Puts the parameters of that name in: a functional loss keeps its networks without."""
        if not self.functional:
            return contextlib.nullcontext()
        return getattr(self, params).to_module(network, preserve_module_state=False)

    def _with_features(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The batch, with the inputs of critics that are heads of the actor's network."""
        if not self._shared_keys:
            return tensordict
        data = tensordict.clone(False)
        sequence = following = data.get("next")
        starts, starts_next = data.get("is_init", None), following.get("is_init", None)
        if starts is not None and starts_next is not None:
            # To a recurrent network an episode begins in "next" too, as in TorchRL's estimators.
            sequence = following.clone(False).set("is_init", starts | starts_next)
        data.update(self.actor_features(data))
        following.update(self.actor_features(sequence))
        return data

    @staticmethod
    def _time_of(estimator: ValueEstimatorBase, data: TensorDictBase) -> int:
        """The dimension along which an estimator sums."""
        time = getattr(estimator, "time_dim", None)  # Not all of TorchRL's have it.
        if time is None:
            time = data.names.index("time") if "time" in data.names else data.ndim - 1
        return time % data.ndim

    def _with_ends(self, data: TensorDictBase, time: int) -> TensorDictBase:
        """The batch, with trajectories that end where what pads them begins.

        To an estimator the padding would be what followed, and NaN in it would reach all before.
        """
        mask = data.get(("collector", "mask"), None)
        if mask is None or self.loss_mask_key is None:
            return data
        done_key, terminated_key, *sums = self._replaced_keys()
        done = get_or_raise(data, done_key)
        mask = mask.reshape(data.shape).bool()
        last = mask & ~mask.roll(-1, time)
        terminated = data.get(terminated_key, done)  # What estimators take for it.
        data = data.clone(False).set(done_key, done | expanded_mask(last, done))
        for key in sums:
            values = data.get(key)
            data.set(key, torch.where(expanded_mask(mask, values), values, 0))
        return data.set(terminated_key, terminated)

    def _replaced_keys(self) -> list[NestedKey]:
        """What :meth:`_with_ends` replaces, in a copy: the batch keeps its own."""
        keys = self.tensor_keys
        names = keys.done, keys.terminated, keys.reward, keys.cost
        return [unravel_key(("next", key)) for key in names]

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
        with self._with_params(self.cost_critic_network, "cost_critic_network_params"):
            # Give it only what it reads, so that a value in the data is not taken for what it
            # writes.
            data = tensordict.select(*self._cost_critic_in_keys, strict=False)
            value = get_or_raise(self.cost_critic_network(data), self.tensor_keys.cost_value)
        self._check_width(self.tensor_keys.cost_value, value)
        loss = distance_loss(target, value, loss_function=self.loss_critic_type)
        clip_fraction = None
        if old_value is not None:
            moved = value - old_value
            clipped = moved.clamp(-self.clip_value, self.clip_value)
            share = (moved != clipped).to(value.dtype)
            clip_fraction = reduced(self, share, tensordict, reduction="mean")
            loss = torch.maximum(
                loss,
                distance_loss(target, old_value + clipped, loss_function=self.loss_critic_type),
            )
        explained_variance = None
        if self.log_explained_variance:
            with torch.no_grad():
                mask = counted(self, tensordict, target)
                total = variances(target, mask) + torch.finfo(target.dtype).eps
                explained_variance = 1 - variances(target - value, mask) / total
        # Summed, not averaged: each critic column then learns as fast with k costs as with one.
        loss = self.cost_critic_coeff * loss.sum(-1, keepdim=True)
        return loss, clip_fraction, explained_variance

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

    def _set_cost_critic_outputs(self, losses: TensorDictBase, tensordict: TensorDictBase) -> None:
        loss, clip_fraction, explained_variance = self.loss_cost_critic(tensordict)
        losses.set("loss_cost_critic", reduced(self, loss, tensordict).squeeze(-1))
        if explained_variance is not None:
            losses.set("cost_explained_variance", explained_variance.mean())
        if clip_fraction is not None:
            losses.set("cost_value_clip_fraction", clip_fraction)

    def _own_out_keys(self) -> list[NestedKey]:
        keys: list[NestedKey] = ["loss_cost_critic"]
        if self.log_explained_variance:
            keys.append("cost_explained_variance")
        if self.clip_value:
            keys.append("cost_value_clip_fraction")
        return keys

    def _own_in_keys(self) -> list[NestedKey]:
        keys = [key for key in self._cost_critic_in_keys if key not in self._shared_keys]
        keys = [*keys, *(unravel_key(("next", key)) for key in keys)]
        return [*keys, unravel_key(("next", self.tensor_keys.cost))]


def _written_by_actor(loss: LossModule) -> list[NestedKey]:
    """The inputs of the critics that the actor's network computes: the critics are its heads."""
    actor = loss.actor_network
    if not isinstance(actor, ProbabilisticTensorDictSequential):
        return []
    critics = [loss.critic_network, loss.cost_critic_network]
    read = [unravel_key(key) for critic in critics if critic is not None for key in critic.in_keys]
    written = [unravel_key(key) for key in actor.det_part.out_keys]
    return [key for key in dict.fromkeys(read) if key in written]
