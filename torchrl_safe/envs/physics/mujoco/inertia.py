"""Inertias of the boxes around collision shapes.

The inertias in the URDF files of some arms are placeholders. A Panda's wrist would be seventy times
as heavy to turn as the real one, and its motor could not do what an action asks for. PyBullet takes
the same boxes by default, so both engines simulate the same arm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_safe.envs.physics.mujoco.engine import mujoco
from torchrl_safe.envs.physics.mujoco.quaternions import rotation_matrix
from torchrl_safe.envs.state import Array

_CORNERS = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, 8).T


def set_box_inertias(spec: Any) -> None:
    """Gives each body of a specification the inertia of the box around its shapes.

    The box has the axes of the inertial frame in the URDF; it need not be centred there.

    Args:
        spec: an ``MjSpec``; changed in place.
    """
    model = spec.compile()
    for body in spec.bodies[1:]:
        compiled = model.body(body.name)
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == compiled.id]
        if geoms and body.mass:
            axes = rotation_matrix(body.iquat)
            size = np.ptp(np.concatenate([_points(model, geom, axes) for geom in geoms]), axis=0)
        elif body.joints:
            continue
        else:  # It names a frame.
            size = np.zeros(3)
        body.inertia = body.mass / 12 * ((size**2).sum() - size**2)
        body.fullinertia = [np.nan] * 6
        body.explicitinertial = True


def _points(model: Any, geom: int, axes: Array) -> Array:
    """Points whose box along the given axes is that of a shape, ``(k, 3)``."""
    turn, (x, y, z) = axes.T @ rotation_matrix(model.geom_quat[geom]), model.geom_size[geom]
    kind = mujoco.mjtGeom(model.geom_type[geom])
    centre = axes.T @ model.geom_pos[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        return centre + vertices @ turn.T
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return centre + (_CORNERS * (x, y, z)) @ turn.T
    along = np.abs(turn[:, 2])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        half = np.full(3, x)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half = x + y * along
    else:
        half = y * along + x * np.sqrt(np.maximum(0, 1 - along**2))
    return centre + np.stack([-half, half])
