"""What losses ask of a policy: its parameters, ratios, divergences and log-probabilities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CompositeDistribution
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, kl_divergence
from torchrl.objectives import PPOLoss


class Policy(NamedTuple):
    """The policy in the states of a batch: evaluated once for all that a loss asks of it.

    ``log_ratio`` is the logarithm of the ratio that PPO clips, to the proximal policy, and
    ``log_correction`` what makes it that to the policy that collected the batch, or ``None`` if
    these two are one (see ``delay_actor`` and ``max_importance_ratio`` of TorchRL's losses). Both
    have shape ``(*B, 1)``, or ``(*B, ..., 1)`` if the log-probability has more than one number.
    """

    log_ratio: Tensor
    distribution: Distribution
    kl_approx: Tensor
    log_correction: Tensor | None

    def ratio(self) -> Tensor:
        """Ratio to the policy that collected the batch, shape ``(*B, 1)``."""
        if self.log_correction is None:
            return self.log_ratio.exp()
        return (self.log_ratio + self.log_correction).exp()

    def joint(self, shape: torch.Size) -> Policy:
        """The same with one ratio for each state; ``shape`` is that of the states.

        PPO clips the ratio of each part of an action by itself if the log-probability is not one
        number, as that of :class:`torch.distributions.Normal`.
        """
        correction = self.log_correction
        return self._replace(
            log_ratio=summed(self.log_ratio, shape),
            log_correction=None if correction is None else summed(correction, shape),
        )


class Evaluated:
    """What TorchRL's forward gets as ``self``: the loss, with policy and advantage ready."""

    def __init__(self, loss: PPOLoss, policy: Policy) -> None:
        self._loss = loss
        self._policy = policy

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loss, name)

    def _log_weight(self, tensordict: TensorDictBase, adv_shape: torch.Size) -> Policy:
        return self._policy

    def _maybe_normalize_advantage(
        self, advantage: Tensor, tensordict: TensorDictBase, *, update_norm: bool
    ) -> Tensor:
        return advantage


def evaluate(
    loss: PPOLoss, tensordict: TensorDictBase, shape: torch.Size, kept: Sequence[NestedKey] = ()
) -> Policy:
    """The present policy of a PPO loss.

    Args:
        loss: the loss.
        tensordict: the states, of this shape. What the collector's policy has left stays there:
            KLPENPPOLoss reads it.
        shape: the shape of the states.
        kept: which of the entries that the policy writes are to be in the data.
    """
    data = tensordict.clone(False)
    # TorchRL's one place for composite actions, the proximal policy and the cap of the ratio.
    policy = Policy(*loss._log_weight(data, adv_shape=shape))
    tensordict.update(data.select(*kept))
    return policy


def forward_evaluated(loss: PPOLoss, tensordict: TensorDictBase, policy: Policy) -> TensorDictBase:
    """The loss's own forward, with a policy that has been evaluated already."""
    return type(loss).forward(Evaluated(loss, policy), tensordict)


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
