"""Constrained losses and the rules that move their multipliers. Needs TorchRL only."""

from torchrl_safe.objectives.cost_gae import CostGAE
from torchrl_safe.objectives.cost_td0 import CostTD0
from torchrl_safe.objectives.functional import penalized_advantage
from torchrl_safe.objectives.multipliers import DualAscent, MultiplierUpdater
from torchrl_safe.objectives.pid_control import PIDControl
from torchrl_safe.objectives.ppo_lagrangian import PPOLagrangianLoss
from torchrl_safe.objectives.sac_lagrangian import SACLagrangianLoss
from torchrl_safe.objectives.td3_lagrangian import TD3LagrangianLoss

__all__ = [
    "CostGAE",
    "CostTD0",
    "DualAscent",
    "MultiplierUpdater",
    "PIDControl",
    "PPOLagrangianLoss",
    "SACLagrangianLoss",
    "TD3LagrangianLoss",
    "penalized_advantage",
]
