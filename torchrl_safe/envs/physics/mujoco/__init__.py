"""MuJoCo: nothing outside this folder imports or names it."""

from torchrl_safe.envs.physics.mujoco.physics import MuJoCo

__all__ = ["MuJoCo"]
