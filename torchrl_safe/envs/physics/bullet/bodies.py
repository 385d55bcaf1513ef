"""Loads arms, shapes and furniture into a PyBullet server."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.arms.models import check_fingers, check_home
from torchrl_safe.envs.arms.urdf import prepare_urdf
from torchrl_safe.envs.obstacles.shapes import Box, Capsule, Cylinder, Part, Shape, Sphere
from torchrl_safe.envs.physics.bullet.engine import pybullet, pybullet_data
from torchrl_safe.envs.physics.palette import (
    FLOOR,
    GOAL,
    GOAL_RADIUS,
    TABLE,
    Colour,
    colour,
    ring,
)
from torchrl_safe.envs.physics.scene import (
    FLOOR_HEIGHT,
    FLOOR_SIZE,
    TABLE_CENTRE,
    TABLE_SHAPE,
    Scene,
)
from torchrl_safe.envs.state import Array

_UNLIMITED_EFFORT = 1e5
# More than the force of the fingers' motors, N.
_GEAR_FORCE = 1e3


@dataclass(frozen=True)
class LoadedArm:
    """What PyBullet calls an arm's parts, and what its URDF says of them.

    Attributes:
        body: number of the body.
        ee: number of the tool link.
        base: numbers of the links that no joint moves, -1 among them.
        joints: numbers of the arm's joints, from base to tool.
        fingers: numbers of the other movable joints.
        columns: where the arm's joints are among all movable joints, of which Bullet's Jacobian
            and inverse kinematics speak.
        num_movable: number of all movable joints.
        joint_lower: lower limits of the arm's joints, rad.
        joint_upper: upper limits of the arm's joints, rad.
        finger_lower: lower limits of the fingers, m.
        finger_upper: upper limits of the fingers, m.
        speed: largest speeds of joints and fingers, rad/s and m/s.
        effort: largest torques and forces of joints and fingers, N m and N.
    """

    body: int
    ee: int
    base: frozenset[int]
    joints: list[int]
    fingers: list[int]
    columns: list[int]
    num_movable: int
    joint_lower: Array
    joint_upper: Array
    finger_lower: Array
    finger_upper: Array
    speed: Array
    effort: list[float]


def load_arm(
    client: int,
    arm: ArmModel,
    scene: Scene,
    *,
    visuals: bool,
    merge: bool,
    urdf_inertia: bool,
    self_collision: bool,
) -> LoadedArm:
    """Loads an arm whose fingers are fixed unless the scene leaves them free.

    Raises:
        ValueError: if the URDF does not load or the home pose does not fit it.
    """
    text, chain, tool_link = prepare_urdf(
        arm, visuals=visuals, fix_fingers=not scene.free_fingers, merge=merge
    )
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE if urdf_inertia else 0
    if self_collision:
        flags |= pybullet.URDF_USE_SELF_COLLISION
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        file.write_text(text)
        try:
            body = pybullet.loadURDF(
                str(file), useFixedBase=True, flags=flags, physicsClientId=client
            )
        except pybullet.error as error:
            raise ValueError(f"urdf {arm.urdf!r} does not load in PyBullet.") from error
    _check_shapes(client, body, text, arm.urdf)
    loaded = _find_joints(client, body, chain, tool_link)
    check_home(arm, loaded.joint_lower, loaded.joint_upper)
    if scene.motor_limits:
        check_fingers(arm, loaded.finger_lower, loaded.finger_upper)
        _couple(client, body, loaded.fingers)
    return loaded


def _check_shapes(client: int, body: int, text: str, urdf: str) -> None:
    """Raises unless all collision shapes were loaded: Bullet leaves out meshes it cannot read."""
    numbers = {pybullet.getBodyInfo(body, physicsClientId=client)[0].decode(): -1}
    for number in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, number, physicsClientId=client)
        numbers[info[12].decode()] = number
    for link in ElementTree.fromstring(text).iter("link"):
        shapes, name = link.findall("collision"), link.get("name", "")
        loaded = pybullet.getCollisionShapeData(body, numbers[name], physicsClientId=client)
        if len(loaded) < len(shapes):
            meshes = [mesh.get("filename") for mesh in link.iter("mesh")]
            raise ValueError(
                f"urdf {urdf!r} does not load in PyBullet: it cannot read a collision shape of "
                f"{name!r}, one of {meshes}."
            )


def _couple(client: int, body: int, fingers: Sequence[int]) -> None:
    """Makes the fingers open alike, as the gear of a parallel gripper does.

    Without it, equal forces from both sides cancel, and as soon as the hand moves, what it holds
    slides to one side together with both fingers.
    """
    for finger in fingers[1:]:
        gear = pybullet.createConstraint(
            body,
            fingers[0],
            body,
            finger,
            jointType=pybullet.JOINT_GEAR,
            jointAxis=(1, 0, 0),
            parentFramePosition=(0, 0, 0),
            childFramePosition=(0, 0, 0),
            physicsClientId=client,
        )
        pybullet.changeConstraint(
            gear, gearRatio=-1, erp=0.1, maxForce=_GEAR_FORCE, physicsClientId=client
        )


def _find_joints(client: int, body: int, chain: set[str], tool_link: str) -> LoadedArm:
    """Sorts the joints into those of the arm and free fingers, and reads their limits."""
    infos = [
        pybullet.getJointInfo(body, joint, physicsClientId=client)
        for joint in range(pybullet.getNumJoints(body, physicsClientId=client))
    ]
    movable = [info for info in infos if info[2] != pybullet.JOINT_FIXED]
    base = {-1}
    # Parents come before their children.
    for info in infos:
        if info[2] == pybullet.JOINT_FIXED and info[16] in base:
            base.add(info[0])
    joints = [info for info in movable if info[1].decode() in chain]
    if not joints:
        raise ValueError(f"ee_link must be a link that a joint moves, got {tool_link!r}.")
    fingers = [info for info in movable if info[1].decode() not in chain]
    count, both = len(joints), joints + fingers
    lower, upper = np.array([info[8:10] for info in both]).T
    lower, upper = np.where(lower >= upper, [[-np.inf], [np.inf]], [lower, upper])
    return LoadedArm(
        body=body,
        ee=next(info[0] for info in infos if info[12].decode() == tool_link),
        base=frozenset(base),
        joints=[info[0] for info in joints],
        fingers=[info[0] for info in fingers],
        columns=[movable.index(info) for info in joints],
        num_movable=len(movable),
        joint_lower=lower[:count],
        joint_upper=upper[:count],
        finger_lower=lower[count:],
        finger_upper=upper[count:],
        speed=np.array([info[11] or np.inf for info in both]),
        effort=[info[10] or _UNLIMITED_EFFORT for info in both],
    )


def load_furniture(
    client: int, furniture: Sequence[tuple[str, Sequence[float]]], *, visuals: bool
) -> list[int]:
    """Loads URDF files of ``pybullet_data``, or if there are none a table with top at height 0."""
    if furniture:
        return [load_body(client, urdf, position, fixed=True) for urdf, position in furniture]
    body = add_shape(client, TABLE_SHAPE, TABLE_CENTRE, TABLE if visuals else None)
    if visuals:
        thin = Box(half_extents=(FLOOR_SIZE, FLOOR_SIZE, 0.01))
        floor = _skin(client, [Part(thin, (0, 0, FLOOR_HEIGHT - 0.01))], FLOOR)
        pybullet.createMultiBody(0, -1, floor, physicsClientId=client)
    return [body]


def scale_dynamics(client: int, body: int, *, mass: float = 1.0, friction: float = 1.0) -> None:
    """Multiplies masses and inertias of a body's links, and the friction of its surfaces."""
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getDynamicsInfo(body, link, physicsClientId=client)
        pybullet.changeDynamics(
            body,
            link,
            mass=mass * info[0],
            localInertiaDiagonal=[mass * inertia for inertia in info[2]],
            lateralFriction=friction * info[1],
            physicsClientId=client,
        )


def load_body(client: int, urdf: str, position: Sequence[float], *, fixed: bool = False) -> int:
    """Loads a URDF file of ``pybullet_data``, free to move unless fixed."""
    try:
        return pybullet.loadURDF(_data(urdf), position, useFixedBase=fixed, physicsClientId=client)
    except pybullet.error as error:
        raise ValueError(f"urdf {urdf!r} does not load in PyBullet.") from error


def add_shape(client: int, shape: Shape, position: Sequence[float], default: Colour | None) -> int:
    """Adds a shape; without a colour it is simulated but not drawn."""
    geometry, size = _geometry(shape)
    body = pybullet.createCollisionShape(geometry, physicsClientId=client, **size)
    skin = -1
    if default is not None:
        parts = shape.look.parts if shape.look is not None else ()
        skin = _skin(client, [Part(shape, (0, 0, 0)), *parts], colour(shape, default))
    return pybullet.createMultiBody(shape.mass, body, skin, position, physicsClientId=client)


def add_goal(client: int, position: Sequence[float]) -> list[int]:
    """Adds ball and ring, which are drawn but not simulated."""
    vertices, triangles = ring()
    skins = [
        pybullet.createVisualShape(
            pybullet.GEOM_SPHERE, radius=GOAL_RADIUS, rgbaColor=GOAL, physicsClientId=client
        ),
        pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices.tolist(),
            indices=triangles.ravel().tolist(),
            rgbaColor=GOAL,
            physicsClientId=client,
        ),
    ]
    return [
        pybullet.createMultiBody(0, -1, skin, position, physicsClientId=client) for skin in skins
    ]


def _skin(client: int, parts: Sequence[Part], default: Colour) -> int:
    geometries, sizes = zip(*(_geometry(part.shape) for part in parts), strict=True)
    # PyBullet wants a value also for arguments that this shape does not use.
    return pybullet.createVisualShapeArray(
        shapeTypes=geometries,
        radii=[size.get("radius", 1.0) for size in sizes],
        halfExtents=[size.get("halfExtents", (1.0, 1.0, 1.0)) for size in sizes],
        lengths=[size.get("height", 1.0) for size in sizes],
        visualFramePositions=[part.position for part in parts],
        visualFrameOrientations=[part.orientation for part in parts],
        rgbaColors=[colour(part.shape, default) for part in parts],
        physicsClientId=client,
    )


def _geometry(shape: Shape) -> tuple[int, dict[str, Any]]:
    match shape:
        case Cylinder():
            return pybullet.GEOM_CYLINDER, {"radius": shape.radius, "height": shape.height}
        case Box():
            return pybullet.GEOM_BOX, {"halfExtents": shape.half_extents}
        case Sphere():
            return pybullet.GEOM_SPHERE, {"radius": shape.radius}
        case Capsule():
            return pybullet.GEOM_CAPSULE, {"radius": shape.radius, "height": shape.length}


def _data(urdf: str) -> str:
    return str(Path(pybullet_data.getDataPath(), urdf))
