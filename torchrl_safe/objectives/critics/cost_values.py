"""What critics of costs share, whether of states or of actions: estimator, keys, state."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.value import ValueEstimatorBase

Self = TypeVar("Self", bound="CostValues")


class CostValues(LossModule):
    """Adds the value estimator of k costs, and the keys of their critic, to a loss of TorchRL.

    It stands before that loss among the bases. A subclass, for one kind of critic, says which
    estimator is the default, by which keys it goes and what the loss reads and returns besides;
    its constructor ends with :meth:`_list_in_keys`.
    """

    parent_forward: ClassVar[Callable[..., TensorDictBase]]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # The next forward after those of ours: TorchRL gives each of our bases one as well.
        # Compiled code cannot ask for it.
        cls.parent_forward = staticmethod(super().forward)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # The parent's constructor already sets keys.
        self._cost_value_estimator: ValueEstimatorBase | None = None
        self._listed_in_keys: list[NestedKey] = []
        self._selected_out_keys: list[NestedKey] | None = None
        super().__init__(*args, **kwargs)
        self.register_state_dict_pre_hook(_build_value_estimators)
        self.register_load_state_dict_pre_hook(_build_value_estimators)
        self.register_load_state_dict_post_hook(_check_loaded_estimator)

    def __setattr__(self, name: str, value: Any) -> None:
        # It would be registered beside the property of that name, and never be used.
        if name in ("value_estimator", "cost_value_estimator") and isinstance(value, nn.Module):
            raise AttributeError(f"{name} cannot be assigned: pass it to make_{name}.")
        super().__setattr__(name, value)

    @abc.abstractmethod
    def _default_cost_estimator(self, **hyperparams: Any) -> ValueEstimatorBase:
        """The estimator that is used unless another is given."""

    @abc.abstractmethod
    def _cost_estimator_keys(self) -> dict[str, NestedKey]:
        """What the estimator calls an entry, and where that entry is."""

    @abc.abstractmethod
    def _own_in_keys(self) -> list[NestedKey]:
        """What is read beside the parent's inputs."""

    @abc.abstractmethod
    def _own_out_keys(self) -> list[NestedKey]:
        """What is returned beside the parent's outputs."""

    def _check_cost_value_estimator(self, estimator: ValueEstimatorBase) -> None:
        """Raises ValueError if the loss cannot use it; any that handles k columns will do."""

    def make_cost_value_estimator(
        self: Self, estimator: ValueEstimatorBase | None = None, **hyperparams: Any
    ) -> Self:
        """Chooses the value estimator of the costs.

        Args:
            estimator (ValueEstimatorBase, optional): an estimator that handles k columns.
                Defaults to a :class:`~torchrl_safe.objectives.CostGAE` for critics of states, a
                :class:`~torchrl_safe.objectives.CostTD0` for critics of actions.
            **hyperparams: arguments of the default estimator, for example ``gamma`` (default
                ``0.99``) and, of ``CostGAE``, ``lmbda`` (default ``0.95``). They act on the costs
                alone; the reward's are those of ``make_value_estimator``.

        Returns:
            The loss itself.

        Raises:
            TypeError: if ``estimator`` is no estimator.
            ValueError: if both an estimator and hyperparameters are given.
        """
        if not isinstance(estimator, ValueEstimatorBase | None):
            raise TypeError(f"estimator must be a ValueEstimatorBase, got {estimator!r}.")
        if estimator is None:
            estimator = self._default_cost_estimator(**hyperparams)
        elif hyperparams:
            raise ValueError(
                f"Pass an estimator or hyperparameters, not both: got {estimator} and "
                f"{sorted(hyperparams)}."
            )
        self._check_cost_value_estimator(estimator)
        self._cost_value_estimator = estimator
        estimator.set_keys(**self._cost_estimator_keys())
        return self

    @property
    def cost_value_estimator(self) -> ValueEstimatorBase:
        """The value estimator of the costs."""
        if self._cost_value_estimator is None:
            self.make_cost_value_estimator()
        return self._cost_value_estimator

    def set_keys(self, **kwargs: Any) -> None:
        """Sets the names of entries, as :meth:`torchrl.objectives.LossModule.set_keys`."""
        super().set_keys(**kwargs)
        self._list_in_keys()
        if self._cost_value_estimator is not None:
            self._cost_value_estimator.set_keys(**self._cost_estimator_keys())

    @property
    def in_keys(self) -> list[NestedKey]:
        # Listed when the keys are set: compiled code reads them at each call.
        return self._listed_in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._listed_in_keys = values

    def _list_in_keys(self) -> None:
        inherited = [unravel_key(key) for key in super().in_keys]
        self._listed_in_keys = list(dict.fromkeys([*inherited, *self._own_in_keys()]))

    @property
    def out_keys(self) -> list[NestedKey]:
        # Listed at each call, since options can be set later.
        if self._selected_out_keys is None:
            return [*super().out_keys, *self._own_out_keys()]
        return self._selected_out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._selected_out_keys = values


def _build_value_estimators(loss: CostValues, *_: Any) -> None:
    # Their buffers are part of the state: a fresh and a used loss then have the same entries.
    _ = loss.value_estimator, loss.cost_value_estimator


def _check_loaded_estimator(loss: CostValues, *_: Any) -> None:
    # Its discount is part of the state, and one of 1 makes NaN where there is no episode_length.
    loss._check_cost_value_estimator(loss.cost_value_estimator)
