"""Constrained losses and the rules that move their multipliers. Needs TorchRL only."""

from torchrl_safe.objectives._reduction import reduced
from torchrl_safe.objectives.critics.cost_gae import CostGAE
from torchrl_safe.objectives.critics.cost_td0 import CostTD0
from torchrl_safe.objectives.functional import (
    cost_advantage_scale,
    penalized_advantage,
    scaled_advantages,
)
from torchrl_safe.objectives.off_policy.sac_lagrangian import SACLagrangianLoss
from torchrl_safe.objectives.off_policy.td3_lagrangian import TD3LagrangianLoss
from torchrl_safe.objectives.on_policy.crpo import CRPOLoss
from torchrl_safe.objectives.on_policy.cup import CUPLoss
from torchrl_safe.objectives.on_policy.focops import FOCOPSLoss
from torchrl_safe.objectives.on_policy.ipo import IPOLoss
from torchrl_safe.objectives.on_policy.lagrangian import LagrangianLoss
from torchrl_safe.objectives.on_policy.p3o import P3OLoss
from torchrl_safe.objectives.on_policy.ppo_lagrangian import PPOLagrangianLoss
from torchrl_safe.objectives.rules.multipliers import DualAscent, MultiplierUpdater
from torchrl_safe.objectives.rules.pid_control import PIDControl
from torchrl_safe.objectives.rules.violation import ViolationUpdater
from torchrl_safe.objectives.trust_region.loss import TrustRegionLoss
from torchrl_safe.objectives.trust_region.methods import (
    CPO,
    PCPO,
    TRPO,
    TrustRegionMethod,
    TrustRegionProblem,
    TrustRegionSolution,
)
from torchrl_safe.objectives.trust_region.step import TrustRegionStep

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
    "cost_advantage_scale",
    "penalized_advantage",
    "reduced",
    "scaled_advantages",
]
