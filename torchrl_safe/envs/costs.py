"""Costs: callables that map an ArmState to one number for each world."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_safe.envs.state import ArmState, Array


@dataclass(frozen=True)
class Collision:
    """Costs 1 for every control step in which the arm touches an obstacle, else 0.

    Every link of the arm, every obstacle and every physics substep counts: a touch that begins
    and ends between two control steps is not lost.

    Args:
        margin: distance in metres up to which a contact point counts as a touch. PyBullet
            reports contact points up to about 0.02 m before the bodies meet.

    Raises:
        ValueError: if ``margin`` is negative.

    Examples:
        >>> Collision()
        Collision(margin=0.0)
    """

    margin: float = 0.0

    def __post_init__(self) -> None:
        if not self.margin >= 0:
            raise ValueError(f"margin must not be negative, got {self.margin}.")

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        return (state.contact_distance <= self.margin).any(axis=1).astype(float)
