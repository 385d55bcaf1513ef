"""Ownership of PyBullet's servers."""

import dataclasses
import gc
import math
import sys

import numpy as np
import pybullet
import pytest
import torch
from bullet_worlds import make_world, worlds_of
from tensordict import TensorDict
from worlds import rest

from torchrl_safe.envs import (
    PANDA,
    ArmEnv,
    ArmModel,
    Box,
    Cylinder,
    InFront,
    JointDelta,
    NoObstacles,
    Placement,
    Region,
    Shield,
)
from torchrl_safe.envs.physics.scene import Scene


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
    for world in worlds_of(one):
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
        world = make_world()
        world.close()
        world.close()
    assert open_clients() == before


def test_closing_closes_the_world_of_the_pictures():
    before = open_clients()
    env = ArmEnv(seed=0)
    env.reset()
    env.render(width=8, height=8)
    env.close()
    assert open_clients() == before
    # Closed, not merely forgotten.
    assert env.is_closed


def test_closing_closes_the_world_of_the_shield():
    before = open_clients()
    env = ArmEnv(seed=0, shield=Shield())
    env.close()
    # Closed, not merely forgotten.
    assert env.is_closed
    assert open_clients() == before


def test_forgotten_world_is_closed():
    before = open_clients()
    world = make_world()
    assert open_clients() != before
    del world
    assert open_clients() == before


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a window needs no DISPLAY")
def test_a_window_without_a_screen_is_refused(monkeypatch):
    """PyBullet itself would end the process."""
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="gui needs a screen"):
        ArmEnv(gui=True)


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
        make_world(arm)
    assert open_clients() == before


# An arm whose tool link has its centre of mass elsewhere and turned, unlike the Panda's, and
# joints without limits of angle, speed or effort.
LEVER = """<robot name="lever">
<link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
<link name="beam"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
<link name="tip">
  <inertial>
    <origin xyz="0.1 0.2 0.05" rpy="0.3 0.5 0"/><mass value="1"/>
    <inertia ixx="1" iyy="2" izz="3"/>
  </inertial>
  <collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision>
</link>
<joint name="turn" type="continuous">
  <parent link="base"/><child link="beam"/><axis xyz="0 0 1"/>
</joint>
<joint name="swing" type="continuous">
  <origin xyz="0.5 0 0.3"/><parent link="beam"/><child link="tip"/><axis xyz="0 1 0"/>
</joint>
</robot>"""


@pytest.fixture
def lever(tmp_path):
    path = tmp_path / "lever.urdf"
    path.write_text(LEVER)
    return ArmModel(
        str(path), "tip", home=(0.2, 0.4), goals=Region((0.4, 0.3, 0.3), (0.4, 0.3, 0.3))
    )


def test_tool_point_is_the_origin_of_the_link(make_env, lever):
    """Not its centre of mass: pose and velocity as by hand."""
    settings = {"frame_skip": 1, "obstacles": NoObstacles()}
    env = make_env(ArmEnv, lever, action=JointDelta(step=0.05), **settings)
    env.reset()
    for _ in range(20):
        action = torch.tensor([[1.0, -0.5]])
        env.step(TensorDict({"action": action}, batch_size=[1]))
    state = env.arm_state
    (turn, swing), (turning, _) = state.joint_position[0], state.joint_velocity[0]
    np.testing.assert_allclose([turn, swing], [1.2, -0.1], atol=1e-3)
    x, y = 0.5 * math.cos(turn), 0.5 * math.sin(turn)
    np.testing.assert_allclose(state.ee_position, [[x, y, 0.3]], atol=1e-5)
    np.testing.assert_allclose(state.ee_velocity / turning, [[-y, x, 0]], atol=1e-5)
    (c, d), (s, t) = (np.cos([turn / 2, swing / 2]), np.sin([turn / 2, swing / 2]))
    np.testing.assert_allclose(state.ee_orientation, [[-s * t, c * t, s * d, c * d]], atol=1e-5)


def test_jacobian_is_that_of_the_origin_of_the_link(lever):
    turn, swing = 1.2, -0.1
    x, y = 0.5 * math.cos(turn), 0.5 * math.sin(turn)
    expected = [[-y, 0], [x, 0], [0, 0], [0, -math.sin(turn)], [0, math.cos(turn)], [1, 0]]
    world = make_world(lever)
    try:
        np.testing.assert_allclose(world.jacobian([turn, swing]), expected, atol=1e-5)
    finally:
        world.close()


def test_joints_without_limits(lever):
    world = make_world(lever)
    try:
        assert (world.joint_lower == -np.inf).all()
        assert (world.joint_upper == np.inf).all()
        assert (world.joint_speed == np.inf).all()
    finally:
        world.close()


@pytest.mark.parametrize("from_urdf", [True, False])
def test_inertia_is_that_of_the_urdf_if_wanted(lever, from_urdf):
    world = make_world(lever, urdf_inertia=from_urdf)
    try:
        inertia = pybullet.getDynamicsInfo(world._arm.body, 1, physicsClientId=world._client)[2]
        assert (inertia == (1, 2, 3)) == from_urdf
    finally:
        world.close()


def test_free_obstacle_falls_onto_the_table(make_env):
    layout = InFront(shape=Cylinder(mass=1.0), height=0.2)
    env = make_env(ArmEnv, obstacles=layout, scene=Scene(gravity=1.62), seed=0)
    env.reset()
    still = TensorDict({"action": torch.zeros(1, 3)}, batch_size=[1])
    observation = env.step(still.clone())["next", "observation"].numpy()
    # After 0.05 s, by gravity and with Bullet's little drag.
    np.testing.assert_allclose(env.arm_state.obstacle_velocity, [[[0, 0, -0.081]]], atol=2e-4)
    fall = observation[:, env.observation_fields["obstacle_velocity"]]
    np.testing.assert_allclose(fall, env.arm_state.obstacle_velocity[:, 0], atol=1e-6)
    for _ in range(40):
        env.step(still.clone())
    # It stands 0.2 m high on a table whose top is at height 0.
    assert env.arm_state.obstacle_position[0, 0, 2] == pytest.approx(0.1, abs=1e-3)


def test_picture_world_takes_joints_and_poses():
    cube = Box((0.02, 0.02, 0.02), mass=0.1)
    one, two = (make_world(shapes=(Cylinder(mass=1.0),), objects=(cube,)) for _ in range(2))
    try:
        lying = ((0.6, 0.1, 0.05), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))
        one.reset(Placement([[0.5, 0, 0.1]]), np.zeros(3), np.array([[0.4, 0.3, 0.02]]))
        one._set_joints(np.array(PANDA.home) + 0.1)
        one._place(one._obstacles[0], *lying)
        turned = ((0.7, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8))
        one._place(one._objects[0], *turned)
        two.copy_from(one)
        assert two._joint_states() == one._joint_states() != ()
        np.testing.assert_allclose(
            np.concatenate(two._pose(two._obstacles[0])), [*lying[0], *lying[1]]
        )
        np.testing.assert_allclose(
            np.concatenate(two._pose(two._objects[0])), [*turned[0], *turned[1]]
        )
        np.testing.assert_allclose([s[0] for s in two._joint_states()], np.array(PANDA.home) + 0.1)
    finally:
        one.close()
        two.close()


def test_a_broken_world_is_named(make_env):
    """And the others take their step."""
    env = make_env(ArmEnv, num_envs=3, seed=0)
    env.reset()
    arm = worlds_of(env)[1]._arm
    client = worlds_of(env)[1]._client
    pybullet.resetJointState(arm.body, arm.joints[0], float("nan"), physicsClientId=client)
    with pytest.raises(FloatingPointError, match="The physics of world 1 is not finite: reset it"):
        rest(env)
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    assert np.isfinite(env.arm_state.joint_position).all()
    assert env.arm_state.step.tolist() == [1, 0, 1]
