import numpy as np
import pytest
from worlds import each_arm, rest, turn

from torchrl_safe.envs import ArmEnv, Capsule, Collision, Human, Region, Sphere
from torchrl_safe.envs.physics.paths import look_ahead

both_engines = pytest.mark.usefixtures("engine")

RATE = 240
START, GOAL = np.array([0.35, 0.0, 0.2]), np.array([0.65, 0.1, 0.1])
PEOPLE = {
    "default": Human(),
    # The hand hangs straight down.
    "hanging": Human(shoulder=(0.9, -0.3, 0.5), rest=(0.9, -0.3, 0.1)),
    "far-away": Human(shoulder=(1.5, 0.0, 0.4), rest=(1.2, 0.0, 0.2)),
    "hasty": Human(duration=(0.3, 0.3), pause=(0.01, 0.02)),
}
each_human = pytest.mark.parametrize("human", PEOPLE.values(), ids=PEOPLE.keys())


def limbs(human, seed=0, seconds=30.0):
    """Shoulder, both ends at the elbow, hand and head's centre, each ``(s, 3)``, at 240 Hz."""
    path = human.sample(np.random.default_rng(seed), START, GOAL).at
    positions, orientations = path(np.arange(0, seconds, 1 / RATE))
    axes = turn(orientations, np.broadcast_to([0.0, 0.0, 1.0], positions.shape))
    ends = []
    for index, shape in enumerate(human.shapes[:2]):
        # The axis of the upper arm points to the shoulder, that of the forearm to the hand.
        half = (-1, 1)[index] * shape.length / 2 * axes[:, index]
        ends += [positions[:, index] - half, positions[:, index] + half]
    return (*ends, positions[:, 2])


@each_human
@pytest.mark.parametrize("seed", range(3))
def test_the_arm_hangs_together(human, seed):
    """From the shoulder, which does not move, over the elbow to the hand; none under the table."""
    shoulder, elbow, below_elbow, hand, head = limbs(human, seed)
    np.testing.assert_allclose(shoulder, np.broadcast_to(human.shoulder, shoulder.shape), atol=1e-9)
    np.testing.assert_allclose(elbow, below_elbow, atol=1e-9)
    np.testing.assert_allclose(head, np.broadcast_to(head[0], head.shape))
    assert [type(shape) for shape in human.shapes] == [Capsule, Capsule, Sphere]
    for joint, shape in ((elbow, human.shapes[0]), (hand, human.shapes[1])):
        assert (joint[:, 2] > shape.radius).all()


@each_human
@pytest.mark.parametrize("seed", range(3))
def test_the_hand_moves_smoothly(human, seed):
    """From rest to rest at no more than 1.875 distance / duration, as minimum-jerk reaches do."""
    *_, hand, _ = limbs(human, seed)
    np.testing.assert_allclose(hand[0], human.rest, atol=1e-9)
    velocity = np.diff(hand, axis=0) * RATE
    farthest = np.linalg.norm(hand - human.rest, axis=1).max()
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.max() <= 1.875 * farthest / human.duration[0] + 1e-9
    # The profile's largest acceleration is 10 / sqrt(3) distance / duration^2.
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1) * RATE
    assert change.max() <= 5.7736 * farthest / human.duration[0] ** 2 + 1e-6
    assert speed.max() > 0.1
    # It waits before it sets out, at least for the shortest pause.
    assert (speed[: int(human.pause[0] * RATE) - 1] < 1e-9).all()


@each_human
@pytest.mark.parametrize("seed", range(3))
def test_limbs_turn_as_fast_as_they_point_elsewhere(human, seed):
    """They do not spin about their axes, not even where an upper arm hangs straight down."""
    placement = human.sample(np.random.default_rng(seed), START, GOAL)
    ways = look_ahead(placement, 0, 20 * RATE)
    axes = turn(ways.orientation, np.broadcast_to([0.0, 0.0, 1.0], ways.position.shape))
    changes = np.linalg.norm(np.diff(axes, axis=0), axis=-1) * RATE
    spins = np.linalg.norm(ways.angular_velocity[1:], axis=-1)
    assert changes[:, :2].max(axis=0).min() > 0.5
    np.testing.assert_allclose(spins, changes, atol=0.5 + 0.2 * changes.max())


def test_one_reach_by_hand():
    """Half the way after half the time, 0.1035 of it after a quarter."""
    human = Human(duration=(0.8, 0.8), pause=(0.4, 0.4))
    *_, hand, _ = limbs(human, seconds=2.4)
    begin, there = hand[96], hand[96 + 192]
    np.testing.assert_allclose(begin, human.rest, atol=1e-9)
    np.testing.assert_allclose(hand[96 + 96], (begin + there) / 2, atol=1e-9)
    quarter = 10 / 4**3 - 15 / 4**4 + 6 / 4**5
    np.testing.assert_allclose(hand[96 + 48], begin + quarter * (there - begin), atol=1e-9)
    # It stays for a pause, and takes as long for the way back.
    np.testing.assert_allclose(hand[96 + 192 + 96], there, atol=1e-9)
    np.testing.assert_allclose(hand[96 + 192 + 96 + 96], (begin + there) / 2, atol=1e-9)


def test_the_hand_reaches_for_the_way():
    """All targets lie about the line from start to goal, if the arm is long enough."""
    human = Human(shoulder=(0.8, 0.3, 0.4), rest=(0.9, 0.25, 0.2))
    ends = []
    for seed in range(20):
        *_, hand, _ = limbs(human, seed)
        still = np.linalg.norm(np.diff(hand, axis=0), axis=1) < 1e-9
        away = np.linalg.norm(hand[1:] - human.rest, axis=1) > 1e-6
        ends.append(hand[1:][still & away])
    ends = np.concatenate(ends)
    way = GOAL - START
    along = (ends - START) @ way / (way @ way)
    aside = np.linalg.norm(ends - START - along[:, None] * way, axis=1)
    # Up to 0.08 m off in each coordinate.
    assert aside.max() < 0.08 * np.sqrt(3)
    assert -0.17 < along.min() < 0.3
    assert 0.9 < along.max() < 1.4
    assert (np.linalg.norm(ends - human.shoulder, axis=1) <= 0.62 + 1e-9).all()


def test_the_motion_repeats_after_sixteen_reaches():
    human = Human(duration=(0.5, 0.5), pause=(0.25, 0.25))
    path = human.sample(np.random.default_rng(0), START, GOAL).at
    times = np.linspace(0, 3, 50)
    for one, two in zip(path(times), path(times + 16 * 1.5), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-9)
    assert not np.allclose(path(times)[0], path(times + 1.5)[0], atol=1e-3)


def test_same_generator_same_motion():
    one, two, three = (np.concatenate(limbs(Human(), seed, 5.0)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.allclose(one, three, atol=1e-3)


@both_engines
@each_arm
def test_arms_at_home_are_out_of_reach_at_first(make_env, arm):
    """No draw is thrown away: a person stands still when an episode begins."""
    env = make_env(
        ArmEnv, arm, obstacles=Human(), costs={"near": Collision(margin=0.02)}, seed=0, num_envs=3
    )
    for _ in range(5):
        env.reset()
        assert all(env._simulator.clearance(row) > 0.02 for row in range(env.num_envs))
        assert not rest(env)["cost"].any()


def test_an_elbow_is_not_folded_flat():
    """A hand that is to pass nearer to the shoulder than 0.12 m stays so far away."""
    human = Human(shoulder=(0.5, 0.05, 0.2), rest=(0.7, 0.1, 0.2))
    shoulder, elbow, below_elbow, hand, _ = limbs(human)
    np.testing.assert_allclose(elbow, below_elbow, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(hand - shoulder, axis=1).min(), 0.12)


def test_each_reach_is_for_another_part_of_the_way():
    human = Human(shoulder=(0.8, 0.3, 0.4), rest=(0.9, 0.25, 0.2))
    *_, hand, _ = limbs(human)
    still = np.linalg.norm(np.diff(hand, axis=0), axis=1) < 1e-9
    away = np.linalg.norm(hand[1:] - human.rest, axis=1) > 1e-6
    way = GOAL - START
    along = (hand[1:][still & away] - START) @ way / (way @ way)
    # One share of the way for all reaches, and up to 0.08 m off it, would be 0.73 at most.
    assert np.ptp(along) > 0.75


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shoulder": (1, 0)}, r"shoulder must have shape \(3,\), got \(2,\)"),
        ({"rest": (1, 0, np.nan)}, "rest must be finite"),
        (
            {"rest": (0.4, 0.2, 0.4)},
            r"rest must be 0.12 to 0.62 m from .* which is 0.700 m away",
        ),
        ({"rest": (1.1, 0.2, 0.35)}, r"rest must be 0.12 to 0.62 m from .* which is 0.050 m away"),
        ({"duration": (0, 1)}, "duration must be positive and finite, got 0"),
        ({"duration": 1.0}, r"duration must have shape \(2,\), got \(\)"),
        ({"duration": (2, 1)}, "duration must be shortest, longest, got 2.0, 1.0"),
        ({"pause": (-1, 1)}, "pause must be positive and finite, got -1"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        Human(**arguments)


def test_a_person_is_an_obstacle_like_others():
    shapes = Human().shapes
    assert all(shape.mass == 0 for shape in shapes)
    # Upper arm, and forearm with fist, of an average adult.
    assert [shape.length for shape in shapes[:2]] == [0.28, 0.35]
    region = Region((0.0, -0.6, 0.0), (1.25, 0.6, 1.0))
    assert region.contains(Human().sample(np.random.default_rng(0), START, GOAL).position).all()
