"""Constrained losses and the rules that move their multipliers. Needs TorchRL only."""

from torchrl_safe.objectives.cost_gae import CostGAE
from torchrl_safe.objectives.functional import penalized_advantage
from torchrl_safe.objectives.lagrangian import LagrangianLoss
from torchrl_safe.objectives.multipliers import DualAscent, MultiplierUpdater
from torchrl_safe.objectives.pid_control import PIDControl
from torchrl_safe.objectives.ppo_lagrangian import PPOLagrangianLoss

__all__ = [
    "CostGAE",
    "DualAscent",
    "LagrangianLoss",
    "MultiplierUpdater",
    "PIDControl",
    "PPOLagrangianLoss",
    "penalized_advantage",
]
