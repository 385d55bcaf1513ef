"""An advantage loss of any kind, held as an object in the place of a parent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule, PPOLoss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_flag
from torchrl_safe.objectives.critics.cost_critic import CostCritic, CostKeys
from torchrl_safe.objectives.on_policy.policies import evaluate, forward_evaluated

_COST_KEYS = frozenset(field.name for field in fields(CostKeys))
# Options that a ConstrainedLoss reads and that not every loss has.
_DEFAULTS: dict[str, Any] = {
    "advantage_norm": None,
    "log_explained_variance": True,
    "normalize_advantage_exclude_dims": (),
}


class WrappedLoss(LossModule):
    """Holds an advantage loss, and gives it the advantage to maximize.

    It stands behind a :class:`ConstrainedLoss` among the bases, in the place of a parent. Its
    attributes are those of the loss that it holds, coefficients and networks too: they are read
    and set there.
    """

    _AcceptedKeys = CostKeys
    default_keys = CostKeys

    # Its own, as that of the cost critic may differ from that of the loss.
    separate_losses = False

    def __init__(self, loss_module: LossModule, *, separate_losses: bool = False) -> None:
        _check_wrapped(loss_module)
        check_flag(separate_losses=separate_losses)
        super().__init__()
        self.loss_module = loss_module
        self.separate_losses = separate_losses
        self._both_keys = _BothKeys(self._AcceptedKeys(), loss_module.tensor_keys)
        # One table for both of who updates target networks, which SoftUpdate writes here and the
        # loss reads there. There is no public one.
        self._has_update_associated = loss_module._has_update_associated

    def unconstrained(self, tensordict: TensorDictBase, advantage: Tensor) -> TensorDictBase:
        """The outputs of the loss that is held, for this advantage of shape ``(*B, 1)``."""
        loss, shared = self.loss_module, self._shared_keys
        tensordict.set(loss.tensor_keys.advantage, advantage)
        if shared and isinstance(loss, PPOLoss):
            policy = evaluate(loss, tensordict, advantage.shape[:-1], shared)
            return forward_evaluated(loss, tensordict.clone(False), policy)
        losses = loss(tensordict.clone(False))
        tensordict.update(self.actor_features(tensordict))
        return losses

    # ---- attributes of the loss that is held

    def __getattr__(self, name: str) -> Any:
        modules = self.__dict__.get("_modules", {})
        own = name in modules or name in self.__dict__.get("_buffers", {})
        if own or "loss_module" not in modules or "cost_critic_network" in name:
            return super().__getattr__(name)
        if name in _DEFAULTS:
            return getattr(modules["loss_module"], name, _DEFAULTS[name])
        return getattr(modules["loss_module"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        inner = self.__dict__.get("_modules", {}).get("loss_module")
        own = name in self.__dict__ or name in self.__dict__.get("_buffers", {})
        # What select_out_keys sets on the wrapper, and deletes from it.
        own = own or name == "_out_keys_apparent"
        if inner is None or own or hasattr(type(self), name) or not hasattr(inner, name):
            super().__setattr__(name, value)
        else:
            setattr(inner, name, value)

    # What LossModule itself has, so that the two above are not asked.

    @property
    def functional(self) -> bool:
        """Whether the wrapped loss is functional."""
        return self.loss_module.functional

    @property
    def value_estimator(self) -> ValueEstimatorBase:
        """The value estimator of the reward."""
        return self.loss_module.value_estimator

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> WrappedLoss:
        """Chooses the value estimator of the reward: the wrapped loss's method."""
        self.loss_module.make_value_estimator(value_type, **hyperparams)
        return self

    @property
    def loss_mask_key(self) -> NestedKey | Literal["auto"] | None:
        """Which entry of the data marks what counts, in the wrapped loss and here."""
        return self.loss_module.loss_mask_key

    @loss_mask_key.setter
    def loss_mask_key(self, value: NestedKey | Literal["auto"] | None) -> None:
        self.loss_module.loss_mask_key = value

    @property
    def deterministic_sampling_mode(self) -> Any:
        """How distributions are sampled in a call of the wrapped loss."""
        return self.loss_module.deterministic_sampling_mode

    @deterministic_sampling_mode.setter
    def deterministic_sampling_mode(self, value: Any) -> None:
        self.loss_module.deterministic_sampling_mode = value

    def reset(self) -> None:
        """Resets the wrapped loss."""
        self.loss_module.reset()

    def reset_parameters_recursive(self) -> None:
        """Reset the parameters of the module."""
        super().reset_parameters_recursive()
        self.loss_module.reset_parameters_recursive()

    def named_children(self) -> Iterator[tuple[str, nn.Module]]:
        """The modules held, and the target networks of the wrapped loss, for ``SoftUpdate``."""
        yield from super().named_children()
        for name, module in self.loss_module.named_children():
            if name.startswith("target_"):
                yield name, module

    # ---- keys

    @property
    def tensor_keys(self) -> _BothKeys:
        """The keys of the wrapped loss and those of the costs."""
        return self._both_keys

    def set_keys(self, **kwargs: Any) -> None:
        """Sets keys of the costs here, and all others in the wrapped loss.

        Call this, not ``set_keys`` of the wrapped loss: the cost critic would keep the old keys.
        """
        self.loss_module.set_keys(**{k: v for k, v in kwargs.items() if k not in _COST_KEYS})
        for name in _COST_KEYS & kwargs.keys():
            key = kwargs[name]
            setattr(self.tensor_keys, name, getattr(CostKeys(), name) if key is None else key)

    @property
    def in_keys(self) -> list[NestedKey]:
        return [unravel_key(key) for key in self.loss_module.in_keys]

    @property
    def out_keys(self) -> list[NestedKey]:
        return self.loss_module.out_keys


class _BothKeys:
    # A view of both: the keys of the wrapped loss are in one place.
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
    if isinstance(loss_module, CostCritic):
        raise ValueError(
            f"loss_module must be a loss without costs, got {type(loss_module).__name__}."
        )
    keys = type(loss_module)._AcceptedKeys.__dataclass_fields__
    # GRPOLoss has the key, and no critic; a loss of yours need not be a subclass of those that do.
    if "advantage" not in keys or not hasattr(loss_module, "critic_network"):
        raise ValueError(
            "loss_module must be a loss that reads an advantage, and has a critic to estimate it, "
            f"got {type(loss_module).__name__}."
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
