"""A PPO-Lagrangian loss on the networks of ``torchrl_safe.testing``."""

from torchrl_safe.objectives import PPOLagrangianLoss
from torchrl_safe.testing import make_networks


def make_loss(num_costs=1, seed=0, **kwargs):
    networks = make_networks(num_costs, seed=seed)
    return PPOLagrangianLoss(*networks, num_costs=num_costs, **kwargs)
