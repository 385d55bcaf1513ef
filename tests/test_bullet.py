"""Ownership of PyBullet's servers."""

import dataclasses
import gc

import pybullet
import pytest
import torch
from tensordict import TensorDict

from torchrl_safe.envs import PANDA, ArmEnv
from torchrl_safe.envs.bullet import World
from torchrl_safe.envs.scene import Scene


def open_clients():
    gc.collect()
    return {c for c in range(64) if pybullet.getConnectionInfo(c)["isConnected"]}


def forward(env, steps=5):
    """Rewards of a motion straight ahead."""
    policy = lambda td: td.set("action", torch.ones(env.action_spec.shape))  # noqa: E731
    return env.rollout(steps, policy)["next", "reward"]


def test_closing_one_environment_leaves_the_other(make_env):
    expected = forward(make_env(ArmEnv, num_envs=2, seed=0))
    one, two = ArmEnv(num_envs=2, seed=1), make_env(ArmEnv, num_envs=2, seed=0)
    one.close()
    # The numbers of the closed servers go to the next environment, and nothing that belonged
    # to the first may close them, neither a second close nor its garbage collection.
    three = make_env(ArmEnv, num_envs=2, seed=0)
    for world in one._worlds:
        world.close()
    del one
    gc.collect()
    assert torch.equal(forward(two), expected)
    assert torch.equal(forward(three), expected)


def test_two_environments_do_not_disturb_each_other(make_env):
    expected = forward(make_env(ArmEnv, seed=1))
    left, right = make_env(ArmEnv, seed=1), make_env(ArmEnv, seed=2)
    right.reset()
    left.reset()
    rewards = []
    for _ in range(5):
        right.step(TensorDict({"action": -torch.ones(1, 3)}, batch_size=[1]))
        out = left.step(TensorDict({"action": torch.ones(1, 3)}, batch_size=[1]))
        rewards.append(out["next", "reward"])
    assert torch.equal(torch.stack(rewards, 1), expected)


def test_open_and_close_leaves_nothing():
    before = open_clients()
    for _ in range(100):
        world = World(PANDA, Scene(), ())
        world.close()
        world.close()
    assert open_clients() == before


def test_forgotten_world_is_closed():
    before = open_clients()
    world = World(PANDA, Scene(), ())
    assert open_clients() != before
    del world
    assert open_clients() == before


def test_failed_environment_is_closed():
    before = open_clients()
    with pytest.raises(ValueError, match="cost 'flat'") as held:
        ArmEnv(num_envs=3, costs={"flat": lambda state: 0.0})
    # Closed, not merely forgotten: the exception still holds the environment.
    assert held.value.__traceback__ is not None
    assert open_clients() == before


@pytest.mark.parametrize(
    ("arm", "message"),
    [
        (dataclasses.replace(PANDA, home=(0.0,) * 6), "home must give 7 joint angles"),
        (dataclasses.replace(PANDA, home=(9.0,) * 7), "home must be within the joint limits"),
        (dataclasses.replace(PANDA, ee_link="hand"), "ee_link must be a link"),
        (dataclasses.replace(PANDA, urdf="gone.urdf"), "urdf must be a readable URDF"),
    ],
    ids=["home-length", "home-limits", "ee_link", "urdf"],
)
def test_bad_arm_raises_and_leaves_no_server(arm, message):
    before = open_clients()
    with pytest.raises(ValueError, match=message):
        World(arm, Scene(), ())
    assert open_clients() == before
