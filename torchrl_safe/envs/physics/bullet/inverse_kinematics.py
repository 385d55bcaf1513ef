"""PyBullet's own inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_safe.envs.physics.bullet.simulator import BulletSimulator
from torchrl_safe.envs.physics.simulator import Simulator
from torchrl_safe.envs.state import ArmState, Array


@dataclass(frozen=True)
class BulletInverseKinematics:
    """PyBullet's own solver with its defaults: 20 iterations, no joint limits.

    Only for the paper's environment, and with ``physics=Bullet()``: it is slower and less exact
    than :class:`~torchrl_safe.envs.DampedLeastSquares`.

    Examples:
        >>> from torchrl_safe.envs import ArmEnv, CartesianDelta
        >>> action = CartesianDelta(inverse_kinematics=BulletInverseKinematics())
        >>> env = ArmEnv(action=action)
        >>> env.rollout(2)["action"].shape
        torch.Size([1, 2, 3])
        >>> env.close()
    """

    def __call__(
        self, position: Array, orientation: Array, state: ArmState, simulator: Simulator
    ) -> Array:
        if not isinstance(simulator, BulletSimulator):
            raise TypeError(
                "inverse_kinematics=BulletInverseKinematics() needs physics=Bullet(), got "
                f"{type(simulator).__name__}."
            )
        return simulator.inverse_kinematics(position, orientation)
