"""Actions and inverse kinematics in the real simulator."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from states import make_state
from tensordict import TensorDict
from worlds import ARMS, each_arm, step, turn

from torchrl_safe.envs import (
    PANDA,
    PAPER_CARTESIAN,
    PAPER_JOINT,
    ArmEnv,
    ArmModel,
    Bullet,
    BulletInverseKinematics,
    CartesianDelta,
    DampedLeastSquares,
    JointDelta,
    MuJoCo,
    NoObstacles,
    Reach,
    Scene,
    Sensing,
)
from torchrl_safe.envs.physics.mujoco.model import build_world
from torchrl_safe.envs.rotations import from_rotation_vector, multiply, rotation_vector

pytestmark = pytest.mark.usefixtures("engine")

# An arm without a gripper.
BARE = ArmModel("kuka_iiwa/model.urdf", "lbr_iiwa_link_7", (0, 0.4, 0, -2, 0, 0.74, 0))


def drive(env, goal, steps):
    """Moves the tool towards a point, as a policy that sees the goal would."""
    for _ in range(steps):
        delta = torch.as_tensor(goal - env.arm_state.ee_position) / env.action_mode.step
        env.step(TensorDict({"action": delta.float()}, batch_size=env.batch_size))
    return env.arm_state


@pytest.mark.parametrize("solver", [DampedLeastSquares(), BulletInverseKinematics()], ids=str)
def test_tool_reaches_targets_to_a_millimetre(make_env, engine, solver):
    corners = np.array(
        [[x, y, z] for x in (0.45, 0.7) for y in (-0.2, 0.2) for z in (0.05, 0.3)], float
    )
    action = CartesianDelta(inverse_kinematics=solver)
    settings = {"num_envs": len(corners), "action": action, "obstacles": NoObstacles(), "seed": 0}
    if engine == "mujoco" and solver == BulletInverseKinematics():
        with pytest.raises(TypeError, match=r"needs physics=Bullet\(\), got MuJoCoSimulator"):
            ArmEnv(**settings)
        return
    env = make_env(ArmEnv, **settings)
    env.reset()
    state = drive(env, corners, 60)
    assert np.linalg.norm(state.ee_position - corners, axis=1).max() < 1e-3
    tilt = rotation_vector(state.ee_orientation, env._simulator.home_orientation)
    assert np.abs(tilt).max() < 0.02
    assert (state.joint_position >= state.joint_lower).all()
    assert (state.joint_position <= state.joint_upper).all()


@pytest.fixture
def panda():
    """A Panda that is not simulated, only asked where it would be."""
    simulator = Bullet().build(PANDA, Scene(), num_envs=1)
    yield simulator
    simulator.close()


def state_at(simulator, angles):
    """What DampedLeastSquares reads, at given joint angles."""
    position, orientation = simulator.tool_at(angles)
    return SimpleNamespace(
        joint_position=angles,
        ee_position=position,
        ee_orientation=orientation,
        joint_lower=simulator.joint_lower,
        joint_upper=simulator.joint_upper,
    )


def test_a_number_of_any_kind_is_one():
    """NumPy's short floats overflow if they are compared with the largest of all floats."""
    assert CartesianDelta(step=np.float32(0.5)).step == 0.5


def test_one_step_of_least_squares_lands_near_the_target(panda):
    rng = np.random.default_rng(0)
    state = state_at(panda, PANDA.home + rng.uniform(-0.3, 0.3, (50, 7)))
    target = state.ee_position + rng.uniform(-0.03, 0.03, (50, 3))
    # The wanted orientation is the present one, so that only the position moves.
    angles = DampedLeastSquares()(target, state.ee_orientation, state, panda)
    errors = np.linalg.norm(panda.tool_at(angles)[0] - target, axis=1)
    assert np.median(errors) < 0.004


def test_damping_and_limits_hold_the_joints_back_near_a_singular_pose(panda):
    """Without damping, a stretched arm that is to stretch on would turn its joints by radians."""
    state = state_at(panda, np.array([[0.0, 0.0, 0.0, -0.08, 0.0, 0.08, 0.0]]))
    target = state.ee_position + np.array([[0.0, 0.0, 0.05]])
    unbounded = np.full(7, np.inf)
    state.joint_lower, state.joint_upper = -unbounded, unbounded
    angles = DampedLeastSquares()(target, state.ee_orientation, state, panda)
    assert np.abs(angles - state.joint_position).max() < 0.5
    # The limits hold whatever the step would be.
    state.joint_lower, state.joint_upper = state.joint_position[0] + [[-0.01], [0.01]]
    held = DampedLeastSquares()(target, state.ee_orientation, state, panda)
    np.testing.assert_array_equal(held, np.clip(angles, state.joint_lower, state.joint_upper))


def test_jacobian_is_the_derivative_of_the_tool_point():
    """With the fingers free, which are none of its columns."""
    simulator = Bullet().build(PANDA, Scene(free_fingers=True), num_envs=1)
    try:
        angles = np.array(PANDA.home) + 0.1
        (jacobian,) = simulator.jacobian(angles[None])
        ahead, behind = (simulator.tool_at(angles + sign * 1e-3 * np.eye(7)) for sign in (1, -1))
    finally:
        simulator.close()
    assert jacobian.shape == (6, 7)
    np.testing.assert_allclose(jacobian[:3].T, (ahead[0] - behind[0]) / 2e-3, atol=1e-4)
    turns = rotation_vector(behind[1], ahead[1])
    np.testing.assert_allclose(jacobian[3:].T, turns / 2e-3, atol=1e-4)


@pytest.mark.parametrize("action", [CartesianDelta(), JointDelta()], ids=lambda a: type(a).__name__)
def test_full_action_keeps_joint_limits(make_env, action):
    env = make_env(ArmEnv, num_envs=2, action=action, obstacles=NoObstacles(), seed=0)
    actions = torch.ones(env.action_spec.shape)
    actions[1] = -1
    env.reset()
    # Long enough for every joint to meet its stop, time limit or not.
    for _ in range(100):
        env.step(TensorDict({"action": actions}, batch_size=env.batch_size))
    state = env.arm_state
    assert (state.joint_position >= state.joint_lower - 0.01).all()
    assert (state.joint_position <= state.joint_upper + 0.01).all()


def efforts(env):
    """The share of its effort that each motor of the arm has used last, ``(N, n)``."""
    simulator, count = env._simulator, len(env.arm.home)
    if isinstance(env.physics, MuJoCo):
        limits = build_world(env.arm, env.scene, (), (), Sensing()).parts.effort[:count]
        used = simulator._batch.bind("qfrc_actuator")[:, simulator._driven_speed[:count]]
    else:
        limits = simulator.worlds[0]._arm.effort[:count]
        used = np.array(
            [[state[3] for state in world._joint_states()[:count]] for world in simulator.worlds]
        )
    return np.abs(used) / limits


@pytest.mark.parametrize("action", [CartesianDelta(), JointDelta()], ids=lambda a: type(a).__name__)
@pytest.mark.parametrize(
    "arm",
    [
        pytest.param(arm, id=name, marks=() if arm is PANDA else pytest.mark.slow)
        for name, arm in ARMS.items()
    ],
)
def test_joints_keep_to_the_speeds_of_the_urdf(make_env, engine, arm, action):
    """Unless a motor's whole effort cannot hold its joint.

    Full reversals of all joints throw the wrists, whose motors are the weakest. Bullet's motors use
    as much effort as it takes. MuJoCo's use the more, the faster a joint is: the whole effort from
    a quarter above its speed.
    """
    task = Reach(radius=0.001)
    env = make_env(
        ArmEnv, arm, num_envs=8, action=action, task=task, obstacles=NoObstacles(), seed=0
    )
    generator = torch.manual_seed(0)
    speeds, used = [], []
    for _ in range(3):
        env.reset()
        for _ in range(8):
            actions = torch.randn(env.action_spec.shape, generator=generator).sign()
            env.step(TensorDict({"action": actions}, batch_size=[8]))
            speeds.append(np.abs(env.arm_state.joint_velocity) / env._simulator.joint_speed)
            used.append(efforts(env))
    fast = np.array(speeds) > {"bullet": 1.01, "mujoco": 1.27}[engine]
    assert (np.array(used)[fast] > 0.99).all()
    assert fast.mean() < 0.02
    if arm is PANDA:
        np.testing.assert_allclose(env._simulator.joint_speed, [2.175] * 4 + [2.61] * 3)
        assert np.percentile(speeds, 90) > 0.95


def test_tool_keeps_the_orientation_it_is_given(make_env):
    """Here that of the paper, tilted by 0.3 rad about the world's x axis."""
    tilt = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)
    c, s = math.cos(0.15), math.sin(0.15)
    wanted = (c * tilt[0], c * tilt[1], s * tilt[1], -s * tilt[0])
    env = make_env(ArmEnv, action=CartesianDelta(orientation=wanted), obstacles=NoObstacles())
    env.reset()
    state = drive(env, np.array([[0.5, 0.0, 0.25]]), 40)
    assert np.abs(state.ee_orientation[0] @ np.array(wanted)) > 0.9999


@pytest.mark.parametrize(("respect", "expected"), [(True, 2.0), (False, 2.5)])
def test_joint_targets_respect_limits_if_wanted(respect, expected):
    both_ways = np.outer([1.0, -1.0], np.ones(7))
    state = make_state(joint_position=1.5 * both_ways)
    action = JointDelta(step=1.0, respect_limits=respect)
    joints, fingers = action.targets(both_ways, state, ())
    np.testing.assert_array_equal(joints, expected * both_ways)
    assert fingers.shape == (2, 0)


def test_all_joints_are_slowed_alike_and_worlds_one_by_one(make_env):
    """So that the tool keeps to its path. The other worlds have no effect."""
    settings = {"action": JointDelta(step=1.0), "obstacles": NoObstacles()}
    both, alone = make_env(ArmEnv, num_envs=2, **settings), make_env(ArmEnv, **settings)
    # World 0 asks for 20 and 10 rad/s, of which 2.175 are to be had; world 1 for 1 rad/s.
    action = torch.zeros(2, 7)
    action[0, 0], action[0, 6], action[1, 6] = 1.0, -0.5, 0.05
    for env, actions in ((both, action), (alone, action[1:])):
        env.reset()
        env.step(TensorDict({"action": actions}, batch_size=env.batch_size))
    moved = both.arm_state.joint_position - PANDA.home
    assert moved[0, 0] / moved[0, 6] == pytest.approx(-2, abs=0.3)
    np.testing.assert_array_equal(
        both.arm_state.joint_position[1], alone.arm_state.joint_position[0]
    )


def test_fingers_follow_with_motor_limits(make_env):
    action = CartesianDelta(finger_step=0.02)
    env = make_env(
        ArmEnv, action=action, scene=Scene(free_fingers=True), obstacles=NoObstacles(), seed=0
    )
    assert env.action_spec.shape == (1, 4)
    env.reset()
    for _ in range(20):
        env.step(TensorDict({"action": torch.tensor([[0, 0, 0, 1.0]])}, batch_size=[1]))
    np.testing.assert_allclose(env.arm_state.finger_position, [[0.02, 0.02]], atol=1e-3)


def shares(env, action):
    """What each world's joints have done of the way that an action asks for, shape (N,)."""
    before = env.arm_state
    targets = env.action_mode.targets(np.asarray(action, float), before, env._simulator)
    asked = env._within_speed(*targets)[0] - before.joint_position
    step(env, action)
    done = env.arm_state.joint_position - before.joint_position
    return (asked * done).sum(1) / (asked * asked).sum(1)


@pytest.mark.parametrize("action", [CartesianDelta(), JointDelta()], ids=lambda a: type(a).__name__)
@each_arm
def test_a_control_step_does_what_was_asked_for(make_env, arm, action):
    """To within 5 % where efforts and speeds allow it. They allow every arm small actions."""
    env = make_env(ArmEnv, arm, num_envs=8, action=action, obstacles=NoObstacles(), seed=0)
    generator = torch.manual_seed(0)
    env.reset()
    for _ in range(10):
        small = torch.rand(env.action_spec.shape, generator=generator) * 0.2 - 0.1
        np.testing.assert_allclose(shares(env, small), 1, atol=0.05)
    # A full action is more than the efforts of some arms can do from rest.
    env.reset()
    full = torch.rand(env.action_spec.shape, generator=generator).round() * 2 - 1
    for _ in range(4):
        done = shares(env, full)
        assert (done < 1.25).all(), "overshoot"
    assert np.median(done) > 0.95


def test_joint_delta_turns_the_joints(make_env):
    env = make_env(ArmEnv, action=JointDelta(step=0.1), obstacles=NoObstacles(), seed=0)
    env.reset()
    before = env.arm_state.joint_position.copy()
    action = torch.tensor([[0.5, 0, 0, 0, 0, 0, -0.5]])
    env.step(TensorDict({"action": action}, batch_size=env.batch_size))
    moved = (env.arm_state.joint_position - before)[0]
    np.testing.assert_allclose(moved[[0, 6]], [0.05, -0.05], rtol=0.01)
    np.testing.assert_allclose(moved[1:6], 0, atol=5e-3)


def test_rotation_vector_takes_the_short_way():
    angle = 0.2
    current = np.array([[0, 0, 0, 1.0], [0, 0, 0, -1.0]])
    wanted = np.array([math.sin(angle / 2), 0, 0, math.cos(angle / 2)])
    expected = [[2 * math.sin(angle / 2), 0, 0]] * 2
    np.testing.assert_allclose(rotation_vector(current, wanted), expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CartesianDelta(step=0), "step must be positive and finite, got 0"),
        (lambda: CartesianDelta(bound=-1), "bound must be positive, got -1"),
        (lambda: JointDelta(bound=True), "bound must be positive, got True"),
        (lambda: JointDelta(bound=0), "bound must be positive, got 0"),
        (lambda: JointDelta(bound=10**400), "bound must be positive, got 1000"),
        (lambda: JointDelta(bound=3e38), "bound must be at most 1.701e\\+38 or infinite, got 3e"),
        (lambda: CartesianDelta(orientation=(0, 0, 0, 0)), "orientation must be a unit quaternion"),
        (lambda: CartesianDelta(orientation=(1, 0, 0)), r"orientation must have shape \(4,\)"),
        (lambda: CartesianDelta(finger_step=0), "finger_step must be positive and finite, got 0"),
        (lambda: JointDelta(step=float("nan")), "step must be positive and finite, got nan"),
        (lambda: JointDelta(step=float("inf")), "step must be positive and finite, got inf"),
        (lambda: DampedLeastSquares(damping=0), "damping must be positive and finite, got 0"),
        (lambda: Scene(gravity=float("nan")), "gravity must be finite"),
        (lambda: Scene(gravity=-9.81), "gravity must be finite and not negative, got -9.81"),
        (lambda: Bullet(motor_gain=0), "motor_gain must be positive and finite, got 0"),
        (lambda: Bullet(motor_gain=5.0), "motor_gain must be at most 1, got 5.0"),
        (lambda: Bullet(furniture=(("plane.urdf", (0, 0)),)), "position of furniture must have"),
        (lambda: ArmEnv(physics=Bullet(target_urdf="no.urdf")), "urdf 'no.urdf' does not load"),
        (
            lambda: CartesianDelta(orientation=(1, 0, 0, 0), rotation_step=1),
            r"give one of them, got \(1, 0, 0, 0\) and 1",
        ),
        (lambda: CartesianDelta(yaw_step=-1), "yaw_step must be positive and finite, got -1"),
        (lambda: CartesianDelta(rotation_step=0), "rotation_step must be positive and finite, got"),
        (lambda: CartesianDelta(yaw_step=1, rotation_step=1), "give one of them, got 1 and 1"),
        (lambda: JointDelta(finger_step=0), "finger_step must be positive and finite, got 0"),
        (
            lambda: ArmEnv(BARE, action=CartesianDelta(finger_step=1)),
            "finger_step moves fingers, got 1 and an arm that has none",
        ),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: CartesianDelta(inverse_kinematics=3),
            "inverse_kinematics must be a callable object, got 3",
        ),
        (
            lambda: CartesianDelta(inverse_kinematics=DampedLeastSquares),
            "inverse_kinematics must be a callable object, got <class",
        ),
        (lambda: Bullet(furniture=("plane.urdf",)), "furniture must be pairs of a file and a pos"),
        (lambda: Bullet(target_urdf=3), "target_urdf must be an instance of str, got 3"),
    ],
)
def test_arguments_of_the_wrong_kind(make, message):
    with pytest.raises(TypeError, match=message):
        make()


def heading(env):
    """The axes of the tool in the world, as columns, ``(3, 3)``."""
    return turn(np.tile(env.arm_state.ee_orientation[0], (3, 1)), np.eye(3)).T


def angle_between(one, other):
    """How far a frame is turned from another, rad, and about which axis."""
    difference = other @ one.T
    axis = np.array([difference[2, 1], difference[0, 2], difference[1, 0]])
    axis -= np.array([difference[1, 2], difference[2, 0], difference[0, 1]])
    return np.arctan2(np.linalg.norm(axis), np.trace(difference) - 1), axis


@each_arm
def test_yaw_turns_the_tool_about_the_vertical(make_env, arm):
    """In ten steps by as many steps' angles; it points down and stays where it is."""
    action = CartesianDelta(yaw_step=0.05)
    env = make_env(ArmEnv, arm, action=action, obstacles=NoObstacles(), max_episode_steps=99)
    env.reset()
    start, place = heading(env), env.arm_state.ee_position[0]
    for sign in (1, -1):
        before = heading(env)
        for _ in range(10):
            step(env, [0, 0, 0, sign])
            assert heading(env)[2, 2] < -0.999
        angle, axis = angle_between(before, heading(env))
        assert angle == pytest.approx(0.5, abs=0.01)
        assert sign * axis[2] > 0.99 * np.linalg.norm(axis)
        assert np.linalg.norm(env.arm_state.ee_position[0] - place) < 0.01
    assert angle_between(start, heading(env))[0] < 0.05


@pytest.mark.parametrize("index", range(3))
@each_arm
def test_rotation_turns_the_tool_about_each_axis(make_env, arm, index):
    """Of the world, not of the tool."""
    action = CartesianDelta(rotation_step=0.05)
    env = make_env(ArmEnv, arm, action=action, obstacles=NoObstacles(), max_episode_steps=99)
    env.reset()
    before, place = heading(env), env.arm_state.ee_position[0]
    for _ in range(6):
        step(env, np.eye(6)[3 + index])
    angle, axis = angle_between(before, heading(env))
    assert angle == pytest.approx(0.3, abs=0.015)
    assert axis[index] > 0.97 * np.linalg.norm(axis)
    assert np.linalg.norm(env.arm_state.ee_position[0] - place) < 0.015


@pytest.mark.parametrize("mode", [CartesianDelta, JointDelta])
@each_arm
def test_fingers_open_and_close(make_env, arm, mode):
    """To the width that the last component asks for, and no further than closed."""
    env = make_env(
        ArmEnv, arm, action=mode(finger_step=0.04), obstacles=NoObstacles(), max_episode_steps=99
    )
    env.reset()
    action = np.zeros(env.action_spec.shape[1])
    for opening, expected in ((1.0, 0.04), (0.5, 0.02), (0.0, 0.0), (1.0, 0.04), (-1.0, 0.0)):
        action[-1] = opening
        for _ in range(12):
            step(env, action)
        fingers = env.arm_state.finger_position
        assert fingers.shape == (1, 2)
        np.testing.assert_allclose(fingers, [[expected] * 2], atol=2e-3)
    np.testing.assert_allclose(env.arm_state.joint_position, [arm.home], atol=0.02)


@pytest.mark.parametrize(
    ("mode", "width"),
    [
        (CartesianDelta(), 3),
        (CartesianDelta(finger_step=0.04), 4),
        (CartesianDelta(yaw_step=0.1), 4),
        (CartesianDelta(rotation_step=0.1), 6),
        (CartesianDelta(rotation_step=0.1, finger_step=0.04), 7),
        (JointDelta(), 6),
        (JointDelta(finger_step=0.04), 7),
    ],
    ids=str,
)
def test_widths(mode, width):
    assert mode.width(num_joints=6) == width
    assert mode.moves_fingers == (mode.finger_step is not None)


def test_steps_are_the_papers_unless_others_are_given():
    assert CartesianDelta().step == PAPER_CARTESIAN.step
    assert JointDelta().step == PAPER_JOINT.step


def test_the_largest_bound():
    """Twice that is the largest number of float32, and an interval of random actions is as long."""
    largest = float(np.finfo(np.float32).max) / 2
    assert CartesianDelta(bound=largest).bound == largest


DOWN = np.array([1.0, 0.0, 0.0, 0.0])


def asked_of_the_tool(action, orientations, **settings):
    """How the tools of two worlds are to be turned, ``(2, 4)``, and their fingers, ``(2, f)``."""
    mode = CartesianDelta(inverse_kinematics=lambda _, turned, *__: turned, **settings)
    state = make_state(ee_orientation=orientations, finger_position=np.zeros((2, 2)))
    return mode.targets(np.array(action, float), state, SimpleNamespace(home_orientation=DOWN))


def test_each_world_turns_as_its_own_action_says():
    """By 0.1 rad and back by 0.2: from half a turn about x, cos and sin of half the angle."""
    action = [[0, 0, 0, 0.5], [0, 0, 0, -1]]
    turned, fingers = asked_of_the_tool(action, [DOWN, DOWN], yaw_step=0.2)
    np.testing.assert_allclose(
        turned, [[math.cos(0.05), math.sin(0.05), 0, 0], [math.cos(0.1), -math.sin(0.1), 0, 0]]
    )
    assert fingers.shape == (2, 0)


def test_turns_and_fingers_have_components_of_their_own():
    """Of seven the fourth to sixth turn the tool, and the last opens the fingers."""
    action = [[0, 0, 0, 1, 0, 0, 0.5], [0, 0, 0, 0, 0, -1, 1]]
    upright = [[0.0, 0.0, 0.0, 1.0]] * 2
    turned, fingers = asked_of_the_tool(action, upright, rotation_step=0.2, finger_step=0.04)
    sin, cos = math.sin(0.1), math.cos(0.1)
    np.testing.assert_allclose(turned, [[sin, 0, 0, cos], [0, 0, -sin, cos]])
    np.testing.assert_allclose(fingers, [[0.02, 0.02], [0.04, 0.04]])


def test_yaw_undoes_a_tilt_and_keeps_the_turn():
    """One tool turned by 0.4 rad and tilted by 0.8 before; one as it is to be."""
    tilted = multiply(from_rotation_vector(np.array([0.8, 0.0, 0.0])), DOWN)
    tilted = multiply(from_rotation_vector(np.array([0.0, 0.0, 0.4])), tilted)
    turned, _ = asked_of_the_tool(np.zeros((2, 4)), [tilted, DOWN], yaw_step=0.1)
    expected = [[math.cos(0.2), math.sin(0.2), 0, 0], DOWN]
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_yaw_turns_the_orientation_that_is_given():
    """Here half a turn and 0.3 rad more about x, which is not what the home pose has."""
    given = (math.cos(0.15), 0.0, 0.0, -math.sin(0.15))
    action = [[0, 0, 0, 0], [0, 0, 0, 1]]
    turned, _ = asked_of_the_tool(action, [given, given], yaw_step=0.2, orientation=given)
    sin, cos = math.sin(0.1), math.cos(0.1)
    expected = [given, [cos * given[0], sin * given[0], sin * given[3], cos * given[3]]]
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_yaw_of_a_tool_that_points_up():
    """Its turn about the vertical is not defined then, but the next action brings it back."""
    up = [[0.0, 0.0, 0.0, 1.0]] * 2
    wanted, _ = asked_of_the_tool(np.zeros((2, 4)), up, yaw_step=0.1)
    np.testing.assert_allclose(wanted, [DOWN, DOWN], atol=0)


def test_orientation_may_be_an_array(make_env):
    wanted = np.array([1.0, 0.0, 0.0, 0.0])
    env = make_env(ArmEnv, action=CartesianDelta(orientation=wanted))
    assert env.rollout(2)["next", "reward"].isfinite().all()
