"""What only MuJoCo's worlds do: they are rows of numbers that can be written, saved and shared."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from programs import run_code
from tensordict import TensorDict
from worlds import Places, each_arm, rest, step, turn

from torchrl_safe.envs import (
    IIWA,
    PANDA,
    UR5,
    XARM7,
    ArmEnv,
    Box,
    Camera,
    Capsule,
    CartesianDelta,
    Collision,
    Cylinder,
    Human,
    InFront,
    JointDelta,
    JointLimit,
    Moving,
    NoObstacles,
    PickAndPlace,
    Push,
    Scattered,
    Scene,
    Sensing,
    Speed,
    SpeedAndSeparation,
    Sphere,
    Swing,
)
from torchrl_safe.envs.physics.mujoco import MuJoCo
from torchrl_safe.envs.physics.mujoco.bodies import TABLE
from torchrl_safe.envs.physics.mujoco.chain import Chain
from torchrl_safe.envs.physics.mujoco.model import build_world
from torchrl_safe.envs.physics.mujoco.readings import CONTACT_RANGE

ONE = MuJoCo(threads=1)
EVERYTHING = {
    "touch": Collision(table=True, itself=True),
    "apart": SpeedAndSeparation(),
    "limit": JointLimit(),
    "speed": Speed(any_link=True),
}
# Between them all kinds of bodies: put in place, on a way, free, absent, held by fingers.
EPISODES = {
    "static": {},
    "human": {"obstacles": Human(), "costs": EVERYTHING},
    "moving": {"obstacles": Moving(Scattered(fewest=0), Swing()), "costs": EVERYTHING},
    "free": {"obstacles": Scattered(fewest=0, shape=Cylinder(mass=0.5)), "costs": EVERYTHING},
    "push": {"task": Push()},
    "pick": {"task": PickAndPlace(), "action": CartesianDelta(finger_step=0.04)},
}
each_episode = pytest.mark.parametrize("settings", EPISODES.values(), ids=EPISODES)


def play(env, steps, seed=0, first=0):
    """The states that random actions lead to, as rows of numbers."""
    generator = torch.Generator().manual_seed(seed)
    actions = 2 * torch.rand(first + steps, *env.action_spec.shape[1:], generator=generator) - 1
    states = []
    for action in actions[first:]:
        step(env, action)
        states.append(numbers(env.arm_state))
    return np.array(states)


def numbers(state):
    """All that an ArmState tells of each world, ``(N, width)``."""
    others = ("joint_lower", "joint_upper", "obstacle_size", "trace", "previous")
    parts = [part for name, part in vars(state).items() if name not in others and part is not None]
    parts += state.trace.values()
    return np.concatenate([np.reshape(part, (len(state.goal), -1)) for part in parts], axis=1)


@each_episode
def test_worlds_are_alike_alone_and_among_others(make_env, settings):
    """Bit for bit: no world affects another, on any number of threads."""
    both = make_env(ArmEnv, num_envs=3, physics=MuJoCo(threads=2), seed=5, **settings)
    both.reset()
    together = play(both, 12)
    single = make_env(ArmEnv, num_envs=3, physics=ONE, seed=5, **settings)
    single.reset()
    np.testing.assert_array_equal(play(single, 12), together)
    alone = make_env(ArmEnv, num_envs=1, physics=ONE, seed=5, **settings)
    alone.reset()
    np.testing.assert_array_equal(play(alone, 12)[:, 0], together[:, 0])


@each_episode
def test_partial_resets_leave_the_others_alone(make_env, settings):
    settings = {**settings, "num_envs": 3, "physics": ONE, "max_episode_steps": 1000}
    untouched, other = (make_env(ArmEnv, seed=5, **settings) for _ in range(2))
    for env in (untouched, other):
        env.reset()
        play(env, 5)
    rows = other._simulator._batch.state.copy()
    other.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    np.testing.assert_array_equal(other._simulator._batch.state[[0, 2]], rows[[0, 2]])
    expected, after = (play(env, 6, seed=1) for env in (untouched, other))
    np.testing.assert_array_equal(after[:, [0, 2]], expected[:, [0, 2]])
    assert not np.array_equal(after[:, 1], expected[:, 1])


@each_episode
@pytest.mark.parametrize(
    "steps", [0, 20, *(pytest.param(s, marks=pytest.mark.slow) for s in (7, 26))]
)
def test_checkpoints_come_back_bit_for_bit(make_env, settings, steps):
    """In another environment with another past, at the beginning and after any number of steps."""
    settings = {**settings, "num_envs": 2, "physics": ONE, "max_episode_steps": 1000}
    first, second = (make_env(ArmEnv, seed=seed, **settings) for seed in (5, 6))
    first.reset()
    play(first, steps)
    second.reset()
    play(second, 9, seed=3)
    checkpoint = first.state_dict()
    second.load_state_dict(checkpoint)
    np.testing.assert_array_equal(numbers(second.arm_state), numbers(first.arm_state))
    np.testing.assert_array_equal(play(second, 30, seed=1), play(first, 30, seed=1))
    for env in (first, second):
        env.reset()
    np.testing.assert_array_equal(numbers(second.arm_state), numbers(first.arm_state))


@each_episode
@pytest.mark.parametrize("history", [0, *(pytest.param(h, marks=pytest.mark.slow) for h in (1, 2))])
def test_checkpoints_come_back_in_any_row(make_env, settings, history):
    """Bit for bit, whatever each world went through: episodes begun at different times."""
    rng = np.random.default_rng(history)
    settings = {**settings, "num_envs": 3, "physics": ONE, "max_episode_steps": 1000}
    first, second = (make_env(ArmEnv, seed=seed, **settings) for seed in (5, 6))
    for env in (first, second):
        env.reset()
        for seed in range(rng.integers(1, 4)):
            play(env, rng.integers(1, 15), seed=seed)
            chosen = torch.as_tensor(rng.random((3, 1)) < 0.5)
            env.reset(TensorDict({"_reset": chosen}, [3]))
        play(env, rng.integers(0, 9), seed=7)
    order = np.array([2, 0, 1])
    second.set_extra_state({name: part[order] for name, part in first.get_extra_state().items()})
    np.testing.assert_array_equal(numbers(second.arm_state), numbers(first.arm_state)[order])
    np.testing.assert_array_equal(play(second, 20, seed=1), play(first, 20, seed=1)[:, order])


def test_checkpoints_of_other_worlds_are_refused(make_env):
    small = make_env(ArmEnv, physics=ONE, seed=0)
    large = make_env(ArmEnv, physics=ONE, num_envs=2, seed=0)
    for env in (small, large):
        env.reset()
    saved = small._simulator.save()
    with pytest.raises(ValueError, match="state must be of an environment like this one"):
        large._simulator.restore(saved)
    del saved["steps"]
    with pytest.raises(ValueError, match=r"steps must be .* got nothing"):
        small._simulator.restore(saved)


def test_checkpoints_of_other_obstacles_are_told(make_env):
    env = make_env(ArmEnv, physics=ONE, seed=0)
    env.reset()
    saved = env._simulator.save()
    env.reset()
    with pytest.warns(UserWarning, match="did not come back bit for bit: their obstacles are"):
        env._simulator.restore(saved)


@pytest.mark.parametrize("number", [np.nan, np.inf, 1e12])
def test_a_broken_world_is_named(make_env, tmp_path, monkeypatch, number):
    """MuJoCo alone would reset that world and write a file into the working directory."""
    monkeypatch.chdir(tmp_path)
    env = make_env(ArmEnv, num_envs=3, physics=ONE, obstacles=NoObstacles(), seed=0)
    env.reset()
    env._simulator._qvel[1, 0] = number
    with pytest.raises(FloatingPointError, match="world 1 is not finite or unstable"):
        rest(env)
    assert not list(tmp_path.iterdir())
    # The others go on when it is reset.
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    assert env.arm_state.step.tolist() == [1, 0, 1]
    rest(env)
    assert np.isfinite(env.arm_state.joint_position).all()


def test_a_world_that_becomes_unstable_is_named(make_env, tmp_path, monkeypatch):
    """By an action that no motor could do."""
    monkeypatch.chdir(tmp_path)
    env = make_env(
        ArmEnv,
        num_envs=3,
        action=JointDelta(step=1e12, respect_limits=False),
        scene=Scene(motor_limits=False),
        obstacles=NoObstacles(),
        physics=ONE,
        seed=0,
    )
    env.reset()
    rest(env)
    with pytest.raises(FloatingPointError, match=r"world 2 is not finite .* \(MuJoCo: BAD"):
        step(env, torch.tensor([[0.0], [0.0], [1.0]]))
    assert not list(tmp_path.iterdir())


def test_others_hear_of_their_own_warnings(tmp_path, monkeypatch):
    """We silence MuJoCo for our own steps only."""
    monkeypatch.chdir(tmp_path)
    ArmEnv(physics=ONE, seed=0).rollout(1)
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qvel[0] = np.nan
    mujoco.mj_step(model, data)
    assert (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_absent_bodies_stay_away(make_env):
    """They do not fall for ever: after a long time they are where they were."""
    places = Places(
        Cylinder(mass=1.0), Sphere(0.05), at=[(0.6, 0.2, 0.1)] * 2, present=[False, False]
    )
    env = make_env(ArmEnv, physics=ONE, obstacles=places, max_episode_steps=10**6, seed=0)
    env.reset()
    before = env.arm_state
    rest(env, 500)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        now = getattr(env.arm_state, f"obstacle_{name}")
        np.testing.assert_array_equal(now, getattr(before, f"obstacle_{name}"))
    assert (env._simulator._qpos[:, env._simulator._free._position[:, 2]] < -99).all()


def test_a_turned_body_spins_about_axes_of_the_world(make_env):
    """MuJoCo has the spin in the frame of the body, whose x axis here points along y."""
    quarter = [[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]]
    layout = Places(Box(mass=1.0), at=[(0.6, 0.3, 0.5)], orientation=quarter)
    settings = {"obstacles": layout, "scene": Scene(gravity=0.0), "frame_skip": 1, "seed": 0}
    env = make_env(ArmEnv, physics=ONE, **settings)
    env.reset()
    env._simulator._qvel[0, env._simulator._free._velocity[0, 3:]] = (2.0, 0.0, 0.0)
    rest(env)
    state = env.arm_state
    np.testing.assert_allclose(state.obstacle_angular_velocity, [[[0, 2, 0]]], atol=1e-3)
    # About y: what is up turns towards x, by 2 / 240.
    up = turn(state.obstacle_orientation[0, 0], np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(up, [2 / 240, 0, 1], atol=1e-4)


def test_fingers_that_no_action_moves_are_not_driven(make_env):
    """Free, and without a motor they are moved by the hand; driven again, they do as told."""
    simulator = ONE.build(PANDA, Scene(free_fingers=True), num_envs=1)
    placement = NoObstacles().sample(np.random.default_rng(0), np.zeros(3), np.ones(3))
    simulator.reset(0, placement, np.zeros(3), np.zeros((0, 3)))
    joints = simulator.state().joint_position
    simulator.advance(joints, np.full((1, 2), 0.01))
    simulator.advance(joints, np.full((1, 2), 0.02))
    np.testing.assert_allclose(simulator.state().finger_position, 0.02, atol=1e-3)
    simulator._qvel[:, simulator._driven_speed[-2:]] = 0.05
    simulator.advance(joints, np.zeros((1, 0)))
    free = simulator.state().finger_position
    # Nothing slows them down.
    np.testing.assert_allclose(free, 0.02 + 0.05 * 0.05, atol=1e-3)
    simulator.advance(joints, free - 0.005)
    np.testing.assert_allclose(simulator.state().finger_position, free - 0.005, atol=1e-3)


@pytest.mark.parametrize(
    ("arm", "links"),
    [
        (PANDA, ["panda_link1", "panda_link2"]),
        (IIWA, ["lbr_iiwa_link_2"]),
        (XARM7, ["link1"]),
        # Its shoulder is a hand's breadth above the table.
        (UR5, []),
    ],
    ids=["panda", "iiwa", "xarm7", "ur5"],
)
def test_links_that_cannot_reach_the_table_are_not_tested_against_it(arm, links):
    model = build_world(arm, Scene(), (), (), Sensing()).model
    pairs = [divmod(int(pair), 2**16) for pair in model.exclude_signature]
    assert [model.body(link).name for world, link in pairs if world == 0] == links
    data, table = mujoco.MjData(model), model.geom(TABLE).id
    lower, upper = np.where(model.jnt_limited, model.jnt_range.T, [[-np.pi], [np.pi]])
    for pose in np.random.default_rng(0).uniform(lower, upper, (300, model.nq)):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        for link in links:
            for geom in np.flatnonzero(model.geom_bodyid == model.body(link).id).tolist():
                assert mujoco.mj_geomDistance(model, data, table, geom, 1.0, None) > CONTACT_RANGE


def test_twice_the_mass_of_the_links_is_twice_in_all_that_follows_from_it():
    """And what is beside the arm weighs what it did."""
    one, two = (
        build_world(PANDA, Scene(link_mass=factor), (Box(mass=1.0),), (), Sensing()).model
        for factor in (1.0, 2.0)
    )
    factor = np.array([[1.0 if "obstacle" in one.body(i).name else 2.0] for i in range(one.nbody)])
    for name in ("body_mass", "body_inertia", "body_subtreemass"):
        before, after = (getattr(model, name).reshape(model.nbody, -1) for model in (one, two))
        # But for the world, which is above both.
        np.testing.assert_allclose(after[1:], (factor * before)[1:], err_msg=name)


def test_a_smooth_link_slips_on_what_is_rough(turntable):
    """Frictions of 0.2 and 0.5 are multiplied, as in Bullet; MuJoCo alone would take the larger."""
    file = Path(turntable["arm"].urdf)
    smooth = '<link name="bar"><contact><lateral_friction value="0.2"/></contact>'
    file.write_text(file.read_text().replace('<link name="bar">', smooth))
    world = build_world(turntable["arm"], Scene(), (Sphere(0.1),), (), Sensing())
    data = mujoco.MjData(world.model)
    data.mocap_pos[0] = (0.3, 0.14, 0.5)
    mujoco.mj_forward(world.model, data)
    np.testing.assert_allclose(data.contact.friction[:, 0], [0.2 * 0.5])


@each_arm
def test_contacts_are_as_deep_as_shapes_overlap(arm):
    """And point the way out of the overlap, as mj_geomDistance measures it.

    Where MuJoCo 4.0 looks for several points (MULTICCD), it is up to 20 mm and 85 degrees off for
    cylinders and capsules.
    """
    generator = np.random.default_rng(0)
    compared = 0
    for shape in (Cylinder(), Box(), Sphere(), Capsule()):
        world = build_world(arm, Scene(), (shape,), (), Sensing())
        model, data = world.model, mujoco.MjData(world.model)
        data.qpos[:] = world.home
        mujoco.mj_forward(model, data)
        links = data.xpos[model.jnt_bodyid].copy()
        for _ in range(100):
            data.mocap_pos[0] = generator.choice(links) + generator.uniform(-0.15, 0.15, 3)
            data.mocap_quat[0] = generator.normal(size=4)
            mujoco.mj_forward(model, data)
            deepest = {}
            for contact in sorted(data.contact, key=lambda contact: -contact.dist):
                deepest[tuple(contact.geom.tolist())] = contact
            for pair, contact in deepest.items():
                ends = np.zeros(6)
                depth = mujoco.mj_geomDistance(model, data, *pair, 1.0, ends)
                # Deep inside there are several ways out that are about as short.
                if -0.02 < depth < -1e-3:
                    assert contact.dist == pytest.approx(depth, abs=5e-4)
                    way = ends[3:] - ends[:3]
                    assert abs(way @ contact.frame[:3]) > 0.95 * np.linalg.norm(way)
                    compared += 1
    assert compared > 100


def test_cylinders_that_may_move_stand_still(make_env):
    """On a single contact point they would walk away, by centimetres in four seconds."""
    obstacles = Scattered(count=2, shape=Cylinder(mass=0.5))
    env = make_env(ArmEnv, obstacles=obstacles, physics=ONE, num_envs=4, seed=0)
    env.reset()
    before = env.arm_state.obstacle_position
    rest(env, 39)
    np.testing.assert_allclose(env.arm_state.obstacle_position, before, atol=1e-4)


@each_arm
def test_kinematics_are_those_of_mujoco(arm):
    world = build_world(arm, Scene(), (), (), Sensing())
    model, data = world.model, mujoco.MjData(world.model)
    chain = Chain(model, world.parts.joints, world.parts.tool)
    angles = np.random.default_rng(0).uniform(-3, 3, (20, len(arm.home)))
    tool = chain(angles)
    body = model.body(world.parts.tool).id
    for row, pose in enumerate(angles):
        data.qpos[world.position] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], data.xpos[body], body)
        np.testing.assert_allclose(tool.position[row], data.xpos[body], atol=1e-12)
        turn = tool.orientation[row] @ data.xquat[body][[1, 2, 3, 0]]
        assert abs(turn) == pytest.approx(1, abs=1e-12)
        np.testing.assert_allclose(tool.jacobian[row], jacobian[:, world.velocity], atol=1e-12)


@each_arm
@pytest.mark.parametrize(
    ("step_size", "quantiles"), [(0.02, (0.05, 0.95)), (0.1, (0.4, 0.6))], ids=["small", "large"]
)
def test_an_action_does_what_it_asks_for(make_env, arm, step_size, quantiles):
    """To within 5 %; efforts do not allow every change of 0.1 rad in 0.05 s."""
    env = make_env(
        ArmEnv,
        arm,
        num_envs=8,
        physics=ONE,
        action=JointDelta(step=step_size),
        obstacles=NoObstacles(),
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    home, generator = np.array(arm.home), np.random.default_rng(0)
    done = []
    longest = (env._simulator.joint_speed / env.control_rate).min()
    for _ in range(20):
        before = env.arm_state.joint_position
        # Back to where there is room, on average; and no faster than any joint may be.
        action = np.clip(generator.uniform(-1, 1, before.shape) - (before - home), -1, 1)
        action *= min(1, 0.999 * longest / step_size)
        step(env, action)
        moved = env.arm_state.joint_position - before
        done.append((moved / (action * step_size))[np.abs(action) > 0.5])
    low, high = np.quantile(np.concatenate(done), quantiles)
    assert 0.95 < low < high < 1.05


def test_threads_are_the_cores_that_are_ours(monkeypatch):
    from torchrl_safe.envs.physics.mujoco import physics

    assert physics._cores() == len(os.sched_getaffinity(0))
    monkeypatch.setattr(physics.multiprocessing, "parent_process", lambda: object())
    assert physics._cores() == 1
    for threads in (0, 1.5, True):
        with pytest.raises(ValueError, match="threads must be"):
            MuJoCo(threads=threads)


FORGET = """
import gc, os, signal
from torchrl_safe.envs import ArmEnv, MuJoCo

env = ArmEnv(num_envs=2, physics=MuJoCo(threads=2), seed=0)
env.rollout(2)
if os.fork() == 0:
    signal.alarm(20)
    del env
    gc.collect()
    os._exit(0)
_, status = os.wait()
assert status == 0, status
"""


@pytest.mark.integration
def test_a_forked_process_can_forget_an_environment():
    """The threads of its worlds stay behind, and freeing them would wait for these for ever."""
    result = run_code(FORGET)
    assert result.returncode == 0, result.stderr


def test_there_is_no_window(make_env):
    with pytest.raises(ValueError, match="gui must be False and render_mode not 'human'"):
        ArmEnv(physics=ONE, gui=True)


@pytest.mark.integration
def test_a_missing_mujoco_is_told_when_a_world_is_made():
    code = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from torchrl_safe.envs.physics.mujoco import MuJoCo\n"
        "from torchrl_safe.envs import PANDA, Scene\n"
        "MuJoCo().build(PANDA, Scene(), num_envs=1)"
    )
    result = run_code(code)
    assert 'pip install "torchrl-safe[mujoco]"' in result.stderr.splitlines()[-1]


@pytest.mark.parametrize("arm", [PANDA, UR5], ids=["panda", "ur5"])
def test_pictures_show_what_there_is(make_env, arm):
    """Obstacles dark, the object blue, the goal green: each only where it is."""
    env = make_env(ArmEnv, arm, num_envs=2, physics=ONE, task=Push(), obstacles=InFront(), seed=0)
    env.reset()
    state = env._simulator._batch.state.copy()
    above = Camera(eye=(0.5, -0.8, 1.5), target=(0.5, 0.0, 0.0))
    first = env.render(320, 240, above)
    assert first.shape == (2, 240, 320, 3)
    assert first.dtype == torch.uint8
    assert torch.equal(env.render(320, 240, above), first)
    for picture in first.int():
        red, green, blue = picture.unbind(-1)
        assert ((red < 80) & (green < 90) & (blue < 110) & (blue > red + 5)).sum() > 100
        assert ((blue > 2 * red) & (blue > 1.3 * green)).sum() > 2
        assert ((green > 2 * red) & (green > 1.3 * blue)).sum() > 2
    assert not torch.equal(first[0], first[1])
    assert env.render(80, 60).shape == (2, 60, 80, 3)
    np.testing.assert_array_equal(env._simulator._batch.state, state)
    rest(env)
    step(env, 1.0)
    assert not torch.equal(env.render(320, 240, above), first)
