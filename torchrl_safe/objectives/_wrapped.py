"""An advantage loss of any kind, made constrained by changing the advantage it is given."""

from __future__ import annotations

import abc
from dataclasses import fields
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import A2CLoss, LossModule, PPOLoss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives._cost_critic import CostKeys

_COST_KEYS = frozenset(field.name for field in fields(CostKeys))


class WrappedLoss(LossModule):
    """Holds an advantage loss and gives it the advantage that :meth:`_mix` makes.

    It stands behind a :class:`CostCriticMixin` among the bases, in the place of a parent. Keys,
    options and networks are those of the loss that it holds, and are set here. Target networks are
    in the loss that it holds: ``SoftUpdate(loss.loss_module)``.
    """

    # Whole-batch standardization as PPO has it, for losses that have none.
    normalize_advantage_exclude_dims = ()
    _standardize_advantage = PPOLoss._standardize_advantage
    _out_keys: list[NestedKey] | None = None

    def __init__(self, loss_module: LossModule, *, separate_losses: bool = False) -> None:
        _check_wrapped(loss_module)
        if not isinstance(separate_losses, bool):
            raise TypeError(f"separate_losses must be a bool, got {separate_losses!r}.")
        super().__init__()
        self._in_keys: list[NestedKey] = []
        self.loss_module = loss_module
        self.separate_losses = separate_losses

    @abc.abstractmethod
    def _mix(self, advantage: Tensor, cost_advantage: Tensor) -> Tensor:
        """The advantage to maximize, of shape ``(*B, 1)``."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        key = self.loss_module.tensor_keys.advantage
        if tensordict.get(key, None) is None:
            self._estimate_advantage(tensordict)
        mixed = self._mix(tensordict.get(key), tensordict.get(self.tensor_keys.cost_advantage))
        return self.loss_module(tensordict.clone(False).set(key, mixed))

    def __setattr__(self, name: str, value: Any) -> None:
        # A coefficient of the wrapped loss, as schedules set it.
        modules = self.__dict__.get("_modules", {})
        inner = modules.get("loss_module")
        if inner is not None and name in type(inner)._all_schedulable_buffers:
            setattr(inner, name, value)
        else:
            super().__setattr__(name, value)

    @property
    def value_estimator(self) -> ValueEstimatorBase:
        """The value estimator of the reward."""
        return self.loss_module.value_estimator

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> WrappedLoss:
        """Chooses the value estimator of the reward: the wrapped loss's method."""
        self.loss_module.make_value_estimator(value_type, **hyperparams)
        return self

    @property
    def functional(self) -> bool:
        """Whether the wrapped loss is functional."""
        return self.loss_module.functional

    @property
    def actor_network(self) -> ProbabilisticTensorDictSequential:
        """The policy of the wrapped loss."""
        return self.loss_module.actor_network

    @property
    def actor_network_params(self) -> TensorDictParams:
        """The parameters of the wrapped loss's policy."""
        return self.loss_module.actor_network_params

    @property
    def critic_network(self) -> TensorDictModule:
        """The critic of the wrapped loss."""
        return self.loss_module.critic_network

    @property
    def critic_network_params(self) -> TensorDictParams:
        """The parameters of the wrapped loss's critic."""
        return self.loss_module.critic_network_params

    @property
    def target_critic_network_params(self) -> TensorDictParams:
        """The target parameters of the wrapped loss's critic."""
        return self.loss_module.target_critic_network_params

    @property
    def reduction(self) -> str:
        """The reduction of the wrapped loss."""
        return self.loss_module.reduction

    @property
    def clip_value(self) -> Tensor | None:
        """The range of value clipping of the wrapped loss."""
        return self.loss_module.clip_value

    @property
    def loss_critic_type(self) -> str:
        """The distance that the wrapped loss trains its critic with."""
        return self.loss_module.loss_critic_type

    @property
    def loss_mask_key(self) -> NestedKey | Literal["auto"] | None:
        """Which entry of the data marks what counts, in the wrapped loss and here."""
        return self.loss_module.loss_mask_key

    @loss_mask_key.setter
    def loss_mask_key(self, value: NestedKey | Literal["auto"] | None) -> None:
        self.loss_module.loss_mask_key = value

    def _loss_mask_keys(self) -> tuple[NestedKey, ...]:
        return self.loss_module._loss_mask_keys()

    def reset_parameters_recursive(self) -> None:
        """Reset the parameters of the module."""
        super().reset_parameters_recursive()
        self.loss_module.reset_parameters_recursive()

    @property
    def tensor_keys(self) -> _BothKeys:
        """The keys of the wrapped loss and those of the costs."""
        return _BothKeys(self._tensor_keys, self.loss_module.tensor_keys)

    def set_keys(self, **kwargs: Any) -> None:
        """Sets keys of the costs here, and all others in the wrapped loss."""
        self.loss_module.set_keys(**{k: v for k, v in kwargs.items() if k not in _COST_KEYS})
        for name in _COST_KEYS & kwargs.keys():
            key = kwargs[name]
            setattr(self._tensor_keys, name, getattr(CostKeys(), name) if key is None else key)
        self._forward_value_estimator_keys()

    def _set_in_keys(self) -> None:
        self._in_keys = [unravel_key(key) for key in self.loss_module.in_keys]

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        self._set_in_keys()

    @property
    def in_keys(self) -> list[NestedKey]:
        if not self._in_keys:
            self._set_in_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[NestedKey]:
        return self.loss_module.out_keys


class _BothKeys:
    # A view, so that it follows whoever sets a key.
    def __init__(self, costs: CostKeys, wrapped: Any) -> None:
        self.__dict__.update(_costs=costs, _wrapped=wrapped)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # Asked by copy of a view that has nothing yet.
            raise AttributeError(name)
        return getattr(self._costs if name in _COST_KEYS else self._wrapped, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._costs if name in _COST_KEYS else self._wrapped, name, value)


def _check_wrapped(loss_module: LossModule) -> None:
    if not isinstance(loss_module, LossModule):
        raise ValueError(f"loss_module must be a LossModule, got {type(loss_module)}.")
    if "advantage" not in type(loss_module)._AcceptedKeys.__dataclass_fields__:
        raise ValueError(
            f"loss_module must be a loss that reads an advantage, got {type(loss_module).__name__}."
        )
    # Both act on the advantage that the loss is given, which is the mixture: a multiplier would
    # mean something else in each minibatch.
    if isinstance(loss_module, PPOLoss) and loss_module.normalize_advantage:
        raise ValueError(
            "loss_module must not have normalize_advantage=True: call estimate_advantages, which "
            "standardizes the reward advantage over the whole batch."
        )
    if isinstance(loss_module, PPOLoss | A2CLoss) and loss_module.advantage_norm is not None:
        raise ValueError(
            f"loss_module must not have an advantage_norm, got {loss_module.advantage_norm}: call "
            "estimate_advantages, which standardizes the reward advantage over the whole batch."
        )
