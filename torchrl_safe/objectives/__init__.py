"""Constrained losses and the rules that move their multipliers. Needs TorchRL only."""

from torchrl_safe.objectives.cost_gae import CostGAE
from torchrl_safe.objectives.functional import penalized_advantage
from torchrl_safe.objectives.multipliers import DualAscent, MultiplierUpdater
from torchrl_safe.objectives.pid_control import PIDControl
from torchrl_safe.objectives.ppo_lagrangian import PPOLagrangianLoss
from torchrl_safe.objectives.trust_region_loss import TrustRegionLoss
from torchrl_safe.objectives.trust_region_methods import CPO, PCPO, TRPO, TrustRegionMethod
from torchrl_safe.objectives.trust_region_step import TrustRegionStep

__all__ = [
    "CPO",
    "PCPO",
    "TRPO",
    "CostGAE",
    "DualAscent",
    "MultiplierUpdater",
    "PIDControl",
    "PPOLagrangianLoss",
    "TrustRegionLoss",
    "TrustRegionMethod",
    "TrustRegionStep",
    "penalized_advantage",
]
