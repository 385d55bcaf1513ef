"""Measures how far the arm is from everything else, wherever it may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.mujoco.arm import name_solids, read_arm
from torchrl_safe.envs.physics.mujoco.bodies import TABLE, add_obstacle, obstacle_name
from torchrl_safe.envs.physics.mujoco.contacts import level_bodies
from torchrl_safe.envs.physics.mujoco.engine import make_batch, mujoco, quiet
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.physics.screws import distance_jacobian, moves
from torchrl_safe.envs.physics.simulator import Nearest
from torchrl_safe.envs.state import Array

# Distances are exact to this, m: curved shapes else take twice as long, for nanometres.
_EXACT = 1e-3


class Ruler:
    """Worlds in which nothing collides: arm, table and obstacles, with a sensor for each pair.

    They are worlds of their own because MuJoCo would read these sensors in every substep.

    Args:
        arm: the arm.
        scene: what is around it.
        threads: threads that the worlds are shared between.
        num_envs: number N of worlds.
        shapes: the m obstacles.
        merge: make one link of those that fixed joints hold together.
        reach: distance up to which is measured, m.
    """

    def __init__(
        self,
        arm: ArmModel,
        scene: Scene,
        *,
        threads: int,
        num_envs: int,
        shapes: Sequence[Shape],
        merge: bool,
        reach: float,
    ) -> None:
        spec, parts = read_arm(
            arm,
            fix_fingers=not scene.free_fingers,
            merge=merge,
            couple=False,
            visuals=False,
            itself=False,
        )
        spec.option.ccd_tolerance = _EXACT
        # Nothing exerts forces here.
        idle = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        spec.option.disableflags |= int(idle)
        names = list(name_solids(spec))
        # A plane without edges: several times as fast as a box.
        spec.worldbody.add_geom(name=TABLE, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1))
        for index, shape in enumerate(shapes):
            # Placed from outside, with or without a mass.
            add_obstacle(spec, index, replace(shape, mass=0.0), reach=0.0)
        for geom in spec.geoms:
            # No two shapes collide. With both 0, MuJoCo would take a shape for one that is only
            # drawn.
            geom.contype, geom.conaffinity = 1, 0
        model = spec.compile()
        joints = [model.joint(name).id for name in parts.joints + parts.fingers]
        moved = moves(model.body_parentid, model.jnt_bodyid[joints])
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        level = level_bodies(model, data)
        body = {name: int(model.geom(name).bodyid[0]) for name in names}
        others = [*(obstacle_name(index) for index in range(len(shapes))), TABLE]
        # Leave out what no joint moves, and the table for what only turns about vertical axes.
        pairs = [
            (name, other)
            for other in others
            for name in names
            if moved[body[name]].any() and not (other == TABLE and body[name] in level)
        ]
        for name, other in pairs:
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_GEOMFROMTO,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=name,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=other,
                cutoff=reach,
            )
        model = spec.compile()
        self._other = np.array([others.index(other) for _, other in pairs], dtype=int)
        geoms = np.array([model.geom(name).id for name, _ in pairs], dtype=int)
        self._geom, self._moves = geoms, moved[model.geom_bodyid[geoms]]
        self._joints, self._slides = joints, model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE
        self._position = model.jnt_qposadr[joints]
        self._batch = make_batch(model, num_envs, threads)
        bind = self._batch.bind
        self._qpos, self._place, self._turn = map(bind, ("qpos", "mocap_pos", "mocap_quat"))
        self._axes, self._anchors, self._centres = map(bind, ("xaxis", "xanchor", "geom_xpos"))
        self._points = bind("sensordata")
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)

    def __call__(
        self,
        rows: NDArray[np.int_],
        angles: Array,
        position: Array,
        orientation: Array,
    ) -> Nearest:
        """Measures in some of the worlds.

        Args:
            rows: which, ``(k,)``.
            angles: of joints and fingers, ``(k, n + f)``.
            position: centres of the obstacles, m, ``(k, m, 3)``.
            orientation: of the obstacles, quaternions (w, x, y, z), ``(k, m, 4)``.
        """
        self._qpos[rows[:, None], self._position] = angles
        self._place[rows], self._turn[rows] = position, orientation
        with quiet():
            # Naming all of them takes longer.
            named = None if len(rows) == len(self._qpos) else rows.tolist()
            self._batch.forward(named, stage=mujoco.mjtStage.mjSTAGE_POS)
        ends = self._points[rows].reshape(len(rows), len(self._other), 2, 3)
        point, way = ends[:, :, 0], ends[:, :, 0] - ends[:, :, 1]
        distance = np.sqrt(np.einsum("kri,kri->kr", way, way))
        found = ends.any(axis=(2, 3))
        # Where they overlap, the two points have changed sides.
        outward = self._centres[rows].take(self._geom, axis=1) - point
        sign = np.where(np.einsum("kri,kri->kr", outward, way) < 0, -1.0, 1.0)
        normal = way * (sign / np.where(distance > 0, distance, 1.0))[..., None]
        distance *= sign
        anchor, axis = (
            part[rows].take(self._joints, axis=1) for part in (self._anchors, self._axes)
        )
        jacobian = distance_jacobian(point, normal, anchor, axis, self._slides) * self._moves
        return Nearest(np.where(found, distance, np.inf), normal, point, jacobian, self._other)
