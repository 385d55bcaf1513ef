import numpy as np
import pytest
from states import make_state

from torchrl_safe.envs import Reach, Region


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
        ({"order": 0}, "order must be at least 1, got 0"),
    ],
)
def test_reach_rejects(arguments, message):
    with pytest.raises(ValueError, match=message):
        Reach(**arguments)
