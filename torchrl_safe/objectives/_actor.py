"""What a trust-region step asks of the actor of a PPO loss."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torchrl.objectives import PPOLoss


def actor_parameters(loss: PPOLoss) -> list[Tensor]:
    """The trainable parameters of the actor."""
    source = loss.actor_network_params if loss.functional else loss.actor_network
    return [parameter for parameter in source.parameters() if parameter.requires_grad]


def actor_distribution(loss: PPOLoss, tensordict: TensorDictBase) -> Distribution:
    """The present policy in the states of a batch."""
    with (
        loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False)
        if loss.functional
        else contextlib.nullcontext()
    ):
        return loss.actor_network.get_dist(tensordict.clone(False))


def divergence(old: Distribution, new: Distribution) -> Tensor:
    """KL divergence of each state, added up over the parts of a composite."""
    if isinstance(old, CompositeDistribution) and isinstance(new, CompositeDistribution):
        parts = [divergence(part, new.dists[name]) for name, part in old.dists.items()]
        return torch.stack(parts).sum(0)
    return kl_divergence(old, new)


def read_flat(parameters: Sequence[Tensor]) -> Tensor:
    """A copy of all parameters, one after the other in a vector."""
    return torch.cat([parameter.detach().reshape(-1) for parameter in parameters])


@torch.no_grad()
def write_flat(vector: Tensor, parameters: Sequence[Tensor]) -> None:
    """Writes a vector in place, so that everything that shares the parameters' memory sees it."""
    sizes = [parameter.numel() for parameter in parameters]
    for part, parameter in zip(vector.split(sizes), parameters, strict=True):
        parameter.copy_(part.view_as(parameter))
