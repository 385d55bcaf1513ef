"""PPO with Lagrange multipliers for the costs."""

from __future__ import annotations

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
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.utils import _clip_value_loss, distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives.cost_gae import CostGAE
from torchrl_safe.objectives.functional import penalized_advantage


class PPOLagrangianLoss(ClipPPOLoss):
    r"""Clipped PPO loss under constraints on k expected costs.

    Presented in "Benchmarking Safe Exploration in Deep Reinforcement Learning", Ray, Achiam,
    Amodei 2019. The clipped surrogate of PPO is maximized on the mixed advantage

    .. math::
        A = \frac{A_r - \sum_i \lambda_i A_{c_i}}{1 + \sum_i \lambda_i}

    This class is a thin specialization of :class:`~torchrl.objectives.ClipPPOLoss`, whose
    arguments, keys and outputs it keeps; with every multiplier at zero its outputs and
    gradients are those of ``ClipPPOLoss``, bit for bit. The differences are:

    - a second critic predicts the k costs; its loss is ``"loss_cost_critic"``;
    - ``lagrange_multiplier`` is a buffer of shape ``(k,)``. No optimizer and no forward changes
      it: a :class:`~torchrl_safe.objectives.MultiplierUpdater` does, in place, once for each
      collected batch;
    - :meth:`estimate_advantages` computes both advantages for a whole batch. Call it before
      the batch is cut into minibatches, so that a multiplier means the same in each of them.

    Args:
        actor_network (ProbabilisticTensorDictSequential): policy operator.
        critic_network (TensorDictModule): value operator of the reward, writes
            ``"state_value"`` of shape ``(*B, 1)``.
        cost_critic_network (TensorDictModule): value operator of the costs, writes
            ``"cost_value"`` of shape ``(*B, k)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``1``.
        multiplier_init (float or Tensor, optional): multiplier to start with, one number or k.
            Defaults to ``0.0``.
        cost_critic_coeff (float, optional): weight of the cost critic's loss.
            Defaults to ``1.0``.
        **kwargs: every keyword argument of :class:`~torchrl.objectives.ClipPPOLoss`.

    Raises:
        ValueError: if ``num_costs`` or ``multiplier_init`` is not usable; in a call, if the cost
            critic or the costs have another width than ``num_costs``.

    Keys beside those of ``ClipPPOLoss``, all of shape ``(*B, k)``: ``cost`` (read under
    ``"next"``), ``cost_value``, ``cost_advantage``, ``cost_value_target``.

    Outputs beside those of ``ClipPPOLoss``: ``loss_cost_critic``, ``cost_explained_variance``
    (mean over the costs) and ``lagrange_multiplier_0`` ... ``lagrange_multiplier_{k-1}``, and
    with ``clip_value`` also ``cost_value_clip_fraction``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
        >>> policy = torch.nn.Sequential(torch.nn.Linear(4, 4), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=TanhNormal,
        ...     return_log_prob=True,
        ... )
        >>> critic = ValueOperator(torch.nn.Linear(4, 1), in_keys=["observation"])
        >>> cost_critic = ValueOperator(
        ...     torch.nn.Linear(4, 2), in_keys=["observation"], out_keys=["cost_value"]
        ... )
        >>> loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, entropy_bonus=False)
        >>> done = torch.zeros(3, 5, 1, dtype=torch.bool)
        >>> data = TensorDict(observation=torch.randn(3, 5, 4), batch_size=[3, 5])
        >>> with torch.no_grad():
        ...     data = actor(data)
        >>> data["next"] = TensorDict(
        ...     observation=torch.randn(3, 5, 4),
        ...     reward=torch.randn(3, 5, 1),
        ...     cost=torch.rand(3, 5, 2),
        ...     done=done,
        ...     terminated=done,
        ...     batch_size=[3, 5],
        ... )
        >>> losses = loss(loss.estimate_advantages(data).reshape(-1))
        >>> sorted(key for key in losses.keys() if key.startswith("loss_"))
        ['loss_cost_critic', 'loss_critic', 'loss_objective']
    """

    @dataclass
    class _AcceptedKeys(ClipPPOLoss._AcceptedKeys):
        cost: NestedKey = "cost"
        cost_value: NestedKey = "cost_value"
        cost_advantage: NestedKey = "cost_advantage"
        cost_value_target: NestedKey = "cost_value_target"

    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"cost_critic_coeff", "lagrange_multiplier"})

    cost_critic_network: TensorDictModule
    cost_critic_network_params: TensorDictParams
    target_cost_critic_network_params: TensorDictParams
    lagrange_multiplier: Tensor
    cost_critic_coeff: Tensor
    _out_keys: list[NestedKey] | None

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
        multiplier = _initial_multiplier(num_costs, multiplier_init)
        # The parent's constructor already asks for in_keys, before a module can be assigned.
        self._cost_critic_in_keys = list(cost_critic_network.in_keys)
        self._cost_value_estimator: ValueEstimatorBase | None = None
        super().__init__(actor_network, critic_network, **kwargs)
        if self.functional:
            self.convert_to_functional(
                cost_critic_network,
                "cost_critic_network",
                compare_against=list(actor_network.parameters()) if self.separate_losses else None,
            )
        else:
            self.cost_critic_network = cost_critic_network
            self.cost_critic_network_params = None
            self.target_cost_critic_network_params = None
        device = self.entropy_coeff.device
        self.register_buffer("lagrange_multiplier", multiplier.to(device))
        self.register_coeff_buffer("cost_critic_coeff", cost_critic_coeff, device=device)
        self.register_state_dict_pre_hook(_build_value_estimators)
        self.register_load_state_dict_pre_hook(_build_value_estimators)

    def make_cost_value_estimator(
        self, estimator: ValueEstimatorBase | None = None, **hyperparams: Any
    ) -> PPOLagrangianLoss:
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
            device = self.lagrange_multiplier.device
            hyperparams = {"gamma": 0.99, "lmbda": 0.95, "device": device, **hyperparams}
            estimator = CostGAE(value_network=self.cost_critic_network, **hyperparams)
        elif hyperparams:
            raise ValueError(
                f"Pass an estimator or hyperparameters, not both: got {estimator} and "
                f"{sorted(hyperparams)}."
            )
        self._cost_value_estimator = estimator
        self._forward_value_estimator_keys()
        return self

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
        advantages are centred only, all over the whole batch.

        Args:
            tensordict (TensorDictBase): a batch as collectors return it, shape ``(*B, T)``.

        Returns:
            The same tensordict with the keys ``advantage``, ``value_target``,
            ``cost_advantage`` and ``cost_value_target`` added (and both critics' values).

        Raises:
            KeyError: if the batch has no cost.
        """
        self.value_estimator(
            tensordict,
            params=self._cached_critic_network_params_detached,
            target_params=self.target_critic_network_params,
        )
        advantage = tensordict.get(self.tensor_keys.advantage)
        if advantage.numel() > 1:
            advantage = self._standardize_advantage(advantage, tensordict)
        tensordict.set(self.tensor_keys.advantage, advantage)
        return self._estimate_cost_advantage(tensordict)

    def _estimate_cost_advantage(self, tensordict: TensorDictBase) -> TensorDictBase:
        _get_or_raise(tensordict, unravel_key(("next", self.tensor_keys.cost)))
        params = self.cost_critic_network_params
        return self.cost_value_estimator(
            tensordict,
            params=params.detach() if self.functional else None,
            target_params=self.target_cost_critic_network_params,
        )

    def _maybe_normalize_advantage(
        self, advantage: Tensor, tensordict: TensorDictBase, *, update_norm: bool
    ) -> Tensor:
        # Mixed after the parent's options have acted on the reward advantage, and nowhere else.
        advantage = super()._maybe_normalize_advantage(
            advantage, tensordict, update_norm=update_norm
        )
        cost_advantage = tensordict.get(self.tensor_keys.cost_advantage)
        return penalized_advantage(advantage, cost_advantage, self.lagrange_multiplier)

    def loss_cost_critic(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor | None, Tensor]:
        """Loss of the cost critic, summed over the costs.

        Args:
            tensordict (TensorDictBase): data with the cost critic's inputs and
                ``cost_value_target``.

        Returns:
            The loss times ``cost_critic_coeff``, shape ``(*B, 1)``; the clipped fraction of the
            values (``None`` without ``clip_value``); the explained variance, shape ``(k,)``.
        """
        if self.separate_losses:
            tensordict = tensordict.detach()
        target = _get_or_raise(tensordict, self.tensor_keys.cost_value_target)
        old_value = None
        if self.clip_value:
            old_value = _get_or_raise(tensordict, self.tensor_keys.cost_value)
        with (
            self.cost_critic_network_params.to_module(
                self.cost_critic_network, preserve_module_state=False
            )
            if self.functional
            else contextlib.nullcontext()
        ):
            value = self.cost_critic_network(tensordict).get(self.tensor_keys.cost_value)
        loss = distance_loss(target, value, loss_function=self.loss_critic_type)
        clip_fraction = None
        if old_value is not None:
            loss, clip_fraction = _clip_value_loss(
                old_value, value, self.clip_value, target, loss, self.loss_critic_type
            )
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
        if tensordict.get(self.tensor_keys.cost_advantage, None) is None:
            self._estimate_cost_advantage(tensordict)
        losses = super().forward(tensordict)
        loss, clip_fraction, explained_variance = self.loss_cost_critic(tensordict)
        losses.set("loss_cost_critic", self._reduce_loss(loss, tensordict).squeeze(-1))
        losses.set("cost_explained_variance", explained_variance.mean())
        if clip_fraction is not None:
            losses.set("cost_value_clip_fraction", clip_fraction)
        # One scalar for each cost, since trainers and loggers keep scalars only; cloned, since
        # the buffer changes in place.
        for index, multiplier in enumerate(self.lagrange_multiplier.clone().unbind()):
            losses.set(f"lagrange_multiplier_{index}", multiplier)
        self._clear_weakrefs(
            tensordict,
            losses,
            "cost_critic_network_params",
            "target_cost_critic_network_params",
        )
        return losses

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        keys = self._cost_critic_in_keys
        keys = [*keys, *(unravel_key(("next", key)) for key in keys)]
        keys.append(unravel_key(("next", self.tensor_keys.cost)))
        self._in_keys += [key for key in dict.fromkeys(keys) if key not in self._in_keys]

    @property
    def out_keys(self) -> list[NestedKey]:
        if self._out_keys is None:
            keys = [*ClipPPOLoss.out_keys.fget(self), "loss_cost_critic", "cost_explained_variance"]
            if self.clip_value:
                keys.append("cost_value_clip_fraction")
            keys += [f"lagrange_multiplier_{i}" for i in range(len(self.lagrange_multiplier))]
            self._out_keys = keys
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


def _build_value_estimators(loss: PPOLagrangianLoss, *_: Any) -> None:
    # Their buffers are part of the state: a fresh and a used loss then have the same entries.
    _ = loss.value_estimator, loss.cost_value_estimator


def _get_or_raise(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    tensor = tensordict.get(key, None)
    if tensor is None:
        raise KeyError(f"The key {key!r} was not found in the input tensordict.")
    return tensor


def _initial_multiplier(num_costs: int, multiplier_init: float | Tensor) -> Tensor:
    if num_costs < 1:
        raise ValueError(f"num_costs must be at least 1, got {num_costs}.")
    multiplier = torch.as_tensor(multiplier_init, dtype=torch.get_default_dtype())
    if multiplier.shape not in ((), (num_costs,)):
        raise ValueError(
            f"multiplier_init must be one number or one for each of the {num_costs} costs, got "
            f"shape {tuple(multiplier.shape)}."
        )
    if not (multiplier.isfinite() & (multiplier >= 0)).all():
        raise ValueError(f"multiplier_init must be finite and not negative, got {multiplier_init}.")
    return multiplier.expand(num_costs).clone()
