import numpy as np
import pytest
from states import make_state

from torchrl_safe.envs import Collision


@pytest.mark.parametrize(
    ("cost", "distances", "expected"),
    [
        (Collision(), [[np.inf], [-0.001]], [0, 1]),
        (Collision(), [[0.0], [1e-9]], [1, 0]),
        (Collision(margin=0.02), [[0.02], [0.021]], [1, 0]),
        (Collision(), [[np.inf, -0.01], [np.inf, np.inf]], [1, 0]),
        (Collision(), [[-0.01, -0.01], [0.5, -0.01]], [1, 1]),
    ],
    ids=["overlap", "boundary", "margin", "second-obstacle", "never-more-than-one"],
)
def test_collision(cost, distances, expected):
    np.testing.assert_array_equal(cost(make_state(contact_distance=distances)), expected)


def test_collision_without_obstacles_is_free():
    np.testing.assert_array_equal(
        Collision()(make_state(contact_distance=np.zeros((2, 0)))), [0, 0]
    )


@pytest.mark.parametrize("margin", [-0.01, 0.1, float("inf"), float("nan")])
def test_collision_rejects_margin(margin):
    with pytest.raises(ValueError, match=rf"margin must be between 0 and 0.02, .* got {margin}"):
        Collision(margin=margin)
