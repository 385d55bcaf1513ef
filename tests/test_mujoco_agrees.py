"""MuJoCo and PyBullet: the same arms, actions, obstacles and measurements."""

from dataclasses import replace

import numpy as np
import pytest
from scripted import fly
from test_mujoco import EVERYTHING, ONE
from test_scripted import PILOTS, settings
from worlds import ARMS, Places, each_arm, rest, step

from torchrl_safe.envs import (
    PANDA,
    UR5,
    ArmEnv,
    Box,
    Bullet,
    Capsule,
    CartesianDelta,
    Cylinder,
    Human,
    InFront,
    JointDelta,
    Moving,
    NoObstacles,
    Patrol,
    PickAndPlace,
    Placement,
    Push,
    Scattered,
    Scene,
    Sphere,
)

pytestmark = pytest.mark.integration

ENGINES = (Bullet(), ONE)
LAYOUTS = {
    "in front": InFront(),
    "scattered": Scattered(fewest=0),
    "free": Scattered(shape=Box(mass=0.5)),
    "moving": Moving(Scattered(), Patrol()),
    "human": Human(),
}


def make_both(make_env, *args, **kwargs):
    """The same environment with either engine, after a reset."""
    envs = [make_env(ArmEnv, *args, physics=physics, seed=3, **kwargs) for physics in ENGINES]
    for env in envs:
        env.reset()
    return envs


def fields(env):
    """All that an ArmState tells, by name, but for signs of quaternions."""
    state = env.arm_state
    named = {**vars(state), **{f"trace {name}": part for name, part in state.trace.items()}}
    del named["trace"], named["previous"]
    return {
        name: np.abs(part) if name.endswith("orientation") else part
        for name, part in named.items()
        if part is not None
    }


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("task", [Push(), PickAndPlace()], ids=["push", "pick"])
def test_episodes_begin_alike(make_env, layout, task):
    """Everything that can be read, in the first five episodes."""
    one, other = make_both(
        make_env,
        num_envs=4,
        obstacles=layout,
        task=task,
        costs=EVERYTHING,
        action=CartesianDelta(finger_step=0.04),
    )
    for _ in range(5):
        expected, found = fields(one), fields(other)
        assert expected.keys() == found.keys()
        for name in expected:
            # Between convex shapes PyBullet leaves a margin of a millimetre.
            near = name.startswith("trace ") and "ee" not in name and "joint" not in name
            np.testing.assert_allclose(
                found[name], expected[name], atol=5e-3 if near else 1e-6, err_msg=name
            )
        one.reset()
        other.reset()


@each_arm
def test_arms_move_alike(make_env, arm):
    """Joint paths over a control step, and over 40 of them, where efforts allow all of it."""
    one, other = make_both(
        make_env,
        arm,
        num_envs=6,
        action=JointDelta(step=0.02),
        obstacles=NoObstacles(),
        max_episode_steps=1000,
    )
    generator = np.random.default_rng(0)
    apart = []
    for _ in range(40):
        action = generator.uniform(-1, 1, one.action_spec.shape)
        step(one, action)
        step(other, action)
        apart.append(np.abs(other.arm_state.joint_position - one.arm_state.joint_position))
    assert np.max(apart[0]) < 5e-4
    assert np.median(apart[-1]) < 6e-4
    assert np.quantile(apart, 0.95) < 2.5e-3


@each_arm
def test_the_tool_moves_alike(make_env, arm):
    """Cartesian actions, 30 of them; near a joint's limit the two may part by a centimetre."""
    one, other = make_both(
        make_env,
        arm,
        num_envs=6,
        action=CartesianDelta(step=0.01),
        obstacles=NoObstacles(),
        max_episode_steps=1000,
    )
    generator = np.random.default_rng(0)
    for _ in range(30):
        action = generator.uniform(-1, 1, one.action_spec.shape)
        step(one, action)
        step(other, action)
    apart = np.abs(other.arm_state.ee_position - one.arm_state.ee_position)
    assert np.median(apart) < 1e-3
    assert apart.max() < 0.02


def test_measurements_mean_the_same(make_env):
    """An arm at rest and a person who moves before it: clearance, its changes, and speeds."""
    one, other = make_both(
        make_env, num_envs=4, obstacles=Human(), costs=EVERYTHING, max_episode_steps=1000
    )
    measured = 0
    for _ in range(20):
        rest(one)
        rest(other)
        expected, found = fields(one), fields(other)
        for name in ("obstacle_position", "obstacle_velocity", "obstacle_angular_velocity"):
            np.testing.assert_allclose(found[name], expected[name], atol=1e-6, err_msg=name)
        clearance = expected["trace clearance"]
        near = np.isfinite(clearance) & np.isfinite(found["trace clearance"])
        # At the end of the range one of the two may see nothing.
        assert (near == np.isfinite(clearance)).mean() > 0.98
        assert np.abs(found["trace clearance"][near] - clearance[near]).max(initial=0) < 4e-3
        # Where several points are about as near, either may be taken.
        name = "trace obstacle_approach"
        apart = np.abs(found[name] - expected[name])[near]
        measured += near.sum()
        assert not near.any() or np.quantile(apart, 0.9) < 0.05
    assert measured > 300


SHAPES = (Cylinder(), Box(), Sphere(), Capsule())


def touches(physics, arm, places, shape):
    """Whether an arm at home touches a shape, and how far it is away, at each of some places."""
    simulator = physics.build(arm, Scene(), num_envs=1, shapes=(shape,), frame_skip=1)
    found = []
    for place, orientation in places:
        simulator.reset(0, Placement(place[None], orientation[None]), np.zeros(3), np.zeros((0, 3)))
        joints = simulator.state().joint_position
        simulator.advance(joints, np.zeros((1, 0)))
        found.append((simulator.state().contact_distance[0, 0] <= 0, simulator.clearance(0)))
    simulator.close()
    return np.array(found)


def poses_near(arm, generator, count):
    """Poses of an obstacle within some centimetres of the arm's axis, and so on its surface."""
    simulator = ONE.build(arm, Scene(), num_envs=1)
    chain = simulator._chain
    ends = np.linspace(0.3, 1.0, 12)[:, None] * np.array(arm.home)
    points = chain(ends).position
    simulator.close()
    places = points[generator.integers(len(points), size=count)]
    places = places + generator.uniform(-0.15, 0.15, (count, 3))
    orientations = generator.normal(size=(count, 4))
    return list(
        zip(places, orientations / np.linalg.norm(orientations, axis=1, keepdims=True), strict=True)
    )


@pytest.mark.parametrize(
    "arm",
    [
        pytest.param(arm, id=name, marks=() if name == "panda" else pytest.mark.slow)
        for name, arm in ARMS.items()
    ],
)
def test_a_touch_in_one_is_a_touch_in_the_other(arm):
    """In at least 99 % of 400 poses, 2,400 for all arms; half of them touch.

    What differs are poses within a millimetre of a touch: PyBullet adds that as a margin to convex
    hulls, and simplifies hulls of many corners in another way.
    """
    generator = np.random.default_rng(0)
    same = []
    for shape in SHAPES:
        places = poses_near(arm, generator, 100)
        one, other = (touches(physics, arm, places, shape) for physics in ENGINES)
        agree = one[:, 0] == other[:, 0]
        same += agree.tolist()
        assert (np.abs(one[~agree, 1]) < 1.5e-3).all()
        assert (np.abs(other[~agree, 1]) < 1.5e-3).all()
        apart = (one[:, 1] > 0) & (one[:, 1] < 0.09)
        assert np.quantile(np.abs(one[:, 1] - other[:, 1])[apart], 0.9) < 1.5e-3
        assert 0.02 < one[:, 0].mean() < 0.98
    assert np.mean(same) >= 0.99


def slowly(arm, task):
    """Settings of an environment in which an action asks for no more than efforts allow."""
    chosen = settings(arm, task)
    action = replace(chosen.get("action", CartesianDelta()), step=0.033)
    return {**chosen, "action": action, "max_episode_steps": 2 * chosen["max_episode_steps"]}


@pytest.mark.parametrize("task", ["reach", "pick"])
@pytest.mark.parametrize("physics", ENGINES, ids=["bullet", "mujoco"])
@pytest.mark.parametrize(
    "arm",
    [
        pytest.param(arm, id=name, marks=() if arm in (PANDA, UR5) else pytest.mark.slow)
        for name, arm in ARMS.items()
    ],
)
def test_what_is_done_in_one_is_done_in_the_other(make_env, arm, physics, task):
    """Past an obstacle, without touching it."""
    env = make_env(ArmEnv, arm, num_envs=7, seed=0, physics=physics, **slowly(arm, task))
    success, _, cost = fly(env, PILOTS[task][0])
    assert success.all()
    assert not cost.any()


@pytest.mark.parametrize("arm", [PANDA, UR5], ids=["panda", "ur5"])
def test_mujocos_objects_slide_as_far_as_friction_says(make_env, arm):
    """A cube that is let go at a speed: friction with the table stops it after v^2 / (2 mu g)."""
    env = make_env(ArmEnv, arm, physics=ONE, task=Push(), obstacles=NoObstacles(), seed=0)
    env.reset()
    before = env.arm_state.object_position[0, 0]
    env._simulator._qvel[0, env._simulator._objects._velocity[0, 0]] = 0.5
    rest(env, 15)
    way = env.arm_state.object_position[0, 0] - before
    np.testing.assert_allclose(way, [0.5**2 / (2 * 0.25 * 9.81), 0, 0], atol=4e-3)


def test_moving_obstacles_push_what_is_in_their_way(make_env):
    """In either engine: a patrol meets a cube and takes it along."""
    for physics in ENGINES:
        places = Places(Box((0.03, 0.2, 0.05)), at=[(0.4, 0, 0.051)])
        env = make_env(
            ArmEnv,
            physics=physics,
            task=Push(),
            obstacles=Moving(places, Patrol(distance=0.6, speed=0.2, direction=(1, 0, 0))),
            max_episode_steps=1000,
            seed=0,
        )
        env.reset()
        before = env.arm_state.object_position[0, 0, 0]
        rest(env, 120)
        assert abs(env.arm_state.object_position[0, 0, 0] - before) > 0.03
