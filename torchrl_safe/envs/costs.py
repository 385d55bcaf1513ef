"""Costs: callables that map an ArmState to one number for each world."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_safe.envs.state import ArmState, Array

#: Distance from which on PyBullet reports contact points, m.
CONTACT_RANGE = 0.02


@dataclass(frozen=True)
class Collision:
    """Costs 1 for every control step in which the arm touches an obstacle, else 0.

    Every link of the arm, every obstacle and every physics substep counts: a touch that begins
    and ends between two control steps is not lost.

    Args:
        margin: distance up to which a contact point counts as a touch, m. PyBullet reports
            contact points from 0.02 m before the bodies meet.

    Raises:
        ValueError: if ``margin`` is not between 0 and 0.02.

    Examples:
        >>> Collision()
        Collision(margin=0.0)
    """

    margin: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.margin <= CONTACT_RANGE:
            raise ValueError(
                f"margin must be between 0 and {CONTACT_RANGE}, where PyBullet reports contacts, "
                f"got {self.margin}."
            )

    def __call__(self, state: ArmState) -> Array:
        """Returns the cost of each world, shape ``(N,)``."""
        return (state.contact_distance <= self.margin).any(axis=1).astype(float)
