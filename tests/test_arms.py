"""The arms of the package: where they start, what they reach, and their grippers."""

import dataclasses
import itertools

import numpy as np
import pybullet
import pytest
import torch
from bullet_worlds import make_world, worlds_of
from worlds import ARMS, ENGINES, each_arm, step

from torchrl_safe.envs import (
    IIWA,
    PANDA,
    UR5,
    ArmEnv,
    CartesianDelta,
    Gripper,
    NoObstacles,
    Reach,
    Scene,
)
from torchrl_safe.envs.arms.urdf import find_urdf, prepare_urdf

pytestmark = pytest.mark.usefixtures("engine")


class Pose:
    """The geometry of an arm over a table, without dynamics."""

    def __init__(self, arm, folder):
        self.client = pybullet.connect(pybullet.DIRECT)
        client = {"physicsClientId": self.client}
        text, joints, tool_link = prepare_urdf(arm, visuals=False, fix_fingers=True, merge=False)
        file = folder / "arm.urdf"
        file.write_text(text)
        self.arm = pybullet.loadURDF(str(file), useFixedBase=True, **client)
        half = (0.75, 0.6, 0.025)
        table = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **client)
        self.table = pybullet.createMultiBody(0, table, basePosition=(0.5, 0, -0.025), **client)
        links = range(pybullet.getNumJoints(self.arm, **client))
        infos = [pybullet.getJointInfo(self.arm, link, **client) for link in links]
        self.joints = [info[0] for info in infos if info[1].decode() in joints]
        self.lower, self.upper = np.array([infos[j][8:10] for j in self.joints]).T
        (self.tool,) = (info[0] for info in infos if info[12].decode() == tool_link)
        self.weight = sum(pybullet.getDynamicsInfo(self.arm, j, **client)[0] for j in links)

    def put(self, joints):
        """Returns tool position and orientation."""
        for joint, angle in zip(self.joints, joints, strict=True):
            pybullet.resetJointState(self.arm, joint, angle, physicsClientId=self.client)
        link = pybullet.getLinkState(
            self.arm, self.tool, computeForwardKinematics=1, physicsClientId=self.client
        )
        return np.array(link[4]), np.array(link[5])

    def jacobian(self, joints):
        zeros = [0.0] * len(joints)
        origin, joints = (0.0, 0.0, 0.0), [float(angle) for angle in joints]
        return np.concatenate(
            pybullet.calculateJacobian(
                self.arm, self.tool, origin, joints, zeros, zeros, physicsClientId=self.client
            )
        )

    def reach(self, joints, position, orientation):
        """Returns joint angles, by damped least squares, with their errors, m and rad."""
        joints = np.array(joints)
        for _ in range(100):
            point, turn = self.put(joints)
            now, wanted = axes(turn), axes(orientation)
            error = np.concatenate([position - point, np.cross(now, wanted, axis=0).sum(1) / 2])
            if np.abs(error).max() < 1e-3:
                break
            jacobian = self.jacobian(joints)
            damped = jacobian @ jacobian.T + 0.05**2 * np.eye(6)
            change = jacobian.T @ np.linalg.solve(damped, error)
            change *= min(1, 0.3 / np.abs(change).max())
            joints = np.clip(joints + change, self.lower, self.upper)
        return joints, np.linalg.norm(error[:3]), np.linalg.norm(error[3:])

    def table_clearance(self):
        """Smallest distance to the table of what moves, up to 0.1 m."""
        points = pybullet.getClosestPoints(self.arm, self.table, 0.1, physicsClientId=self.client)
        # The links before the first joint stand on the table.
        return min((p[8] for p in points if p[3] >= self.joints[0]), default=0.1)

    def overlaps(self, depth=1e-3):
        """Pairs of links that overlap."""
        points = pybullet.getClosestPoints(self.arm, self.arm, 0, physicsClientId=self.client)
        return {tuple(sorted(p[3:5])) for p in points if p[8] < -depth and p[3] != p[4]}


@pytest.fixture
def pose(tmp_path):
    """Closes the server of every pose that a test has made with it."""
    made = []

    def make(arm):
        made.append(Pose(arm, tmp_path))
        return made[-1]

    yield make
    for one in made:
        pybullet.disconnect(one.client)


def axes(orientation):
    """The axes of a frame, as columns."""
    return np.array(pybullet.getMatrixFromQuaternion(orientation)).reshape(3, 3)


@each_arm
def test_home(pose, arm):
    """The tool points down before the base, far from table, joint limits and singular poses."""
    one = pose(arm)
    margin = np.minimum(one.upper - arm.home, arm.home - one.lower)
    assert margin.min() > 0.05
    point, turn = one.put(arm.home)
    np.testing.assert_allclose(point[1:], [0, 0.25 if arm is IIWA else 0.2], atol=1e-3)
    assert 0.2 < point[0] < 0.45
    _, along, out = axes(turn).T
    assert np.arccos(-out[2]) < 0.01
    # The fingers open along y.
    assert abs(along[1]) > 0.999
    assert np.linalg.svd(one.jacobian(arm.home), compute_uv=False).min() > 0.1
    # A UR5's shoulder turns closely above the table.
    assert one.table_clearance() > 0.02


@each_arm
def test_links_at_home_do_not_touch(pose, arm):
    """But for neighbours, which overlap in every pose."""
    one = pose(arm)
    one.put(arm.home)
    overlaps = one.overlaps()
    generator = np.random.default_rng(0)
    for _ in range(10):
        one.put(generator.uniform(-1.5, 1.5, len(arm.home)))
        overlaps &= one.overlaps(depth=0)
    one.put(arm.home)
    assert one.overlaps() == overlaps


@each_arm
def test_goals_and_the_table_before_them_are_reached(pose, arm):
    """With the tool as at home, over all goals and where a cube is pushed to them."""
    one = pose(arm)
    _, down = one.put(arm.home)
    low, high = np.array(arm.goals.low), np.array(arm.goals.high)
    grid = itertools.product(*np.linspace(low, high, 5).T)
    pushing = itertools.product(
        np.linspace(low[0] - 0.15, high[0] + 0.05, 5), np.linspace(-0.27, 0.27, 5), [0.02]
    )
    for position in [*grid, *pushing]:
        _, error, turn = one.reach(arm.home, np.array(position), down)
        assert error < 5e-3, position
        assert turn < 0.05, position
        assert one.table_clearance() > 0, position


@each_arm
def test_obstacles_leave_the_arm_free_at_home(make_env, arm):
    env = make_env(ArmEnv, arm, task=Reach(), seed=0)
    for _ in range(50):
        env.reset()
        way = env.arm_state.goal - env.arm_state.ee_position
        assert np.linalg.norm(way[:, :2]) >= 0.23
        assert env._simulator.clearance(0) > 0.02


@each_arm
def test_motors_hold_the_arm_and_bring_it_to_the_goals(make_env, arm):
    """Within the efforts and speeds of the URDF, on straight lines, with the gripper's weight."""
    task = Reach(radius=0.01)
    env = make_env(ArmEnv, arm, num_envs=8, obstacles=NoObstacles(), task=task, seed=0)
    env.reset()
    home = env.arm_state.ee_position
    for _ in range(10):
        step(env, torch.zeros(8, 3))
    np.testing.assert_allclose(env.arm_state.ee_position, home, atol=5e-4)
    reached = torch.zeros(8, 1, dtype=torch.bool)
    for _ in range(40):
        state = env.arm_state
        way = torch.as_tensor(state.goal - state.ee_position) / env.action_mode.step
        action = way / way.abs().amax(1, keepdim=True).clamp_min(1)
        reached |= step(env, action.float())["success"]
        state = env.arm_state
        assert (state.joint_position > state.joint_lower).all()
        assert (state.joint_position < state.joint_upper).all()
    assert reached.all()


@each_arm
def test_fingers_open_and_close(make_env, engine, arm):
    env = make_env(
        ArmEnv,
        arm,
        obstacles=NoObstacles(),
        scene=Scene(free_fingers=True),
        action=CartesianDelta(finger_step=0.04),
    )
    env.reset()
    assert env.arm_state.finger_position.shape == (1, 2)
    home = env.arm_state.ee_position
    for share in (1.0, 0.0):
        for _ in range(10):
            step(env, torch.tensor([[0.0, 0.0, 0.0, share]]))
        np.testing.assert_allclose(env.arm_state.finger_position, 0.04 * share, atol=1e-4)
        if engine == "bullet":
            world = worlds_of(env)[0]
            gap = pybullet.getClosestPoints(
                world._arm.body,
                world._arm.body,
                0.1,
                *world._arm.fingers,
                physicsClientId=world._client,
            )
            assert min(point[8] for point in gap) == pytest.approx(0.08 * share, abs=3e-3)
    np.testing.assert_allclose(env.arm_state.ee_position, home, atol=5e-4)


@pytest.mark.parametrize("arm", [a for a in ARMS.values() if a.gripper], ids=[*ARMS][1:])
def test_tool_is_between_the_finger_tips(pose, arm):
    """1 cm before their ends; its z axis points out of the gripper, which weighs 0.5 kg."""
    bare, armed = pose(dataclasses.replace(arm, gripper=None)), pose(arm)
    flange, turn = bare.put(arm.home)
    tool, tool_turn = armed.put(arm.home)
    np.testing.assert_allclose(tool_turn, turn, atol=1e-6)
    offset = arm.gripper.position + np.array([0, 0, 0.1])
    np.testing.assert_allclose(tool - flange, axes(turn) @ offset, atol=1e-6)
    assert armed.weight - bare.weight == pytest.approx(0.5)
    joints, *_ = armed.reach(arm.home, np.array([0.5, 0, 0.02]), turn)
    height = armed.put(joints)[0][2]
    assert armed.table_clearance() == pytest.approx(height - 0.01, abs=1e-3)


def test_closed_fingers_are_always_in_contact(pose):
    """Otherwise rounding would decide now and then whether the arm touches itself."""
    one = pose(UR5)
    one.put(UR5.home)
    points = pybullet.getClosestPoints(one.arm, one.arm, 0, physicsClientId=one.client)
    tips = {p[8] for p in points if {p[3], p[4]} == {one.tool - 2, one.tool - 1}}
    assert min(tips) == pytest.approx(-1e-3, abs=1e-4)


@pytest.mark.parametrize("name", ["position", "rotation"])
def test_bad_mount_is_named(name):
    with pytest.raises(ValueError, match=rf"{name} must have shape \(3,\)"):
        Gripper("gripper.urdf", "tool", **{name: (0, 0)})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"urdf": 3}, TypeError, "urdf must be an instance of str, got 3"),
        ({"home": 0.0}, ValueError, r"home must have shape \(1,\)"),
        ({"home": ((0.0,),)}, ValueError, r"home must have shape \(1,\)"),
        ({"home": ("0",)}, ValueError, "home must be"),
        ({"ee_link": None}, TypeError, "ee_link must be an instance of str, got None"),
        ({"goals": ((0, 0, 0), (1, 1, 1))}, TypeError, "goals must be an instance of Region"),
        ({"gripper": "gripper.urdf"}, TypeError, "gripper must be an instance of Gripper"),
        ({"finger_home": float("nan")}, ValueError, "finger_home must be finite"),
        ({"handling_orientation": (0, 0, 0, 0)}, ValueError, "handling_orientation must be a unit"),
    ],
)
def test_arm_rejects(changes, error, message):
    with pytest.raises(error, match=message):
        dataclasses.replace(PANDA, **changes)


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_free_fingers_begin_within_their_limits(physics):
    arm = dataclasses.replace(PANDA, finger_home=0.5)
    with pytest.raises(ValueError, match=r"finger_home must be within .*, got 0\.5"):
        physics.build(arm, Scene(free_fingers=True), num_envs=1)
    physics.build(arm, Scene(), num_envs=1).close()  # They are fixed.


def test_a_home_pose_may_be_a_tensor():
    assert dataclasses.replace(PANDA, home=torch.tensor(PANDA.home, dtype=torch.float64)) == PANDA


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_fingers_must_open_alike(tmp_path, physics):
    """With axes that point the same way, equal motor targets would move the hand, not open it."""
    path = tmp_path / "mirrored.urdf"
    text = find_urdf("gripper.urdf").read_text()
    mirrored = 'lower="-0.04" upper="0"'
    path.write_text(mirrored.join(text.rsplit('lower="0" upper="0.04"', 1)))
    assert mirrored in path.read_text()
    arm = dataclasses.replace(UR5, gripper=Gripper(str(path), "tool"))
    with pytest.raises(ValueError, match=r"gripper must have fingers that all open by the same"):
        physics.build(arm, Scene(free_fingers=True), num_envs=1)


def test_tool_must_be_moved_by_a_joint():
    with pytest.raises(ValueError, match="ee_link must be a link that a joint moves, got 'panda_l"):
        make_world(dataclasses.replace(PANDA, ee_link="panda_link0", home=()))


def test_urdf_of_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "mine.urdf").write_text("<robot name='mine'/>")
    monkeypatch.chdir(tmp_path)
    assert find_urdf("mine.urdf") == tmp_path / "mine.urdf"
