"""The action filter that keeps an arm off what is around it."""

from torchrl_safe.envs.shield.shield import Shield, Shielded

__all__ = ["Shield", "Shielded"]
