"""N worlds side by side, and the record of their state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate

import numpy as np

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.physics.bullet.readings import Vector, velocity_at
from torchrl_safe.envs.physics.bullet.world import TOOL_MOTION, World
from torchrl_safe.envs.scene import Camera, Scene
from torchrl_safe.envs.shapes import Shape
from torchrl_safe.envs.state import ArmState, Array, Sensing, Trace

Parts = Mapping[str, tuple[slice, tuple[int, ...]]]


class WorldBatch:
    """N worlds of the same build.

    Args:
        num_envs: number N of worlds.
        arm: the arm.
        scene: how the worlds are simulated.
        shapes: the m obstacles.
        objects: what the task moves.
        sensing: what is measured in every substep.
        frame_skip: physics substeps of a control step.
        gui: show the first world in PyBullet's window.
    """

    def __init__(
        self,
        num_envs: int,
        arm: ArmModel,
        scene: Scene,
        shapes: Sequence[Shape],
        objects: Sequence[Shape],
        *,
        sensing: Sensing,
        frame_skip: int,
        gui: bool,
    ) -> None:
        self._build = (arm, scene, shapes, objects)
        self._frame_skip = frame_skip
        self._picture_world: World | None = None
        #: The worlds.
        self.worlds: list[World] = []
        try:
            for row in range(num_envs):
                self.worlds.append(
                    World(*self._build, sensing=sensing, gui=gui and row == 0),
                )
        except BaseException:
            self.close()
            raise
        self._sizes = np.array([shape.half_extents for shape in shapes]).reshape(-1, 3)
        self._parts = parts(self.worlds[0].read_shapes())
        self._trace_parts = parts(self.worlds[0].trace_shapes())
        self._rows: list[Sequence[float]] = [()] * num_envs
        self._measured: list[Sequence[Sequence[float]]] = [()] * num_envs
        self._present = np.zeros((num_envs, len(shapes)), dtype=bool)
        self._contact_distance = np.full((num_envs, len(shapes)), np.inf)
        self._contact_force = np.zeros((num_envs, len(shapes)))

    def reset(self, row: int, placement: Placement, goal: Array, objects: Array) -> None:
        """Begins an episode in one world."""
        world = self.worlds[row]
        world.reset(placement, goal, objects)
        self._rows[row] = world.read(fresh=True)
        self._measured[row] = [world.measure(touches=False)] * self._frame_skip
        self._present[row] = placement.present
        self._contact_distance[row] = np.inf
        self._contact_force[row] = 0

    def advance(self, joints: Array, fingers: Array) -> None:
        """Takes a control step towards joint targets ``(N, n)`` and finger targets ``(N, f)``."""
        for row, targets in enumerate(zip(joints.tolist(), fingers.tolist(), strict=True)):
            self.advance_row(row, *targets)

    def advance_row(self, row: int, joints: Vector, fingers: Vector) -> None:
        """Takes a control step in one world."""
        world = self.worlds[row]
        distances, forces, measured = world.advance(joints, fingers, self._frame_skip)
        self._contact_distance[row] = distances
        self._contact_force[row] = forces
        self._measured[row] = measured
        self._rows[row] = world.read()

    def table(self) -> Array:
        """Returns what each world was when it was last read, one row each."""
        return np.array(self._rows)

    def state(self) -> ArmState:
        """Returns the state of all worlds."""
        row = split(self.table(), self._parts)
        tool = [row["ee_position"], *(row.pop(name) for name in TOOL_MOTION)]
        velocity = velocity_at(*([*part.T] for part in tool))
        del row["finger_velocity"]
        return ArmState(
            **row,
            ee_velocity=np.stack(velocity, axis=1),
            joint_lower=self.worlds[0].joint_lower,
            joint_upper=self.worlds[0].joint_upper,
            obstacle_present=self._present.copy(),
            obstacle_size=self._sizes,
            contact_distance=self._contact_distance.copy(),
            contact_force=self._contact_force.copy(),
            trace=Trace(
                split(np.array(self._measured), self._trace_parts) if self._trace_parts else {}
            ),
        )

    def pictures(self, camera: Camera, width: int, height: int) -> Array:
        """Returns an RGB picture of every world, uint8, ``(N, height, width, 3)``."""
        if self._picture_world is None:
            self._picture_world = World(*self._build, visuals=True)
        pictures = []
        for world in self.worlds:
            self._picture_world.copy_from(world)
            pictures.append(self._picture_world.picture(camera, width, height))
        return np.stack(pictures)

    def close(self) -> None:
        """Closes every world."""
        for world in self.worlds:
            world.close()
        if self._picture_world is not None:
            self._picture_world.close()


def parts(shapes: Mapping[str, tuple[int, ...]]) -> Parts:
    """Where the named parts of the given shapes are in a row that has them one after the other."""
    widths = [math.prod(shape) for shape in shapes.values()]
    ends = list(accumulate(widths))
    return {
        name: (slice(end - width, end), shape)
        for (name, shape), width, end in zip(shapes.items(), widths, ends, strict=True)
    }


def split(table: Array, parts: Parts) -> dict[str, Array]:
    """Cuts the last axis of a table into its parts."""
    return {
        name: table[..., where].reshape(*table.shape[:-1], *shape)
        for name, (where, shape) in parts.items()
    }
