import numpy as np
import pytest
import torch
from bullet_worlds import worlds_of
from tensordict import TensorDict
from worlds import Places, at_speed, placements, rest, step, turn

from torchrl_safe.envs import (
    ArmEnv,
    Box,
    CartesianDelta,
    Cylinder,
    Human,
    InFront,
    Motion,
    Moving,
    NoObstacles,
    Patrol,
    Placement,
    Scattered,
    Sphere,
    Swing,
)

both_engines = pytest.mark.usefixtures("engine")

RATE = 240
START, GOAL = np.array([0.3, 0, 0.2]), np.ones(3)
ACROSS = np.array([0.6, 0.8, 0.0])
SIDEWAYS = [[0.0, 0.0, np.sin(0.4), np.cos(0.4)]] * 2


def draw(motion, seed=0):
    return motion.sample(np.random.default_rng(seed), ACROSS)


@pytest.mark.parametrize("motion", [Swing(), Patrol()], ids=lambda value: type(value).__name__)
def test_without_a_direction_the_motion_is_across(motion):
    way = draw(motion)(np.arange(0, 3, 1 / RATE))
    np.testing.assert_allclose(way, (way @ ACROSS)[:, None] * ACROSS, atol=1e-12)
    assert np.ptp(way @ ACROSS) > 0.1


@pytest.mark.parametrize(
    ("goal", "across"),
    [((0.3, 0.5, 0.7), (1, 0)), ((0.9, 0.8, 0.1), (-0.8, 0.6)), ((0.3, 0, 0.9), (0, 1))],
    ids=["to-the-left", "aslant", "straight-up"],
)
def test_obstacles_move_across_the_way_from_start_to_goal(goal, across):
    layout = Moving(Places(Sphere(), at=[(0.7, 0, 0.4)]), Swing())
    placement = layout.sample(np.random.default_rng(0), START, np.array(goal))
    way = np.diff(placement.at(np.arange(0, 1, 1 / RATE))[0][:, 0], axis=0)
    assert np.abs(way).max() > 0
    np.testing.assert_allclose(way[:, :2] @ [across[1], -across[0]], 0, atol=1e-12)
    np.testing.assert_array_equal(way[:, 2], 0)


@pytest.mark.parametrize("seed", range(3))
def test_swing(seed):
    """A sine: its range, its largest speed, its period, and half way it is on the other side."""
    motion = Swing(amplitude=0.3, period=1.5, direction=(0, 0, 2))
    displacement = draw(motion, seed)
    times = np.arange(0, 3, 1 / RATE)
    way = displacement(times)
    np.testing.assert_array_equal(way[:, :2], 0)
    assert way[:, 2].max() == pytest.approx(0.3, abs=1e-4)
    assert way[:, 2].min() == pytest.approx(-0.3, abs=1e-4)
    speed = np.abs(np.diff(way[:, 2])) * RATE
    assert speed.max() == pytest.approx(2 * np.pi * 0.3 / 1.5, rel=1e-3)
    np.testing.assert_allclose(displacement(times + 1.5), way, atol=1e-12)
    np.testing.assert_allclose(displacement(times + 0.75), -way, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_patrol(seed):
    """Back and forth between two ends, at constant speed but where it turns."""
    motion = Patrol(distance=0.3, speed=0.2, direction=(3, 4, 0))
    displacement = draw(motion, seed)
    times = np.arange(0, 6, 1 / RATE)
    way = displacement(times) @ (0.6, 0.8, 0)
    np.testing.assert_allclose(displacement(times), way[:, None] * (0.6, 0.8, 0), atol=1e-12)
    assert way.max() == pytest.approx(0.15, abs=1e-3)
    assert way.min() == pytest.approx(-0.15, abs=1e-3)
    speed = np.abs(np.diff(way)) * RATE
    turns = speed < 0.2 - 1e-6
    np.testing.assert_allclose(speed[~turns], 0.2)
    # There and back take 3 s: in 6 s it turns four times.
    assert turns.sum() <= 4
    np.testing.assert_allclose(displacement(times + 3), displacement(times), atol=1e-9)


@pytest.mark.parametrize("motion", [Swing(), Patrol()], ids=lambda value: type(value).__name__)
def test_the_start_is_random(motion):
    assert isinstance(motion, Motion)
    starts = np.array([draw(motion, seed)(np.zeros(1))[0] @ ACROSS for seed in range(200)])
    half = 0.1 if isinstance(motion, Swing) else 0.15
    assert starts.min() < -0.9 * half
    assert starts.max() > 0.9 * half
    assert abs(np.mean(starts)) < 0.2 * half
    # Either way.
    ahead = np.array([draw(motion, seed)(np.array([0.0, 0.01])) @ ACROSS for seed in range(200)])
    assert 60 < (np.diff(ahead) > 0).sum() < 140
    np.testing.assert_array_equal(draw(motion, 7)(np.ones(1)), draw(motion, 7)(np.ones(1)))


def moved(layout, seconds=2.0, seed=0):
    placement = layout.sample(np.random.default_rng(seed), START, GOAL)
    return placement, placement.at(np.arange(0, seconds, 1 / RATE))


def test_moving_adds_to_where_the_layout_puts_it():
    base = Places(Cylinder(), Box(), at=[(0.5, 0, 0.1), (0.2, 0.1, 0.1)], orientation=SIDEWAYS)
    placement, (positions, orientations) = moved(Moving(base, Patrol(distance=0.2, speed=0.5)))
    np.testing.assert_allclose(
        (positions.max(0) + positions.min(0)) / 2, base.placement.position, atol=2e-3
    )
    np.testing.assert_array_equal(orientations, [SIDEWAYS] * 480)
    np.testing.assert_array_equal(positions[0], placement.position)
    # Each by itself.
    first, second = (positions - base.placement.position)[:, :, 1].T
    assert not np.allclose(first, second, atol=0.01)
    # The layout's own placement is not moved along.
    np.testing.assert_array_equal(base.placement.position, [(0.5, 0, 0.1), (0.2, 0.1, 0.1)])


def test_moving_over_scattered():
    """Those that are absent stay so."""
    layout = Moving(Scattered(count=4, fewest=0), Swing(amplitude=0.05))
    counts = set()
    for seed in range(40):
        placement, (positions, orientations) = moved(layout, 0.5, seed)
        still = layout.layout.sample(
            np.random.default_rng(seed), np.array([0.3, 0, 0.2]), np.ones(3)
        )
        np.testing.assert_array_equal(placement.present, still.present)
        np.testing.assert_array_equal(orientations[-1], still.orientation)
        assert np.abs(positions - still.position).max() <= 0.05 + 1e-12
        counts.add(int(placement.present.sum()))
    assert counts == {0, 1, 2, 3, 4}


def test_motions_add_up():
    """A swing along y on top of a patrol along x goes both ways."""
    patrol = Moving(InFront(), Patrol(distance=0.2, speed=0.4, direction=(1, 0, 0)))
    both = Moving(patrol, Swing(amplitude=0.1, period=1.0, direction=(0, 1, 0)))
    _, (positions, _) = moved(both)
    spread = np.ptp(positions[:, 0], axis=0)
    np.testing.assert_allclose(spread, [0.2, 0.2, 0], atol=4e-3)


def test_a_person_who_walks():
    """A path that turns as well goes on as it was, only elsewhere."""
    alone, walking = (
        moved(layout)[1] for layout in (Human(), Moving(Human(), Swing(amplitude=0.1, period=9.0)))
    )
    np.testing.assert_array_equal(alone[1], walking[1])
    assert 0.01 < np.abs(alone[0] - walking[0]).max() <= 0.1


def test_nothing_moves_nowhere():
    placement, (positions, _) = moved(Moving(NoObstacles(), Swing()))
    assert positions.shape == (480, 0, 3)
    assert placement.present.shape == (0,)


@both_engines
def test_the_simulator_follows_the_path(make_env, engine):
    """Bodies are where the path says, at every control step, and as fast as it says."""
    layout = Moving(
        Places(Cylinder(), Box(), at=[(0.6, 0.2, 0.2), (0.6, -0.2, 0.3)], orientation=SIDEWAYS),
        Swing(amplitude=0.1, period=1.0),
    )
    env = make_env(ArmEnv, num_envs=2, obstacles=layout, seed=0, max_episode_steps=1000)
    noted = placements(env)
    env.reset()
    path = noted[1].at
    for index in range(30):
        state = env.arm_state
        now = np.array([index * 12 / RATE])
        expected = path(now)
        np.testing.assert_allclose(state.obstacle_position[1], expected[0][0], atol=1e-12)
        np.testing.assert_array_equal(state.obstacle_orientation[1], expected[1][0])
        if engine == "bullet":  # Which has them beside what it tells.
            world = worlds_of(env)[1]
            bodies = [world._pose(body) for body in world._obstacles]
            np.testing.assert_allclose([body[0] for body in bodies], expected[0][0], atol=1e-12)
            np.testing.assert_allclose([body[1] for body in bodies], expected[1][0], atol=1e-12)
        # The velocity is that of the last substep; at the start that of the first.
        ends = now + np.array([-1, 0]) / RATE if index else np.array([0, 1]) / RATE
        velocity = np.diff(path(ends)[0], axis=0)[0] * RATE
        np.testing.assert_allclose(state.obstacle_velocity[1], velocity, atol=1e-9)
        assert np.abs(state.obstacle_angular_velocity).max() < 1e-12
        rest(env)
    assert np.abs(velocity).max() > 0.05


@both_engines
def test_turning_is_a_velocity(make_env):
    """A block that turns by 2 rad/s about z, and one that stands still."""

    def path(times):
        half = times + 0.1
        turned = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], 1)
        return (
            np.tile([[0.6, 0.2, 0.1], [0.6, -0.2, 0.1]], (len(times), 1, 1)),
            np.stack([turned, np.tile([0, 0, 0, 1.0], (len(times), 1))], 1),
        )

    layout = Places(Box(), Box(), at=[(0.6, 0.2, 0.1), (0.6, -0.2, 0.1)], path=path)
    env = make_env(ArmEnv, obstacles=layout, seed=0)
    env.reset()
    for _ in range(3):
        spin = env.arm_state.obstacle_angular_velocity[0]
        np.testing.assert_allclose(spin, [[0, 0, 2], [0, 0, 0]], atol=1e-4)
        rest(env)
    # After 0.15 s it is turned by 0.5 rad.
    x = turn(env.arm_state.obstacle_orientation[0, 0], np.array([1.0, 0, 0]))
    np.testing.assert_allclose(x, [np.cos(0.5), np.sin(0.5), 0], atol=1e-9)


@both_engines
def test_motion_begins_anew_with_the_episode(make_env):
    """It begins at time 0 of a new draw, and other worlds keep their time."""
    settings = {"num_envs": 2, "obstacles": Moving(InFront(), Swing(period=0.7)), "seed": 3}
    alone, other = make_env(ArmEnv, **settings), make_env(ArmEnv, **settings)
    noted = [placements(env) for env in (alone, other)]
    alone.reset(), other.reset()
    mask = torch.tensor([[True], [False]])
    for index in range(9):
        expected, got = step(alone, [0.5, 0.2, 0]), step(other, [0.5, 0.2, 0])
        np.testing.assert_array_equal(
            alone.arm_state.obstacle_position[1], other.arm_state.obstacle_position[1]
        )
        assert torch.equal(expected["observation"][1], got["observation"][1])
        if index in (3, 6):
            other.reset(TensorDict({**got, "_reset": mask}, batch_size=[2]))
            begin = noted[1][0].at(np.zeros(1))[0][0]
            np.testing.assert_array_equal(other.arm_state.obstacle_position[0], begin)
    assert not np.allclose(noted[0][0].position, noted[1][0].position)


@both_engines
def test_what_is_gone_in_the_next_episode_is_at_rest(make_env):
    """It was on its way in the one before, and is still said to be on one."""
    start = (0.6, 0.2, 0.3)
    path = at_speed(start, (0, 0.2, 0))
    layout = Places(Sphere(), at=[start], path=path)
    env = make_env(ArmEnv, obstacles=layout, seed=0)
    env.reset()
    np.testing.assert_allclose(env.arm_state.obstacle_velocity, [[[0, 0.2, 0]]], atol=1e-9)
    rest(env)
    layout.placement = Placement([start], present=[False], path=path)
    env.reset()
    for _ in range(2):
        np.testing.assert_array_equal(env.arm_state.obstacle_velocity, 0)
        rest(env)


@both_engines
def test_the_clock_of_a_frame_skip(make_env):
    """The path does not depend on the length of the control steps."""
    layout = Moving(Places(Sphere(), at=[(0.7, 0, 0.4)]), Patrol())
    ends = []
    for frame_skip, steps in ((2, 60), (12, 10), (60, 2)):
        env = make_env(ArmEnv, obstacles=layout, frame_skip=frame_skip, seed=4)
        env.reset()
        for _ in range(steps):
            rest(env)
        ends.append(env.arm_state.obstacle_position)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)
    np.testing.assert_allclose(ends[0], ends[2], atol=1e-12)


@both_engines
def test_it_does_not_stop_for_the_arm(make_env):
    """The arm in its way is pushed aside, and the obstacle follows its path."""
    layout = Moving(Places(Sphere(0.06), at=[(0.35, 0.15, 0.2)]), Patrol(distance=0.3, speed=0.4))
    env = make_env(ArmEnv, obstacles=layout, action=CartesianDelta(step=1e-3), seed=0)
    noted = placements(env)
    env.reset()
    start = env.arm_state.ee_position
    for index in range(1, 20):
        there = noted[0].at(env.arm_state.time)[0]
        assert np.abs(env.arm_state.obstacle_position - there).max() < 1e-12
        cost = rest(env)["cost"].item()
        if cost and index > 3:
            break
    else:
        pytest.fail("they never met")
    rest(env, 5)
    assert np.linalg.norm(env.arm_state.ee_position - start) > 0.01


@both_engines
@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: Moving(InFront(shape=Box(mass=1))), ValueError, "layout must have shapes of mass"),
        (lambda: Moving(Swing()), TypeError, "layout must be an instance of Obstacles, got Swing"),
        (
            lambda: Moving(InFront(), "swing"),
            TypeError,
            "motion must be an instance of Motion, got",
        ),
        (
            lambda: Moving(InFront(), InFront()),
            TypeError,
            "motion must map times to displacements, got InFront",
        ),
        (lambda: Moving(InFront(), Swing), TypeError, "motion must be an instance of Motion"),
        (lambda: Swing(amplitude=0), ValueError, "amplitude must be positive and finite, got 0"),
        (lambda: Swing(period=-1), ValueError, "period must be positive and finite, got -1"),
        (lambda: Swing(direction=(0, 0, 0)), ValueError, r"direction must not be zero, got \(0, 0"),
        (
            lambda: Patrol(distance=np.nan),
            ValueError,
            "distance must be positive and finite, got n",
        ),
        (lambda: Patrol(speed=0), ValueError, "speed must be positive and finite, got 0"),
        (lambda: Patrol(direction=(1, 0)), ValueError, r"direction must have shape \(3,\), got"),
    ],
)
def test_bad_arguments(make, kind, message):
    with pytest.raises(kind, match=message):
        make()


@both_engines
def test_what_moves_must_be_fixed(make_env):
    """A path for a shape with a mass would fight physics, even for one of several."""
    places = [(0.6, 0, 0.1), (0.6, 0.3, 0.1)]
    for shapes in ([Box(mass=1.0)], [Box(), Box(mass=1.0)]):
        at = places[: len(shapes)]
        layout = Places(*shapes, at=at, path=Placement(at).at)
        with pytest.raises(
            ValueError, match=r"path moves fixed shapes only .mass 0., got .*mass=1.0"
        ):
            ArmEnv(obstacles=layout)


@both_engines
@pytest.mark.parametrize(
    ("path", "message"),
    [
        (lambda t: (np.zeros((len(t), 2, 3)), np.zeros((len(t), 2, 4))), r"positions of the path"),
        (lambda t: (np.full((len(t), 1, 3), np.nan), np.ones((len(t), 1, 4))), r"must be finite"),
        (lambda t: (np.ones((len(t), 1, 3)), np.ones((len(t), 4))), r"orientations of the path"),
        (
            lambda t: (np.ones((len(t), 1, 3)), np.ones((len(t), 1, 4))),
            r"each orientation of the path must be a unit quaternion .*, got",
        ),
    ],
    ids=["count", "nan", "shape", "not-unit"],
)
def test_bad_paths(path, message):
    with pytest.raises(ValueError, match=message):
        ArmEnv(obstacles=Places(Box(), at=[(0.6, 0, 0.1)], path=path))


def test_moving_leaves_the_paths_of_its_layout_alone():
    """Also if they return the same array each time."""
    kept = {n: (np.zeros((n, 1, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (n, 1, 1))) for n in (1, 2)}
    inner = Places(Sphere(), at=[(0.7, 0, 0.4)], path=lambda times: kept[len(times)])
    placement = Moving(inner, Swing()).sample(np.random.default_rng(0), START, GOAL)
    times = np.array([0.1, 0.2])
    first = placement.at(times)[0]
    np.testing.assert_array_equal(placement.at(times)[0], first)
    np.testing.assert_array_equal(kept[2][0], 0)
