"""How distances change with the joints, the same for every engine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.rotations import cross
from torchrl_safe.envs.state import Array


def distance_jacobian(
    point: Array, normal: Array, anchor: Array, axis: Array, slides: NDArray[np.bool_]
) -> Array:
    """Returns by how much points move along their normals with each joint, ``(k, r, n)``.

    As products of lines (of the normals through the points) and screws (of the joints), for all
    joints, also those that do not move the point.

    Args:
        point: points on the arm, m, ``(k, r, 3)``.
        normal: unit vectors, ``(k, r, 3)``.
        anchor: a point on the axis of each joint, m, ``(k, n, 3)``.
        axis: directions of the joints, ``(k, n, 3)``.
        slides: which joints slide instead of turning, ``(n,)``.

    Examples:
        >>> point, along_y = np.array([[[2.0, 0.0, 0.0]]]), np.array([[[0.0, 1.0, 0.0]]])
        >>> origin, about_z = np.zeros((1, 1, 3)), np.array([[[0.0, 0.0, 1.0]]])
        >>> distance_jacobian(point, along_y, origin, about_z, np.array([False]))
        array([[[2.]]])
    """
    turning, moving = axis, cross(anchor, axis)
    if slides.any():
        slides = slides[:, None]
        turning, moving = np.where(slides, 0.0, axis), np.where(slides, axis, moving)
    by_turning = cross(point, normal) @ turning.transpose(0, 2, 1)
    by_moving: Array = normal @ moving.transpose(0, 2, 1)
    return by_turning + by_moving


def moves(parents: Sequence[int], links: Sequence[int]) -> NDArray[np.bool_]:
    """Returns which joints move which links, ``(links, joints)``.

    Args:
        parents: number of each link's parent, before its children; another for a root.
        links: number of the link that each joint moves.

    Examples:
        >>> moves([-1, 0, 0], [0, 2]).tolist()
        [[True, False], [True, False], [True, True]]
    """
    found = np.asarray(links) == np.arange(len(parents))[:, None]
    for link, parent in enumerate(parents):
        if 0 <= parent < link:
            found[link] |= found[parent]
    return found
