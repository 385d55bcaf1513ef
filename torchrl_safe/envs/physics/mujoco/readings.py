"""The sensors that measure what an ArmState has, for all worlds at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torchrl_safe.envs.physics.mujoco.arm import ArmParts
from torchrl_safe.envs.physics.mujoco.bodies import TABLE, obstacle, thing
from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.shapes import Shape
from torchrl_safe.envs.state import Array, Sensing

#: Distance from which on contacts are reported, m, as PyBullet does.
CONTACT_RANGE = 0.02
# Of one obstacle; of more contacts at once the shallowest are not counted.
_SLOTS = 16
_NEAREST = 1  # How a contact sensor sorts what it has found.


class Place(NamedTuple):
    """Where readings of one kind are in a row of sensor data."""

    #: Their numbers in the row.
    columns: slice
    #: Their shape.
    shape: tuple[int, ...]

    def of(self, data: Array) -> Array:
        """Cuts them out of rows ``(..., width)``; a view."""
        return data[..., self.columns].reshape(*data.shape[:-1], *self.shape)


class Sensors:
    """Adds the sensors to a world, and knows where each is in what they read.

    Args:
        spec: the world; changed in place.
        parts: of the arm.
        shapes: the obstacles.
        objects: what the task moves.
        sensing: what is measured in every substep besides contacts.
    """

    def __init__(
        self,
        spec: Any,
        parts: ArmParts,
        shapes: Sequence[Shape],
        objects: Sequence[Shape],
        sensing: Sensing,
    ) -> None:
        self._spec, self._parts = spec, parts
        self._width = 0
        #: Where the readings of each kind are.
        self.places: dict[str, Place] = {}
        body, frame = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
        self._add_frames("ee", [parts.tool])
        self._add_frames("object", [thing(index) for index in range(len(objects))])
        free = [obstacle(index) for index, shape in enumerate(shapes) if shape.mass]
        self._add_frames("obstacle", free)
        self._add_contacts("contacts", shapes, slots=_SLOTS, data=("FOUND", "FORCE", "DIST"))
        if sensing.clearance:
            data = ("FOUND", "DIST", "POS", "NORMAL", "LINVEL")
            self._add_contacts("nearest", shapes, slots=1, data=data, base=True)
        if sensing.table:
            self._add_touch("table", parts.moving, mujoco.mjtObj.mjOBJ_GEOM, TABLE)
        if sensing.itself:
            self._add_touch("self", parts.root, frame, parts.root)
        if sensing.joints:
            kind, joint = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
            self._add("joints", (), [(kind, joint, name) for name in parts.joints])
        if sensing.links:
            kind = mujoco.mjtSensor.mjSENS_FRAMELINVEL
            self._add("links", (3,), [(kind, body, name) for name in parts.links])

    def _add_frames(self, prefix: str, bodies: Sequence[str]) -> None:
        """Pose and velocities of bodies in world coordinates."""
        kinds = {
            "position": (mujoco.mjtSensor.mjSENS_FRAMEPOS, 3),
            "orientation": (mujoco.mjtSensor.mjSENS_FRAMEQUAT, 4),
            "velocity": (mujoco.mjtSensor.mjSENS_FRAMELINVEL, 3),
            "angular_velocity": (mujoco.mjtSensor.mjSENS_FRAMEANGVEL, 3),
        }
        frame = mujoco.mjtObj.mjOBJ_XBODY
        for name, (kind, width) in kinds.items():
            self._add(f"{prefix}_{name}", (width,), [(kind, frame, body) for body in bodies])

    def _add(self, name: str, shape: tuple[int, ...], sensors: Sequence[tuple]) -> None:
        for kind, objtype, objname in sensors:
            self._spec.add_sensor(type=kind, objtype=objtype, objname=objname)
        self._note(name, (len(sensors), *shape))

    def _note(self, name: str, shape: tuple[int, ...]) -> None:
        width = math.prod(shape)
        self.places[name] = Place(slice(self._width, self._width + width), shape)
        self._width += width

    def _add_contacts(
        self,
        name: str,
        shapes: Sequence[Shape],
        *,
        slots: int,
        data: Sequence[str],
        base: bool = False,
    ) -> None:
        """Contacts of the arm with each obstacle; with its base where that is asked for, or free."""
        for index, shape in enumerate(shapes):
            arm = self._parts.root if base or shape.mass else self._parts.moving
            self._add_contact(arm, mujoco.mjtObj.mjOBJ_GEOM, obstacle(index), slots, data)
        width = sum(_WIDTHS[part] for part in data)
        self._note(name, (len(shapes), slots, width))

    def _add_touch(self, name: str, body: str, reftype: Any, refname: str) -> None:
        self._add_contact(body, reftype, refname, 1, ("FOUND", "DIST"))
        self._note(name, (2,))

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


# Of what a contact sensor can tell, in its order.
_WIDTHS = {"FOUND": 1, "FORCE": 3, "DIST": 1, "POS": 3, "NORMAL": 3, "LINVEL": 3}
