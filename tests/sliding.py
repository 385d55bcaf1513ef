"""A small continuous environment with two costs, of any size."""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete

STEPS = 20


class Slide(gymnasium.Env):
    """Pushes a puck along a line: its speed is the reward, and too much of it a cost."""

    metadata: ClassVar = {"render_modes": []}
    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    action_space = Box(-2, 2, (1,), np.float32)

    def __init__(self, reward_size=1.0, cost_size=1.0):
        self.reward_size, self.cost_size = reward_size, cost_size

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed, self.count = self.np_random.normal(), 0.0, 0
        return self.observe(), {}

    def observe(self):
        return np.array([1000 + 100 * self.place, self.speed])

    def step(self, action):
        assert action.shape == (1,)
        assert abs(action[0]) < 2
        self.speed = 0.8 * self.speed + 0.1 * float(action[0])
        self.place += self.speed
        self.count += 1
        fast, far = max(self.speed - 0.05, 0) * self.cost_size, float(self.place > 1)
        info = {"cost": fast, "costs": {"fast": fast, "far": far, "gain": -fast}}
        truncated = self.count == STEPS
        return self.observe(), self.speed * self.reward_size, False, truncated, info


class SlideDiscrete(Slide):
    """Pushes with full force, to the left, not at all, or to the right."""

    action_space = Discrete(3)

    def step(self, action):
        return super().step(np.array([1.9 * (action - 1)]))


class SlideGrid(Slide):
    """Has actions of two numbers that are whole."""

    action_space = MultiDiscrete([2, 3])


class SlideMatrix(Slide):
    """Has actions of two rows."""

    action_space = Box(-2, 2, (2, 2), np.float32)


gymnasium.register("Slide-v0", Slide)
gymnasium.register("SlideScaled-v0", lambda: Slide(reward_size=128.0, cost_size=1024.0))
gymnasium.register("SlideNaN-v0", lambda: Slide(reward_size=np.nan))
gymnasium.register("SlideDiscrete-v0", SlideDiscrete)
gymnasium.register("SlideGrid-v0", SlideGrid)
gymnasium.register("SlideMatrix-v0", SlideMatrix)
