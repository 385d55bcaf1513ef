"""Spaces of Gymnasium of which TorchRL's specs say something else: refused, or returned rightly."""

from functools import partial

import numpy as np
import pytest
from counting import Counting
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from torchrl_safe.envs.gym import SafeGymWrapper

PAIR = Tuple([Box(0, 1000, (1,), np.float32)] * 2)


class Odd(Counting):
    """Counts, with the spaces that it is given; of two observations the second is 10 more."""

    def __init__(self, observation_space=Counting.observation_space, action_space=None):
        super().__init__()
        self.observation_space = observation_space
        self.action_space = self.action_space if action_space is None else action_space

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return (observation, observation + 10), info


class OneOfTwo(Counting):
    """Says that it returns two rewards, and returns one, as a wrapper of mo-gymnasium's does."""

    reward_space = Box(-np.inf, np.inf, (2,))


def several(make):
    return SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.DISABLED)


@pytest.mark.parametrize("many", [False, True], ids=["one", "several"])
@pytest.mark.parametrize(
    ("space", "part"),
    [
        (Discrete(3, start=5), r"Discrete\(3, start=5\)"),
        (MultiDiscrete([3, 3], start=[0, 1]), r"MultiDiscrete\(\[3 3\], start=\[0 1\]\)"),
        (Dict(grip=Discrete(2, start=1), move=Box(-1, 1)), r"Discrete\(2, start=1\)"),
    ],
    ids=["discrete", "several-discrete", "in-a-dict"],
)
def test_discrete_actions_are_numbered_from_0(space, part, many):
    """TorchRL would send 0, 1 and 2."""
    make = partial(Odd, action_space=space)
    with pytest.raises(ValueError, match=rf"number its actions from 0, got {part}"):
        SafeGymWrapper(several(make) if many else make())


@pytest.mark.parametrize(
    "spaces",
    [{"observation_space": PAIR}, {"action_space": PAIR}, {"observation_space": Dict(both=PAIR)}],
    ids=["observation", "action", "in-a-dict"],
)
def test_the_parts_of_a_tuple_are_not_taken_for_environments(spaces):
    with pytest.raises(ValueError, match=r"no Tuple space if it is vectorized, got .*Tuple\(Box"):
        SafeGymWrapper(several(partial(Odd, **spaces)))


def test_a_single_environment_may_observe_a_tuple(make_env):
    env = make_env(SafeGymWrapper, Odd(observation_space=PAIR))
    assert env.reset()["observation"].tolist() == [[0], [10]]


def test_rewards_of_several_numbers_are_refused(make_env):
    with pytest.raises(ValueError, match=r"one reward, of shape \(1,\), got .* shape \(2,\)"):
        SafeGymWrapper(OneOfTwo())
    env = OneOfTwo()
    env.reward_space = Box(-np.inf, np.inf, ())  # As the error says.
    assert make_env(SafeGymWrapper, env).rollout(2)["next", "reward"].tolist() == [[10], [20]]
