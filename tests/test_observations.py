import numpy as np
import pytest
import torch
from states import bodies, make_state
from worlds import Places, rest

from torchrl_safe.envs import (
    ArmEnv,
    CartesianDelta,
    Cylinder,
    FullObservation,
    PickAndPlace,
    Scattered,
    paper_observation,
)

both_engines = pytest.mark.usefixtures("engine")

FIELDS = {
    "joint_position": 7,
    "joint_velocity": 7,
    "finger_position": 2,
    "ee_position": 3,
    "ee_velocity": 3,
    "to_goal": 3,
    "to_object": 3,
    "object_orientation": 4,
    "object_velocity": 3,
    "object_angular_velocity": 3,
    "to_obstacle": 9,
    "obstacle_size": 9,
    "obstacle_orientation": 12,
    "obstacle_velocity": 9,
    "obstacle_angular_velocity": 9,
    "obstacle_present": 3,
}


def several(count, **changes):
    """Two worlds with obstacles that can all be told apart."""
    fields = bodies("obstacle", count)
    for name, array in fields.items():
        array += np.arange(2 * count).reshape(2, count, 1) + 1
        array += {"obstacle_position": 0.1, "obstacle_velocity": 0.2}.get(name, 0.3)
    fields["obstacle_present"] = np.ones((2, count), bool)
    fields["obstacle_size"] = np.arange(3 * count).reshape(count, 3) + 0.5
    fields["contact_distance"] = np.full((2, count), np.inf)
    return make_state(**{**fields, **changes})


@both_engines
def test_fields_and_slices(make_env):
    """In the documented order, one after the other."""
    env = make_env(
        ArmEnv,
        num_envs=2,
        action=CartesianDelta(finger_step=0.04),
        task=PickAndPlace(),
        obstacles=Scattered(3),
        seed=0,
    )
    observation = env.reset()["observation"]
    begin = 0
    assert list(env.observation_fields) == list(FIELDS)
    for name, width in FIELDS.items():
        assert env.observation_fields[name] == slice(begin, begin + width), name
        begin += width
    assert observation.shape == (2, begin)
    state = env.arm_state
    here = state.ee_position[:, None]
    for name, expected in {
        "joint_position": state.joint_position,
        "finger_position": state.finger_position,
        "to_goal": state.goal - state.ee_position,
        "to_object": state.object_position - here,
        "object_orientation": state.object_orientation,
        "to_obstacle": state.obstacle_position - here,
        "obstacle_present": np.ones((2, 3)),
    }.items():
        found = observation[:, env.observation_fields[name]].numpy()
        np.testing.assert_allclose(found, expected.reshape(2, -1), atol=1e-6)


def test_all_obstacles_in_their_own_order():
    state = several(3)
    fields = FullObservation()(state)
    np.testing.assert_array_equal(fields["to_obstacle"], state.obstacle_position.reshape(2, 9))
    np.testing.assert_array_equal(
        fields["obstacle_velocity"], state.obstacle_velocity.reshape(2, 9)
    )
    np.testing.assert_array_equal(fields["obstacle_size"], [np.arange(9) + 0.5] * 2)


def test_what_is_absent_is_zero():
    state = several(3, obstacle_present=[[True, False, True], [False] * 3])
    for name, field in FullObservation()(state).items():
        if "obstacle" in name:
            first, second = field.reshape(2, 3, -1)
            assert (first[[0, 2]] != 0).any(axis=1).all(), name
            assert (first[1] == 0).all(), name
            assert (second == 0).all(), name


def test_the_nearest_come_first():
    """By the distance of their centres from the tool point; every field in the same order."""
    positions = [[[3.0, 0, 0], [0, 1, 0], [0, 0, -2]], [[1, 1, 1], [1, 1, 3], [1, 1, 2.2]]]
    state = several(3, obstacle_position=positions, ee_position=[[0, 0, 0], [1, 1, 2]])
    fields = FullObservation(nearest=2)(state)
    np.testing.assert_allclose(
        fields["to_obstacle"], [[0, 1, 0, 0, 0, -2], [0, 0, 0.2, 0, 0, -1]], atol=1e-12
    )
    order = [[1, 2], [2, 0]]
    for name in ("obstacle_velocity", "obstacle_angular_velocity"):
        expected = [getattr(state, name)[row][order[row]].ravel() for row in range(2)]
        np.testing.assert_array_equal(fields[name], expected)
    sizes = [state.obstacle_size[order[row]].ravel() for row in range(2)]
    np.testing.assert_array_equal(fields["obstacle_size"], sizes)
    np.testing.assert_array_equal(fields["obstacle_present"], [[1, 1], [1, 1]])


def test_the_absent_are_not_near():
    """Where a world has fewer than are asked for, zeros follow."""
    positions = np.zeros((2, 3, 3))
    positions[:, :, 0] = [[0.1, 0.2, 0.3], [3, 2, 1]]
    present = [[False, True, True], [True, False, False]]
    state = several(3, obstacle_position=positions, obstacle_present=present)
    fields = FullObservation(nearest=2)(state)
    np.testing.assert_array_equal(fields["to_obstacle"][:, [0, 3]], [[0.2, 0.3], [3, 0]])
    np.testing.assert_array_equal(fields["obstacle_present"], [[1, 1], [1, 0]])
    assert (fields["obstacle_orientation"][1, 4:] == 0).all()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_nearest_is_as_wide_for_any_number(count):
    state = several(count)
    fields = FullObservation(nearest=3)(state)
    seen = min(count, 3)
    for name, width in (("to_obstacle", 3), ("obstacle_orientation", 4), ("obstacle_present", 1)):
        assert fields[name].shape == (2, 3 * width)
        parts = fields[name].reshape(2, 3, width)
        assert (parts[:, :seen] != 0).any(axis=2).all()
        assert (parts[:, seen:] == 0).all()


def test_equally_near_keep_their_order():
    state = several(3, obstacle_position=np.ones((2, 3, 3)))
    np.testing.assert_array_equal(
        FullObservation(nearest=2)(state)["obstacle_size"],
        [state.obstacle_size[:2].ravel()] * 2,
    )


def test_quaternions_have_one_sign():
    """An orientation is seen in one way only, for objects and obstacles."""
    orientation = np.array([[[0.1, -0.7, 0.1, -0.7]], [[0.1, -0.7, 0.1, 0.7]]])
    expected = [[-0.1, 0.7, -0.1, 0.7], [0.1, -0.7, 0.1, 0.7]]
    state = make_state(object_orientation=orientation, obstacle_orientation=orientation)
    fields = FullObservation()(state)
    np.testing.assert_array_equal(fields["object_orientation"], expected)
    np.testing.assert_array_equal(fields["obstacle_orientation"], expected)


def test_objects():
    state = make_state(**bodies("object", 2))
    state.object_position[:] = [[[1, 2, 3], [4, 5, 6]], [[7, 8, 9], [0, 0, 1]]]
    state.object_velocity[:, 1] = 5
    state.ee_position[:] = [[1, 1, 1], [0, 0, 1]]
    fields = FullObservation()(state)
    expected = [[0, 1, 2, 3, 4, 5], [7, 8, 8, 0, 0, 0]]
    np.testing.assert_array_equal(fields["to_object"], expected)
    np.testing.assert_array_equal(fields["object_velocity"], [[0, 0, 0, 5, 5, 5]] * 2)
    assert FullObservation()(make_state(**bodies("object", 0)))["to_object"].shape == (2, 0)


@both_engines
def test_one_policy_for_any_number(make_env):
    """In the simulator: the second of two is nearest, and widths agree."""
    at = [(0.6, -0.5, 0.1), (0.6, 0.0, 0.1)]
    two = Places(Cylinder(), Cylinder(radius=0.04), at=at)
    widths = []
    for layout in (two, Scattered(5, fewest=0)):
        env = make_env(ArmEnv, obstacles=layout, observation=FullObservation(nearest=1), seed=0)
        env.reset()
        widths.append(rest(env)["observation"].shape)
        if layout is two:
            field = env.observation_fields["obstacle_size"]
            size = rest(env)["observation"][0, field]
            torch.testing.assert_close(size, torch.tensor([0.04, 0.04, 0.1]))
    assert widths[0] == widths[1]


def test_of_the_paper():
    state = make_state(ee_position=[[1, 2, 3]] * 2, finger_position=[[4, 5]] * 2)
    fields = paper_observation(state)
    np.testing.assert_array_equal(
        np.concatenate(list(fields.values()), axis=1), [[1, 2, 3, 4, 5, 1, 1, 1]] * 2
    )


@pytest.mark.parametrize("nearest", [0, -1, 1.5, True])
def test_nearest_is_a_count(nearest):
    with pytest.raises(ValueError, match=f"nearest must be a whole number .*, got {nearest}"):
        FullObservation(nearest=nearest)
