"""What a trust-region step asks of a policy: a copy to try steps on, and its ratio."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution, set_composite_lp_aggregate
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives import PPOLoss

from torchrl_safe.objectives._checks import get_or_raise
from torchrl_safe.objectives.on_policy.policies import actor_params, summed


class ActorCopy:
    """A copy of an actor's parameters, in another precision, to try steps on.

    Weights that the actor uses twice stay one parameter. Nothing reaches the actor, its buffers
    included, before :meth:`commit`.

    Args:
        loss (PPOLoss): a loss with an actor, functional or not.
        dtype (torch.dtype): the precision of the copy.
    """

    def __init__(self, loss: PPOLoss, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self._actor = loss.actor_network
        # A functional loss keeps its actor without parameters.
        self._options = {"preserve_module_state": False} if loss.functional else {}
        copies: dict[int, Tensor] = {}

        def copy(tensor: Tensor) -> Tensor:
            if id(tensor) not in copies:
                copies[id(tensor)] = _in_precision(tensor.detach().clone(), dtype)
                copies[id(tensor)].requires_grad_(tensor.requires_grad)
            return copies[id(tensor)]

        self._copies = actor_params(loss).apply(copy)
        self._originals = actor_parameters(loss)
        self.parameters = [copies[id(parameter)] for parameter in self._originals]

    def distribution(self, tensordict: TensorDictBase) -> Distribution:
        """The policy in the states of a batch, which must be in the precision of the copy."""
        with self._copies.to_module(self._actor, **self._options):
            try:
                return self._actor.get_dist(tensordict.clone(False))
            except (RuntimeError, ValueError) as error:  # A GRU raises the second.
                if any(original.dtype != self.dtype for original in self._originals):
                    raise RuntimeError(
                        f"The actor failed on parameters and inputs in {self.dtype}: {error} If "
                        "its network fixes a precision of its own, pass that one as dtype."
                    ) from error
                raise

    @torch.no_grad()
    def move(self, step: Tensor) -> None:
        """Sets the copy to where it started plus a step, rounded as the actor will hold it."""
        sizes = [parameter.numel() for parameter in self.parameters]
        parts = zip(step.split(sizes), self.parameters, self._originals, strict=True)
        for part, parameter, original in parts:
            parameter.copy_((original + part.view_as(original)).to(original.dtype))

    @torch.no_grad()
    def commit(self) -> None:
        """Moves the actor to the copy, in place: all that shares its memory sees it."""
        for original, parameter in zip(self._originals, self.parameters, strict=True):
            original.copy_(parameter)


def actor_parameters(loss: PPOLoss) -> list[Tensor]:
    """The trainable parameters of the actor."""
    source = loss.actor_network_params if loss.functional else loss.actor_network
    return [parameter for parameter in source.parameters() if parameter.requires_grad]


def in_precision(
    tensordict: TensorDictBase, keys: Iterable[NestedKey], dtype: torch.dtype
) -> TensorDictBase:
    """The same data, of which the entries asked for are in another precision."""
    data = tensordict.clone(False)
    data.update(data.select(*keys, strict=False).apply(lambda entry: _in_precision(entry, dtype)))
    return data


def importance_weight(
    loss: PPOLoss, distribution: Distribution, tensordict: TensorDictBase, shape: torch.Size
) -> Tensor:
    """Ratio of a policy's probability of the actions to that with which they were collected.

    Args:
        loss (PPOLoss): gives the names of the entries, and the ``max_importance_ratio`` above
            which a ratio is lowered to it, its gradient in proportion. As in TorchRL's losses, that
            is the ratio of each part of an action if its log-probability has a number for each.
        distribution (Distribution): the policy in the states of the batch.
        tensordict (TensorDictBase): the batch.
        shape (torch.Size): shape of its states.

    Returns:
        The ratio, shape ``(*shape, 1)``.
    """
    log_weight = _log_ratio(loss.tensor_keys, distribution, tensordict, shape)
    if loss.max_importance_ratio is not None:
        excess = log_weight.detach() - loss.max_importance_ratio.log()
        log_weight = log_weight - excess.clamp_min(0)
    return summed(log_weight, shape).exp()


def _in_precision(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    return tensor.to(dtype) if tensor.is_floating_point() else tensor


def _log_ratio(
    keys: Any, distribution: Distribution, tensordict: TensorDictBase, shape: torch.Size
) -> Tensor:
    if isinstance(keys.sample_log_prob, str | tuple):
        before = get_or_raise(tensordict, keys.sample_log_prob)
    else:  # One for each part of a composite.
        parts = tensordict.select(*keys.sample_log_prob)
        parts.batch_size = shape
        before = parts.sum(dim="feature", reduce=True)
    if not isinstance(distribution, CompositeDistribution):
        return distribution.log_prob(get_or_raise(tensordict, keys.action)) - before
    names = [keys.action] if isinstance(keys.action, str | tuple) else keys.action
    actions = tensordict.select(*names)
    actions.batch_size = shape
    with set_composite_lp_aggregate(True):
        return distribution.log_prob(actions) - before
