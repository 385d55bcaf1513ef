"""What costs measure, in the real simulator."""

from dataclasses import asdict, replace

import numpy as np
import pybullet
import pytest
from bullet_worlds import worlds_of
from worlds import ARMS, Places, each_arm, home_of, rest, step

from torchrl_safe.envs import (
    ArmEnv,
    Box,
    Bullet,
    CartesianDelta,
    Collision,
    ContactForce,
    InFront,
    JointDelta,
    JointLimit,
    Moving,
    NoObstacles,
    Proximity,
    Region,
    Scene,
    Sensing,
    Speed,
    Sphere,
    Swing,
    Workspace,
)
from torchrl_safe.envs.state import Trace

pytestmark = pytest.mark.usefixtures("engine")

EVERYTHING = {
    "table": Collision(table=True),
    "itself": Collision(itself=True),
}


@pytest.mark.parametrize("opening", [0.0, 0.03], ids=["closed", "open"])
@each_arm
def test_at_home_the_arm_touches_neither_table_nor_itself(make_env, arm, opening):
    """Not even closely, nor when it opens and closes its fingers; what it stands on is no touch."""
    env = make_env(
        ArmEnv,
        replace(arm, finger_home=opening),
        action=CartesianDelta(finger_step=0.04),
        obstacles=NoObstacles(),
        costs=EVERYTHING,
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    trace = env.arm_state.trace
    for motion in (1, -1):
        for _ in range(10):
            assert not step(env, [0, 0, 0, motion])["cost"].any()
            assert (env.arm_state.trace["table_distance"] > 0.02).all()
    assert trace["table_distance"].shape == trace["self_distance"].shape == (1, 12)


@each_arm
def test_pressing_on_the_table_is_a_touch(make_env, arm):
    env = make_env(
        ArmEnv,
        arm,
        obstacles=NoObstacles(),
        costs={"table": Collision(table=True), "none": Collision()},
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    costs = np.array([step(env, [0, 0, -1])["cost"][0].tolist() for _ in range(12)])
    assert not costs[:3, 0].any()
    assert costs[-1, 0]
    assert not costs[:, 1].any()
    assert env.arm_state.trace["table_distance"].min() <= 0
    # The touch is over with the episode.
    env.reset()
    assert np.isinf(env.arm_state.trace["table_distance"]).all()


def test_no_press_on_the_table_is_lost(make_env):
    """PyBullet's solver holds what it presses together a hair apart."""
    env = make_env(
        ArmEnv,
        obstacles=NoObstacles(),
        costs={"table": Collision(table=True)},
        max_episode_steps=300,
        physics=Bullet(),
        seed=0,
    )
    env.reset()
    (world,) = worlds_of(env)  # The force is not among the readings.
    rng = np.random.default_rng(0)
    for index in range(60):
        action = [0, 0, -1] if index < 12 else rng.normal([0, 0, -0.3], [0.7, 0.7, 0.5])
        cost = step(env, action)["cost"].item()
        points = pybullet.getContactPoints(world._arm.body, physicsClientId=world._client)
        pressed = any(point[9] > 0 and point[3] not in world._arm.base for point in points)
        assert cost or not pressed, index


# Actions that, kept up, fold the arm into itself; the Panda's hand then presses on its base.
FOLD = {
    "panda": [1, 1, -0.5, -1, 0.8, -1, -0.1],
    "iiwa": [1, -0.5, -0.3, -1, 1, 1, 1],
    "xarm6": [-0.5, 0.9, 1, 0.1, 1, 1],
    "xarm7": [-0.5, 1, -1, -1, -0.7, 1, 0.1],
    "ur5": [-1, -0.1, 1, 1, -0.9, -1],
    "ur10": [-0.3, -0.1, 1, 1, -0.5, -0.3],
}


@pytest.mark.parametrize("name", ARMS)
def test_folding_into_itself_is_a_touch(make_env, name):
    """From the first touch to the last. The arm moves slowly, since a fast one rebounds."""
    env = make_env(
        ArmEnv,
        ARMS[name],
        action=JointDelta(step=0.05),
        obstacles=NoObstacles(),
        costs={"itself": Collision(itself=True)},
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    costs = np.array([step(env, FOLD[name])["cost"].item() for _ in range(36)])
    first = costs.argmax()
    assert 3 <= first <= 25
    assert costs[first:].all()
    env.reset()
    assert np.isinf(env.arm_state.trace["self_distance"]).all()
    assert not rest(env)["cost"].any()


def test_nothing_is_measured_unless_asked_for(make_env):
    """And a cost that reads it anyway hears why."""
    env = make_env(ArmEnv, num_envs=2, costs={"c": Collision(), "f": ContactForce()}, seed=0)
    env.reset()
    rest(env)
    assert dict(env.arm_state.trace) == {}
    for name, sensing in (("clearance", "clearance=0.1"), ("ee_velocity", "tool=True")):
        message = (
            rf"'{name}' is measured only if a cost asks .* Sensing\({sensing}\); there is \[\]"
        )
        with pytest.raises(KeyError, match=message):
            ArmEnv(costs={"mine": lambda state, name=name: state.trace[name][:, -1, 0]})
    with pytest.raises(KeyError, match="'ee_speed' must be one of clearance, arm_approach, obsta"):
        ArmEnv(costs={"mine": lambda state: state.trace["ee_speed"]})


class Asking:
    """A cost of 0 that asks for measurements."""

    def __init__(self, sensing):
        self.sensing = sensing

    def __call__(self, state):
        return np.zeros(len(state.time))


@pytest.mark.parametrize(
    ("sensing", "measured"),
    [
        (Sensing(joints=True), {"joint_position"}),
        (Sensing(tool=True), {"ee_position", "ee_velocity"}),
        (Sensing(links=True), {"link_speed"}),
        (Sensing(clearance=0.1), {"clearance", "arm_approach", "obstacle_approach"}),
        (Sensing(table=True), {"table_distance"}),
        (Sensing(itself=True), {"self_distance"}),
    ],
    ids=["joints", "tool", "links", "clearance", "table", "itself"],
)
def test_what_a_cost_gets_for_what_it_asks(make_env, sensing, measured):
    """As docs/howto/cost.md lists it, and as the error says where a cost has not asked."""
    env = make_env(ArmEnv, costs={"mine": Asking(sensing)}, seed=0)
    env.reset()
    assert set(env.arm_state.trace) == measured
    (asked,) = (f"{name}={value}" for name, value in asdict(sensing).items() if value)
    for name in measured:
        with pytest.raises(KeyError, match=asked):
            Trace()[name]


def test_what_is_measured_alone_is_measured_alike(make_env):
    """Of the same substeps, whatever else is measured."""

    def traces(sensing):
        env = make_env(ArmEnv, costs={"mine": Asking(sensing)}, seed=0)
        env.reset()
        step(env, [1.0, 0.5, -0.5])
        return env.arm_state.trace

    alone = [{"joints": True}, {"tool": True}, {"links": True}, {"clearance": 0.4}]
    together = traces(Sensing(0.4, joints=True, tool=True, links=True))
    for asked in alone:
        for name, values in traces(Sensing(**asked)).items():
            np.testing.assert_allclose(values, together[name], atol=1e-9, err_msg=name)


def test_costs_share_what_is_measured(make_env):
    """The widest range of all, and a plain function may read it too."""

    def mine(state):
        return state.trace["clearance"].min(axis=(1, 2)).clip(max=9)

    costs = {"near": Proximity(0.05), "far": Proximity(0.4), "mine": mine, "speed": Speed()}
    env = make_env(ArmEnv, num_envs=2, obstacles=InFront(), costs=costs, seed=0, frame_skip=3)
    env.reset()
    near, far, clearance, _ = step(env, [1, 0, 0])["cost"].T.numpy()
    assert set(env.arm_state.trace) == {
        *("clearance", "arm_approach", "obstacle_approach", "ee_position", "ee_velocity")
    }
    assert env.arm_state.trace["clearance"].shape == (2, 3, 1)
    assert (clearance < 0.4).all()
    np.testing.assert_allclose(far, 0.4 - clearance, atol=1e-6)
    np.testing.assert_allclose(near, np.maximum(0, 0.05 - clearance), atol=1e-6)


def test_speeds_of_the_turntable(make_env, turntable):
    """The tool point at 0.5 m from the axis; the bar's own centre does not move."""
    turntable["physics"] = Bullet(merged_links=False)
    env = make_env(ArmEnv, **turntable, costs={"speed": Speed(limit=0.6, any_link=True)})
    env.reset()
    for action in (1.0, 0.5):
        for _ in range(4):
            before = env.arm_state.trace["ee_position"][0, -1]
            cost = step(env, action)["cost"].item()
            trace = env.arm_state.trace
            positions = np.vstack([before, trace["ee_position"][0]])
            velocities = np.diff(positions, axis=0) * 240
            np.testing.assert_allclose(trace["ee_velocity"][0], velocities, atol=0.02)
            bar, tool = trace["link_speed"][0].T
            np.testing.assert_allclose(bar, 0, atol=1e-9)
            np.testing.assert_allclose(tool, np.linalg.norm(velocities, axis=1), atol=0.02)
            assert cost == (tool > 0.6).any()
        # The motor sets out at 0.1 rad in 0.05 s, which is 2 rad/s.
        assert tool.max() == pytest.approx(action, abs=0.02)


@each_arm
def test_speeds_of_every_arm(make_env, arm):
    costs = {"speed": Speed(any_link=True), "in": Workspace(Region((-2,) * 3, (2,) * 3))}
    env = make_env(ArmEnv, arm, action=JointDelta(), obstacles=NoObstacles(), costs=costs, seed=0)
    env.reset()
    step(env, 0.3)
    trace, before = env.arm_state.trace, env.arm_state
    change = np.diff(trace["ee_position"][0], axis=0) * 240
    np.testing.assert_allclose(trace["ee_velocity"][0, 1:], change, atol=0.02)
    np.testing.assert_allclose(trace["ee_position"][0, -1], before.ee_position[0], atol=1e-12)
    np.testing.assert_allclose(trace["ee_velocity"][0, -1], before.ee_velocity[0], atol=1e-12)
    # The farthest link is as fast as the tool, if not faster, and the first the slowest.
    speeds = trace["link_speed"][0, -1]
    tool = np.linalg.norm(trace["ee_velocity"][0, -1])
    assert 0.5 * tool < speeds.max() < 1.5 * tool
    assert speeds[0] < 0.2 * tool


def test_a_middle_substep_counts(make_env, turntable):
    """A cost that reads substeps finds a violation that is over when the control step ends."""
    costs = {"table": Speed(limit=0.9)}
    turntable["physics"] = Bullet(motor_gain=0.3)
    env = make_env(ArmEnv, **turntable, costs=costs)
    env.reset()
    cost = step(env, 1.0)["cost"].item()
    speed = np.linalg.norm(env.arm_state.trace["ee_velocity"][0], axis=1)
    assert speed[-1] < 0.9 < speed.max()
    assert np.linalg.norm(env.arm_state.ee_velocity) == pytest.approx(speed[-1])
    assert cost == 1


def test_joint_limit_is_met(make_env, turntable):
    env = make_env(ArmEnv, **turntable, costs={"limit": JointLimit(margin=0.05)})
    env.reset()
    assert not rest(env)["cost"].any()
    history = []
    for _ in range(20):
        cost = step(env, 1.0)["cost"].item()
        history.append((env.arm_state.trace["joint_position"].max(), cost))
    angles, costs = np.array(history).T
    np.testing.assert_array_equal(costs, angles > 0.95)
    assert not costs[:5].any()
    # The limit holds the bar, though it is asked to go on.
    assert angles[-1] == pytest.approx(1.0, abs=0.02)


def test_workspace_is_left(make_env, turntable):
    """The tool point turns out of a narrow strip."""
    region = Region((0.0, -0.1, 0.4), (1.0, 0.1, 0.6))
    env = make_env(ArmEnv, **turntable, costs={"out": Workspace(region)})
    env.reset()
    for _ in range(6):
        cost = step(env, 1.0)["cost"].item()
        assert cost == (np.abs(env.arm_state.trace["ee_position"][0, :, 1]) > 0.1).any()
    assert cost == 1


def test_weight_is_a_force(make_env, turntable):
    """2 kg and 0.5 kg rest on the bar: as much force as gravity times mass."""
    heavy, light = Box((0.04, 0.04, 0.04), mass=2.0), Box((0.04, 0.04, 0.04), mass=0.5)
    turntable["obstacles"] = Places(heavy, light, at=[(0.15, 0, 0.561), (-0.15, 0, 0.561)])
    costs = {"force": ContactForce(limit=19.0), "more": ContactForce(limit=20.5)}
    env = make_env(ArmEnv, **turntable, costs=costs)
    env.reset()
    assert (env.arm_state.contact_force == 0).all()
    result = rest(env, 40)
    np.testing.assert_allclose(env.arm_state.contact_force, [[19.62, 4.905]], rtol=0.02)
    assert (np.abs(env.arm_state.contact_distance) < 2e-3).all()
    assert result["cost"].tolist() == [[1, 0]]
    assert (np.abs(env.arm_state.obstacle_velocity) < 1e-3).all()


def test_the_largest_force_of_a_step_counts(make_env, turntable):
    """2 kg that fall 3 cm are stopped within some substeps, in the middle of a control step."""
    turntable["obstacles"] = Places(Box((0.04,) * 3, mass=2.0), at=[(0.15, 0, 0.59)])
    env = make_env(ArmEnv, **turntable)
    env.reset()
    forces = []
    for _ in range(12):
        rest(env)
        forces.append(env.arm_state.contact_force.item())
    assert forces[0] == 0
    assert forces[1] > 5 * forces[-1]
    assert forces[-1] == pytest.approx(2 * 9.81, rel=0.02)


def test_effort_limits_the_force(make_env, turntable):
    """100 N m at 0.45 m from the axis press with 222 N, and with nothing before the touch."""
    turntable["obstacles"] = Places(Box((0.05, 0.05, 0.05)), at=[(0.45, 0.25, 0.5)])
    env = make_env(ArmEnv, **turntable, costs={"force": ContactForce(limit=140)})
    env.reset()
    forces, costs = [], []
    for _ in range(60):
        costs.append(step(env, 1.0)["cost"].item())
        forces.append(env.arm_state.contact_force.item())
    assert forces[0] == 0
    assert costs[0] == 0
    assert costs[-1] == 1
    # Where the edge of the block touches: between 0.4 and 0.5 m from the axis.
    assert 100 / 0.54 < forces[-1] < 100 / 0.40


@each_arm
def test_pressing_on_an_obstacle(make_env, arm):
    """Harder than nothing, and softer than motors without limits would."""
    place = np.add(home_of(arm), (0, 0, -0.1))
    place[2] = 0.05
    block = Places(Box((0.05, 0.05, 0.05)), at=[place])
    forces = []
    for scene in (Scene(), Scene(motor_limits=False)):
        env = make_env(ArmEnv, arm, obstacles=block, scene=scene, seed=0)
        env.reset()
        largest = []
        for _ in range(8):
            step(env, [0, 0, -1])
            largest.append(env.arm_state.contact_force.item())
        assert largest[0] == 0
        forces.append(max(largest))
    assert 5 < forces[0] < forces[1]


def test_a_moving_obstacle_touches_an_arm_at_rest(make_env, turntable):
    """The arm does nothing; the ball comes to it, in one of the substeps."""
    here = Places(Sphere(0.1), at=[(0.75, 0, 0.5)])
    turntable["obstacles"] = Moving(here, Swing(amplitude=0.2, period=1.0, direction=(1, 0, 0)))
    env = make_env(ArmEnv, **turntable, costs={"touch": Collision(), "force": ContactForce(0)})
    env.reset()
    touched = 0
    for _ in range(40):
        before = env.arm_state.obstacle_position[0, 0, 0]
        touch, force = rest(env)["cost"][0].tolist()
        after = env.arm_state.obstacle_position[0, 0, 0]
        if max(before, after) < 0.595:
            assert touch == 1
            touched += 1
        if min(before, after) > 0.63:
            assert touch == force == 0
    assert touched >= 3


def test_sensors_are_recognised_by_their_property(make_env):
    """A user's own cost in five lines."""

    class Elbow:
        sensing = Sensing(joints=True)

        def __call__(self, state):
            return state.trace["joint_position"][:, :, 3].max(axis=1) + 3

    env = make_env(ArmEnv, costs={"elbow": Elbow()}, seed=0)
    env.reset()
    assert rest(env)["cost"].item() == pytest.approx(3 - 2.849, abs=0.01)


def test_sensing_must_be_one():
    """A cost with a property of that name that means something else."""

    class Mine(Collision):
        sensing = True

    with pytest.raises(TypeError, match="sensing of cost 'mine' must be an instance of Sensing"):
        ArmEnv(costs={"mine": Mine()})
