import numpy as np
import pytest
import torch

from torchrl_safe.envs import (
    Box,
    Camera,
    CartesianDelta,
    Human,
    InFront,
    Patrol,
    Region,
    Swing,
)

BOX = Region(low=(0.5, -0.2, 0.1), high=(0.7, 0.2, 0.1))


def test_samples_fill_the_box():
    points = np.array([BOX.sample(np.random.default_rng(seed)) for seed in range(300)])
    assert points.shape == (300, 3)
    assert BOX.contains(points).all()
    np.testing.assert_allclose(points.min(0), BOX.low, atol=0.01)
    np.testing.assert_allclose(points.max(0), BOX.high, atol=0.01)


def test_contains_its_sides_and_nothing_beyond():
    points = [[[0.5, 0.2, 0.1], [0.6, 0.0, 0.1]], [[0.71, 0.0, 0.1], [0.6, 0.0, 0.09]]]
    np.testing.assert_array_equal(BOX.contains(points), [[True, True], [False, False]])
    assert BOX.contains(BOX.low)
    with pytest.raises(ValueError, match=r"points must have shape \(..., 3\), got \(2,\)"):
        BOX.contains([0.0, 1.0])


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ((1, 0, 0), (0, 0, 0), r"low must not exceed high, got \(1, 0, 0\) and \(0, 0, 0\)"),
        ((0, 0), (0, 0, 0), r"low must have shape \(3,\), got \(2,\)"),
        ((0, 0, 0), (0, np.inf, 0), "high must be finite"),
    ],
    ids=["empty", "shape", "infinite"],
)
def test_bad_box_is_named(low, high, message):
    with pytest.raises(ValueError, match=message):
        Region(low, high)


@pytest.mark.parametrize("give", [list, np.array, torch.tensor])
def test_points_may_be_lists_arrays_and_tensors(give):
    """They make the same parts, which can be compared and hashed."""
    point, beyond = (0.5, -0.25, 0.0), (0.75, 0.25, 0.5)
    for kind, numbers in (
        (Box, {"half_extents": beyond}),
        (InFront, {"direction": point}),
        (Swing, {"direction": point}),
        (Patrol, {"direction": point}),
        (Human, {"shoulder": beyond, "rest": (0.625, 0.25, 0.25), "pause": (0.5, 1.0)}),
        (Region, {"low": point, "high": beyond}),
        (Camera, {"eye": point, "target": beyond}),
        (CartesianDelta, {"orientation": (0.0, 0.0, 0.0, 1.0)}),
    ):
        part = kind(**{name: give(value) for name, value in numbers.items()})
        same = kind(**numbers)
        assert part == same
        assert hash(part) == hash(same)
