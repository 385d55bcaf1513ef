"""Tasks: what the arm is to do, its reward and when it has succeeded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.checks import check_array, check_positive
from torchrl_safe.envs.state import ArmState, Array


@runtime_checkable
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
        ValueError: if the box is empty, ``radius`` is not positive or ``order`` is less than 1.

    Examples:
        >>> Reach(radius=0.03)
        Reach(low=(0.6, -0.2, 0.05), high=(0.7, 0.2, 0.15), radius=0.03, order=2)
    """

    low: tuple[float, float, float] = (0.6, -0.2, 0.05)
    high: tuple[float, float, float] = (0.7, 0.2, 0.15)
    radius: float = 0.05
    order: float = 2

    def __post_init__(self) -> None:
        low, high = check_array("low", self.low, (3,)), check_array("high", self.high, (3,))
        if not np.all(low <= high):
            raise ValueError(f"low must not exceed high, got {self.low} and {self.high}.")
        check_positive(radius=self.radius)
        if not self.order >= 1:
            raise ValueError(f"order must be at least 1, got {self.order}.")

    def sample_goal(self, rng: np.random.Generator) -> Array:
        return rng.uniform(self.low, self.high)

    def reward(self, state: ArmState) -> Array:
        return -self._distance(state)

    def success(self, state: ArmState) -> NDArray[np.bool_]:
        return self._distance(state) < self.radius

    def _distance(self, state: ArmState) -> Array:
        return np.linalg.norm(state.ee_position - state.goal, ord=self.order, axis=1)
