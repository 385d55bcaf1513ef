"""Constrained losses and the rules that move their multipliers. Needs TorchRL only."""

from torchrl_safe.objectives.cost_gae import CostGAE
from torchrl_safe.objectives.cost_td0 import CostTD0
from torchrl_safe.objectives.crpo import CRPOLoss
from torchrl_safe.objectives.cup import CUPLoss
from torchrl_safe.objectives.focops import FOCOPSLoss
from torchrl_safe.objectives.functional import penalized_advantage
from torchrl_safe.objectives.ipo import IPOLoss
from torchrl_safe.objectives.lagrangian import LagrangianLoss
from torchrl_safe.objectives.multipliers import DualAscent, MultiplierUpdater
from torchrl_safe.objectives.p3o import P3OLoss
from torchrl_safe.objectives.pid_control import PIDControl
from torchrl_safe.objectives.ppo_lagrangian import PPOLagrangianLoss
from torchrl_safe.objectives.sac_lagrangian import SACLagrangianLoss
from torchrl_safe.objectives.td3_lagrangian import TD3LagrangianLoss
from torchrl_safe.objectives.trust_region_loss import TrustRegionLoss
from torchrl_safe.objectives.trust_region_methods import (
    CPO,
    PCPO,
    TRPO,
    TrustRegionMethod,
    TrustRegionProblem,
    TrustRegionSolution,
)
from torchrl_safe.objectives.trust_region_step import TrustRegionStep
from torchrl_safe.objectives.violation import ViolationUpdater

__all__ = [
    "CPO",
    "PCPO",
    "TRPO",
    "CRPOLoss",
    "CUPLoss",
    "CostGAE",
    "CostTD0",
    "DualAscent",
    "FOCOPSLoss",
    "IPOLoss",
    "LagrangianLoss",
    "MultiplierUpdater",
    "P3OLoss",
    "PIDControl",
    "PPOLagrangianLoss",
    "SACLagrangianLoss",
    "TD3LagrangianLoss",
    "TrustRegionLoss",
    "TrustRegionMethod",
    "TrustRegionProblem",
    "TrustRegionSolution",
    "TrustRegionStep",
    "ViolationUpdater",
    "penalized_advantage",
]
