"""SafeGymWrapper, SafeGymEnv and the recipe around Bullet-Safety-Gym, with the current Gymnasium.

The package (Gronauer 2022) pins Gymnasium 0.28.1 and runs with later ones. Its environments draw
from NumPy's global generator, so they are compared with what they returned, not with a second one.
"""

import sys

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from experiments import safe_gym
from torchrl_safe.envs.gym import SafeGymEnv, SafeGymWrapper

pytest.importorskip(
    "bullet_safety_gym", reason="`make test` installs it, without the Gymnasium that it pins"
)

# It bounds observations by the largest number of double precision, and says that they are float32.
pytestmark = [
    pytest.mark.integration,
    pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning"),
]

# Each task and each agent.
NAMES = [
    f"Safety{name}-v0" for name in ("BallCircle", "BallRun", "CarPush", "DroneReach", "AntGather")
]


def use_real_streams(monkeypatch):
    """It silences PyBullet by the names of these two, which pytest's do not have.

    A fixture would be too early: pytest sets its own once more before it calls the test.
    """
    monkeypatch.setattr(sys, "stdout", sys.__stdout__)
    monkeypatch.setattr(sys, "stderr", sys.__stderr__)


class Recorded(gymnasium.Wrapper):
    """Keeps what the environment returned."""

    def __init__(self, env):
        super().__init__(env)
        self.rows = []

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.rows.append((observation, reward, info["cost"], terminated, truncated))
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize("name", NAMES)
def test_tensors_are_what_it_returned(make_env, monkeypatch, name):
    use_real_streams(monkeypatch)
    recorded = Recorded(gymnasium.make(f"bullet_safety_gym:{name}", max_episode_steps=20))
    env = make_env(SafeGymWrapper, recorded)
    ahead = torch.ones(env.action_spec.shape)
    rollout = env.rollout(
        50, lambda tensordict: tensordict.set("action", ahead), break_when_any_done=False
    )["next"]
    rows = [np.array(column) for column in zip(*recorded.rows, strict=True)]
    keys = ("observation", "reward", "cost", "terminated", "truncated")
    for key, expected in zip(keys, rows, strict=True):
        found = rollout[key].numpy()
        np.testing.assert_array_equal(found, expected.astype(found.dtype).reshape(found.shape), key)
    if name == "SafetyBallRun-v0":  # Full speed is more than it allows.
        assert rollout["cost"].sum() > 10


@pytest.mark.parametrize("num_envs", [None, 3])
def test_made_by_name(make_env, monkeypatch, num_envs):
    use_real_streams(monkeypatch)
    several = {} if num_envs is None else {"num_envs": num_envs, "asynchronous": False}
    env = make_env(SafeGymEnv, "bullet_safety_gym:SafetyCarRun-v0", **several)
    check_env_specs(env)
    assert env.rollout(3)["next", "cost"].shape == (*env.batch_size, 3, 1)


@pytest.mark.usefixtures("threads")
def test_the_recipe(tmp_path, monkeypatch):
    use_real_streams(monkeypatch)
    small = safe_gym.Config(
        out=tmp_path,
        env="bullet_safety_gym:SafetyBallRun-v0",
        frames=800,
        frames_per_batch=400,
        envs=2,
        epochs=1,
        eval_episodes=2,
        random_frames=100,
        compile=False,
    )
    results = safe_gym.main(small)
    assert [row["frames"] for row in results["history"]] == [400, 800]
    assert results["evaluation"]["steps"] == [100, 100, 100]
    assert all("cost/cost" in row for row in results["history"])
