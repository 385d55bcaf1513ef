"""Generalized advantage estimation for several costs at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.compiler import is_dynamo_compiling
from torchrl.objectives.value import GAE

from torchrl_safe.objectives._checks import check_number, get_or_raise, refuse_options


class CostGAE(GAE):
    r"""GAE of k costs, each with its own column, sharing one done signal.

    This class is a thin specialization of :class:`~torchrl.objectives.value.GAE`
    (Schulman et al. 2015, https://arxiv.org/abs/1506.02438). The differences are:

    - it reads ``("next", "cost")`` and ``"cost_value"`` and writes ``"cost_advantage"`` and
      ``"cost_value_target"``, all of shape ``(*B, T, k)``; ``done`` and ``terminated`` keep
      their shape ``(*B, T, 1)`` and are broadcast over the k costs;
    - with N agents, whose values have the shape ``(*B, T, N, k)``, cost, ``done`` and
      ``terminated`` may be per agent or shared by all, of shape ``(*B, T, k)`` and
      ``(*B, T, 1)``, as in :class:`~torchrl.objectives.value.MultiAgentGAE`; a shared cost needs
      a shared ``done``;
    - it does not scale the advantages: ``estimate_advantages`` of the losses scales those of reward
      and costs together, with :func:`~torchrl_safe.objectives.scaled_advantages`;
    - ``vectorized`` defaults to ``True``.

    Keyword Args:
        gamma (float): discount of the costs, from 0 to 1.
        lmbda (float): trace decay of the costs, from 0 to 1.
        value_network (TensorDictModule, optional): cost critic with k outputs. Defaults to
            ``None``, which expects ``"cost_value"`` and ``("next", "cost_value")`` in the data.
        vectorized (bool, optional): use the vectorized recursion, unless ``gamma`` or ``lmbda``
            is 0, for which TorchRL's fails. Defaults to ``True``.
        **kwargs: the other arguments of :class:`~torchrl.objectives.value.GAE`, ``average_gae``
            and ``group_key`` excepted.

    Raises:
        ValueError: if ``gamma`` or ``lmbda`` is out of its range, or the advantages are to be
            normalized here; in a call, if the cost,
            ``done`` or ``terminated`` of a batch does not fit the shape of its value, or the
            batch has n-step sums (``"steps_to_next_obs"``), which GAE cannot use.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> critic = TensorDictModule(torch.nn.Linear(4, 2), ["observation"], ["cost_value"])
        >>> gae = CostGAE(gamma=0.99, lmbda=0.95, value_network=critic)
        >>> done = torch.zeros(3, 5, 1, dtype=torch.bool)
        >>> batch = TensorDict(
        ...     observation=torch.randn(3, 5, 4),
        ...     next=TensorDict(
        ...         observation=torch.randn(3, 5, 4),
        ...         cost=torch.rand(3, 5, 2),
        ...         done=done,
        ...         terminated=done,
        ...         batch_size=[3, 5],
        ...     ),
        ...     batch_size=[3, 5],
        ... )
        >>> gae(batch)["cost_advantage"].shape
        torch.Size([3, 5, 2])
    """

    @dataclass
    class _AcceptedKeys(GAE._AcceptedKeys):
        # All of them are declared again: set_keys looks at the class's own names only.
        advantage: NestedKey = "cost_advantage"
        value_target: NestedKey = "cost_value_target"
        value: NestedKey = "cost_value"
        reward: NestedKey = "cost"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        sample_log_prob: NestedKey | None = None

    default_keys = _AcceptedKeys

    def __init__(
        self,
        *,
        gamma: float,
        lmbda: float,
        value_network: TensorDictModuleBase | None = None,
        vectorized: bool | None = True,
        **kwargs: Any,
    ) -> None:
        reason = "scaled_advantages scales advantages, of reward and costs together"
        refuse_options("CostGAE", kwargs, "average_gae", "group_key", reason=reason)
        super().__init__(
            gamma=check_number("gamma", gamma, most=1),
            lmbda=check_number("lmbda", lmbda, most=1),
            value_network=value_network,
            vectorized=vectorized,
            **kwargs,
        )

    @property
    def vectorized(self) -> bool:
        if is_dynamo_compiling():  # As in GAE: the vectorized recursion compiles to other numbers.
            return False
        # Asked at each call, since a loaded state may bring a discount of 0.
        return bool(super().vectorized and self.gamma * self.lmbda)

    @vectorized.setter
    def vectorized(self, value: bool | None) -> None:
        GAE.vectorized.fset(self, value)

    @dispatch
    def forward(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> TensorDictBase:
        self._check(tensordict)
        return super().forward(tensordict, *args, **kwargs)

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        if not self.vectorized:  # GAE's takes the vectorized recursion whatever this says.
            data = self.forward(tensordict.clone(False), *args, **kwargs)
            return data.get(self.tensor_keys.value_target)
        self._check(tensordict)
        return super().value_estimate(tensordict, *args, **kwargs)

    def _check(self, tensordict: TensorDictBase) -> None:
        get_or_raise(tensordict, unravel_key(("next", self.tensor_keys.reward)))
        # The recursion goes on with the next step, which the sum already contains.
        if tensordict.get(key := self.tensor_keys.steps_to_next_obs, None) is not None:
            raise ValueError(
                f"{key!r} is in the batch, which a multi-step transform has put there: GAE wants "
                "the rewards and costs of single steps, and sums them itself."
            )

    def _prepare_signals(
        self, reward: Tensor, done: Tensor, terminated: Tensor, value: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        team, width = value.shape[:-2], value.shape[-1:]
        # A cost without agents beside a done signal with them could be anything.
        if done.shape == (*team, 1) and reward.shape == team + width:
            reward = reward.unsqueeze(-2).expand_as(value)
        if reward.shape != value.shape:
            raise ValueError(
                f"The cost {self.tensor_keys.reward!r} and its value {self.tensor_keys.value!r} "
                f"must have one column for each constraint, got shapes {tuple(reward.shape)} and "
                f"{tuple(value.shape)}. The cost critic needs an output for each of num_costs. "
                "(A cost that agents share needs a done that they share.)"
            )
        return (
            reward,
            self._broadcast(self.tensor_keys.done, done, value),
            self._broadcast(self.tensor_keys.terminated, terminated, value),
        )

    def _broadcast_optional(self, tensor: Tensor, value: Tensor) -> Tensor:
        return self._broadcast("truncated", tensor, value)

    def _broadcast(self, key: NestedKey, signal: Tensor, value: Tensor) -> Tensor:
        """Gives a signal of all costs, or of all agents and costs, the shape of the values."""
        if signal.shape == (*value.shape[:-2], 1):
            signal = signal.unsqueeze(-2)
        elif signal.shape not in ((*value.shape[:-1], 1), value.shape):
            own, shared = (*value.shape[:-1], 1), (*value.shape[:-2], 1)
            raise ValueError(
                f"{key!r} must have the shape {own}, or {shared} if agents share it, where "
                f"{self.tensor_keys.value!r} has {tuple(value.shape)}, got {tuple(signal.shape)}."
            )
        return signal.expand_as(value)
