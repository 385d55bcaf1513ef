"""Quaternions (x, y, z, w) and vectors, one or many: the last axis holds their numbers."""

from __future__ import annotations

import numpy as np

from torchrl_safe.envs.state import Array

#: The orientation of what is not turned.
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# For x, y and z: the axis that follows, and the one before.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def rotation_vector(current: Array, wanted: Array) -> Array:
    """Returns the rotation from current orientations to wanted ones, in world coordinates.

    Exact in direction; its length is twice the sine of half the angle, which equals the angle
    to third order.

    Args:
        current: quaternions, ``(..., 4)``.
        wanted: quaternions, ``(..., 4)``.

    Returns:
        Rotation vectors, rad, ``(..., 3)``.

    Examples:
        >>> quarter = np.array([0.0, 0.0, np.sin(0.05), np.cos(0.05)])
        >>> rotation_vector(np.array([0.0, 0.0, 0.0, 1.0]), quarter).round(4)
        array([0. , 0. , 0.1])
    """
    difference = multiply(wanted, current * (-1, -1, -1, 1))
    return 2 * np.where(difference[..., 3:] < 0, -1, 1) * difference[..., :3]


def multiply(first: Array, second: Array) -> Array:
    """Returns the orientations after turning by ``second``, then by ``first``, ``(..., 4)``.

    Examples:
        >>> half = np.array([0.0, 0.0, 1.0, 0.0])
        >>> multiply(half, half)
        array([ 0.,  0.,  0., -1.])
    """
    x, y, z, w = (first[..., part] for part in range(4))
    other_x, other_y, other_z, other_w = (second[..., part] for part in range(4))
    return np.stack(
        [
            w * other_x + other_w * x + (y * other_z - z * other_y),
            w * other_y + other_w * y + (z * other_x - x * other_z),
            w * other_z + other_w * z + (x * other_y - y * other_x),
            w * other_w - (x * other_x + y * other_y + z * other_z),
        ],
        axis=-1,
    )


def from_rotation_vector(vector: Array) -> Array:
    """Returns the quaternions of rotation vectors, rad, ``(..., 3)``.

    Examples:
        >>> from_rotation_vector(np.array([0.0, 0.0, np.pi])).round(4)
        array([0., 0., 1., 0.])
    """
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # numpy's sinc is sin(pi x) / (pi x), which is 1 at 0.
    return np.concatenate(
        [vector / 2 * np.sinc(angle / (2 * np.pi)), np.cos(angle / 2)],
        axis=-1,
    )


def from_z_axis(axis: Array) -> Array:
    """Returns the shortest rotations that bring the z axis to given unit vectors, ``(..., 3)``.

    Examples:
        >>> from_z_axis(np.array([1.0, 0.0, 0.0])) @ [0, 0.5**0.5, 0, 0.5**0.5]
        np.float64(1.0)
    """
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    half = np.stack([-y, x, np.zeros_like(x), 1 + z], axis=-1)
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    # Straight down the axis of the half turn is free: x is taken.
    return np.where(length < 1e-9, (1.0, 0.0, 0.0, 0.0), half / np.maximum(length, 1e-9))


def cross(first: Array, second: Array) -> Array:
    """Returns cross products, ``(..., 3)``: for few vectors several times as fast as NumPy's."""
    ahead: Array = first.take(_NEXT, axis=-1) * second.take(_LAST, axis=-1)
    return ahead - first.take(_LAST, axis=-1) * second.take(_NEXT, axis=-1)


def turn(orientation: Array, vector: Array) -> Array:
    """Returns vectors ``(..., 3)`` turned by quaternions (x, y, z, w), ``(..., 4)``."""
    axis, twice = orientation[..., :3], 2 * cross(orientation[..., :3], vector)
    return vector + orientation[..., 3:] * twice + cross(axis, twice)
