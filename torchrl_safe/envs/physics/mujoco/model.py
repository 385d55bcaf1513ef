"""Puts arm, table, obstacles, objects, motors and sensors together into a compiled world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.mujoco.arm import ArmParts, read_arm
from torchrl_safe.envs.physics.mujoco.bodies import add_object, add_obstacle, add_table
from torchrl_safe.envs.physics.mujoco.contacts import exclude_overlaps, set_options
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.motors import add_motors, set_gains
from torchrl_safe.envs.physics.mujoco.readings import CONTACT_RANGE, Place, Sensors
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.state import Array, Sensing


@dataclass(frozen=True)
class World:
    """A compiled world, and where its parts are.

    Attributes:
        model: the ``MjModel``.
        parts: names and limits of the arm.
        places: where the readings of each kind are in the sensor data.
        joints: numbers of the arm's joints, and so of their axes, ``(n,)``.
        position: where arm joints and free fingers are in ``qpos``, ``(n + f,)``.
        velocity: where they are in ``qvel``, ``(n + f,)``.
        home: ``qpos`` with the arm at home.
    """

    model: Any
    parts: ArmParts
    places: dict[str, Place]
    joints: Array
    position: Array
    velocity: Array
    home: Array


def build_world(
    arm: ArmModel,
    scene: Scene,
    shapes: Sequence[Shape],
    objects: Sequence[Shape],
    sensing: Sensing,
    *,
    visuals: bool = False,
) -> World:
    """Builds the world of an environment.

    Raises:
        ValueError: if the URDF does not load or the home pose does not fit it.
    """
    spec, parts = read_arm(
        arm,
        fix_fingers=not scene.free_fingers,
        merge=not objects,
        couple=scene.motor_limits,
        visuals=visuals,
        itself=sensing.itself,
    )
    set_options(spec, scene.gravity)
    links = {body.name for body in spec.bodies[1:]}
    reach = max(CONTACT_RANGE, sensing.clearance)
    add_table(spec, reach=CONTACT_RANGE)
    for index, shape in enumerate(shapes):
        add_obstacle(spec, index, shape, reach=reach)
    for index, shape in enumerate(objects):
        add_object(spec, index, shape)
    add_motors(spec, parts, limited=scene.motor_limits)
    sensors = Sensors(spec, parts, shapes, sensing)
    model, data = _at_home(spec, arm, parts)
    exclude_overlaps(spec, links, model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    model = spec.compile()
    ids = [model.joint(name).id for name in parts.joints + parts.fingers]
    velocity = model.jnt_dofadr[ids]
    set_gains(model, parts, np.diag(mass)[velocity])
    return World(
        model=model,
        parts=parts,
        places=sensors.places,
        joints=np.array(ids[: len(parts.joints)]),
        position=model.jnt_qposadr[ids],
        velocity=velocity,
        home=data.qpos.copy(),
    )


def _at_home(spec: Any, arm: ArmModel, parts: ArmParts) -> tuple[Any, Any]:
    """The world compiled as it is, and its state with the arm at home and all else far away."""
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, angle in zip(parts.joints, arm.home, strict=True):
        data.joint(name).qpos = angle
    for name in parts.fingers:
        data.joint(name).qpos = arm.finger_home
    mujoco.mj_forward(model, data)
    return model, data
