"""find_home: joint angles for a pose, and what stopped the search."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import ENGINES, each_arm

from torchrl_safe.envs import PANDA, UR5, XARM6, ArmEnv, Bullet, NoObstacles, Scene, find_home
from torchrl_safe.envs.kinematics import approach, distance_to_reach
from torchrl_safe.envs.rotations import from_rotation_vector, multiply

DOWN = (1.0, 0.0, 0.0, 0.0)


def pose_of(arm, angles):
    simulator = Bullet().build(arm, Scene(), num_envs=1)
    positions, orientations = simulator.tool_at(np.array([angles]))
    limits = simulator.joint_lower, simulator.joint_upper
    simulator.close()
    return positions[0], orientations[0], limits


@each_arm
def test_a_guess_becomes_a_home(make_env, arm):
    """Of elbow and wrist alike, and where the tool was to be."""
    position, orientation, (lower, upper) = pose_of(arm, arm.home)
    generator = np.random.default_rng(0)
    for _ in range(3):
        guess = np.array(arm.home) + generator.uniform(-0.3, 0.3, len(arm.home))
        guess = np.clip(guess, lower + 0.01, upper - 0.01)
        home = find_home(replace(arm, home=tuple(guess)), position, orientation)
        there, turned, _ = pose_of(arm, home)
        np.testing.assert_allclose(there, position, atol=1e-3)
        assert abs(turned @ orientation) == pytest.approx(1, abs=1e-6)
        np.testing.assert_array_equal(np.clip(home, lower, upper), home)
        assert np.abs(np.subtract(home, guess)).max() < 1.0, "no other elbow"
    env = make_env(ArmEnv, replace(arm, home=home), obstacles=NoObstacles())
    env.reset()
    np.testing.assert_allclose(env.arm_state.ee_position[0], position, atol=1e-3)


@each_arm
def test_home_is_its_own_home(arm):
    position, orientation, _ = pose_of(arm, arm.home)
    np.testing.assert_allclose(find_home(arm, position, orientation), arm.home, atol=1e-4)


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
def test_searches_side_by_side_are_those_of_each_alone(physics):
    """Also where some arrive before others, and one never does."""
    simulator = physics.build(PANDA, Scene(), num_envs=1)
    position, orientation = simulator.home_position, simulator.home_orientation
    moves = np.array([[0, 0, 0], [0.1, -0.2, 0.1], [0.2, 0.3, 0.2], [2, 0, 0]])
    starts = np.tile(PANDA.home, (4, 1))
    poses = position + moves, np.tile(orientation, (4, 1))
    together = approach(simulator, starts, *poses)
    assert (together.distance < 1e-5).tolist() == [True, True, True, False]
    for row in range(4):
        alone = approach(simulator, *(part[row : row + 1] for part in (starts, *poses)))
        assert alone.distance[0] == pytest.approx(together.distance[row], abs=1e-4)
        if row < 3:
            np.testing.assert_allclose(alone.angles[0], together.angles[row], atol=1e-6)
    misses = distance_to_reach(simulator, PANDA.home, poses[0])
    simulator.close()
    assert misses[:3].tolist() == [0, 0, 0]
    assert misses[3] > 1.0


@pytest.mark.parametrize("arm", [PANDA, UR5], ids=["panda", "ur5"])
def test_what_joint_angles_near_home_reach_is_found_to_be_in_reach(arm):
    """Wherever the tool is when each joint has turned by up to a radian."""
    simulator = Bullet().build(arm, Scene(), num_envs=1)
    turns = np.random.default_rng(0).uniform(-1, 1, (200, len(arm.home)))
    angles = np.clip(arm.home + turns, simulator.joint_lower, simulator.joint_upper)
    missed = distance_to_reach(simulator, arm.home, simulator.tool_at(angles)[0])
    simulator.close()
    assert not missed.any()


def test_a_tool_that_is_there_already_is_still_turned():
    """By a radian, on the spot: the search is not over where the distance is 0."""
    simulator = Bullet().build(PANDA, Scene(), num_envs=1)
    position, orientation = simulator.tool_at(np.array([PANDA.home]))
    wanted = multiply(from_rotation_vector(np.array([[0.0, 0.0, 1.0]])), orientation)
    found = approach(simulator, np.array([PANDA.home]), position, wanted)
    there, turned = simulator.tool_at(found.angles)
    simulator.close()
    np.testing.assert_allclose(there, position, atol=1e-5)
    assert abs(turned[0] @ wanted[0]) == pytest.approx(1, abs=1e-6)
    assert max(found.distance[0], found.turn[0]) < 1e-5


@each_arm
def test_out_of_reach(arm):
    with pytest.raises(
        ValueError, match=r"got \[2.0, 0.0, 0.2\] and .* it is out of reach, ([\d.]+) m"
    ):
        find_home(arm, (2.0, 0.0, 0.2))


def test_how_far_out_of_reach(turntable):
    """The end of the bar goes round in a circle of 0.5 m, at a height of 0.5 m."""
    with pytest.raises(ValueError, match=r"it is out of reach, 0\.300 m beyond"):
        find_home(turntable["arm"], (0.8, 0.0, 0.5), (0, 0, 0, 1))


def test_a_joint_limit(turntable):
    """The bar turns by 1 rad to each side, and would have to by 1.5."""
    angle = 1.5
    position = (0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.5)
    orientation = (0, 0, np.sin(angle / 2), np.cos(angle / 2))
    message = (
        r"stays 0\.247 m and 0\.500 rad away: "
        r"a joint limit stopped it: joint 1, counted from the base, would have to be at "
        r"1\.500 rad and goes from -1\.000 to 1\.000"
    )
    with pytest.raises(ValueError, match=message):
        find_home(turntable["arm"], position, orientation)
    within = (0.5 * np.cos(0.9), 0.5 * np.sin(0.9), 0.5)
    home = find_home(turntable["arm"], within, (0, 0, np.sin(0.45), np.cos(0.45)))
    assert home == pytest.approx([0.9], abs=1e-3)


def test_a_limit_of_an_arm():
    """Behind the base, where a Panda's wrist would have to fold up."""
    with pytest.raises(
        ValueError, match=r"a joint limit stopped it: joint \d, counted from the base"
    ):
        find_home(PANDA, (0.0, 0.0, 0.05))


@pytest.mark.parametrize(("arm", "position"), [(XARM6, (0.3, 0, 0.9)), (UR5, (0.3, 0, 0.9))])
def test_a_singular_pose(arm, position):
    """Above what the stretched arm reaches with its tool down, though not with its tool up."""
    with pytest.raises(ValueError, match=r"a singular pose stopped it, \[.*Jacobian 0\.0\d\d\)"):
        find_home(arm, position)


def test_an_arm_with_too_few_joints(turntable):
    """It never turns about anything but the vertical."""
    with pytest.raises(ValueError, match=r"a singular pose stopped it, .*Jacobian 0\.000\)"):
        find_home(turntable["arm"], (0.5, 0.0, 0.5), DOWN)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (("panda", (0.4, 0, 0.2)), TypeError, "arm must be an instance of ArmModel, got 'panda'"),
        ((PANDA, (0.4, 0)), ValueError, r"position must have shape \(3,\), got \(2,\)"),
        ((PANDA, (0.4, 0, np.nan)), ValueError, "position must be finite"),
        ((PANDA, (0.4, 0, 0.2), (1, 1, 0, 0)), ValueError, "orientation must be a unit quaternion"),
    ],
)
def test_bad_arguments(arguments, kind, message):
    with pytest.raises(kind, match=message):
        find_home(*arguments)


def test_physics_is_an_engine():
    with pytest.raises(TypeError, match="physics must be an instance of Physics, got 'bullet'"):
        find_home(PANDA, (0.4, 0, 0.2), physics="bullet")
