"""The sensors that measure what an ArmState has, for all worlds at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.mujoco.arm import ArmParts
from torchrl_safe.envs.physics.mujoco.bodies import TABLE, obstacle_name
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.paths import Ways
from torchrl_safe.envs.physics.rows import places
from torchrl_safe.envs.rotations import cross
from torchrl_safe.envs.state import Array, Sensing

#: Distance from which on contacts are found, m; forces begin at a touch.
CONTACT_RANGE = 0.02
# Of one obstacle; of more contacts at once the shallowest are not counted.
_SLOTS = 16
_NEAREST = 1  # How a contact sensor sorts what it has found.
# What is where in the readings of contacts; the force is in the frame of the contact.
_FOUND, _NORMAL_FORCE, _DIST = 0, 1, 4


class Sensors:
    """Adds the sensors to a world, and knows where each is in what they read.

    Args:
        spec: the world; changed in place.
        parts: of the arm.
        solids: the arm's shapes that collide, see :func:`~.arm.name_solids`.
        shapes: the obstacles.
        sensing: what is measured in every substep besides contacts.
    """

    def __init__(
        self,
        spec: Any,
        parts: ArmParts,
        solids: Mapping[str, str],
        shapes: Sequence[Shape],
        sensing: Sensing,
    ) -> None:
        self._spec = spec
        self._shapes: dict[str, tuple[int, ...]] = {}
        frame = mujoco.mjtObj.mjOBJ_XBODY
        for index, shape in enumerate(shapes):
            # With the arm's base too if the obstacle is free.
            arm = parts.root if shape.mass else parts.moving
            geom = mujoco.mjtObj.mjOBJ_GEOM
            self._add_contact(arm, geom, obstacle_name(index), _SLOTS, ("FOUND", "FORCE", "DIST"))
        self._shapes["contacts"] = (len(shapes), _SLOTS, 5)
        if sensing.clearance:
            self._add_distances(solids, shapes, sensing.clearance)
        if sensing.table:
            self._add_touch("table_distance", parts.moving, mujoco.mjtObj.mjOBJ_GEOM, TABLE)
        if sensing.itself:
            self._add_touch("self_distance", parts.root, frame, parts.root)
        if sensing.tool:
            self._add("ee_position", mujoco.mjtSensor.mjSENS_FRAMEPOS, frame, parts.tool)
            self._add("ee_velocity", mujoco.mjtSensor.mjSENS_FRAMELINVEL, frame, parts.tool)
        if sensing.links:
            # Of a body MuJoCo tells the velocity of its centre of mass.
            kind, body = mujoco.mjtSensor.mjSENS_FRAMELINVEL, mujoco.mjtObj.mjOBJ_BODY
            for link in parts.links:
                spec.add_sensor(type=kind, objtype=body, objname=link)
            self._shapes["links"] = (len(parts.links), 3)
        #: Where the readings of each kind are.
        self.places = places(self._shapes)

    def _add(self, name: str, kind: Any, objtype: Any, objname: str) -> None:
        self._spec.add_sensor(type=kind, objtype=objtype, objname=objname)
        self._shapes[name] = (3,)

    def _add_distances(
        self, solids: Mapping[str, str], shapes: Sequence[Shape], reach: float
    ) -> None:
        """Distances of all shapes of the arm from each obstacle, and how the shapes move.

        Contacts cannot tell them: with a wide gap MuJoCo gets the normals of overlaps wrong.
        """
        kinds = mujoco.mjtSensor
        for index in range(len(shapes)):
            for name in solids:
                self._spec.add_sensor(
                    type=kinds.mjSENS_GEOMFROMTO,
                    objtype=mujoco.mjtObj.mjOBJ_GEOM,
                    objname=name,
                    reftype=mujoco.mjtObj.mjOBJ_GEOM,
                    refname=obstacle_name(index),
                    cutoff=reach,
                )
        self._shapes["closest"] = (len(shapes), len(solids), 2, 3)
        for body in solids.values():
            for kind in (kinds.mjSENS_FRAMEPOS, kinds.mjSENS_FRAMELINVEL, kinds.mjSENS_FRAMEANGVEL):
                self._spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=body)
        self._shapes["motions"] = (len(solids), 3, 3)

    def _add_touch(self, name: str, body: str, reftype: Any, refname: str) -> None:
        self._add_contact(body, reftype, refname, 1, ("FOUND", "DIST"))
        self._shapes[name] = (2,)

    def _add_contact(
        self, body: str, reftype: Any, refname: str, slots: int, data: Sequence[str]
    ) -> None:
        sensor = self._spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname=body,
            reftype=reftype,
            refname=refname,
        )
        bits = (int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{part}")) for part in data)
        sensor.intprm[:3] = (sum(1 << bit for bit in bits), _NEAREST, slots)


def touches(data: Array) -> tuple[Array, Array]:
    """Smallest distance, m, and largest force, N, of the contacts of a control step.

    Args:
        data: readings of contacts in every substep, ``(N, s, m, slots, 5)``.

    Returns:
        For each obstacle of each world, ``(N, m)``: distances infinite without contact.
    """
    worlds, _, obstacles, slots, _ = data.shape
    distance, force = np.full((worlds, obstacles), np.inf), np.zeros((worlds, obstacles))
    # The nearest come first. What has found nothing reads zero.
    near = (data[..., 0, _FOUND] > 0) & (data[..., 0, _DIST] <= CONTACT_RANGE)
    row, substep, index = near.nonzero()
    if len(row):
        hits = data[row, substep, index]
        used = np.arange(slots) < hits[:, :1, _FOUND]
        np.minimum.at(distance, (row, index), hits[:, 0, _DIST])
        forces = np.where(used, hits[:, :, _NORMAL_FORCE], 0).sum(axis=1)
        np.maximum.at(force, (row, index), forces)
    return distance, force


def touch_distance(data: Array) -> Array:
    """Smallest distance of contacts, m, infinite without one, of readings ``(..., 2)``."""
    return np.where(data[..., 0] > 0, data[..., 1], np.inf)


def nearest(closest: Array, motions: Array, ways: Ways) -> dict[str, Array]:
    """Clearance, m, and the speeds at which the closest points approach each other, m/s.

    Args:
        closest: the closest points of each of the g shapes of the arm and each obstacle, on the arm
            and on the obstacle, m, ``(..., m, g, 2, 3)``; zeros where they are out of reach.
        motions: centre, velocity and angular velocity of each shape's body, ``(..., g, 3, 3)``.
        ways: the obstacles at the same time, ``(..., m, width)``.
    """
    # Mostly nothing is within reach. All the rest is computed only where something is.
    near = np.any(closest, axis=(-3, -2, -1))
    closest, motions = closest[near], motions[np.nonzero(near)[:-1]]
    position, velocity, spin = (
        part[near] for part in (ways.position, ways.velocity, ways.angular_velocity)
    )
    way = closest[..., 1, :] - closest[..., 0, :]
    apart = np.sqrt(np.einsum("...i,...i->...", way, way))
    # Where they overlap, the two points have changed sides.
    inwards = position[:, None] - closest[..., 1, :]
    apart = np.where(np.einsum("...i,...i->...", inwards, way) < 0, -apart, apart)
    apart = np.where(closest.any(axis=(-2, -1)), apart, np.inf)
    rows, shape = np.arange(len(apart)), apart.argmin(axis=1)
    clearance = apart[rows, shape]
    # Where surfaces just touch, nobody knows the normal, and approaches are 0.
    normal = way[rows, shape] / np.where(clearance == 0, 1.0, clearance)[:, None]
    on_arm, on_obstacle = np.moveaxis(closest[rows, shape], 1, 0)
    centre, moving, turning = np.moveaxis(motions[rows, shape], 1, 0)
    arm = moving + cross(turning, on_arm - centre)
    met = velocity + cross(spin, on_obstacle - position)
    found = {
        "clearance": (np.inf, clearance),
        "arm_approach": (0.0, np.einsum("...i,...i->...", arm, normal)),
        "obstacle_approach": (0.0, -np.einsum("...i,...i->...", met, normal)),
    }
    trace = {}
    for name, (beyond, values) in found.items():
        trace[name] = np.full(near.shape, beyond)
        trace[name][near] = values
    return trace
