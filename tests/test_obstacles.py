import numpy as np
import pytest
import torch
from worlds import Places, rest, step, turn

from torchrl_safe.envs import (
    ArmEnv,
    Box,
    Collision,
    Cylinder,
    FullObservation,
    InFront,
    NoObstacles,
    Obstacles,
    Placement,
    Proximity,
    Push,
    Region,
    Scattered,
)

both_engines = pytest.mark.usefixtures("engine")

START, GOAL = np.array([0.35, 0.0, 0.2]), np.array([0.65, 0.1, 0.1])
RNG = np.random.default_rng(0)


def test_in_front_stands_on_the_way():
    start, goal = np.array([0.3, 0.1, 0.5]), np.array([0.6, 0.5, 0.2])
    (centre,) = InFront(gap=0.25, shape=Cylinder(height=0.3)).sample(RNG, start, goal).position
    # The way is (0.3, 0.4) long 0.5: half of it before the goal, on the table.
    np.testing.assert_allclose(centre, [0.45, 0.3, 0.15])


def test_in_front_of_the_paper():
    layout = InFront(gap=0.2, direction=(1, 0, 0), height=0.05)
    (centre,) = layout.sample(RNG, np.zeros(3), np.array([0.7, 0.1, 0.05])).position
    np.testing.assert_allclose(centre, [0.5, 0.1, 0.05])


def test_direction_has_no_length():
    """It gives a direction only, whatever the start: the room for it depends on the goal alone."""
    layout = InFront(gap=0.2, direction=(0, 5, 0), shape=Cylinder(height=0.3))
    (centre,) = layout.sample(RNG, np.array([0.7, 0, 0.5]), np.array([0.7, 0.1, 0.05])).position
    np.testing.assert_allclose(centre, [0.7, -0.1, 0.15], atol=1e-12)
    # Squared, the second is 0.
    for length in (0.1, 1e-255):
        other = InFront(gap=0.2, direction=(0, length, 0), shape=Cylinder(height=0.3))
        np.testing.assert_allclose(
            other.sample(RNG, np.zeros(3), np.array([0.7, 0.1, 0.05])).position,
            [[0.7, -0.1, 0.15]],
            atol=1e-12,
        )


def test_sampling_leaves_the_goal_alone():
    goal = np.array([0.7, 0.1, 0.05])
    InFront().sample(RNG, np.zeros(3), goal)
    np.testing.assert_array_equal(goal, [0.7, 0.1, 0.05])


def test_in_front_needs_room():
    with pytest.raises(ValueError, match=r"gap must be less than .* a distance of 0\.200"):
        InFront(gap=0.2).sample(RNG, np.array([0.3, 0, 0.5]), np.array([0.5, 0, 0.1]))


def test_no_obstacles():
    assert NoObstacles().shapes == ()
    assert NoObstacles().sample(RNG, np.zeros(3), np.ones(3)).position.shape == (0, 3)


def scatter(layout, draws=100):
    """Positions and presence of several draws."""
    rng = np.random.default_rng(0)
    placements = [layout.sample(rng, START, GOAL) for _ in range(draws)]
    return np.array([p.position for p in placements]), np.array([p.present for p in placements])


def test_scattered_keeps_its_distances():
    region = Region((0.2, -0.5, 0.3), (0.8, 0.4, 0.5))
    shape = Cylinder(radius=0.05, height=0.2)
    layout = Scattered(4, region=region, shape=shape, clearance=0.1, spacing=0.04)
    positions, present = scatter(layout)
    assert present.all()
    # Their lower ends are in the region.
    assert region.contains(positions - (0, 0, 0.1)).all()
    flat = positions[:, :, :2]
    for end in (START, GOAL):
        apart = np.linalg.norm(flat - end[:2], axis=-1) - 0.05
        assert 0.1 <= apart.min() < 0.12
    one, other = np.triu_indices(4, 1)
    between = np.linalg.norm(flat[:, one] - flat[:, other], axis=-1)
    assert 0.14 <= between.min() < 0.16
    # All of the region is used.
    np.testing.assert_allclose(positions.min((0, 1)), (0.2, -0.5, 0.4), atol=0.02)
    np.testing.assert_allclose(positions.max((0, 1)), (0.8, 0.4, 0.6), atol=0.02)


def test_boxes_are_as_wide_as_their_diagonal():
    """They are turned at random, all alike."""
    layout = Scattered(2, shape=Box((0.06, 0.08, 0.1)), clearance=0.0, spacing=0.0)
    positions, _ = scatter(layout, 300)
    between = np.linalg.norm(positions[:, 0, :2] - positions[:, 1, :2], axis=-1)
    assert 0.2 <= between.min() < 0.21
    np.testing.assert_allclose(positions[:, :, 2], 0.1)
    rng = np.random.default_rng(0)
    yaws = []
    for _ in range(300):
        turned = layout.sample(rng, START, GOAL).orientation
        np.testing.assert_array_equal(turned[:, :2], 0)
        x = turn(turned, np.broadcast_to([1.0, 0, 0], (2, 3)))
        yaws += np.arctan2(x[:, 1], x[:, 0]).tolist()
    quarters = np.histogram(yaws, 4, (-np.pi, np.pi))[0]
    assert quarters.sum() == 600
    assert quarters.min() > 110


def test_a_whole_number_beyond_all_floats_is_refused():
    with pytest.raises(ValueError, match="gap must be positive and finite, got 1000"):
        InFront(gap=10**400)


@pytest.mark.parametrize(("fewest", "numbers"), [(None, [3]), (3, [3]), (1, [1, 2, 3])])
def test_scattered_numbers_are_equally_likely(fewest, numbers):
    _, present = scatter(Scattered(3, fewest), 600)
    found, counts = np.unique(present.sum(1), return_counts=True)
    np.testing.assert_array_equal(found, numbers)
    np.testing.assert_allclose(counts, 600 / len(numbers), rtol=0.15)
    # The first are present, the last absent.
    assert (np.diff(present.astype(int), axis=1) <= 0).all()


def test_scattered_is_drawn_from_the_generator():
    layout = Scattered(3, fewest=0)
    one, two, other = (layout.sample(np.random.default_rng(s), START, GOAL) for s in (5, 5, 6))
    np.testing.assert_array_equal(one.position, two.position)
    np.testing.assert_array_equal(one.orientation, two.orientation)
    assert not np.allclose(one.position, other.position)


def test_scattered_needs_room():
    layout = Scattered(3, region=Region((0.3, 0, 0), (0.4, 0.1, 0)))
    with pytest.raises(ValueError, match=r"region must have room for 3 obstacles, 0.12 m from sta"):
        layout.sample(RNG, START, GOAL)


@both_engines
@pytest.mark.parametrize("task", [None, Push()], ids=["reach", "push"])
def test_scattered_leaves_arm_and_object_free(make_env, task):
    """In 200 worlds, however they are drawn; a step in which nothing moves costs nothing."""
    task = {} if task is None else {"task": task}
    costs = {"touch": Collision(), "near": Proximity(margin=0.1)}
    layout = Scattered(count=4, fewest=1)
    env = make_env(ArmEnv, num_envs=2, **task, obstacles=layout, costs=costs, seed=0)
    for _ in range(100):
        env.reset()
        assert all(env._simulator.clearance(row) > 0 for row in range(2))
        state = env.arm_state
        if task:
            apart = state.obstacle_position - state.object_position
            apart = np.linalg.norm(apart[..., :2], axis=-1) - 0.05
            assert (apart[state.obstacle_present] >= 0.12).all()
    assert not rest(env)["cost"][:, 0].any()


@both_engines
@pytest.mark.parametrize("mass", [0.0, 1.0], ids=["fixed", "free"])
def test_what_is_absent_is_nowhere(make_env, engine, mass):
    """No contact, no distance, zeros in the observation, and nothing in the picture."""
    # MuJoCo's solver stops at a tolerance that depends on the inertia of all bodies of a model.
    # With one body more, what stands on the table rests some micrometres elsewhere.
    atol = 2e-5 if engine == "mujoco" and mass else 0
    here = [(0.35, 0.0, 0.2), (0.6, 0.3, 0.1)]
    shape = Cylinder(mass=mass)
    layout = Places(shape, shape, at=here, present=[False, True])
    costs = {"touch": Collision(), "near": Proximity(0.5)}
    env = make_env(ArmEnv, obstacles=layout, costs=costs, seed=0)
    alone = make_env(ArmEnv, obstacles=Places(shape, at=here[1:]), costs=costs, seed=0)
    # It would stand in the middle of the tool.
    env.reset(), alone.reset()
    for _ in range(5):
        one, other = step(env, [0, 1, -1]), step(alone, [0, 1, -1])
        state = env.arm_state
        np.testing.assert_array_equal(state.obstacle_present, [[False, True]])
        assert state.contact_distance[0, 0] == np.inf
        assert state.contact_force[0, 0] == 0
        assert (state.trace["clearance"][0, :, 0] == np.inf).all()
        torch.testing.assert_close(one["cost"], other["cost"], atol=atol, rtol=0)
        fields = FullObservation()(state)
        for name, width in (("to", 3), ("size", 3), ("orientation", 4), ("velocity", 3)):
            name = "to_obstacle" if name == "to" else f"obstacle_{name}"
            np.testing.assert_array_equal(fields[name][0, :width], 0)
            assert fields[name].shape == (1, 2 * width)
        np.testing.assert_array_equal(fields["obstacle_present"], [[0, 1]])
        # Far below the table, and there it stays.
        assert state.obstacle_position[0, 0, 2] < -50
        np.testing.assert_array_equal(state.obstacle_velocity[0, 0], 0)
    assert torch.equal(env.render(64, 48), alone.render(64, 48))


@both_engines
def test_presence_changes_with_the_episode(make_env):
    env = make_env(ArmEnv, obstacles=Scattered(2, fewest=0), seed=0)
    seen = set()
    for _ in range(20):
        env.reset()
        state = env.arm_state
        seen.add(int(state.obstacle_present.sum()))
        inside = np.abs(state.obstacle_position[0, :, 2]) < 1
        np.testing.assert_array_equal(inside, state.obstacle_present[0])
        np.testing.assert_array_equal(state.obstacle_velocity, 0)
        rest(env)
    assert seen == {0, 1, 2}


@both_engines
def test_a_layout_of_ones_own(make_env):
    """In ten lines: a gate of two posts before the goal."""

    class Gate:
        shapes = (Cylinder(radius=0.02), Cylinder(radius=0.02))

        def sample(self, rng, start, goal):
            middle = goal + (start - goal) * 0.4
            sides = [[0, rng.uniform(0.1, 0.15), 0], [0, -0.1, 0]]
            return Placement((middle + sides) * (1, 1, 0) + (0, 0, 0.1))

    assert isinstance(Gate(), Obstacles)
    env = make_env(ArmEnv, num_envs=2, obstacles=Gate(), seed=0)
    env.reset()
    state = env.arm_state
    middle = 0.6 * state.goal + 0.4 * START
    np.testing.assert_allclose(state.obstacle_position[:, 1, 1], middle[:, 1] - 0.1, atol=1e-6)
    np.testing.assert_allclose(state.obstacle_position[:, :, 2], 0.1)
    assert (np.ptp(state.obstacle_position[:, :, 1], axis=1) > 0.2).all()


def test_placement_fills_in():
    placement = Placement([[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(placement.orientation, [[0, 0, 0, 1]] * 2)
    np.testing.assert_array_equal(placement.present, [True, True])
    positions, orientations = placement.at(np.arange(5.0))
    np.testing.assert_array_equal(positions, [[[1, 2, 3], [4, 5, 6]]] * 5)
    assert orientations.shape == (5, 2, 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"position": [1, 2, 3]}, r"position must have shape \(3, 3\), got \(3,\)"),
        ({"position": [[1, 2, np.inf]]}, "position must be finite"),
        ({"position": [[1, 2, 3]], "orientation": [0, 0, 0, 1]}, r"orientation must have shape"),
        ({"position": [[1, 2, 3]], "orientation": [[0, 0, 0, 0]]}, "orientation must be a unit"),
        ({"position": [[1, 2, 3]], "present": True}, r"present must have shape \(1,\), got \(\)"),
    ],
)
def test_bad_placements(arguments, message):
    with pytest.raises(ValueError, match=message):
        Placement(**arguments)


@both_engines
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: InFront(gap=0), "gap must be positive and finite, got 0"),
        (lambda: InFront(gap=0.05), r"gap must leave the goal free, .* radius of 0\.050, got 0.05"),
        (lambda: InFront(gap=float("inf")), "gap must be positive and finite, got inf"),
        (lambda: InFront(height=float("nan")), "height must be finite"),
        (lambda: InFront(direction=(0, 0, 1)), "direction must be horizontal"),
        (lambda: InFront(direction=(0, 0, 0)), "direction must be horizontal and not zero"),
        (lambda: InFront(direction=(1, 0)), r"direction must have shape \(3,\), got \(2,\)"),
        (lambda: Scattered(0), "count must be a whole number of at least 1, got 0"),
        (lambda: Scattered(3, 4), "fewest must be a whole number between 0 and count = 3, got 4"),
        (lambda: Scattered(3, -1), "fewest must be a whole number of at least 0, got -1"),
        (lambda: Scattered(3, np.zeros((2, 2))), "fewest must be a whole number .*, got array"),
        (lambda: Scattered(3, 1.5), "fewest must be a whole number .*, got 1.5"),
        (lambda: Scattered(clearance=-1), "clearance must be finite and not negative, got -1"),
        (lambda: Scattered(spacing=np.nan), "spacing must be finite and not negative, got nan"),
        (lambda: Cylinder(radius=-1), "radius must be positive and finite, got -1"),
        (lambda: Cylinder(height=float("nan")), "height must be positive and finite, got nan"),
        (lambda: Cylinder(mass=-1), "mass must be finite and not negative, got -1"),
        (lambda: Cylinder(mass=float("inf")), "mass must be finite and not negative, got inf"),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_each_is_turned_by_itself():
    x = np.broadcast_to([1.0, 0, 0], (3, 3))
    turned = turn(Scattered(3).sample(np.random.default_rng(0), START, GOAL).orientation, x)
    assert (np.abs(turned - np.roll(turned, 1, axis=0)).max(axis=1) > 0.1).all()


def test_half_of_it_may_be_in_the_table():
    (centre,) = InFront(height=0.0).sample(RNG, START, GOAL).position
    assert centre[2] == 0
