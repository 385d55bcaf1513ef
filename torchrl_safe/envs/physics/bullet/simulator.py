"""N worlds side by side, and the record of their state."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.bullet.readings import Vector, velocity_at
from torchrl_safe.envs.physics.bullet.record import TargetRecord
from torchrl_safe.envs.physics.bullet.ruler import Ruler
from torchrl_safe.envs.physics.bullet.world import TOOL_MOTION, World
from torchrl_safe.envs.physics.rows import places, split
from torchrl_safe.envs.physics.scene import SUBSTEP, Camera, Scene
from torchrl_safe.envs.physics.simulator import Nearest, Saved
from torchrl_safe.envs.state import ArmState, Array, Sensing, Trace, is_touch

if TYPE_CHECKING:
    from torchrl_safe.envs.physics.bullet.physics import Bullet


class BulletSimulator:
    """N worlds of the same build, see :class:`~torchrl_safe.envs.physics.simulator.Simulator`.

    PyBullet cannot save a world completely: motor targets and contacts are missing. But a reset
    does not depend on what came before it, so replaying the motors' targets since the reset brings
    an episode back, bit for bit.

    Args:
        options: how the worlds are simulated.
        arm: the arm.
        scene: what is around it.
        num_envs: number N of worlds.
        shapes: the m obstacles.
        objects: what the task moves.
        sensing: what is measured in every substep.
        frame_skip: physics substeps of a control step.
        reach: distance up to which :meth:`nearest` measures, m.
        gui: show the first world in PyBullet's window.
    """

    def __init__(
        self,
        options: Bullet,
        arm: ArmModel,
        scene: Scene,
        *,
        num_envs: int,
        shapes: Sequence[Shape],
        objects: Sequence[Shape],
        sensing: Sensing,
        frame_skip: int,
        reach: float | None,
        gui: bool,
    ) -> None:
        self._build = (arm, scene, options, shapes, objects)
        self._frame_skip = frame_skip
        self._picture_world: World | None = None
        self._ruler: Ruler | None = None
        #: The worlds.
        self.worlds: list[World] = []
        try:
            for row in range(num_envs):
                self.worlds.append(
                    World(*self._build, sensing=sensing, gui=gui and row == 0),
                )
            if reach is not None:
                merge = options.merged_links and not objects
                self._ruler = Ruler(arm, scene, options, shapes, merge=merge, reach=reach)
        except BaseException:
            self.close()
            raise
        first = self.worlds[0]
        self.joint_lower: Array = first.joint_lower
        self.joint_upper: Array = first.joint_upper
        self.joint_speed: Array = first.joint_speed
        self.finger_speed: Array = first.finger_speed
        self.home_position: Array = np.array(first.home_position)
        self.home_orientation: Array = np.array(first.home_orientation)
        self._sizes = np.array([shape.half_extents for shape in shapes]).reshape(-1, 3)
        for array in (self.joint_lower, self.joint_upper, self._sizes):
            array.setflags(write=False)  # States have them, and whoever reads a state.
        self._places = places(first.read_shapes())
        self._trace_places = places(first.trace_shapes())
        self._targets = TargetRecord(num_envs)
        self._rows: list[Sequence[float]] = [()] * num_envs
        self._measured: list[Sequence[Sequence[float]]] = [()] * num_envs
        self._present = np.zeros((num_envs, len(shapes)), dtype=bool)
        self._contact_distance = np.full((num_envs, len(shapes)), np.inf)
        self._contact_force = np.zeros((num_envs, len(shapes)))

    def reset(self, row: int, placement: Placement, goal: Array, objects: Array) -> None:
        """Begins an episode in one world."""
        world = self.worlds[row]
        world.reset(placement, goal, objects)
        self._targets.begin(row)
        self._rows[row] = world.read(fresh=True)
        self._measured[row] = [world.measure(touches=False)] * self._frame_skip
        self._present[row] = placement.present
        self._contact_distance[row] = np.inf
        self._contact_force[row] = 0

    def advance(self, joints: Array, fingers: Array) -> None:
        """Takes a control step towards joint targets ``(N, n)`` and finger targets ``(N, f)``."""
        self._targets.add(joints, fingers)
        for row, targets in enumerate(zip(joints.tolist(), fingers.tolist(), strict=True)):
            self._advance_row(row, *targets)
        if not (finite := np.isfinite(self._rows).all(axis=1)).all():
            rows = ", ".join(map(str, np.flatnonzero(~finite)))
            raise FloatingPointError(f"The physics of world {rows} is not finite: reset it.")

    def _advance_row(self, row: int, joints: Vector, fingers: Vector) -> None:
        world = self.worlds[row]
        distances, forces, measured = world.advance(joints, fingers, self._frame_skip)
        self._contact_distance[row] = distances
        self._contact_force[row] = forces
        self._measured[row] = measured
        self._rows[row] = world.read()

    def state(self) -> ArmState:
        """Returns the state of all worlds."""
        row: dict[str, Any] = split(np.array(self._rows), self._places)
        tool = [row["ee_position"], *(row.pop(name) for name in TOOL_MOTION)]
        velocity = velocity_at(*([*part.T] for part in tool))
        del row["finger_velocity"]
        return ArmState(
            **row,
            ee_velocity=np.stack(velocity, axis=1),
            joint_lower=self.joint_lower,
            joint_upper=self.joint_upper,
            obstacle_present=self._present.copy(),
            obstacle_size=self._sizes,
            contact_distance=self._contact_distance.copy(),
            contact_force=self._contact_force.copy(),
            step=self._targets.steps.copy(),
            time=self._targets.steps * self._frame_skip * SUBSTEP,
            trace=Trace(
                split(np.array(self._measured), self._trace_places) if self._trace_places else {}
            ),
            previous=None,
        )

    def tool_at(self, joints: Array) -> tuple[Array, Array]:
        """Returns tool points and orientations; the first world is to be reset afterwards."""
        poses = [self.worlds[0].tool_at(angles) for angles in joints.tolist()]
        return np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])

    def jacobian(self, joints: Array) -> Array:
        """Returns the tool point's Jacobians."""
        return np.array([self.worlds[0].jacobian(angles) for angles in joints.tolist()])

    def inverse_kinematics(self, position: Array, orientation: Array) -> Array:
        """Returns the joint angles of Bullet's own solver, ``(N, n)``."""
        poses = zip(self.worlds, position.tolist(), orientation.tolist(), strict=True)
        return np.array([world.inverse_kinematics(*pose) for world, *pose in poses])

    def clearance(self, row: int) -> float:
        """Returns how far obstacles and objects are from arm and objects, up to 0.1 m."""
        return self.worlds[row].clearance()

    def nearest(self, rows: NDArray[np.int_], joints: Array, fingers: Array) -> Nearest:
        """Measures how far the arm would be from obstacles and table."""
        if self._ruler is None:
            raise ValueError("reach must be given to build to measure distances, got None.")
        now = split(np.array([self._rows[row] for row in rows.tolist()]), self._places)
        angles = np.concatenate([joints, fingers], axis=1)
        return self._ruler(angles, now["obstacle_position"], now["obstacle_orientation"])

    def save(self) -> Saved:
        """Returns the targets since the resets, and the states they have led to."""
        return {**self._targets.save(), "state": np.array(self._rows)}

    def restore(self, saved: Saved) -> None:
        """Plays the targets again."""
        before = saved["state"]
        if before.shape != (shape := np.shape(self._rows)):
            raise ValueError(
                f"state must be of an environment like this one, whose worlds have the shape "
                f"{shape}, got {before.shape}."
            )
        joints = len(self.joint_lower)
        self._targets.restore(saved)
        for row, targets in enumerate(self._targets.rows()):
            for target in targets.tolist():
                self._advance_row(row, target[:joints], target[joints:])
        if not np.array_equal(before, after := np.array(self._rows)):
            warnings.warn(
                "The running episodes did not come back bit for bit, but with differences of up to "
                f"{np.abs(after - before).max():.1e} in their states: they are of another "
                "environment, another version of PyBullet or another kind of processor.",
                stacklevel=2,
            )

    def pictures(self, camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
        """Returns an RGB picture of every world, uint8, ``(N, height, width, 3)``."""
        if self._picture_world is None:
            self._picture_world = World(*self._build, visuals=True)
        pictures = []
        touches = is_touch(self._contact_distance, self._contact_force)
        for world, touched in zip(self.worlds, touches, strict=True):
            self._picture_world.copy_from(world)
            self._picture_world.light_up(touched.tolist())
            pictures.append(self._picture_world.picture(camera, width, height))
        return np.stack(pictures)

    def close(self) -> None:
        """Closes every world."""
        for world in self.worlds:
            world.close()
        if self._picture_world is not None:
            self._picture_world.close()
        if self._ruler is not None:
            self._ruler.close()
