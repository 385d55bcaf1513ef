"""Glue for ``torchrl.trainers``: a hook that moves multipliers, and a PPO trainer that has it.

Hydra configurations are in ``torchrl_safe.trainers.configs``, which is not imported here: it needs
the ``hydra`` extra.
"""

from torchrl_safe.trainers.constrained_ppo import ConstrainedPPOTrainer
from torchrl_safe.trainers.multiplier_hook import MultiplierHook

__all__ = ["ConstrainedPPOTrainer", "MultiplierHook"]
