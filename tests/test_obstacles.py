import numpy as np
import pytest

from torchrl_safe.envs import Cylinder, InFront, NoObstacles

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
    """It only points; and as it does not depend on the start, neither does the room for it."""
    layout = InFront(gap=0.2, direction=(0, 5, 0), shape=Cylinder(height=0.3))
    (centre,) = layout.sample(RNG, np.array([0.7, 0, 0.5]), np.array([0.7, 0.1, 0.05])).position
    np.testing.assert_allclose(centre, [0.7, -0.1, 0.15], atol=1e-12)
    slow = InFront(gap=0.2, direction=(0, 0.1, 0), shape=Cylinder(height=0.3))
    np.testing.assert_allclose(
        slow.sample(RNG, np.zeros(3), np.array([0.7, 0.1, 0.05])).position,
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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: InFront(gap=0), "gap must be positive and finite, got 0"),
        (lambda: InFront(gap=float("inf")), "gap must be positive and finite, got inf"),
        (lambda: InFront(height=float("nan")), "height must be finite"),
        (lambda: InFront(direction=(0, 0, 1)), "direction must be horizontal"),
        (lambda: InFront(direction=(0, 0, 0)), "direction must be horizontal and not zero"),
        (lambda: InFront(direction=(1, 0)), r"direction must have shape \(3,\), got \(2,\)"),
        (lambda: Cylinder(radius=-1), "radius must be positive and finite, got -1"),
        (lambda: Cylinder(height=float("nan")), "height must be positive and finite, got nan"),
        (lambda: Cylinder(mass=-1), "mass must be finite and not negative, got -1"),
        (lambda: Cylinder(mass=float("inf")), "mass must be finite and not negative, got inf"),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()
