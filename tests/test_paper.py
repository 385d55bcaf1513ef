"""The paper's environment against what its authors' code was measured to do.

The numbers are from reference runs of the original code (reset pose, spawn heights, step sizes,
costs and returns of scripted policies), with tolerances for their number of episodes.
"""

import math
from types import SimpleNamespace

import numpy as np
import pybullet
import pytest
import torch
from bullet_worlds import worlds_of
from scripted import fly, go, straight
from states import make_state
from torchrl.envs.utils import check_env_specs
from worlds import step

from torchrl_safe.envs import (
    PAPER_CARTESIAN,
    PAPER_JOINT,
    PAPER_SETTINGS,
    Proximity,
    Speed,
    paper_env,
)

pytestmark = pytest.mark.integration


def still(env):
    """AR1's zero action: no displacement, fingers wherever they are let go."""
    return torch.zeros(env.action_spec.shape)


@pytest.mark.parametrize(
    ("action", "width"), [(PAPER_CARTESIAN, 4), (PAPER_JOINT, 7)], ids=["AR1", "AR2"]
)
def test_shape(make_env, action, width):
    env = make_env(paper_env, action, num_envs=2)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (2, 8)
    assert env.action_spec.shape == (2, width)
    assert env.control_rate == 240
    assert env.max_episode_steps == 500


def test_start(make_env):
    env = make_env(paper_env, num_envs=20, seed=0)
    observation = env.reset()["observation"].numpy()
    np.testing.assert_allclose(observation[:, :3], [[0.4315, 0, 0.2346]] * 20, atol=1e-4)
    np.testing.assert_allclose(observation[:, 3:5], 0.08, atol=1e-6)
    goal = observation[:, 5:]
    assert ((goal[:, 0] >= 0.6) & (goal[:, 0] <= 0.8)).all()
    assert (np.abs(goal[:, 1]) <= 0.2).all()
    np.testing.assert_allclose(goal[:, 2], 0.05, atol=1e-6)
    np.testing.assert_allclose(env.arm_state.obstacle_position[:, 0], goal - [0.2, 0, 0], atol=1e-6)


def test_brick_falls_and_obstacle_is_pushed_out_of_the_table(make_env):
    env = make_env(paper_env, num_envs=4, seed=0)
    env.reset()
    for _ in range(60):
        step(env, still(env))
    np.testing.assert_allclose(env.arm_state.goal[:, 2], -0.0135, atol=2e-3)
    np.testing.assert_allclose(env.arm_state.obstacle_position[:, 0, 2], 0.076, atol=2e-3)


def test_brick_falls_with_10_m_per_s2(make_env):
    env = make_env(paper_env, seed=0)
    env.reset()
    for _ in range(12):
        step(env, still(env))
    fallen = 10 * (1 / 240) ** 2 * sum(range(1, 13))
    np.testing.assert_allclose(env.arm_state.goal[0, 2], 0.05 - fallen, atol=1e-4)


def test_a_tenth_of_a_cartesian_command_is_done(make_env):
    env = make_env(paper_env, seed=0)
    env.reset()
    heights = []
    for _ in range(12):
        step(env, torch.tensor([[0.0, 0.0, 1.0, 0.0]]))
        heights.append(env.arm_state.ee_position[0, 2])
    assert 0.003 < np.diff(heights)[-5:].mean() < 0.005


def test_joint_command_turns_a_hundredth(make_env):
    env = make_env(paper_env, PAPER_JOINT, seed=0)
    env.reset()
    angles = []
    for _ in range(12):
        step(env, torch.tensor([[1.0, 0, 0, 0, 0, 0, 0]]))
        angles.append(env.arm_state.joint_position[0, 0])
    np.testing.assert_allclose(np.diff(angles)[-5:], 0.01, atol=5e-4)


def test_actions_are_not_clipped(make_env):
    env = make_env(paper_env, PAPER_JOINT, seed=0)
    env.reset()
    start = env.arm_state.joint_position[0, 0]
    for _ in range(12):
        step(env, torch.tensor([[3.0, 0, 0, 0, 0, 0, 0]]))
    assert env.arm_state.joint_position[0, 0] - start > 0.2


def test_cartesian_actions_are_not_clipped_either(make_env):
    """Three times as much is done of one that is three times as large."""
    env = make_env(paper_env, num_envs=2, seed=0)
    env.reset()
    start = env.arm_state.ee_position[:, 2]
    for _ in range(8):
        step(env, torch.tensor([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 3.0, 0.0]]))
    one, three = env.arm_state.ee_position[:, 2] - start
    assert three / one == pytest.approx(3, rel=0.1)


def test_joint_commands_go_beyond_the_limits():
    """Which are at 2 rad here: a tenth of the action is added, whatever comes of it."""
    state = make_state(joint_position=[[1.95] * 7, [-1.95] * 7])
    targets, _ = PAPER_JOINT.targets(np.array([[1.0] * 7, [-1.0] * 7]), state, None)
    np.testing.assert_allclose(targets, [[2.05] * 7, [-2.05] * 7])


def test_the_tool_points_down_and_a_quarter_turn_aside():
    turned = pybullet.getQuaternionFromEuler((0, -math.pi, math.pi / 2))
    assert abs(np.dot(PAPER_CARTESIAN.orientation, turned)) == pytest.approx(1)


def test_the_arm_is_the_one_of_the_file(make_env):
    """All of its twelve joints, and the 0.1 kg m^2 that the file writes for every link."""
    world = worlds_of(make_env(paper_env))[0]
    arm, client = world._arm.body, world._client
    assert pybullet.getNumJoints(arm, physicsClientId=client) == 12
    for link in range(7):
        inertia = pybullet.getDynamicsInfo(arm, link, physicsClientId=client)[2]
        assert inertia == pytest.approx((0.1, 0.1, 0.1))


def test_success_is_within_9_centimetres_counted_along_the_axes():
    """Both tools are 5 cm away as the crow flies."""
    state = make_state(
        ee_position=[[0.03, 0.03, 0.029], [0.03, 0.03, 0.031]], goal=np.zeros((2, 3))
    )
    assert PAPER_SETTINGS["task"].success(state).tolist() == [True, False]


def test_tool_pose_lags_one_substep(make_env):
    env = make_env(paper_env, seed=0)
    env.reset()
    step(env, torch.tensor([[0.0, 0.0, 1.0, 0.0]]))
    fresh = np.array(worlds_of(env)[0].read(fresh=True))[18:21]
    step(env, torch.tensor([[0.0, 0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(env.arm_state.ee_position[0], fresh, atol=1e-6)


def test_gap_with_a_contact_point_costs(make_env):
    """Bullet reports contact points before a touch: so the original counts."""
    (cost,) = make_env(paper_env).costs.values()
    distances = np.array([[np.inf, np.inf], [np.inf, 0.0015], [-0.001, np.inf]])
    assert cost(SimpleNamespace(contact_distance=distances)).tolist() == [0, 1, 1]


def test_fourth_component_is_the_fingers_position(make_env):
    env = make_env(paper_env, seed=0)
    env.reset()
    for _ in range(100):
        step(env, torch.tensor([[0, 0, 0, 0.03]]))
    np.testing.assert_allclose(env.arm_state.finger_position, [[0.03, 0.03]], atol=2e-3)


def test_arguments_go_before_the_papers(make_env):
    env = make_env(paper_env, max_episode_steps=3, frame_skip=2)
    assert (env.max_episode_steps, env.control_rate) == (3, 120)


def test_obstacle_weighs_a_kilogram(make_env):
    world = worlds_of(make_env(paper_env))[0]
    body = pybullet.getDynamicsInfo(world._obstacles[0], -1, physicsClientId=world._client)
    assert body[0] == 1


def test_reward_is_the_l1_distance(make_env):
    env = make_env(paper_env, num_envs=3, seed=0)
    env.reset()
    result = step(env, still(env))
    state = env.arm_state
    expected = -np.abs(state.ee_position - state.goal).sum(1)
    np.testing.assert_allclose(result["reward"][:, 0], expected, rtol=1e-5)


def test_straight_policy_scores_as_in_the_original(make_env):
    """Measured there, 50 episodes: success 1.00, return -21.6 +- 6.6, cost 28.6 +- 15.1."""
    env = make_env(paper_env, num_envs=25, seed=1)
    success, total, cost = fly(env, straight, share=1)
    assert success.all()
    standard_error = math.sqrt(1 / 50 + 1 / 25)
    assert total.mean() == pytest.approx(-21.6, abs=3 * 6.6 * standard_error)
    assert cost.mean() == pytest.approx(28.6, abs=3 * 15.1 * standard_error)


def test_going_around_costs_nothing(make_env):
    """Measured there: 22 cm sideways, then in, reaches every target at cost 0."""
    env = make_env(paper_env, num_envs=20, seed=2)

    def around(env, row):
        goal = env.arm_state.goal[row]
        side = goal + np.array([0, -0.22 if goal[1] > 0 else 0.22, 0.12])
        yield from go(env, row, np.array([0.43, side[1], 0.25]))
        yield from go(env, row, side)
        yield from straight(env, row)

    success, _, cost = fly(env, around, share=1)
    assert success.all()
    assert not cost.any()


def test_measuring_changes_nothing(make_env):
    """Not even where the tool is read one substep late."""
    costs = {**PAPER_SETTINGS["costs"], "speed": Speed(), "near": Proximity()}
    plain, measured = make_env(paper_env, seed=0), make_env(paper_env, seed=0, costs=costs)
    ahead = lambda td: td.set("action", torch.full((1, 4), 0.3))  # noqa: E731
    expected, got = (env.rollout(60, ahead)["next"] for env in (plain, measured))
    assert torch.equal(got["observation"], expected["observation"])
    assert torch.equal(got["cost"][..., :1], expected["cost"])
