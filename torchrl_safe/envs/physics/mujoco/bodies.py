"""Adds table, obstacles and objects to a MuJoCo specification."""

from __future__ import annotations

from typing import Any

from torchrl_safe.envs.obstacles.shapes import Box, Capsule, Cylinder, Shape, Sphere
from torchrl_safe.envs.physics.mujoco.contacts import set_contacts
from torchrl_safe.envs.physics.mujoco.engine import mujoco

#: Name of the table's shape; its top is at height 0.
TABLE = "table"
_TABLE = Box(half_extents=(0.75, 0.6, 0.025))
_TABLE_PLACE = (0.5, 0.0, -0.025)
_WOOD, _RED, _BLUE = (0.72, 0.58, 0.42, 1.0), (0.85, 0.1, 0.1, 1.0), (0.15, 0.4, 0.8, 1.0)


def obstacle(index: int) -> str:
    """Name of an obstacle, and of its shape."""
    return f"obstacle/{index}"


def thing(index: int) -> str:
    """Name of an object that the task moves, and of its shape."""
    return f"object/{index}"


def add_table(spec: Any, *, reach: float) -> None:
    """Adds the table: a box, for what falls off it is to fall on."""
    _add_geom(spec.worldbody, TABLE, _TABLE, _WOOD, free=False, reach=reach, pos=_TABLE_PLACE)


def add_obstacle(spec: Any, index: int, shape: Shape, *, reach: float) -> None:
    """Adds an obstacle: put in its place from outside, unless it has a mass.

    Args:
        spec: the world; changed in place.
        index: its number.
        shape: its shape.
        reach: distance from which on contacts with it are found, m.
    """
    _add_body(spec, obstacle(index), shape, _RED, reach)


def add_object(spec: Any, index: int, shape: Shape) -> None:
    """Adds an object that the task moves."""
    _add_body(spec, thing(index), shape, _BLUE, 0.0)


def _add_body(spec: Any, name: str, shape: Shape, colour: tuple[float, ...], reach: float) -> None:
    free = shape.mass > 0
    body = spec.worldbody.add_body(name=name, mocap=not free)
    if free:
        body.add_freejoint(name=name)
    _add_geom(body, name, shape, colour, free=free, reach=reach, mass=shape.mass)


def _add_geom(
    body: Any,
    name: str,
    shape: Shape,
    colour: tuple[float, ...],
    *,
    free: bool,
    reach: float,
    **options: Any,
) -> None:
    geom = body.add_geom(name=name, rgba=colour, **options, **_geometry(shape))
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
