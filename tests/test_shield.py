"""The shield: its distances and what it does to actions."""

import numpy as np
import pytest
import torch
from states import make_state
from worlds import ENGINES, Places, at_speed, each_arm, step

from experiments.pilots import act, make_pilot
from torchrl_safe.envs import (
    PANDA,
    ArmEnv,
    Box,
    CartesianDelta,
    Collision,
    Cylinder,
    InFront,
    JointDelta,
    Nearest,
    NoObstacles,
    PickAndPlace,
    Placement,
    Push,
    Region,
    Scattered,
    Scene,
    Shield,
    Sphere,
)

# With that, a control step of 1/20 s may use up this share of the room above the margin.
SLOW = Shield(margin=0.02, rate=5.0)

SHARE = 1 - np.exp(-5 / 20)

# A Cartesian action towards the table.
DOWN = torch.tensor([0.0, 0.0, -1.0])


def build(physics, arm=PANDA, free_fingers=False):
    """Two worlds with a cylinder and a box beside the arm."""
    simulator = physics.build(
        arm,
        Scene(free_fingers=free_fingers),
        num_envs=2,
        shapes=(Cylinder(), Box()),
        reach=0.3,
    )
    for row in range(2):
        placement = Placement([[0.5, 0.05, 0.1], [0.3, 0.35, 0.2]])
        simulator.reset(row, placement, np.array([0.6, 0.0, 0.1]), np.zeros((0, 3)))
    return simulator


def nearest_to_bar(physics, turntable, shape, centre, reach):
    """What is near the bar of the turntable, at rest, of one obstacle."""
    simulator = physics.build(turntable["arm"], Scene(), num_envs=1, shapes=(shape,), reach=reach)
    simulator.reset(0, Placement([centre]), np.zeros(3), np.zeros((0, 3)))
    near = simulator.nearest(np.arange(1), np.zeros((1, 1)), np.zeros((1, 0)))
    simulator.close()
    return near


def nearest_of_each(simulator, joints, fingers):
    """Distance and Jacobian of the nearest pair of each obstacle and the table, ``(2, 3, ...)``."""
    near = simulator.nearest(np.arange(2), joints, fingers)
    masked = [np.where(near.other == other, near.distance, np.inf) for other in range(3)]
    pairs = np.stack([distance.argmin(axis=1) for distance in masked], axis=1)
    rows = np.arange(2)[:, None]
    return near.distance[rows, pairs], near.jacobian[rows, pairs]


@pytest.mark.parametrize("free_fingers", [False, True])
@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_distances_change_as_their_jacobians_say(physics, free_fingers):
    simulator = build(physics, free_fingers=free_fingers)
    joints = PANDA.home + np.random.default_rng(0).normal(0, 0.2, (2, 7))
    fingers = np.full((2, len(simulator.finger_speed)), 0.02)
    distance, jacobian = nearest_of_each(simulator, joints, fingers)
    assert (distance < 0.3).all()
    angles, small = np.concatenate([joints, fingers], axis=1), 1e-3
    for index in range(angles.shape[1]):
        change = np.eye(angles.shape[1])[index] * small
        ends = [np.split(angles + sign * change, [7], axis=1) for sign in (1, -1)]
        more, less = (nearest_of_each(simulator, *end)[0] for end in ends)
        np.testing.assert_allclose(jacobian[..., index], (more - less) / (2 * small), atol=0.01)
    simulator.close()


@each_arm
def test_both_engines_measure_the_same(arm):
    """But for the margin of a millimetre that PyBullet leaves."""
    simulators = [build(physics, arm) for physics in ENGINES.values()]
    joints = arm.home + np.random.default_rng(1).normal(0, 0.2, (2, len(arm.home)))
    found = []
    for simulator in simulators:
        near = simulator.nearest(np.arange(2), joints, np.zeros((2, 0)))
        found.append([np.sort(d[np.isfinite(d)]) for d in near.distance])
        simulator.close()
    for bullet, mujoco in zip(*found, strict=True):
        np.testing.assert_allclose(bullet, mujoco, atol=2.5e-3)


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_the_way_out_of_an_overlap(turntable, physics):
    """A ball reaches 1 cm into the side of the bar, which has to turn by 1 cm / 0.3 m out of it."""
    near = nearest_to_bar(physics, turntable, Sphere(0.1), (0.3, 0.14, 0.5), reach=0.3)
    pair = near.distance[0].argmin()
    assert near.distance[0, pair] == pytest.approx(-0.01, abs=1e-3)
    np.testing.assert_allclose(near.normal[0, pair], [0, -1, 0], atol=1e-3)
    assert near.jacobian[0, pair, 0] == pytest.approx(-0.3, abs=1e-3)


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_what_just_touches_is_near(turntable, physics):
    """A box of exact numbers lies on the bar."""
    near = nearest_to_bar(physics, turntable, Box((0.125,) * 3), (0.25, 0.0, 0.645), reach=0.3)
    assert near.distance.min() == pytest.approx(0, abs=5e-4)


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_what_cannot_sink_is_not_measured_against_the_table(turntable, physics):
    """No joint could change it, and below the margin it would hold the arm for ever."""
    near = nearest_to_bar(physics, turntable, Sphere(), (0.8, 0.0, 0.5), reach=1.0)
    assert np.isfinite(near.distance[:, near.other == 0]).any()
    assert not np.isfinite(near.distance[:, near.other == 1]).any()


def test_measuring_changes_nothing(make_env, engine):
    """And is only done where somebody wants it."""
    plain, measured = (make_env(ArmEnv, seed=0, shield=shield) for shield in (None, Shield()))
    with pytest.raises(ValueError, match="reach must be given"):
        plain._simulator.nearest(np.arange(1), plain.arm_state.joint_position, np.zeros((1, 0)))
    states = []
    for env in (plain, measured):
        env.reset()
        state = env.arm_state
        for _ in range(5):
            if env is measured:
                rows, fingers = np.arange(1), state.finger_position
                env._simulator.nearest(rows, state.joint_position + 0.3, fingers)
            env._simulator.advance(state.joint_position + 0.02, np.zeros((1, 0)))
            state = env._simulator.state()
        states.append(state.joint_position)
    np.testing.assert_array_equal(*states)


def turn(make_env, turntable, sphere, action=1.0, **settings):
    """A step of the bar towards a ball beside its end; returns the environment."""
    layout = Places(Sphere(0.1), at=[sphere])
    env = make_env(ArmEnv, **{"shield": SLOW, **turntable, "obstacles": layout, **settings})
    env.reset()
    step(env, action)
    return env


def test_a_distance_shrinks_by_its_share(make_env, engine, turntable):
    """By hand: the side of the bar is 0.1 m from the ball, and 0.45 m from the axis."""
    env = turn(make_env, turntable, (0.45, 0.25, 0.5))
    allowed = SHARE * (0.1 - 0.02) / 0.45
    state = env.arm_state
    assert state.shield_correction[0] == pytest.approx(0.1 - allowed, abs=1e-4)
    assert not state.shield_braked[0]
    assert state.joint_position[0, 0] == pytest.approx(allowed, rel=0.05)


def test_a_distance_leaves_room_to_stop_in(make_env, engine, turntable):
    """By hand: a third of 10 rad/s^2 at a lever of 0.45 m, over 1/20 s."""
    shield = Shield(margin=0.02, rate=1e3)
    env = turn(make_env, turntable, (0.45, 0.25, 0.5), shield=shield)
    brake = 10 * 0.05**2 * 0.45 / 3
    allowed = (np.sqrt(brake**2 / 4 + 2 * brake * 0.08) - brake / 2) / 0.45
    # A little more: what is nearest at the end of the step is another point.
    assert env.arm_state.shield_correction[0] == pytest.approx(0.1 - allowed, abs=2e-3)
    assert not env.arm_state.shield_braked[0]
    # And it stops in it, as fast as it may.
    steps = [step(env, 1.0) for _ in range(30)]
    assert not any(after["cost"].any() for after in steps)
    state = env.arm_state
    near = env._simulator.nearest(np.arange(1), state.joint_position, state.finger_position)
    assert near.distance.min() == pytest.approx(0.02, abs=2e-3)


def test_what_leads_away_is_left_alone(make_env, engine, turntable):
    state = turn(make_env, turntable, (0.45, 0.25, 0.5), action=-1.0).arm_state
    assert state.shield_correction[0] == 0
    assert state.joint_position[0, 0] == pytest.approx(-0.1, rel=0.05)


def test_the_tool_goes_on_where_other_joints_can_give_way(make_env, engine):
    env = make_env(ArmEnv, num_envs=16, obstacles=Scattered(), shield=Shield(), seed=0)
    env.reset()
    state, simulator = env.arm_state, env._simulator
    action = np.sign(state.obstacle_position[:, 0] - state.ee_position)
    asked, fingers = CartesianDelta(step=0.02).targets(action, state, simulator)
    jacobian = simulator.jacobian(state.joint_position)[:, :3]
    way = (jacobian @ (asked - state.joint_position)[:, :, None])[:, :, 0]
    speeds = {"longest": simulator.joint_speed / env.control_rate, "duration": 1 / env.control_rate}
    missed, turned, fastest = [], [], []
    for tool_weight in (0.0, 10.0):
        shield = Shield(rate=1.0, acceleration=1e3, tool_weight=tool_weight)
        done = shield(asked, fingers, state, simulator, **speeds)
        assert not done.braked.any()
        change = done.joints - asked
        tool = (jacobian @ change[:, :, None])[:, :, 0]
        missed.append(np.abs((tool * way).sum(axis=1)))
        turned.append(np.linalg.norm(change, axis=1))
        fastest.append(np.abs(done.joints - state.joint_position).max(axis=1))
    assert (missed[1] < missed[0]).all()
    assert (turned[1] > turned[0]).all()
    # No joint turns further than the largest turn that is asked for.
    most = np.abs(asked - state.joint_position).max(axis=1)
    assert (fastest[1] <= most + 1e-9).all()
    assert np.isclose(fastest[1], most).any()


def test_far_from_everything_a_shield_does_nothing(make_env, engine, turntable):
    """Bit for bit."""
    rollouts = []
    for shield in (None, Shield()):
        env = make_env(ArmEnv, **{**turntable, "num_envs": 2, "shield": shield})
        torch.manual_seed(0)
        rollouts.append(env.rollout(10)["observation"])
    torch.testing.assert_close(*rollouts, rtol=0, atol=0)


def test_what_comes_is_given_way_to(make_env, engine, turntable):
    """A ball that comes at 0.4 m/s pushes the bar, which is to rest, away before it touches it."""
    start = (0.45, 0.25, 0.5)
    layout = Places(Sphere(0.1), at=[start], path=at_speed(start, (0, -0.4, 0)))
    for shield in (None, Shield(tool_weight=0.0), Shield()):
        env = make_env(ArmEnv, **{**turntable, "obstacles": layout, "shield": shield})
        env.reset()
        costs = torch.cat([step(env, 0.0)["cost"] for _ in range(10)])
        assert costs.any() == (shield is None)
        assert shield is None or env.arm_state.joint_position[0, 0] < -0.1


def test_what_comes_is_given_way_to_as_far_as_what_stands_allows(make_env, engine, turntable):
    """On one side of the bar a ball comes at 0.4 m/s, on the other one leaves room for 2 mm."""

    def path(times):
        comes = np.array([0.45, 0.18, 0.5]) - 0.4 * times[:, None] * [0, 1, 0]
        stands = np.tile([0.45, -0.172, 0.5], (len(times), 1))
        orientations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 2, 1))
        return np.stack([comes, stands], axis=1), orientations

    positions = [(0.45, 0.18, 0.5), (0.45, -0.172, 0.5)]
    layout = Places(Sphere(0.1), Sphere(0.1), at=positions, path=path)
    env = make_env(ArmEnv, **{**turntable, "obstacles": layout, "shield": SLOW})
    env.reset()
    assert step(env, 1.0)["shield_braked"].item()
    assert env.arm_state.joint_position[0, 0] == pytest.approx(-0.002 / 0.45, abs=1e-3)


def test_what_may_come_is_not_approached(make_env, engine, turntable):
    """In a step of 1/20 s a ball of up to 2 m/s could take up the whole room."""
    shield = Shield(obstacle_speed=2.0)
    state = turn(make_env, turntable, (0.45, 0.25, 0.5), shield=shield).arm_state
    assert state.joint_position[0, 0] == pytest.approx(0, abs=1e-3)
    assert not state.shield_braked[0]


def test_between_two_that_are_too_near_it_brakes(make_env, engine, turntable):
    """Each would have the bar move towards the other."""
    layout = Places(Sphere(0.1), Sphere(0.1), at=[(0.45, 0.16, 0.5), (0.45, -0.16, 0.5)])
    env = make_env(ArmEnv, **{**turntable, "obstacles": layout, "shield": SLOW})
    env.reset()
    after = step(env, 1.0)
    assert after["shield_braked"].item()
    assert env.arm_state.joint_position[0, 0] == pytest.approx(0, abs=1e-3)
    # A reset does not change what a step has returned.
    env.reset()
    assert after["shield_braked"].item()
    assert after["shield_correction"].item() == pytest.approx(0.1)


@pytest.mark.parametrize("action", [1.0, -1.0])
def test_with_half_of_its_margin_gone_an_arm_only_withdraws(make_env, engine, turntable, action):
    """By hand: 13 mm of 20 are gone, at a lever of 0.45 m. What is asked for does not matter."""
    env = turn(make_env, turntable, (0.45, 0.157, 0.5), action=action)
    assert env.arm_state.shield_braked[0]
    assert env.arm_state.joint_position[0, 0] == pytest.approx(-SHARE * 0.013 / 0.45, rel=0.1)
    # With 7 mm gone it does what leads away, as fast as the motors follow near an obstacle.
    state = turn(make_env, turntable, (0.45, 0.163, 0.5), action=-1.0).arm_state
    assert not state.shield_braked[0]
    assert state.joint_position[0, 0] == pytest.approx(-10 * 0.05**2, rel=0.05)


def test_an_arm_that_withdraws_does_not_press_its_tool_down(make_env, engine):
    """From a ball before and above the hand the shortest way leads back and down."""
    layout = Places(Sphere(0.05), at=[(0.445, 0.0, 0.3)])
    env = make_env(ArmEnv, action=CartesianDelta(), obstacles=layout, shield=Shield(), seed=0)
    env.reset()
    height, found = env.arm_state.ee_position[0, 2], []
    for _ in range(2):
        assert step(env, DOWN)["shield_braked"].item()
        state = env.arm_state
        assert state.ee_position[0, 2] == pytest.approx(height, abs=1e-3)
        near = env._simulator.nearest(np.arange(1), state.joint_position, state.finger_position)
        found.append(near.distance.min())
    assert 0.005 < found[0] < 0.01 < found[1]


def test_the_tool_stays_in_its_workspace(make_env, engine):
    region = Region((0.2, -0.1, 0.1), (0.5, 0.1, 0.4))
    shield = Shield(workspace=region)
    env = make_env(ArmEnv, obstacles=NoObstacles(), shield=shield, max_episode_steps=99, seed=0)
    env.reset()
    for direction in ((1.0, 1.0, 0.0), (-1.0, -1.0, 1.0)):
        for _ in range(15):
            step(env, torch.tensor(direction))
            assert region.contains(env.arm_state.ee_position + np.zeros(3)).all()


@pytest.mark.parametrize("mode", [CartesianDelta(), JointDelta()], ids=["cartesian", "joint"])
def test_nothing_drives_the_tool_out_of_its_workspace(make_env, engine, mode):
    """Actions turn round every eight steps; at the walls motors have to follow."""
    region = Region((0.2, -0.15, 0.1), (0.5, 0.15, 0.4))
    env = make_env(
        ArmEnv,
        num_envs=8,
        action=mode,
        obstacles=NoObstacles(),
        shield=Shield(workspace=region),
        max_episode_steps=99,
        seed=0,
    )
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        action = torch.randn(env.action_spec.shape, generator=generator).sign()
        for _ in range(8):
            step(env, action)
            assert region.contains(env.arm_state.ee_position).all()


def test_a_tool_outside_its_workspace_moves_in(make_env, engine):
    """Whatever it is asked for: at home it is 10 cm in front of the box."""
    region = Region((0.45, -0.1, 0.1), (0.7, 0.1, 0.4))
    shield = Shield(workspace=region)
    env = make_env(ArmEnv, obstacles=NoObstacles(), shield=shield, max_episode_steps=99, seed=0)
    env.reset()
    assert not region.contains(env.arm_state.ee_position).any()
    for _ in range(20):
        step(env, torch.tensor([-1.0, 0.0, 0.0]))
    assert region.contains(env.arm_state.ee_position).all()


def test_a_tool_far_from_the_walls_moves_as_asked_where_obstacles_may_come(make_env, engine):
    """A ball beside it could come, but is far away as well."""
    shield = Shield(workspace=Region((-2, -2, -2), (2, 2, 2)), obstacle_speed=0.5)
    layout = Places(Sphere(), at=[(-0.4, 0.6, 0.8)])
    env = make_env(ArmEnv, obstacles=layout, shield=shield, seed=0)
    env.reset()
    for action in (*torch.eye(3), *-torch.eye(3)):
        assert step(env, action)["shield_correction"].item() == 0


def test_motors_without_limits(make_env, engine):
    scene = Scene(motor_limits=False)
    env = make_env(ArmEnv, obstacles=Scattered(), scene=scene, shield=Shield(), seed=0)
    env.reset()
    assert not step(env, torch.tensor([0.0, 0.0, 1.0]))["shield_braked"].item()


def test_a_workspace_without_room_is_refused():
    with pytest.raises(ValueError, match=r"workspace must be wider than two margins of 0.02 m"):
        Shield(workspace=Region((0.2, -0.02, 0.1), (0.6, 0.02, 0.4)))


def test_the_table_is_left_alone(make_env, engine):
    """The gripper is pressed down, open or closed; without the shield it would touch."""
    action = CartesianDelta(finger_step=0.04)
    for shield in (None, Shield()):
        env = make_env(
            ArmEnv,
            action=action,
            obstacles=NoObstacles(),
            costs={"table": Collision(table=True)},
            shield=shield,
            seed=0,
        )
        env.reset()
        costs = [
            step(env, torch.tensor([0.3, 0.0, -1.0, float(index % 2)]))["cost"].item()
            for index in range(12)
        ]
        assert any(costs) == (shield is None)


@pytest.mark.parametrize(
    ("task", "obstacles"),
    [(Push(), NoObstacles()), (PickAndPlace(on_table=1.0), InFront())],
    ids=["push", "pick"],
)
def test_it_lets_an_arm_push_and_pick_up(make_env, task, obstacles):
    """Down to the table, and beside the obstacle, where a hand needs a smaller margin."""
    action = CartesianDelta(
        step=0.03,
        orientation=PANDA.handling_orientation,
        finger_step=0.04 if isinstance(task, PickAndPlace) else None,
    )
    settings = {"task": task, "obstacles": obstacles, "action": action, "seed": 0}
    settings["max_episode_steps"] = 200
    physics = ENGINES["mujoco"]
    env = make_env(ArmEnv, num_envs=4, physics=physics, shield=Shield(margin=0.01), **settings)
    env.reset()
    pilot, alive, success = make_pilot(env), torch.ones(4, 1, dtype=torch.bool), 0
    while alive.any():
        after = step(env, torch.as_tensor(act(env, pilot), dtype=torch.float32))
        assert not (after["cost"] * alive).any()
        success = success + (after["success"] & alive)
        alive &= ~after["done"]
    assert success.all()


class _Fist:
    """A joint q and a finger f, at a distance of 0.05 - f - q**2 / 2 from an obstacle."""

    def __init__(self):
        self.measured = []

    def nearest(self, rows, angles, fingers):
        distance = 0.05 - fingers - angles**2 / 2
        self.measured.append(distance)
        nothing = np.zeros((len(rows), 1, 3))
        jacobian = np.stack([-angles, -np.ones_like(fingers)], -1)
        return Nearest(distance, nothing, nothing, jacobian, np.array([0]))

    def jacobian(self, angles):
        return np.zeros((len(angles), 6, 1))


def test_what_the_fingers_use_up_counts_when_it_looks_ahead():
    """Where the step begins, the joint seems to be free to move."""
    world = _Fist()
    joint = dict.fromkeys(("joint_position", "joint_velocity", "finger_position"), np.zeros((2, 1)))
    state = make_state(**joint, joint_lower=[-9.0], joint_upper=[9.0])
    shield = Shield(margin=0.0, table=0.0, acceleration=1e4)
    asked = np.full((2, 1), 0.2), np.full((2, 1), 0.0315)
    done = shield(*asked, state, world, longest=np.array([0.2]), duration=0.05)
    assert len(world.measured) == 2
    assert (world.nearest(range(2), done.joints, done.fingers).distance > 0).all()
