"""What losses ask of a policy: its parameters, divergences, log-probabilities of whole actions."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, kl_divergence
from torchrl.objectives import PPOLoss


def actor_params(loss: PPOLoss) -> TensorDictBase:
    """Parameters and buffers of the actor."""
    if loss.functional:
        return loss.actor_network_params
    return TensorDict.from_module(loss.actor_network)


def divergence(old: Distribution, new: Distribution, shape: torch.Size) -> Tensor:
    """KL divergence of each state, added up over the parts of its action, ``(*shape, 1)``."""
    if isinstance(old, CompositeDistribution) and isinstance(new, CompositeDistribution):
        parts = [divergence(part, new.dists[name], shape) for name, part in old.dists.items()]
        return torch.stack(parts).sum(0)
    return summed(_divergence(old, new), shape)


def summed(log_probs: Tensor, shape: torch.Size) -> Tensor:
    """Sums of log-probabilities over the parts of each action: ``(*shape, ...)`` to one number."""
    return log_probs.reshape(*shape, -1).sum(-1, keepdim=True)


def _divergence(old: Distribution, new: Distribution) -> Tensor:
    if isinstance(old, Independent) and isinstance(new, Independent):
        return _divergence(old.base_dist, new.base_dist)
    if isinstance(old, Categorical) and isinstance(new, Categorical):
        # PyTorch's has a gradient of NaN where a mask excludes an action from both.
        gap = torch.where(new.probs > 0, old.logits - new.logits, math.inf)
        return (old.probs * torch.where(old.probs > 0, gap, 0.0)).sum(-1)
    try:
        return kl_divergence(old, new)
    except NotImplementedError as error:
        raise NotImplementedError(
            f"PyTorch knows no KL divergence of {type(old).__name__}: choose another distribution, "
            "for example TanhNormal, or a loss that needs none, such as PPOLagrangianLoss."
        ) from error
