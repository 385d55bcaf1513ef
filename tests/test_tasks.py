import numpy as np
import pytest
import torch
from states import make_state
from tensordict import TensorDict
from worlds import ARMS, Places, each_arm, rest, step

from torchrl_safe.envs import (
    PANDA,
    ArmEnv,
    Box,
    CartesianDelta,
    Cylinder,
    NoObstacles,
    PickAndPlace,
    Push,
    Reach,
    Region,
)

both_engines = pytest.mark.usefixtures("engine")

GRIP = CartesianDelta(finger_step=0.04)
each_object_task = pytest.mark.parametrize("kind", [Push, PickAndPlace])


def test_reach_is_euclidean():
    state = make_state(ee_position=[[0, 0, 0], [0.3, 0, 0.4]], goal=[[3, 0, 4], [0.3, 0.01, 0.4]])
    np.testing.assert_allclose(Reach().reward(state), [-5, -0.01])
    np.testing.assert_array_equal(Reach(radius=0.011).success(state), [False, True])


def test_reach_of_the_paper_is_l1():
    state = make_state(ee_position=np.zeros((2, 3)), goal=[[0.03, 0.03, 0.029], [0.04, 0.03, 0.03]])
    np.testing.assert_allclose(Reach(order=1).reward(state), [-0.089, -0.1])
    np.testing.assert_array_equal(Reach(order=1, radius=0.09).success(state), [True, False])


def test_goals_fill_the_box():
    own, arms = Region((0.5, -0.2, 0.1), (0.7, 0.2, 0.1)), Region((0, 0, 0), (1, 1, 1))
    rng = np.random.default_rng(0)
    for task, region in ((Reach(own), own), (Reach(), arms)):
        goals = np.array([task.sample(rng, arms)[0] for _ in range(500)])
        assert region.contains(goals).all()
        np.testing.assert_allclose(goals.min(0), region.low, atol=0.01)
        np.testing.assert_allclose(goals.max(0), region.high, atol=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radius": 0}, "radius must be positive and finite, got 0"),
        ({"radius": float("nan")}, "radius must be positive and finite, got nan"),
        ({"order": True}, "order must be at least 1, got True"),
        ({"order": 0}, "order must be at least 1, got 0"),
    ],
)
def test_reach_rejects(arguments, message):
    with pytest.raises(ValueError, match=message):
        Reach(**arguments)


def draws(task, goals, count=400):
    rng = np.random.default_rng(0)
    pairs = [task.sample(rng, goals) for _ in range(count)]
    return np.array([goal for goal, _ in pairs]), np.array([objects for _, objects in pairs])


@each_arm
@each_object_task
def test_object_and_goal_are_apart(arm, kind):
    """On the table, in the arm's region, and at least so far from each other."""
    goals, objects = draws(kind(distance=0.25), arm.goals)
    assert objects.shape == (400, 1, 3)
    flat = (1, 1, 0)
    region = Region(arm.goals.low * np.array(flat), arm.goals.high * np.array(flat))
    assert region.contains(goals * flat).all()
    assert region.contains(objects * flat).all()
    np.testing.assert_array_equal(objects[:, :, 2], 0.02)
    apart = np.linalg.norm((goals - objects[:, 0])[:, :2], axis=1)
    assert 0.25 <= apart.min() < 0.26
    # Either may be left.
    left = (goals[:, 1] > objects[:, 0, 1]).mean()
    assert 0.4 < left < 0.6
    if kind is Push:
        np.testing.assert_array_equal(goals[:, 2], 0.02)


@each_object_task
def test_own_region_and_shape(kind):
    region = Region((0.4, -0.3, 0.5), (0.8, 0.3, 0.6))
    can = Cylinder(radius=0.03, height=0.1, mass=0.2)
    goals, objects = draws(kind(region=region, shape=can), PANDA.goals)
    np.testing.assert_allclose(objects[:, 0].min(0), (0.4, -0.3, 0.05), atol=0.02)
    np.testing.assert_allclose(objects[:, 0].max(0), (0.8, 0.3, 0.05), atol=0.02)
    np.testing.assert_allclose(goals[:, :2].max(0), (0.8, 0.3), atol=0.02)
    assert kind(shape=can).objects == (can,)


@pytest.mark.parametrize(("share", "low", "high"), [(0.0, 0, 0), (0.3, 0.25, 0.35), (1.0, 1, 1)])
def test_share_of_goals_on_the_table(share, low, high):
    goals, _ = draws(PickAndPlace(on_table=share), PANDA.goals, 1000)
    on_table = goals[:, 2] == 0.02
    assert low <= on_table.mean() <= high
    if share < 1:
        # The others are in the region, at any height.
        air = goals[~on_table]
        assert PANDA.goals.contains(air).all()
        np.testing.assert_allclose([air[:, 2].min(), air[:, 2].max()], [0.05, 0.15], atol=2e-3)


@each_object_task
@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "sparse"])
def test_rewards_of_panda_gym(kind, sparse):
    """The distance of object and goal, wherever the tool is; or -1 and 0."""
    state = make_state(
        goal=[[0.3, 0.4, 0.0], [0.5, 0.0, 0.25]],
        object_position=[[[0.0, 0.0, 0.0]], [[0.5, 0.0, 0.24]]],
        finger_position=np.zeros((2, 2)),
    )
    task = kind(shaped=False, sparse=sparse)
    np.testing.assert_allclose(task.reward(state), [-1, 0] if sparse else [-0.5, -0.01])
    np.testing.assert_array_equal(task.success(state), [False, True])


@each_object_task
def test_sparse_is_sparse_with_shaping_too(kind):
    state = make_state(finger_position=np.zeros((2, 2)))
    np.testing.assert_array_equal(kind(sparse=True).reward(state), [-1, -1])


def test_reward_of_pushing_is_progress():
    """On the way of the cube, and on the tool's to the point behind it."""
    # 0.02 m of cube and 0.01 m of fingers before the cube, seen along the way of (3, 4).
    behind, goal = np.array([-0.018, -0.024, 0.01]), [[0.3, 0.4, 0.0]] * 2
    before = make_state(goal=goal, ee_position=[np.add(behind, (0, 0, 0.2)), behind])
    after = make_state(
        goal=goal,
        ee_position=[np.add(behind, (0, 0.1, 0)), behind],
        # The second is pushed to where it counts as there.
        object_position=[[[0, 0, 0]], [[0.3, 0.37, 0]]],
        previous=before,
    )
    # From 0.5 + 0.2 to 0.5 + 0.1, and from 0.5 to nothing, with 10 for it.
    np.testing.assert_allclose(Push(radius=0.05).reward(after), [2, 10 + 10])
    np.testing.assert_allclose(Push(radius=0.1).reward(after), [1, 5 + 10])
    np.testing.assert_array_equal(Push().reward(before), [0, 0])


@each_object_task
def test_an_object_that_falls_off_the_table_earns_nothing_more(kind):
    """It falls without end: 490 m in ten seconds, thousands of radii."""
    still = {"goal": [[0.5, 0, 0]] * 2, "finger_position": np.zeros((2, 2))}

    def fallen(depths, previous):
        places = [[[0.9, 0, -depth]] for depth in depths]
        return make_state(**still, object_position=places, previous=previous)

    first = fallen([2, 400], make_state(**still))
    lost = kind().reward(first)
    assert lost[0] == lost[1]
    assert -2 / 0.05 <= lost[0] < 0
    np.testing.assert_array_equal(kind().reward(fallen([3, 490], first)), 0)


def test_reward_of_picking_up_is_progress():
    """Of the tool, to the cube from above, of the fingers, and of the cube once it is held."""
    goal = [[0.12, 0.16, 0.0]] * 2

    def state(places, openings, **settings):
        fingers = [[opening, opening] for opening in openings]
        return make_state(goal=goal, ee_position=places, finger_position=fingers, **settings)

    # Closed above the cube: 0.1 m to go, 0.04 m to open, 0.02 m to close again. And as far beside
    # it as it is high: 0.05 m, and 0.01 m too low where it has to be 0.04 m high.
    closed = state([[0, 0, 0.1], [0.04, 0, 0.03]], [0, 0.01])
    # Around it, with 0.01 m to close. And as far beside it in the air, open for whatever size.
    around = state([[0, 0, 0.01], [0, 0.04, 0.2]], [0.03, 0.1], previous=closed)
    held = state([[0, 0, 0.01], [0, 0.04, 0.2]], [0.022, 0.1], previous=around)
    expected = [
        (around, [0.1 + 0.18 - 0.01 - 0.03, 0.05 + 0.01 + 0.15 - np.hypot(0.04, 0.2) - 0.06]),
        # From 0.5 m for what is not held to the 0.2 m that it is away.
        (held, [0.5 - 0.2 + 3 * 0.008, 0]),
    ]
    for after, progress in expected:
        np.testing.assert_allclose(PickAndPlace().reward(after) * 0.05, progress, atol=1e-12)
    # At the goal: what was left is nothing now, and 10 for it.
    placed = state([[0, 0, 0.01], [0.12, 0.16, 0.05]], [0.022, 0.02], previous=held)
    placed.object_position[1, 0] = goal[1]
    way = 0.5 + np.hypot(0.04, 0.2) + 0.06
    np.testing.assert_allclose(PickAndPlace().reward(placed), [0, 10 + way / 0.05], atol=1e-9)


@both_engines
@pytest.mark.parametrize(("kind", "width"), [(Push, 3), (PickAndPlace, 4)])
@pytest.mark.parametrize("name", ["panda", "xarm6"])
def test_progress_adds_up_to_the_way(make_env, name, kind, width):
    """Whatever happens in between: potentials leave nothing behind, in every episode."""
    env = make_env(
        ArmEnv,
        ARMS[name],
        num_envs=2,
        task=kind(),
        action=CartesianDelta(finger_step=0.04 if width == 4 else None),
        obstacles=NoObstacles(),
        max_episode_steps=7,
        seed=0,
    )
    generator, total, episodes = torch.Generator().manual_seed(0), np.zeros(2), 0
    env.reset()
    start = env.task._way(env.arm_state)
    for number in range(15):
        done = step(env, 2 * torch.rand(2, width, generator=generator) - 1)
        total += done["reward"][:, 0].numpy()
        now = env.task._way(env.arm_state)
        np.testing.assert_allclose(total, (start - now) / env.task.radius, atol=1e-5)
        # The second world begins anew in the middle of an episode of the first.
        again = done["done"] | (number == 4) * torch.tensor([[False], [True]])
        if again.any():
            env.reset(TensorDict({"_reset": again}, [2]))
            rows = again[:, 0].numpy()
            total[rows], start[rows] = 0, env.task._way(env.arm_state)[rows]
            episodes += rows.sum()
    assert episodes == 4
    assert np.abs(total).max() > 0.1


@pytest.mark.parametrize("kind", [Reach, Push, PickAndPlace])
def test_at_the_radius_is_not_within_it(kind):
    """Of the same mind: a sparse reward is 0 where the task is done."""
    places = np.array([[0.25, 0, 0], [0.2499, 0, 0]])
    state = make_state(
        goal=np.zeros((2, 3)),
        ee_position=places,
        object_position=places[:, None],
        finger_position=np.zeros((2, 2)),
    )
    task = kind(radius=0.25, sparse=True)
    np.testing.assert_array_equal(task.success(state), [False, True])
    np.testing.assert_array_equal(task.reward(state), [-1, 0])


def test_the_way_of_pushing_of_any_shape():
    """Behind the widest side, at the upper half; level, also where the object does not lie flat."""
    goal = [[0.5, 0, 0.03], [0, 0.5, 0.03]]
    place = np.array([[[0, 0, 0.03]], [[0, 0, 0.15]]])
    # 0.04 m of half a box and 0.01 m of fingers before the box.
    tool = place[:, 0] + [[-0.05, 0, 0.015], [0, -0.05, 0.015]]
    state = make_state(goal=goal, object_position=place, ee_position=tool)
    way = Push(shape=Box((0.02, 0.04, 0.03), mass=1.0))._way(state)
    np.testing.assert_allclose(way, [0.5, np.hypot(0.5, 0.12)])


@pytest.mark.parametrize(
    ("tool", "openings", "goal", "way"),
    [
        # Far beside the box it need not be higher than 0.06 m.
        ((0.3, 0, 0.06), (0.04, 0.04), (0.2, 0, 0), 0.5 + np.hypot(0.3, 0.06) + 3 * 0.02),
        # Both fingers count, and those that are closed do not hold what is between them ...
        ((0, 0, 0.01), (0.03, 0.01), (0.2, 0, 0), 0.2 + 0.01),
        ((0, 0, 0.01), (0, 0), (0.2, 0, 0), 0.5 + 0.01 + 3 * 0.02),
        # ... nor do those that are elsewhere, as wide as the box.
        ((0, 0, 0.3), (0.02, 0.02), (0.2, 0, 0), 0.5 + 0.3 + 3 * 0.04),
        # Held, and further from the goal than 0.5 m.
        ((0, 0, 0.01), (0.02, 0.02), (0.9, 0, 0), 0.5 + 0.01),
    ],
    ids=["far-beside", "both-fingers", "closed", "elsewhere", "far-to-carry"],
)
def test_the_way_of_picking_up(tool, openings, goal, way):
    """A box that is higher than wide: its width is what the fingers take."""
    state = make_state(goal=[goal] * 2, ee_position=[tool] * 2, finger_position=[openings] * 2)
    task = PickAndPlace(shape=Box((0.02, 0.02, 0.05), mass=0.1))
    np.testing.assert_allclose(task._way(state), way)


def test_goals_in_the_air_are_not_below_those_on_the_table():
    task = PickAndPlace(Region((0.4, -0.3, 0.0), (0.8, 0.3, 0.04)), on_table=0.0)
    rng = np.random.default_rng(0)
    heights = [task.sample(rng, None)[0][2] for _ in range(200)]
    assert min(heights) == 0.02
    assert max(heights) > 0.035


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"radius": 0}, ValueError, "radius must be positive and finite, got 0"),
        ({"distance": np.nan}, ValueError, "distance must be positive and finite, got nan"),
        ({"radius": 0.5}, ValueError, "distance must be more than radius, 0.5, got 0.3"),
        ({"radius": 0.3}, ValueError, "distance must be more than radius, 0.3, got 0.3"),
        ({"shape": Box()}, ValueError, r"shape must have a mass to be moved, got Box\("),
        ({"shape": None}, TypeError, "shape must be an instance of Cylinder or Box or"),
        ({"shape": "box"}, TypeError, "shape must be an instance of Cylinder or Box or"),
        ({"region": (0, 1)}, TypeError, r"region must be an instance of Region, got \(0, 1\)"),
    ],
)
@pytest.mark.parametrize("task", [Push, PickAndPlace])
def test_object_tasks_reject(task, arguments, kind, message):
    with pytest.raises(kind, match=message):
        task(**arguments)


@both_engines
@each_object_task
def test_region_must_be_wide_enough(kind):
    """It says so when the environment is made."""
    task = kind(region=Region((0.5, -0.1, 0), (0.6, 0.1, 0)))
    with pytest.raises(ValueError, match=r"region must be wide enough .* distance of 0.3 m, got R"):
        ArmEnv(task=task, action=GRIP)


@pytest.mark.parametrize("share", [-0.1, 1.1, np.nan, True])
def test_on_table_is_a_share(share):
    with pytest.raises(ValueError, match=f"on_table must be between 0 and 1, got {share}"):
        PickAndPlace(on_table=share)


def test_fingers_close_on_what_is_as_wide_as_deep():
    assert PickAndPlace(shape=Cylinder(0.025, 0.03, mass=0.1)).objects[0].radius == 0.025
    with pytest.raises(ValueError, match="shape must be as wide along x as along y"):
        PickAndPlace(shape=Box((0.02, 0.03, 0.02), mass=0.1))


@both_engines
def test_picking_needs_fingers():
    with pytest.raises(ValueError, match="action must move the fingers to pick something up"):
        ArmEnv(task=PickAndPlace())


@both_engines
@pytest.mark.parametrize(
    ("task", "what"),
    [
        (Reach(Region((2, 0, 0.1), (2.1, 0, 0.1))), "goals"),
        (Push(Region((0.9, -0.5, 0), (1.0, 0.5, 0))), "goals"),
    ],
    ids=["reach", "push"],
)
def test_unreachable_goals(task, what):
    with pytest.raises(ValueError, match=rf"task must draw {what} that the arm can reach, got \["):
        ArmEnv(task=task, obstacles=NoObstacles())


def test_a_goal_a_hair_out_of_reach(turntable):
    """The end of the bar goes round at 0.5 m; up to 2 cm further is as good as there."""
    turntable["task"] = Reach(Region((0.51, 0, 0.5), (0.51, 0, 0.5)))
    ArmEnv(**turntable).close()
    turntable["task"] = Reach(Region((0.55, 0, 0.5), (0.55, 0, 0.5)))
    with pytest.raises(ValueError, match=r"got \[0\.55, 0\.0, 0\.5\] .* stays 0\.050 m away"):
        ArmEnv(**turntable)


def test_a_single_object_out_of_reach():
    """That of the third draw: the places of all draws are looked at."""
    drawn = []

    class Strewn(Push):
        def sample(self, rng, goals):
            goal, objects = super().sample(rng, goals)
            drawn.append(objects)
            return goal, objects + (len(drawn) == 3) * np.array([2.0, 0.0, 0.0])

    message = r"task must draw objects that the arm can reach, got \[2\.\d+, .* stays 1\.\d+ m away"
    with pytest.raises(ValueError, match=message):
        ArmEnv(task=Strewn(), obstacles=NoObstacles())


@both_engines
@pytest.mark.parametrize("name", ARMS)
def test_objects_lie_still(make_env, name):
    """Where they were put, on the table, until something touches them."""
    env = make_env(ArmEnv, ARMS[name], num_envs=2, task=Push(), obstacles=NoObstacles(), seed=0)
    env.reset()
    start = env.arm_state.object_position
    np.testing.assert_array_equal(start[:, 0, 2], 0.02)
    np.testing.assert_array_equal(env.arm_state.object_orientation, [[[0, 0, 0, 1]]] * 2)
    rest(env, 10)
    state = env.arm_state
    np.testing.assert_allclose(state.object_position, start, atol=1e-3)
    assert np.abs(state.object_velocity).max() < 5e-3
    assert np.abs(state.object_angular_velocity).max() < 0.05


@both_engines
@each_arm
def test_the_arm_pushes_the_object(make_env, arm):
    """Down before the cube, then into it: it goes where the tool goes, and the reward follows."""
    task = Push(shaped=False)
    env = make_env(ArmEnv, arm, task=task, obstacles=NoObstacles(), max_episode_steps=500, seed=1)
    env.reset()
    start, goal = env.arm_state.object_position[0, 0], env.arm_state.goal[0]
    before, behind = start - (0.08, 0, 0), np.add(start, (0.05, 0, 0))
    for stop in ([*before[:2], 0.2], before, behind):
        for _ in range(30):
            way = stop - env.arm_state.ee_position[0]
            if np.linalg.norm(way) < 0.015:
                break
            result = step(env, (way / max(0.05, np.abs(way).max())))
    place = env.arm_state.object_position[0, 0]
    assert place[0] > start[0] + 0.04
    assert abs(place[1] - start[1]) < 0.03
    reward = -np.linalg.norm(place - goal)
    assert result["reward"].item() == pytest.approx(reward, abs=1e-6)


class PushOneOfTwo(Push):
    """Another object stands at 10 cm from the one to push."""

    @property
    def objects(self):
        return (self.shape, self.shape)

    def sample(self, rng, goals):
        goal, objects = super().sample(rng, goals)
        return goal, np.stack([objects[0], objects[0] + (0, 0.1, 0)])


@pytest.mark.parametrize("kind", [Push, PushOneOfTwo])
@both_engines
def test_the_first_object_is_where_the_way_begins(make_env, kind):
    """Obstacles of a pushing task stand between cube and goal."""

    class Note(Places):
        def sample(self, rng, start, goal):
            self.seen = start, goal
            return super().sample(rng, start, goal)

    layout = Note(at=np.zeros((0, 3)))
    env = make_env(ArmEnv, task=kind(), obstacles=layout, seed=0)
    env.reset()
    np.testing.assert_array_equal(layout.seen[0], env.arm_state.object_position[0, 0])
    np.testing.assert_array_equal(layout.seen[1], env.arm_state.goal[0])
