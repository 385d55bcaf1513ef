"""One simulated world. The only file that talks to PyBullet."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles import Cylinder
from torchrl_safe.envs.scene import Camera, Scene
from torchrl_safe.envs.state import Array
from torchrl_safe.envs.urdf import prepare_urdf

_RED, _YELLOW, _WOOD = (0.85, 0.1, 0.1, 1.0), (1.0, 0.85, 0.1, 1.0), (0.72, 0.58, 0.42, 1.0)
_LIMBO = (0.0, 0.0, -100.0)
_UNLIMITED_EFFORT = 1e5


class World:
    """One arm, its table and obstacles in a PyBullet server of its own.

    Built once; :meth:`reset` restores a saved state in microseconds instead of loading files.

    Args:
        arm: the arm.
        scene: how the world is simulated.
        shapes: the obstacles.
        visuals: load what is needed for pictures.
        gui: open PyBullet's window; one process can have one.
    """

    def __init__(
        self,
        arm: ArmModel,
        scene: Scene,
        shapes: Sequence[Cylinder],
        *,
        visuals: bool = False,
        gui: bool = False,
    ) -> None:
        self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self._client < 0:
            raise RuntimeError(
                "PyBullet opened no world: a process can hold 1024, one of them with a window."
            )
        # PyBullet reuses client numbers: each is disconnected once, by its owner.
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        self._scene = scene
        self._visuals = visuals or gui
        try:
            self._build(arm, shapes)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Shuts the server down; afterwards every other method raises ``pybullet.error``."""
        self._disconnect()
        self._client = -1

    def __reduce__(self) -> NoReturn:
        # A copy would drive, and in the end disconnect, the server of this one.
        raise TypeError(
            "A simulated world cannot be copied or pickled; pass a factory, such as "
            "functools.partial(ArmEnv, num_envs=8)."
        )

    def clearance(self) -> float:
        """Returns the smallest distance between arm and obstacles, up to 0.1 m."""
        points = [
            point[8]
            for body in self._obstacles
            for point in pybullet.getClosestPoints(
                self._arm, body, 0.1, physicsClientId=self._client
            )
        ]
        return min(points, default=0.1)

    def _build(self, arm: ArmModel, shapes: Sequence[Cylinder]) -> None:
        client, scene = self._client, self._scene
        pybullet.setGravity(0, 0, -scene.gravity, physicsClientId=client)
        # Contacts then do not depend on the order in which bodies came close.
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        self._load_furniture()
        self._load_arm(arm)
        self._obstacles = [
            self._add_body(
                _RED,
                pybullet.GEOM_CYLINDER,
                mass=shape.mass,
                radius=shape.radius,
                height=shape.height,
            )
            for shape in shapes
        ]
        self._is_static = [shape.mass == 0 for shape in shapes]
        self._brick = None if scene.target_urdf is None else self._load_brick(scene.target_urdf)
        self._marker = self._load_marker() if self._visuals and self._brick is None else None
        bodies = zip(self._obstacles, self._is_static, strict=True)
        self._movable = [body for body, static in bodies if not static]
        if self._brick is not None:
            self._movable.append(self._brick)
        # Bullet restores a state bit for bit only if it was saved after a first step.
        pybullet.stepSimulation(physicsClientId=client)
        fingers = [arm.finger_home] * len(self._fingers)
        self._set_joints([*arm.home, *fingers])
        self._home = pybullet.saveState(physicsClientId=client)
        self._goal: Sequence[float] = _LIMBO
        self._places: Sequence[Sequence[float]] = [_LIMBO] * len(shapes)
        link = self._link_state(fresh=True)
        #: Tool point, m, and tool orientation, a quaternion (x, y, z, w), at home.
        self.home_position, self.home_orientation = link[4], link[5]

    def _load_furniture(self) -> None:
        client = self._client
        data = Path(pybullet_data.getDataPath())
        for urdf, position in self._scene.furniture:
            pybullet.loadURDF(str(data / urdf), position, useFixedBase=True, physicsClientId=client)
        if self._scene.furniture:
            return
        size = (0.75, 0.6, 0.025)
        self._add_body(_WOOD, pybullet.GEOM_BOX, position=(0.5, 0, -size[2]), halfExtents=size)
        if self._visuals:
            pybullet.loadURDF(str(data / "plane.urdf"), (0, 0, -0.7), physicsClientId=client)

    def _load_arm(self, arm: ArmModel) -> None:
        text, chain, tool_link = prepare_urdf(
            arm, visuals=self._visuals, fix_fingers=not self._scene.free_fingers
        )
        client = self._client
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE if self._scene.urdf_inertia else 0
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(text)
            try:
                self._arm = pybullet.loadURDF(
                    str(file), useFixedBase=True, flags=flags, physicsClientId=client
                )
            except pybullet.error as error:
                raise ValueError(f"urdf {arm.urdf!r} does not load in PyBullet.") from error
        self._find_joints(chain, tool_link)
        if len(arm.home) != len(self._joints):
            raise ValueError(
                f"home must give {len(self._joints)} joint angles, one for each movable joint up "
                f"to {arm.ee_link!r}, got {len(arm.home)}."
            )
        if not np.all((self.joint_lower <= arm.home) & (arm.home <= self.joint_upper)):
            raise ValueError(
                f"home must be within the joint limits {self.joint_lower.tolist()} and "
                f"{self.joint_upper.tolist()}, got {arm.home}."
            )

    def _find_joints(self, chain: set[str], ee_link: str) -> None:
        """Sorts the joints into those of the arm and free fingers, and reads their limits."""
        client = self._client
        infos = [
            pybullet.getJointInfo(self._arm, j, physicsClientId=client)
            for j in range(pybullet.getNumJoints(self._arm, physicsClientId=client))
        ]
        movable = [info for info in infos if info[2] != pybullet.JOINT_FIXED]
        joints = [info for info in movable if info[1].decode() in chain]
        fingers = [info for info in movable if info[1].decode() not in chain]
        self._joints = [info[0] for info in joints]
        self._fingers = [info[0] for info in fingers]
        # Bullet's Jacobian and inverse kinematics speak of all movable joints.
        self._columns = [movable.index(info) for info in joints]
        self._num_movable = len(movable)
        self._ee = next(info[0] for info in infos if info[12].decode() == ee_link)
        unlimited = [info[8] >= info[9] for info in joints]
        self.joint_lower = np.where(unlimited, -np.inf, [info[8] for info in joints])
        self.joint_upper = np.where(unlimited, np.inf, [info[9] for info in joints])
        self.joint_speed = np.array([info[11] or np.inf for info in joints])
        self._efforts = [info[10] or _UNLIMITED_EFFORT for info in joints + fingers]

    def _add_body(
        self,
        colour: Sequence[float],
        geometry: int,
        *,
        mass: float = 0.0,
        position: Sequence[float] = _LIMBO,
        **size: Any,
    ) -> int:
        client = self._client
        shape = pybullet.createCollisionShape(geometry, physicsClientId=client, **size)
        skin = -1
        if self._visuals:
            # PyBullet calls the same measure "height" of a shape and "length" of its skin.
            size = {"length" if name == "height" else name: size[name] for name in size}
            skin = pybullet.createVisualShape(
                geometry, rgbaColor=colour, physicsClientId=client, **size
            )
        return pybullet.createMultiBody(mass, shape, skin, position, physicsClientId=client)

    def _load_brick(self, urdf: str) -> int:
        path = Path(pybullet_data.getDataPath()) / urdf
        return pybullet.loadURDF(str(path), _LIMBO, physicsClientId=self._client)

    def _load_marker(self) -> int:
        skin = pybullet.createVisualShape(
            pybullet.GEOM_SPHERE, radius=0.02, rgbaColor=_YELLOW, physicsClientId=self._client
        )
        return pybullet.createMultiBody(0, -1, skin, _LIMBO, physicsClientId=self._client)

    def reset(self, places: Array, goal: Array) -> None:
        """Puts the arm at home, the obstacles at ``places`` (m, 3) and the target at ``goal``."""
        client = self._client
        # What can move is taken out of all contacts first: Bullet keeps contact points over a
        # restore, in an order that depends on what happened before.
        for body in self._movable:
            self._place(body, _LIMBO)
        pybullet.performCollisionDetection(physicsClientId=client)
        pybullet.restoreState(self._home, physicsClientId=client)
        self._goal, self._places = goal.tolist(), places.tolist()
        for body, place in zip(self._obstacles, self._places, strict=True):
            self._place(body, place)
        for target in (self._brick, self._marker):
            if target is not None:
                self._place(target, self._goal)

    def advance(
        self, joint_target: Sequence[float], finger_target: Sequence[float], substeps: int
    ) -> list[float]:
        """Drives the joints towards a target for some physics substeps.

        Returns:
            For each obstacle the smallest contact distance of all substeps, m; infinite where
            there was no contact.
        """
        client = self._client
        self._command(joint_target, finger_target, self._scene.motor_gain or 1 / substeps)
        distances = [float("inf")] * len(self._obstacles)
        for _ in range(substeps):
            pybullet.stepSimulation(physicsClientId=client)
            for index, body in enumerate(self._obstacles):
                points = pybullet.getContactPoints(self._arm, body, physicsClientId=client)
                for point in points:
                    distances[index] = min(distances[index], point[8])
        return distances

    def _command(
        self, joint_target: Sequence[float], finger_target: Sequence[float], gain: float
    ) -> None:
        targets = [*joint_target, *finger_target]
        count = len(targets)
        limits = {"forces": self._efforts[:count]} if self._scene.motor_limits else {}
        pybullet.setJointMotorControlArray(
            self._arm,
            (self._joints + self._fingers)[:count],
            pybullet.POSITION_CONTROL,
            targetPositions=targets,
            positionGains=[gain] * count,
            physicsClientId=self._client,
            **limits,
        )

    def read(self, *, fresh: bool = False) -> tuple[float, ...]:
        """Returns the state as one flat row, in the order of :meth:`widths`."""
        states = self._joint_states()
        link = self._link_state(fresh=fresh or self._scene.fresh_links)
        arm = len(self._joints)
        row = [
            *(state[0] for state in states[:arm]),
            *(state[1] for state in states[:arm]),
            *(state[0] for state in states[arm:]),
            *link[4],
            *link[5],
            *_velocity_at(link[4], link[0], link[6], link[7]),
        ]
        row += self._goal if self._brick is None else self._pose(self._brick)[0]
        velocities: list[float] = []
        for body, static, place in zip(self._obstacles, self._is_static, self._places, strict=True):
            row += place if static else self._pose(body)[0]
            velocities += (
                (0.0, 0.0, 0.0)
                if static
                else pybullet.getBaseVelocity(body, physicsClientId=self._client)[0]
            )
        return (*row, *velocities)

    def widths(self) -> dict[str, int]:
        """Names and widths of the parts of a row that :meth:`read` returns."""
        obstacles = 3 * len(self._obstacles)
        return {
            "joint_position": len(self._joints),
            "joint_velocity": len(self._joints),
            "finger_position": len(self._fingers),
            "ee_position": 3,
            "ee_orientation": 4,
            "ee_velocity": 3,
            "goal": 3,
            "obstacle_position": obstacles,
            "obstacle_velocity": obstacles,
        }

    def jacobian(self, joint_position: Sequence[float]) -> tuple[Sequence[float], ...]:
        """Returns the six rows of the tool point's Jacobian: linear, then angular velocity."""
        position = [0.0] * self._num_movable
        for column, angle in zip(self._columns, joint_position, strict=True):
            position[column] = angle
        zeros = [0.0] * self._num_movable
        # The point is given in the frame of the link, whose origin is the tool point.
        linear, angular = pybullet.calculateJacobian(
            self._arm, self._ee, (0.0, 0.0, 0.0), position, zeros, zeros, self._client
        )
        if self._num_movable == len(self._columns):
            return (*linear, *angular)
        return tuple([row[c] for c in self._columns] for row in (*linear, *angular))

    def inverse_kinematics(
        self, position: Sequence[float], orientation: Sequence[float]
    ) -> list[float]:
        """Returns the joint angles of Bullet's iterative solver, its default 20 iterations."""
        angles = pybullet.calculateInverseKinematics(
            self._arm, self._ee, position, orientation, physicsClientId=self._client
        )
        return [angles[column] for column in self._columns]

    def copy_from(self, other: World) -> None:
        """Takes the state of another world of the same build, for a picture of it."""
        self._set_joints([state[0] for state in other._joint_states()])
        for mine, theirs in zip(self._obstacles, other._obstacles, strict=True):
            self._place(mine, *other._pose(theirs))
        if self._brick is not None and other._brick is not None:
            self._place(self._brick, *other._pose(other._brick))
        if self._marker is not None:
            self._place(self._marker, other._goal)

    def picture(self, camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
        """Returns an RGB picture, ``(height, width, 3)``."""
        view = pybullet.computeViewMatrix(camera.eye, camera.target, (0, 0, 1))
        projection = pybullet.computeProjectionMatrixFOV(
            camera.field_of_view, width / height, 0.1, 10
        )
        pixels = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(1, -1, 2),
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )[2]
        return np.asarray(pixels, np.uint8).reshape(height, width, 4)[..., :3]

    def _link_state(self, *, fresh: bool) -> tuple:
        return pybullet.getLinkState(
            self._arm,
            self._ee,
            computeLinkVelocity=1,
            computeForwardKinematics=int(fresh),
            physicsClientId=self._client,
        )

    def _joint_states(self) -> tuple[tuple[float, float], ...]:
        return pybullet.getJointStates(
            self._arm, self._joints + self._fingers, physicsClientId=self._client
        )

    def _set_joints(self, positions: Sequence[float]) -> None:
        pybullet.resetJointStatesMultiDof(
            self._arm,
            self._joints + self._fingers,
            [[angle] for angle in positions],
            [[0.0] for _ in positions],
            physicsClientId=self._client,
        )

    def _place(
        self, body: int, position: Sequence[float], orientation: Sequence[float] = (0, 0, 0, 1)
    ) -> None:
        pybullet.resetBasePositionAndOrientation(
            body, position, orientation, physicsClientId=self._client
        )

    def _pose(self, body: int) -> tuple[Sequence[float], Sequence[float]]:
        return pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)


def _velocity_at(
    point: Sequence[float],
    centre: Sequence[float],
    linear: Sequence[float],
    angular: Sequence[float],
) -> tuple[float, float, float]:
    """Velocity of a point of a body whose centre of mass has the given velocities."""
    x, y, z = (p - c for p, c in zip(point, centre, strict=True))
    wx, wy, wz = angular
    return (
        linear[0] + wy * z - wz * y,
        linear[1] + wz * x - wx * z,
        linear[2] + wx * y - wy * x,
    )
