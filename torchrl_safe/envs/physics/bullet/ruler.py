"""Measures how far the arm is from everything else. Like ``world.py`` it calls PyBullet."""

from __future__ import annotations

import heapq
import weakref
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.bullet.bodies import add_shape, load_arm, load_furniture
from torchrl_safe.envs.physics.bullet.engine import connect, pybullet
from torchrl_safe.envs.physics.paths import limbo
from torchrl_safe.envs.physics.scene import Scene
from torchrl_safe.envs.physics.screws import distance_jacobian, moves
from torchrl_safe.envs.physics.simulator import Nearest
from torchrl_safe.envs.rotations import turn
from torchrl_safe.envs.state import Array

if TYPE_CHECKING:
    from torchrl_safe.envs.physics.bullet.physics import Bullet

# Pairs of points with each obstacle: the nearest ones, more than an arm has shapes.
_PAIRS = 24


class Ruler:
    """A world in which nothing is simulated, to measure all others in turn.

    Args:
        arm: the arm.
        scene: what is around it.
        options: how the worlds are simulated.
        shapes: the m obstacles.
        merge: make one link of those that fixed joints hold together.
        reach: distance up to which is measured, m.
    """

    def __init__(
        self,
        arm: ArmModel,
        scene: Scene,
        options: Bullet,
        shapes: Sequence[Shape],
        *,
        merge: bool,
        reach: float,
    ) -> None:
        self._client = client = connect()
        self.close = weakref.finalize(self, pybullet.disconnect, client)
        self._reach = reach
        self._arm = load_arm(
            client,
            arm,
            scene,
            visuals=False,
            merge=merge,
            urdf_inertia=options.urdf_inertia,
            self_collision=False,
        )
        if options.furniture:
            table = load_furniture(client, options.furniture, visuals=False)
        else:
            # A plane without edges: twice as fast as a box.
            plane = pybullet.createCollisionShape(
                pybullet.GEOM_PLANE, planeNormal=(0, 0, 1), physicsClientId=client
            )
            table = [pybullet.createMultiBody(0, plane, physicsClientId=client)]
        # Placed from outside, with or without a mass.
        self._obstacles = [
            add_shape(client, replace(shape, mass=0.0), limbo(0), None) for shape in shapes
        ]
        self._driven = self._arm.joints + self._arm.fingers
        infos = [
            pybullet.getJointInfo(self._arm.body, link, physicsClientId=client)
            for link in range(pybullet.getNumJoints(self._arm.body, physicsClientId=client))
        ]
        self._slides = np.array([infos[j][2] == pybullet.JOINT_PRISMATIC for j in self._driven])
        self._axis = np.array([infos[joint][13] for joint in self._driven])
        self._moves = moves([info[16] for info in infos], self._driven)
        moving = {link for link in range(len(infos)) if self._moves[link].any()}
        rising = {link for link in moving if not self._is_level(link)}
        #: Bodies that are measured against the arm, and the links that count there.
        self._things = [(body, moving, index) for index, body in enumerate(self._obstacles)]
        self._things += [(body, rising, len(shapes)) for body in table]
        self._other = np.repeat([index for *_, index in self._things], _PAIRS)

    def _is_level(self, link: int) -> bool:
        """Whether a link turns about vertical axes only, so that it never rises or sinks."""
        _, axes = self._frames([0.0] * len(self._driven))
        moved = self._moves[link]
        return bool((~self._slides[moved]).all() and (np.abs(axes[moved, 2]) > 1 - 1e-9).all())

    def _frames(self, angles: Sequence[float]) -> tuple[Array, Array]:
        """Moves the arm; returns a point of each joint's axis, m, and its direction, ``(n, 3)``."""
        pybullet.resetJointStatesMultiDof(
            self._arm.body,
            self._driven,
            [[angle] for angle in angles],
            [[0.0]] * len(self._driven),
            physicsClientId=self._client,
        )
        states = pybullet.getLinkStates(
            self._arm.body, self._driven, computeForwardKinematics=1, physicsClientId=self._client
        )
        anchor = np.array([state[4] for state in states])
        return anchor, turn(np.array([state[1] for state in states]), self._axis)

    def __call__(self, angles: Array, position: Array, orientation: Array) -> Nearest:
        """Measures in k worlds.

        Args:
            angles: of joints and fingers, ``(k, n + f)``.
            position: centres of the obstacles, m, ``(k, m, 3)``.
            orientation: of the obstacles, ``(k, m, 4)``.
        """
        shape = (len(angles), len(self._other))
        distance, links = np.full(shape, np.inf), np.zeros(shape, dtype=int)
        normal, point = np.zeros((*shape, 3)), np.zeros((*shape, 3))
        anchor, axis = np.zeros((2, *angles.shape, 3))
        for row, worlds in enumerate(
            zip(angles.tolist(), position.tolist(), orientation.tolist(), strict=True)
        ):
            anchor[row], axis[row] = self._frames(worlds[0])
            for body, *pose in zip(self._obstacles, *worlds[1:], strict=True):
                pybullet.resetBasePositionAndOrientation(body, *pose, physicsClientId=self._client)
            for number, (body, counted, _) in enumerate(self._things):
                points = pybullet.getClosestPoints(
                    self._arm.body, body, self._reach, physicsClientId=self._client
                )
                points = [found for found in points if found[3] in counted]
                if len(points) > _PAIRS:
                    points = heapq.nsmallest(_PAIRS, points, key=lambda found: found[8])
                for slot, found in enumerate(points, number * _PAIRS):
                    links[row, slot], distance[row, slot] = found[3], found[8]
                    point[row, slot], normal[row, slot] = found[5], found[7]
        jacobian = distance_jacobian(point, normal, anchor, axis, self._slides)
        jacobian *= self._moves[links]
        return Nearest(distance, normal, point, jacobian, self._other)
