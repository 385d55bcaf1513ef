"""Transforms for any environment with costs."""

from torchrl_safe.envs.transforms.cost_to_reward import CostToReward
from torchrl_safe.envs.transforms.early_termination import EarlyTermination
from torchrl_safe.envs.transforms.frame_skip import FrameSkip
from torchrl_safe.envs.transforms.saute import Saute

__all__ = ["CostToReward", "EarlyTermination", "FrameSkip", "Saute"]
