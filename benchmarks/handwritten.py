"""PPO-Lagrangian's update as one would write it by hand, on plain tensors: the floor."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from benchmarks.networks import ACTION, network


class HandWritten(nn.Module):
    """The losses of a Gaussian policy and two critics, with nothing that is only for the log."""

    multiplier: Tensor

    def __init__(self, clip: float = 0.2) -> None:
        super().__init__()
        self.policy, self.critic, self.cost_critic = network(ACTION), network(1), network(1)
        self.log_std = nn.Parameter(torch.zeros(ACTION))
        self.register_buffer("multiplier", torch.zeros(1))
        self.clip = clip

    def forward(
        self,
        observation: Tensor,
        action: Tensor,
        old_log_prob: Tensor,
        advantage: Tensor,
        target: Tensor,
        cost_advantage: Tensor,
        cost_target: Tensor,
    ) -> Tensor:
        """Returns the sum of the losses; the log-probability is ``(B,)``, all else has rows."""
        noise = (action - self.policy(observation)) * torch.exp(-self.log_std)
        normalization = self.log_std.sum() + 0.5 * ACTION * math.log(2 * math.pi)
        log_prob = -0.5 * noise.square().sum(-1) - normalization
        mixed = (advantage - self.multiplier * cost_advantage) / (1 + self.multiplier)
        weight = torch.exp(log_prob - old_log_prob)[:, None]
        clipped = weight.clamp(1 - self.clip, 1 + self.clip)
        objective = -torch.minimum(weight * mixed, clipped * mixed).mean()
        value_loss = nn.functional.mse_loss(self.critic(observation), target)
        cost_loss = nn.functional.mse_loss(self.cost_critic(observation), cost_target)
        return objective + value_loss + cost_loss


def arguments(minibatch: TensorDictBase) -> tuple[Tensor, ...]:
    """The arguments of :class:`HandWritten`, from a minibatch of the losses."""
    keys = ("observation", "action", "action_log_prob", "advantage", "value_target")
    return tuple(minibatch[key] for key in (*keys, "cost_advantage", "cost_value_target"))
