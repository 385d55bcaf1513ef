import numpy as np
import pytest
from worlds import turn, turn_back

from torchrl_safe.envs.rotations import (
    from_rotation_vector,
    from_z_axis,
    multiply,
    rotation_vector,
)

RNG = np.random.default_rng(0)


def random_quaternions(*shape):
    quaternions = RNG.normal(size=(*shape, 4))
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)


@pytest.mark.parametrize(
    ("vector", "quaternion"),
    [
        ((0, 0, 0), (0, 0, 0, 1)),
        ((np.pi, 0, 0), (1, 0, 0, 0)),
        ((0, np.pi / 2, 0), (0, np.sqrt(0.5), 0, np.sqrt(0.5))),
        # A third of a turn about the diagonal.
        (2 * np.pi / 3 / np.sqrt(3) * np.ones(3), (0.5, 0.5, 0.5, 0.5)),
        ((0, 0, 2e-9), (0, 0, 1e-9, 1)),
    ],
)
def test_from_rotation_vector(vector, quaternion):
    np.testing.assert_allclose(from_rotation_vector(np.array(vector)), quaternion, atol=1e-15)


def test_multiply_turns_by_the_second_first():
    """A quarter about z brings x to y; then a quarter about x brings it to z."""
    about_x, about_z = (from_rotation_vector(np.pi / 2 * axis) for axis in np.eye(3)[[0, 2]])
    x = np.array([1.0, 0, 0])
    np.testing.assert_allclose(turn(multiply(about_x, about_z), x), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turn(multiply(about_z, about_x), x), [0, 1, 0], atol=1e-12)


def test_multiply_many():
    one, two = random_quaternions(5, 3), random_quaternions(5, 3)
    vectors = RNG.normal(size=(5, 3, 3))
    both = multiply(one, two)
    np.testing.assert_allclose(turn(both, vectors), turn(one, turn(two, vectors)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(both, axis=-1), 1, atol=1e-12)
    # One for many.
    np.testing.assert_allclose(multiply(one, two[0, 0])[2, 1], multiply(one[2, 1], two[0, 0]))
    # With its conjugate it cancels.
    none = multiply(one, one * (-1, -1, -1, 1))
    np.testing.assert_allclose(none, np.broadcast_to([0, 0, 0, 1], none.shape), atol=1e-12)


def test_rotation_vector_is_the_inverse():
    """In world coordinates, to third order in the angle, whichever sign the quaternions have."""
    current = random_quaternions(20)
    vectors = RNG.normal(size=(20, 3))
    vectors *= 0.1 / np.linalg.norm(vectors, axis=1, keepdims=True)
    wanted = multiply(from_rotation_vector(vectors), current)
    for signs in (1, -1):
        found = rotation_vector(current, signs * wanted)
        np.testing.assert_allclose(found, vectors, atol=0.1**3 / 20)
        # Exact in direction, and as long as twice the sine of half the angle.
        np.testing.assert_allclose(found, vectors * 20 * np.sin(0.05), atol=1e-12)


def test_from_z_axis():
    """The shortest rotation: it turns about a horizontal axis by the angle from z."""
    axes = RNG.normal(size=(50, 3))
    axes = np.vstack([axes, np.eye(3), -np.eye(3)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    found = from_z_axis(axes)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    z = np.broadcast_to([0.0, 0, 1], axes.shape)
    np.testing.assert_allclose(turn(found, z), axes, atol=1e-12)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(
        np.cos(2 * np.arccos(found[:, 3].clip(-1, 1))), axes[:, 2], atol=1e-9
    )
    assert from_z_axis(axes.reshape(8, 7, 3)).shape == (8, 7, 4)


def test_the_helper_of_these_tests():
    """x to y to z to x, by a third of a turn."""
    third = np.array([0.5, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(turn(third, np.array([1.0, 2.0, 3.0])), [3, 1, 2])
    np.testing.assert_allclose(turn_back(third, np.array([3.0, 1.0, 2.0])), [1, 2, 3])
