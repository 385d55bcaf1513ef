"""Adds table, obstacles and objects to a MuJoCo specification."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_safe.envs.obstacles.shapes import Box, Capsule, Cylinder, Shape, Sphere
from torchrl_safe.envs.physics.mujoco.contacts import set_contacts
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.quaternions import TO_MUJOCO
from torchrl_safe.envs.physics.palette import (
    OBJECT,
    OBSTACLE,
    TABLE as TABLE_COLOUR,
    Colour,
    colour,
)
from torchrl_safe.envs.physics.scene import TABLE_CENTRE, TABLE_SHAPE

#: Name of the table's shape, which no arm has; its top is at height 0.
TABLE = "scene/table"


def obstacle_name(index: int) -> str:
    """Name of an obstacle, and of its shape."""
    return f"obstacle/{index}"


def object_name(index: int) -> str:
    """Name of an object that the task moves, and of its shape."""
    return f"object/{index}"


def add_table(spec: Any, *, reach: float) -> None:
    """Adds the table: a box, so that what falls off its edge keeps falling."""
    _add_geom(
        spec.worldbody, TABLE, TABLE_SHAPE, TABLE_COLOUR, free=False, reach=reach, pos=TABLE_CENTRE
    )


def add_obstacle(spec: Any, index: int, shape: Shape, *, reach: float) -> None:
    """Adds an obstacle. It is placed from outside, unless it has a mass.

    Args:
        spec: the world; changed in place.
        index: its number.
        shape: its shape.
        reach: distance from which on contacts with it are found, m.
    """
    _add_body(spec, obstacle_name(index), shape, OBSTACLE, reach)


def add_object(spec: Any, index: int, shape: Shape) -> None:
    """Adds an object that the task moves."""
    _add_body(spec, object_name(index), shape, OBJECT, 0.0)


def add_parts(spec: Any, shapes: Sequence[Shape], objects: Sequence[Shape]) -> None:
    """Adds what is drawn with obstacles and objects, and collides with nothing."""
    names = [(obstacle_name(index), shape, OBSTACLE) for index, shape in enumerate(shapes)]
    names += [(object_name(index), shape, OBJECT) for index, shape in enumerate(objects)]
    for name, shape, default in names:
        for part in shape.look.parts if shape.look is not None else ():
            spec.body(name).add_geom(
                rgba=colour(part.shape, colour(shape, default)),
                pos=part.position,
                quat=np.array(part.orientation)[TO_MUJOCO],
                contype=0,
                conaffinity=0,
                mass=0,
                **_geometry(part.shape),
            )


def _add_body(spec: Any, name: str, shape: Shape, default: Colour, reach: float) -> None:
    free = shape.mass > 0
    body = spec.worldbody.add_body(name=name, mocap=not free)
    if free:
        body.add_freejoint(name=name)
    _add_geom(body, name, shape, colour(shape, default), free=free, reach=reach, mass=shape.mass)


def _add_geom(
    body: Any,
    name: str,
    shape: Shape,
    rgba: Colour,
    *,
    free: bool,
    reach: float,
    **options: Any,
) -> None:
    geom = body.add_geom(name=name, rgba=rgba, **options, **_geometry(shape))
    set_contacts(geom, free=free, reach=reach)


def _geometry(shape: Shape) -> dict[str, Any]:
    kinds = mujoco.mjtGeom
    match shape:
        case Cylinder():
            return {"type": kinds.mjGEOM_CYLINDER, "size": (shape.radius, shape.height / 2, 0)}
        case Box():
            return {"type": kinds.mjGEOM_BOX, "size": shape.half_extents}
        case Sphere():
            return {"type": kinds.mjGEOM_SPHERE, "size": (shape.radius, 0, 0)}
        case Capsule():
            return {"type": kinds.mjGEOM_CAPSULE, "size": (shape.radius, shape.length / 2, 0)}
