"""Tasks: what the arm is to do, its reward and when it has succeeded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.state import ArmState, Array


class Task(Protocol):
    """What :class:`~torchrl_safe.envs.ArmEnv` asks of a task."""

    def sample_goal(self, rng: np.random.Generator) -> Array:
        """Draws a goal position of one world, m, shape ``(3,)``."""

    def reward(self, state: ArmState) -> Array:
        """Returns the reward of each world, shape ``(N,)``."""

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        """Returns which worlds have succeeded, shape ``(N,)``; success ends the episode."""


@dataclass(frozen=True)
class Reach:
    """Bring the tool point within ``radius`` of a target drawn uniformly from a box.

    The reward of a step is minus the distance between tool and target, in metres; since
    success ends the episode, the return is best for a fast approach.

    Args:
        low: lower corner of the box of targets, m.
        high: upper corner of the box of targets, m.
        radius: distance at which the target counts as reached, m.
        order: order of the distance's norm: 2 is Euclidean, 1 is the paper's.

    Raises:
        ValueError: if the box is empty or ``radius`` is not positive.

    Examples:
        >>> Reach(radius=0.03)
        Reach(low=(0.55, -0.2, 0.05), high=(0.7, 0.2, 0.15), radius=0.03, order=2)
    """

    low: tuple[float, float, float] = (0.55, -0.2, 0.05)
    high: tuple[float, float, float] = (0.7, 0.2, 0.15)
    radius: float = 0.05
    order: float = 2

    def __post_init__(self) -> None:
        if not np.all(np.asarray(self.low) <= np.asarray(self.high)):
            raise ValueError(f"low must not exceed high, got {self.low} and {self.high}.")
        if not self.radius > 0:
            raise ValueError(f"radius must be positive, got {self.radius}.")

    def sample_goal(self, rng: np.random.Generator) -> Array:
        return rng.uniform(self.low, self.high)

    def reward(self, state: ArmState) -> Array:
        return -self._distance(state)

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        return self._distance(state) < self.radius

    def _distance(self, state: ArmState) -> Array:
        return np.linalg.norm(state.ee_position - state.goal, ord=self.order, axis=1)
