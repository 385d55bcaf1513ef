"""One simulated world. This file, ``bodies.py``, ``readings.py`` and ``ruler.py`` call PyBullet."""

from __future__ import annotations

import math
import os
import sys
import weakref
from collections.abc import Sequence
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.arms.models import grips
from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.bullet.bodies import (
    add_goal,
    add_shape,
    load_arm,
    load_body,
    load_furniture,
    scale_dynamics,
)
from torchrl_safe.envs.physics.bullet.engine import connect, pybullet
from torchrl_safe.envs.physics.bullet.readings import MovingBody, Readings, Vector, link_state
from torchrl_safe.envs.physics.palette import OBJECT, OBSTACLE, TOUCHED, colour
from torchrl_safe.envs.physics.paths import WIDTHS, Ways, limbo, look_ahead
from torchrl_safe.envs.physics.scene import FARTHEST, SUBSTEP, Camera, Scene
from torchrl_safe.envs.rotations import UPRIGHT
from torchrl_safe.envs.state import Array, Sensing

if TYPE_CHECKING:
    from torchrl_safe.envs.physics.bullet.physics import Bullet

#: Centre of mass of the tool link, m, its velocity, m/s, and the link's angular velocity, rad/s.
TOOL_MOTION = ("ee_centre", "ee_centre_velocity", "ee_angular_velocity")
_AT_REST = (0.0, 0.0, 0.0)


class World:
    """One arm, its table, obstacles and objects in a PyBullet server of its own.

    Built once; :meth:`reset` restores a saved state in microseconds instead of loading files.

    Args:
        arm: the arm.
        scene: what is around it.
        options: how the world is simulated.
        shapes: the obstacles.
        objects: what the task moves.
        sensing: what is measured in every substep.
        visuals: load what is needed for pictures.
        gui: open PyBullet's window; one process can have one.
    """

    def __init__(
        self,
        arm: ArmModel,
        scene: Scene,
        options: Bullet,
        shapes: Sequence[Shape] = (),
        objects: Sequence[Shape] = (),
        *,
        sensing: Sensing = Sensing(),
        visuals: bool = False,
        gui: bool = False,
    ) -> None:
        if gui and sys.platform == "linux" and not os.environ.get("DISPLAY"):
            # PyBullet would end the process, and the training with it.
            raise RuntimeError("gui needs a screen, but DISPLAY is not set: make a video instead.")
        self._client = connect(gui=gui)
        # PyBullet reuses client numbers: each is disconnected once, by its owner.
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        self._scene, self._options = scene, options
        # Joints and fingers as last read, as long as nothing has moved.
        self._positions: Vector | None = None
        try:
            self._build(arm, shapes, objects, sensing, visuals=visuals or gui)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Shuts the server down; afterwards every other method raises ``pybullet.error``."""
        self._disconnect()
        self._client = -1

    def _build(
        self,
        arm: ArmModel,
        shapes: Sequence[Shape],
        objects: Sequence[Shape],
        sensing: Sensing,
        *,
        visuals: bool,
    ) -> None:
        client, scene, options = self._client, self._scene, self._options
        pybullet.setGravity(0, 0, -scene.gravity, physicsClientId=client)
        # Contacts then do not depend on the order in which bodies came close.
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        furniture = load_furniture(client, options.furniture, visuals=visuals)
        self._arm = load_arm(
            client,
            arm,
            scene,
            visuals=visuals,
            # What touches objects has friction and stiffness of its own, link by link.
            merge=options.merged_links and not objects,
            urdf_inertia=options.urdf_inertia,
            self_collision=sensing.itself,
        )
        self._driven = self._arm.joints + self._arm.fingers
        unlimited = np.full(len(self._driven), np.inf)
        self._efforts = [scene.motor_strength * effort for effort in self._arm.effort]
        self._fastest = (self._arm.speed if scene.motor_limits else unlimited).tolist()
        self._readings = Readings(
            client, self._arm, furniture, len(shapes), sensing, fresh_links=options.fresh_links
        )
        self._senses = sensing != Sensing()
        dark, blue = (OBSTACLE, OBJECT) if visuals else (None, None)
        self._obstacles = [
            add_shape(client, shape, limbo(index), dark) for index, shape in enumerate(shapes)
        ]
        self._objects = [
            add_shape(client, shape, limbo(index + len(shapes)), blue)
            for index, shape in enumerate(objects)
        ]
        self._shapes = tuple(shapes)
        self._is_fixed = [shape.mass == 0 for shape in shapes]
        urdf = options.target_urdf
        self._brick = brick = None if urdf is None else load_body(client, urdf, limbo(0))
        self._markers = add_goal(client, limbo(0)) if visuals and brick is None else []
        bodies = zip(self._obstacles, self._is_fixed, strict=True)
        self._movable = [body for body, fixed in bodies if not fixed] + self._objects
        if self._brick is not None:
            self._movable.append(self._brick)
        if scene.link_mass != 1:
            scale_dynamics(client, self._arm.body, mass=scene.link_mass)
        if scene.friction != 1:
            for number in range(pybullet.getNumBodies(physicsClientId=client)):
                body = pybullet.getBodyUniqueId(number, physicsClientId=client)
                # Bullet multiplies the frictions of the two that touch.
                scale_dynamics(client, body, friction=scene.friction**0.5)
        if self._movable:
            # Bullet solves bodies that are, or once were, near each other together, with as many
            # iterations as the slowest needs. Only if all take the same number does the past not
            # show in the last bits of what is to come.
            pybullet.setPhysicsEngineParameter(solverResidualThreshold=0, physicsClientId=client)
        # Bullet restores a state bit for bit only if it was saved after a first step.
        pybullet.stepSimulation(physicsClientId=client)
        for fingers in grips(arm, self._arm.finger_lower, self._arm.finger_upper):
            self._set_joints([*arm.home, *fingers])
            if sensing.itself:
                self._allow_overlaps()
        self._home = pybullet.saveState(physicsClientId=client)
        self._goal: Vector = limbo(0)
        self._present: list[int] = []
        self._bodies_move = True
        self._bodies: list[float] = []
        self._poses: list[tuple[Vector, Vector]] = [
            (limbo(index), UPRIGHT) for index in range(len(shapes))
        ]
        self._velocities: list[tuple[Vector, Vector]] = [(_AT_REST, _AT_REST)] * len(shapes)
        link = self._link_state(fresh=True)
        #: Tool point, m, and tool orientation, a quaternion (x, y, z, w), at home.
        self.home_position, self.home_orientation = link[4], link[5]
        joints = len(self._arm.joints)
        #: Limits of the arm's joints, rad, and largest speeds, rad/s; then those of fingers, m/s.
        self.joint_lower, self.joint_upper = self._arm.joint_lower, self._arm.joint_upper
        self.joint_speed, self.finger_speed = self._arm.speed[:joints], self._arm.speed[joints:]

    def _allow_overlaps(self) -> None:
        # The collision shapes of neighbouring links overlap, and fingers touch where they close.
        body = self._arm.body
        pybullet.performCollisionDetection(physicsClientId=self._client)
        for point in pybullet.getContactPoints(body, body, physicsClientId=self._client):
            if point[8] <= 0:
                pybullet.setCollisionFilterPair(
                    body, body, point[3], point[4], 0, physicsClientId=self._client
                )

    def reset(self, placement: Placement, goal: Array, objects: Array) -> None:
        """Puts the arm at home, obstacles and objects in their places, the target at ``goal``."""
        client = self._client
        # What can move is taken out of all contacts first, beside the obstacles that are not
        # present: Bullet keeps contact points over a restore, in an order that depends on what
        # happened before.
        for index, body in enumerate(self._movable):
            self._place(body, limbo(len(self._obstacles) + index))
        pybullet.performCollisionDetection(physicsClientId=client)
        pybullet.restoreState(self._home, physicsClientId=client)
        self._positions = None
        self._goal = goal.tolist()
        self._present = np.flatnonzero(placement.present).tolist()
        self._placement, self._substeps = placement, 0
        poses = zip(placement.position.tolist(), placement.orientation.tolist(), strict=True)
        for index, (body, pose) in enumerate(zip(self._obstacles, poses, strict=True)):
            self._poses[index] = pose if index in self._present else (limbo(index), UPRIGHT)
            self._velocities[index] = (_AT_REST, _AT_REST)
            self._place(body, *self._poses[index])
        if placement.path is not None:
            self._follow(*self._look_ahead(1)[0])
        for body, place in zip(self._objects, objects.tolist(), strict=True):
            self._place(body, place)
        for target in (*([] if self._brick is None else [self._brick]), *self._markers):
            self._place(target, self._goal)
        self._bodies = self._read_bodies()
        self._bodies_move = (
            bool(self._objects)
            or placement.path is not None
            or any(map(self._is_simulated, self._present))
        )

    def _look_ahead(self, substeps: int) -> list[tuple[list[Vector], ...]]:
        """The obstacles' ways through the next substeps: for now, and after each of them."""
        ways = look_ahead(self._placement, self._substeps, substeps)
        return list(zip(*(part.tolist() for part in ways), strict=True))

    def _follow(
        self,
        positions: list[Vector],
        orientations: list[Vector],
        velocities: list[Vector],
        spins: list[Vector],
    ) -> None:
        """Puts the obstacles where their ways lead."""
        for index in self._present:
            self._poses[index] = (positions[index], orientations[index])
            self._velocities[index] = (velocities[index], spins[index])
            self._place(self._obstacles[index], *self._poses[index])

    def advance(
        self, joint_target: Vector, finger_target: Vector, substeps: int
    ) -> tuple[list[float], list[float], list[list[float]]]:
        """Drives the joints towards a target for some physics substeps.

        Returns:
            For each obstacle the smallest contact distance of all substeps, m, infinite where
            there was no contact; the largest contact force, N; and for each substep the
            measurements of :meth:`measure`.
        """
        client, arm = self._client, self._arm.body
        targets = [*joint_target, *finger_target]
        # The second half makes up for what efforts did not allow in the first.
        halfway = None if self._options.motor_gain else substeps // 2 + 1
        distances = [math.inf] * len(self._obstacles)
        forces = [0.0] * len(self._obstacles)
        measurements = []
        ways = None if self._placement.path is None else self._look_ahead(substeps)
        present = [(index, self._obstacles[index]) for index in self._present]
        step, find_contacts = pybullet.stepSimulation, pybullet.getContactPoints
        for substep in range(1, substeps + 1):
            if substep in (1, halfway):
                self._drive(targets, substeps + 1 - substep)
            step(physicsClientId=client)
            for index, obstacle in present:
                if points := find_contacts(arm, obstacle, physicsClientId=client):
                    nearest, force = min(p[8] for p in points), sum(p[9] for p in points)
                    distances[index] = min(distances[index], nearest)
                    forces[index] = max(forces[index], force)
            # Bullet has looked for contacts before it moved the arm: now the obstacles move too.
            if ways is not None:
                self._follow(*ways[substep])
            if self._senses:
                measurements.append(self.measure())
        self._substeps += substeps
        return distances, forces, measurements

    def _drive(self, targets: Vector, remaining: int) -> None:
        """Tells the motors how to get to their targets in the remaining substeps."""
        count, gain = len(targets), self._options.motor_gain
        driven = self._driven[:count]
        options: dict[str, Any] = {"physicsClientId": self._client}
        if self._scene.motor_limits:
            options["forces"] = self._efforts[:count]
        if gain is not None:
            pybullet.setJointMotorControlArray(
                self._arm.body,
                driven,
                pybullet.POSITION_CONTROL,
                targetPositions=targets,
                positionGains=[gain] * count,
                **options,
            )
            return
        # The motors keep to a velocity, in each substep, as far as their efforts allow.
        time = SUBSTEP * remaining
        positions = self._positions or [state[0] for state in self._joint_states()]
        self._positions = None
        wanted = [(target - now) / time for target, now in zip(targets, positions, strict=False)]
        velocities = [
            velocity if -fastest <= velocity <= fastest else math.copysign(fastest, velocity)
            for velocity, fastest in zip(wanted, self._fastest, strict=False)
        ]
        pybullet.setJointMotorControlArray(
            self._arm.body,
            driven,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=velocities,
            **options,
        )

    def read(self, *, fresh: bool = False) -> list[float]:
        """Returns the state as one flat row, in the order of :meth:`read_shapes`."""
        positions, velocities, *_ = zip(*self._joint_states(), strict=True)
        self._positions = positions
        link = self._link_state(fresh=fresh or self._options.fresh_links)
        goal = self._goal if self._brick is None else self._pose(self._brick)[0]
        if self._bodies_move:
            self._bodies = self._read_bodies()
        return [
            *positions,
            *velocities,
            *link[4],
            *link[5],
            *link[0],
            *link[6],
            *link[7],
            *goal,
            *self._bodies,
        ]

    def _read_bodies(self) -> list[float]:
        objects = [(*self._pose(body), *self._velocity(body)) for body in self._objects]
        obstacles = [
            (*self._obstacle_pose(index), *self._obstacle_velocity(index))
            for index in range(len(self._obstacles))
        ]
        return [
            number
            for bodies in (objects, obstacles)
            for part in range(len(WIDTHS))
            for body in bodies
            for number in body[part]
        ]

    def read_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the parts of a row that :meth:`read` returns."""
        joints, fingers = (len(self._arm.joints),), (len(self._arm.fingers),)
        shapes: dict[str, tuple[int, ...]] = {
            "joint_position": joints,
            "finger_position": fingers,
            "joint_velocity": joints,
            "finger_velocity": fingers,
            "ee_position": (3,),
            "ee_orientation": (4,),
            **dict.fromkeys(TOOL_MOTION, (3,)),
            "goal": (3,),
        }
        for kind, bodies in (("object", self._objects), ("obstacle", self._obstacles)):
            for part, width in zip(Ways._fields, WIDTHS, strict=True):
                shapes[f"{kind}_{part}"] = (len(bodies), width)
        return shapes

    def measure(self, *, touches: bool = True) -> list[float]:
        """Returns what ``sensing`` asks for as a flat row, in the order of :meth:`trace_shapes`.

        Args:
            touches: read contact points, which are those of the last substep.
        """
        indices = range(len(self._obstacles)) if self._readings.sensing.clearance else ()
        obstacles = [
            MovingBody(
                self._obstacles[index],
                self._obstacle_pose(index)[0],
                *self._obstacle_velocity(index),
            )
            if index in self._present
            else None
            for index in indices
        ]
        return self._readings.read(obstacles, touches=touches)

    def trace_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the parts of a row that :meth:`measure` returns."""
        return self._readings.shapes()

    def clearance(self) -> float:
        """Returns how far obstacles and objects are from arm and objects, up to 0.1 m."""
        kept_free = self._arm.body, *self._objects
        present = [self._obstacles[index] for index in self._present]
        points = [
            point[8]
            for one, other in [*product(present, kept_free), *combinations(kept_free, 2)]
            for point in pybullet.getClosestPoints(
                one, other, FARTHEST, physicsClientId=self._client
            )
        ]
        return min(points, default=FARTHEST)

    def tool_at(self, joint_position: Vector) -> tuple[Vector, Vector]:
        """Moves the arm at once; returns tool point and orientation. To be reset afterwards."""
        self._set_joints([*joint_position, *(0.0 for _ in self._arm.fingers)])
        link = self._link_state(fresh=True)
        return link[4], link[5]

    def jacobian(self, joint_position: Vector) -> tuple[Vector, ...]:
        """Returns the six rows of the tool point's Jacobian: linear, then angular velocity."""
        arm = self._arm
        position = [0.0] * arm.num_movable
        for column, angle in zip(arm.columns, joint_position, strict=True):
            position[column] = angle
        zeros = [0.0] * arm.num_movable
        # The point is given in the frame of the link, whose origin is the tool point.
        linear, angular = pybullet.calculateJacobian(
            arm.body, arm.ee, (0.0, 0.0, 0.0), position, zeros, zeros, self._client
        )
        if arm.num_movable == len(arm.columns):
            return (*linear, *angular)
        return tuple([row[c] for c in arm.columns] for row in (*linear, *angular))

    def inverse_kinematics(self, position: Vector, orientation: Vector) -> list[float]:
        """Returns the joint angles of Bullet's iterative solver, its default 20 iterations."""
        angles = pybullet.calculateInverseKinematics(
            self._arm.body, self._arm.ee, position, orientation, physicsClientId=self._client
        )
        return [angles[column] for column in self._arm.columns]

    def copy_from(self, other: World) -> None:
        """Takes the state of another world of the same build, for a picture of it."""
        self._set_joints([state[0] for state in other._joint_states()])
        for index, body in enumerate(self._obstacles):
            self._place(body, *other._obstacle_pose(index))
        for mine, theirs in zip(self._objects, other._objects, strict=True):
            self._place(mine, *other._pose(theirs))
        if self._brick is not None and other._brick is not None:
            self._place(self._brick, *other._pose(other._brick))
        for marker in self._markers:
            self._place(marker, other._goal)

    def light_up(self, touched: Sequence[bool]) -> None:
        """Draws the obstacles that are touched in another colour, and the others in theirs."""
        bodies = zip(self._obstacles, self._shapes, touched, strict=True)
        for body, shape, lit in bodies:
            pybullet.changeVisualShape(
                body,
                -1,
                shapeIndex=0,
                rgbaColor=TOUCHED if lit else colour(shape, OBSTACLE),
                physicsClientId=self._client,
            )

    def picture(self, camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
        """Returns an RGB picture, ``(height, width, 3)``."""
        # A view straight down has no direction that is up in the picture: take x.
        up = (1, 0, 0) if camera.eye[:2] == camera.target[:2] else (0, 0, 1)
        view = pybullet.computeViewMatrix(camera.eye, camera.target, up)
        projection = pybullet.computeProjectionMatrixFOV(
            camera.field_of_view, width / height, 0.1, 10 + math.dist(camera.eye, camera.target)
        )
        pixels = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(1, -1, 2),
            # Closer lights cast no shadow.
            lightDistance=10,
            shadow=camera.shadows,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )[2]
        return np.asarray(pixels, np.uint8).reshape(height, width, 4)[..., :3]

    def _link_state(self, *, fresh: bool) -> tuple:
        return link_state(self._client, self._arm.body, self._arm.ee, fresh=fresh)

    def _joint_states(self) -> tuple[tuple[float, float], ...]:
        return pybullet.getJointStates(self._arm.body, self._driven, physicsClientId=self._client)

    def _set_joints(self, positions: Vector) -> None:
        self._positions = None
        pybullet.resetJointStatesMultiDof(
            self._arm.body,
            self._driven,
            [[angle] for angle in positions],
            [[0.0] for _ in positions],
            physicsClientId=self._client,
        )

    def _place(self, body: int, position: Vector, orientation: Vector = UPRIGHT) -> None:
        pybullet.resetBasePositionAndOrientation(
            body, position, orientation, physicsClientId=self._client
        )

    def _pose(self, body: int) -> tuple[Vector, Vector]:
        return pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)

    def _velocity(self, body: int) -> tuple[Vector, Vector]:
        return pybullet.getBaseVelocity(body, physicsClientId=self._client)

    def _is_simulated(self, index: int) -> bool:
        # What is not present falls for ever: do not report that.
        return not self._is_fixed[index] and index in self._present

    def _obstacle_pose(self, index: int) -> tuple[Vector, Vector]:
        simulated = self._is_simulated(index)
        return self._pose(self._obstacles[index]) if simulated else self._poses[index]

    def _obstacle_velocity(self, index: int) -> tuple[Vector, Vector]:
        simulated = self._is_simulated(index)
        return self._velocity(self._obstacles[index]) if simulated else self._velocities[index]
