"""PyBullet: nothing outside this folder imports it."""

from torchrl_safe.envs.physics.bullet.inverse_kinematics import BulletInverseKinematics
from torchrl_safe.envs.physics.bullet.physics import Bullet

__all__ = ["Bullet", "BulletInverseKinematics"]
