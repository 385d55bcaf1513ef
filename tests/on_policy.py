"""A PPO-Lagrangian loss on the networks of ``torchrl_safe.testing``, and composite actions."""

from functools import partial

import torch
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_safe.objectives import PPOLagrangianLoss
from torchrl_safe.testing import OBSERVATION_SIZE, make_batch, make_critic, make_networks
from torchrl_safe.testing.networks import mlp


def make_loss(num_costs=1, seed=0, **kwargs):
    networks = make_networks(num_costs, seed=seed)
    return PPOLagrangianLoss(*networks, num_costs=num_costs, **kwargs)


def make_composite(num_costs):
    """Actor with a continuous and a discrete head, the critics, and a batch."""
    torch.manual_seed(0)

    class Heads(nn.Module):
        def __init__(self):
            super().__init__()
            self.body = mlp(OBSERVATION_SIZE, 5)

        def forward(self, observation):
            out = self.body(observation)
            return out[..., :1], out[..., 1:2].exp(), out[..., 2:]

    params = [("params", "move", "loc"), ("params", "move", "scale"), ("params", "grip", "logits")]
    actor = ProbabilisticActor(
        TensorDictModule(Heads(), ["observation"], params),
        in_keys=["params"],
        out_keys=["move", "grip"],
        distribution_class=partial(
            CompositeDistribution,
            distribution_map={
                "move": IndependentNormal,
                "grip": torch.distributions.Categorical,
            },
        ),
        return_log_prob=True,
    )
    batch = make_batch(num_costs).exclude("action", "action_log_prob", "loc", "scale")
    with torch.no_grad():
        actor(batch)
        for key in ("move_log_prob", "grip_log_prob"):  # As of an older policy.
            batch[key] = batch[key] + 0.2 * torch.randn_like(batch[key])
    return actor, make_critic(), make_critic("cost_value", num_costs), batch
