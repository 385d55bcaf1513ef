"""How an episode begins: what is drawn, what is drawn again, and what is refused."""

from itertools import product

import numpy as np
import pytest
from draws import misses, tool_at_home
from worlds import ENGINES, Places

from torchrl_safe.envs import (
    ArmEnv,
    Cylinder,
    InFront,
    JointDelta,
    NoObstacles,
    NoRoomError,
    Placement,
    Push,
    Reach,
    Region,
    Scene,
    Sphere,
)
from torchrl_safe.envs.generators import pack, unpack
from torchrl_safe.envs.gym import ARMS, OBSTACLES, TASKS, combination

# Now and then a goal is drawn that leaves no room between it and the arm at home.
TIGHT = InFront(gap=0.195)


class Sometimes:
    """A layout that finds room in every n-th draw, and notes the goals that it is asked for."""

    shapes = ()

    def __init__(self, every, error=NoRoomError):
        self.every, self.error, self.goals = every, error, []

    def sample(self, rng, start, goal):
        self.goals.append(goal)
        if len(self.goals) % self.every:
            raise self.error("no room today")
        return Placement(np.zeros((0, 3)))


def test_a_rare_draw_does_not_end_a_run(make_env):
    """It ended this one in reset 169; the goals that leave no room are the nearest."""
    env = make_env(ArmEnv, obstacles=TIGHT, seed=0)
    goals, first = [], []
    for _ in range(400):
        first.append(Reach().sample(copy_of(env._generators[0]), env.arm.goals)[0])
        env.reset()
        assert env._simulator.clearance(0) > 0
        goals.append(env.arm_state.goal[0])
    again = (np.array(goals) != first).any(axis=1)
    assert 1 <= again.sum() <= 20
    assert np.array(first)[again, 0].max() < 0.62


def copy_of(generator):
    copied = np.random.default_rng(0)
    copied.bit_generator.state = generator.bit_generator.state
    return copied


def test_a_checkpoint_from_before_a_rare_draw_goes_on(make_env):
    """Which is what a run that it had ended was resumed from."""
    env = make_env(ArmEnv, obstacles=TIGHT, seed=0)
    env.reset()
    while True:
        state = env.state_dict()
        first = Reach().sample(copy_of(env._generators[0]), env.arm.goals)[0]
        env.reset()
        if (env.arm_state.goal[0] != first).any():
            break
    resumed = make_env(ArmEnv, obstacles=TIGHT)
    resumed.load_state_dict(state)
    for _ in range(3):
        resumed.reset()
        np.testing.assert_array_equal(resumed.arm_state.goal, env.arm_state.goal)
        env.reset()
    # So does a checkpoint of the episode that was drawn twice.
    resumed.load_state_dict(env.state_dict())
    np.testing.assert_array_equal(resumed.arm_state.goal, env.arm_state.goal)


def test_a_packed_generator_goes_on_where_it_was():
    """Also where half of a 64-bit word is left for the next number; and each on its own."""
    whole, half = (np.random.default_rng(seed) for seed in (1, 2))
    half.integers(10, dtype=np.uint32)
    assert half.bit_generator.state["has_uint32"]
    packed = [pack(generator) for generator in (whole, half)]
    assert {(numbers.dtype, numbers.shape) for numbers in packed} == {(np.dtype("u1"), (40,))}
    copies = [unpack(numbers) for numbers in packed]
    for generator, copied in zip((whole, half), copies, strict=True):
        drawn = generator.integers(10**6, size=3, dtype=np.uint32)
        np.testing.assert_array_equal(copied.integers(10**6, size=3, dtype=np.uint32), drawn)
        assert copied.bit_generator.state == generator.bit_generator.state


def test_each_draw_is_a_new_one(make_env):
    layout = Sometimes(every=7)
    env = make_env(ArmEnv, task=Push(), obstacles=layout, seed=0)
    layout.goals.clear()
    env.reset()
    assert len(layout.goals) == len(np.unique(layout.goals, axis=0)) == 7
    np.testing.assert_array_equal(env.arm_state.goal[0], layout.goals[-1])


@pytest.mark.parametrize(("task", "obstacles"), [*product(TASKS, OBSTACLES)])
def test_a_first_draw_that_fits_is_taken(make_env, task, obstacles):
    """Task, then layout, from the generator of the world and nothing else: a seed is a rollout."""
    settings = combination("Panda", task, obstacles, "Joint")
    env = make_env(ArmEnv, num_envs=2, **settings, seed=11)
    task, layout = settings["task"], settings["obstacles"]
    fits = 0
    for _ in range(20):
        copies = [copy_of(generator) for generator in env._generators]
        env.reset()
        state = env.arm_state
        for row, rng in enumerate(copies):
            goal, objects = task.sample(rng, env.arm.goals)
            start = objects[0] if len(objects) else env._simulator.home_position
            placement = layout.sample(rng, start, goal)
            if (pack(rng) != pack(env._generators[row])).any():
                continue  # This one was drawn again.
            fits += 1
            np.testing.assert_array_equal(state.goal[row], goal)
            np.testing.assert_array_equal(state.object_position[row], objects)
            present = placement.present
            np.testing.assert_array_equal(state.obstacle_present[row], present)
            np.testing.assert_array_equal(
                state.obstacle_position[row][present], placement.position[present]
            )
    assert fits > 20


class Stacked(Push):
    """Two cubes where they are told to be."""

    def __init__(self, *places):
        super().__init__()
        object.__setattr__(self, "places", np.array(places))

    @property
    def objects(self):
        return self.shape, self.shape

    def sample(self, rng, goals):
        return np.array([0.65, 0.0, 0.02]), self.places


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(
    "places",
    [[(0.35, 0, 0.22), (0.6, 0.1, 0.02)], [(0.6, 0.1, 0.02), (0.61, 0.1, 0.02)]],
    ids=["in-the-hand", "in-each-other"],
)
def test_objects_do_not_overlap_the_arm_or_each_other(places):
    """They would be thrown away, at more than a metre a second."""
    with pytest.raises(ValueError, match=r"free the arm at home and the objects, got an over"):
        ArmEnv(task=Stacked(*places), obstacles=NoObstacles())


@pytest.mark.parametrize("physics", ENGINES.values(), ids=ENGINES)
@pytest.mark.parametrize(("gap", "expected"), [(0.05, 0.05), (0.2, 0.1), (-0.02, -0.02)])
def test_clearance_is_measured_up_to_ten_centimetres(turntable, physics, gap, expected):
    """Between a ball and the end of the bar."""
    simulator = physics.build(turntable["arm"], Scene(), num_envs=1, shapes=(Sphere(0.2),))
    placement = Placement([[0.7 + gap, 0.0, 0.5]])
    simulator.reset(0, placement, np.zeros(3), np.zeros((0, 3)))
    assert simulator.clearance(0) == pytest.approx(expected, abs=1e-3)
    simulator.close()


def test_what_hardly_ever_fits_is_refused():
    with pytest.raises(
        ValueError, match=r"no room today None of 100 draws of Reach\(.* was usable"
    ):
        ArmEnv(obstacles=Sometimes(every=101))
    at_home = Places(Cylinder(), at=[[0.35, 0, 0.2]])
    with pytest.raises(ValueError, match=r"overlap of 0\.\d+ m .* None of 100 draws"):
        ArmEnv(obstacles=at_home)


def test_other_errors_of_a_layout_are_not_hidden():
    layout = Sometimes(every=2, error=ValueError)
    with pytest.raises(ValueError, match=r"^no room today$"):
        ArmEnv(obstacles=layout)
    assert len(layout.goals) == 1


def test_what_stops_to_fit_says_so(make_env):
    """After ten times as many draws as it was checked with."""
    layout = Sometimes(every=1)
    env = make_env(ArmEnv, obstacles=layout, seed=0)
    layout.goals.clear()
    layout.every = 10_000
    with pytest.raises(ValueError, match="None of 1000 draws"):
        env.reset()
    assert len(layout.goals) == 1000


def test_a_task_may_find_no_room(make_env):
    """Two places in 0.31 m by 0.02 m are rarely 0.3 m apart: in some draws no pair is."""
    task = Push(region=Region((0.5, -0.155, 0), (0.52, 0.155, 0)))
    rng = np.random.default_rng(0)
    failed = 0
    for _ in range(300):
        try:
            task.sample(rng, ARMS["Panda"].goals)
        except NoRoomError:
            failed += 1
    assert 0 < failed < 150
    env = make_env(ArmEnv, action=JointDelta(), task=task, obstacles=NoObstacles(), seed=0)
    for _ in range(300):
        env.reset()


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_every_registered_combination_has_room(arm):
    """Drawn without physics; a million of each with `make draws ARGS="--draws 1000000"`."""
    home = tool_at_home(arm)
    for task in TASKS:
        assert not any(misses(arm, task, home, OBSTACLES, 1_000).values()), task


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_every_registered_combination_begins(make_env, monkeypatch, arm):
    """With physics, that is with overlaps: a fifth of the draws of Push and Scattered have one."""
    drawn = []
    for kind in {type(task) for task in TASKS.values()}:
        monkeypatch.setattr(kind, "sample", counting(kind.sample, drawn))
    for task, obstacles in product(TASKS, OBSTACLES):
        env = make_env(ArmEnv, **combination(arm, task, obstacles, ""), seed=0)
        drawn.clear()
        for _ in range(100):
            env.reset()
        env.close()
        assert 100 <= len(drawn) < 150, (task, obstacles)


def counting(function, calls):
    def counted(*arguments):
        calls.append(arguments)
        return function(*arguments)

    return counted
