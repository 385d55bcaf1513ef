"""Puts arm, table, obstacles, objects, motors and sensors together into a compiled world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.arms.models import grips
from torchrl_safe.envs.obstacles.shapes import Cylinder, Shape
from torchrl_safe.envs.physics.mujoco.arm import ArmParts, name_solids, read_arm
from torchrl_safe.envs.physics.mujoco.bodies import (
    add_object,
    add_obstacle,
    add_parts,
    add_table,
)
from torchrl_safe.envs.physics.mujoco.contacts import (
    exclude_overlaps,
    exclude_unreachable,
    set_options,
)
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.inertia import set_box_inertias
from torchrl_safe.envs.physics.mujoco.motors import add_motors, add_rotors, set_gains
from torchrl_safe.envs.physics.mujoco.readings import CONTACT_RANGE, Sensors
from torchrl_safe.envs.physics.mujoco.scenery import add_scenery, dress_arm
from torchrl_safe.envs.physics.rows import Place
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.state import Array, Sensing


@dataclass(frozen=True)
class World:
    """A compiled world, and where its parts are.

    Attributes:
        model: the ``MjModel``.
        parts: names and limits of the arm.
        places: where the readings of each kind are in the sensor data.
        position: where arm joints and free fingers are in ``qpos``, ``(n + f,)``.
        velocity: where they are in ``qvel``, ``(n + f,)``.
        home: ``qpos`` with the arm at home.
    """

    model: Any
    parts: ArmParts
    places: dict[str, Place]
    position: NDArray[np.int_]
    velocity: NDArray[np.int_]
    home: Array


def build_world(
    arm: ArmModel,
    scene: Scene,
    shapes: Sequence[Shape],
    objects: Sequence[Shape],
    sensing: Sensing,
) -> World:
    """Builds the world of an environment.

    Raises:
        ValueError: if the URDF does not load or the home pose does not fit it.
    """
    spec, parts = _read_arm(arm, scene, objects, itself=sensing.itself)
    links = {body.name for body in spec.bodies[1:]}
    try:
        set_box_inertias(spec)
    except ValueError as error:
        raise ValueError(f"urdf {arm.urdf!r} does not load in MuJoCo: {error}") from error
    standing = any(isinstance(shape, Cylinder) and shape.mass > 0 for shape in (*shapes, *objects))
    set_options(spec, scene.gravity, standing=standing)
    solids = name_solids(spec)
    _add_bodies(spec, shapes, objects, reach=CONTACT_RANGE)
    add_motors(spec, parts, limited=scene.motor_limits, strength=scene.motor_strength)
    sensors = Sensors(spec, parts, solids, shapes, sensing)
    model = spec.compile()
    positions = grips(arm, parts.finger_lower, parts.finger_upper)
    states = [_at_home(model, arm, parts, fingers) for fingers in positions]
    exclude_overlaps(spec, links, model, states)
    data = states[-1]
    exclude_unreachable(spec, links, model, data, reach=CONTACT_RANGE)
    ids = [model.joint(name).id for name in parts.joints + parts.fingers]
    velocity = model.jnt_dofadr[ids]
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    moved = add_rotors(spec, parts, np.diag(mass)[velocity])
    model = spec.compile()
    set_gains(model, parts, moved, limited=scene.motor_limits)
    model.geom_friction[:, 0] *= scene.friction
    _scale_mass(model, links, scene.link_mass)
    return World(
        model=model,
        parts=parts,
        places=sensors.places,
        position=model.jnt_qposadr[ids],
        velocity=velocity,
        home=data.qpos.copy(),
    )


def _scale_mass(model: Any, links: set[str], factor: float) -> None:
    """Multiplies the masses of some bodies, and what MuJoCo has derived from them."""
    if factor == 1:
        return
    bodies = [model.body(name).id for name in links]
    model.body_mass[bodies] *= factor
    model.body_inertia[bodies] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))


def build_scenery(
    arm: ArmModel, scene: Scene, shapes: Sequence[Shape], objects: Sequence[Shape]
) -> Any:
    """Builds what is to be seen of a world: an ``MjModel`` with the same joints.

    The goal is the last of the bodies that are placed from outside.
    """
    spec, _ = _read_arm(arm, scene, objects, visuals=True)
    dress_arm(spec)
    _add_bodies(spec, shapes, objects, reach=0.0)
    add_parts(spec, shapes, objects)
    add_scenery(spec)
    return spec.compile()


def _read_arm(
    arm: ArmModel,
    scene: Scene,
    objects: Sequence[Shape],
    *,
    visuals: bool = False,
    itself: bool = False,
) -> tuple[Any, ArmParts]:
    return read_arm(
        arm,
        fix_fingers=not scene.free_fingers,
        # Links that touch objects have friction of their own.
        merge=not objects,
        couple=scene.motor_limits,
        visuals=visuals,
        itself=itself,
    )


def _add_bodies(
    spec: Any, shapes: Sequence[Shape], objects: Sequence[Shape], *, reach: float
) -> None:
    add_table(spec, reach=CONTACT_RANGE)
    for index, shape in enumerate(shapes):
        add_obstacle(spec, index, shape, reach=reach)
    for index, shape in enumerate(objects):
        add_object(spec, index, shape)


def _at_home(model: Any, arm: ArmModel, parts: ArmParts, fingers: Array) -> Any:
    """The state with the arm at home, and all else far away."""
    data = mujoco.MjData(model)
    for name, position in zip(parts.joints + parts.fingers, (*arm.home, *fingers), strict=True):
        data.joint(name).qpos = position
    mujoco.mj_forward(model, data)
    return data
