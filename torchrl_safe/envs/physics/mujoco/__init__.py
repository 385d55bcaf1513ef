"""MuJoCo: nothing outside this folder imports it."""

from torchrl_safe.envs.physics.mujoco.physics import MuJoCo

__all__ = ["MuJoCo"]
