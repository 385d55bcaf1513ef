"""N worlds in one batch of MuJoCo."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.arms import ArmModel
from torchrl_safe.envs.obstacles import Placement
from torchrl_safe.envs.obstacles.shapes import Shape
from torchrl_safe.envs.physics.mujoco.bodies import object_name, obstacle_name
from torchrl_safe.envs.physics.mujoco.chain import Chain, ToolPose
from torchrl_safe.envs.physics.mujoco.clearance import Clearance
from torchrl_safe.envs.physics.mujoco.engine import make_batch, mujoco, quiet
from torchrl_safe.envs.physics.mujoco.free import FreeBodies
from torchrl_safe.envs.physics.mujoco.model import build_scenery, build_world
from torchrl_safe.envs.physics.mujoco.motors import FINGER_GROUP, fill_controls
from torchrl_safe.envs.physics.mujoco.pictures import Painter
from torchrl_safe.envs.physics.mujoco.quaternions import TO_MUJOCO
from torchrl_safe.envs.physics.mujoco.readings import nearest, touch_distance, touches
from torchrl_safe.envs.physics.mujoco.ruler import Ruler
from torchrl_safe.envs.physics.mujoco.tracks import Tracks
from torchrl_safe.envs.physics.paths import Ways
from torchrl_safe.envs.physics.scene import SUBSTEP, Camera, Scene
from torchrl_safe.envs.physics.simulator import Nearest, Saved
from torchrl_safe.envs.rotations import UPRIGHT
from torchrl_safe.envs.state import ArmState, Array, Sensing, Trace, is_touch


class MuJoCoSimulator:
    """N worlds of the same build, see :class:`~torchrl_safe.envs.physics.simulator.Simulator`.

    A world is a row of numbers. A reset writes its row, and a checkpoint holds the table of all.

    Args:
        arm: the arm.
        scene: what is around it.
        threads: threads that the worlds are shared between.
        num_envs: number N of worlds.
        shapes: the m obstacles.
        objects: what the task moves.
        sensing: what is measured in every substep.
        frame_skip: substeps of a control step.
        reach: distance up to which :meth:`nearest` measures, m.
    """

    def __init__(
        self,
        arm: ArmModel,
        scene: Scene,
        *,
        threads: int,
        num_envs: int,
        shapes: Sequence[Shape],
        objects: Sequence[Shape],
        sensing: Sensing,
        frame_skip: int,
        reach: float | None,
    ) -> None:
        world = build_world(arm, scene, shapes, objects, sensing)
        model, parts = world.model, world.parts
        self._build = (arm, scene, shapes, objects)
        self._frame_skip, self._sensing, self._places = frame_skip, sensing, world.places
        self._batch = make_batch(model, num_envs, threads)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._mocap_pos, self._mocap_quat = (
            self._batch.bind(name) for name in ("mocap_pos", "mocap_quat")
        )
        self._readings = self._batch.bind("sensordata")
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[:] = world.home
        self._start = self._batch.state[0].copy()
        self._driven, self._driven_speed = world.position, world.velocity
        self._chain = Chain(model, parts.joints, parts.tool)
        self._pose: tuple[Array, ToolPose] | None = None
        self._controls = np.zeros((num_envs, frame_skip, model.nu))
        self._fingers_rest = False  # Whether their motors do.
        self._clearance = Clearance(
            model,
            [*map(obstacle_name, range(len(shapes)))],
            [*map(object_name, range(len(objects)))],
        )
        self._ruler: Ruler | None = None
        if reach is not None:
            self._ruler = Ruler(
                arm,
                scene,
                threads=threads,
                num_envs=num_envs,
                shapes=shapes,
                merge=not objects,
                reach=reach,
            )

        count = len(parts.joints)
        self.joint_lower, self.joint_upper = parts.joint_lower, parts.joint_upper
        self.joint_speed, self.finger_speed = parts.speed[:count], parts.speed[count:]
        home = self._chain(np.array([arm.home], dtype=float))
        self.home_position, self.home_orientation = home.position[0], home.orientation[0]

        self._sizes = np.array([shape.half_extents for shape in shapes]).reshape(-1, 3)
        for array in (self.joint_lower, self.joint_upper, self._sizes):
            array.setflags(write=False)  # States have them, and whoever reads a state.
        self._is_free = np.array([shape.mass > 0 for shape in shapes], dtype=bool)
        self._some_free = bool(self._is_free.any())
        self._tracks = Tracks(num_envs, len(shapes), frame_skip)
        self._objects = FreeBodies(model, [object_name(index) for index in range(len(objects))])
        self._free = FreeBodies(
            model, [obstacle_name(i) for i in np.flatnonzero(self._is_free).tolist()]
        )
        self._goal = np.zeros((num_envs, 3))
        self._steps = np.zeros(num_envs, dtype=int)
        self._contact_distance = np.full((num_envs, len(shapes)), np.inf)
        self._contact_force = np.zeros((num_envs, len(shapes)))
        self._senses = sensing != Sensing()
        # Measurements of positions after the last substep need one more evaluation.
        self._looks = bool(sensing.clearance or sensing.tool or sensing.links)
        # Recording takes time as well.
        self._recorded: tuple[str, ...] = ("sensordata",)
        if sensing.joints or (sensing.clearance and self._some_free):
            self._recorded += ("qpos", "qvel")
        self._record: dict[str, Array] | None = None
        self._painter: Painter | None = None
        self._trace: dict[str, Array] = {}

    def reset(self, row: int, placement: Placement, goal: Array, objects: Array) -> None:
        """Begins an episode in one world."""
        self._batch.state[row] = self._start
        self._batch.warning[row] = 0
        self._tracks.reset(row, placement)
        now, fixed = self._tracks.now, ~self._is_free
        self._mocap_pos[row] = now.position[row, fixed]
        self._mocap_quat[row] = now.orientation[row, fixed][:, TO_MUJOCO]
        self._free.put(
            self._qpos[row], now.position[row, self._is_free], now.orientation[row, self._is_free]
        )
        self._objects.put(self._qpos[row], objects, np.array(UPRIGHT))
        self._goal[row], self._steps[row] = goal, 0
        self._contact_distance[row], self._contact_force[row] = np.inf, 0
        self._pose = None
        if self._senses:
            self._measure_now(row)

    def _measure_now(self, row: int) -> None:
        """Fills the trace of a world with what is measured at the beginning of an episode."""
        if self._looks:
            with quiet():
                self._batch.forward([row], stage=mujoco.mjtStage.mjSTAGE_VEL)
        rows = slice(row, row + 1)
        ways = Ways(*(part[rows, None] for part in self._obstacles()))
        measured = self._measure(self._readings[rows, None], self._qpos[rows, None], ways)
        for name in ("table_distance", "self_distance"):
            if name in measured:
                measured[name][:] = np.inf
        for name, values in measured.items():
            if name not in self._trace:
                shape = (len(self._goal), self._frame_skip, *values.shape[2:])
                self._trace[name] = np.zeros(shape)
            self._trace[name][row] = values[0]

    def advance(self, joints: Array, fingers: Array) -> None:
        """Takes a control step towards joint targets ``(N, n)`` and finger targets ``(N, f)``."""
        tracks = self._tracks
        if self._some_free:
            self._hold_absent()
        current = self._qpos.take(self._driven, axis=1)
        targets = current.copy()
        targets[:, : joints.shape[1]] = joints
        if fingers.shape[1]:
            targets[:, joints.shape[1] :] = fingers
        self._drive_fingers(fingers.shape[1] > 0)
        fill_controls(self._controls, current, targets)
        controls, spec = self._controls, mujoco.mjtState.mjSTATE_CTRL
        ways = None
        if tracks.moving:
            ways = tracks.ahead()
            controls = np.concatenate(
                [
                    controls,
                    ways.position[:, :-1].reshape(*controls.shape[:2], -1),
                    ways.orientation[:, :-1, :, TO_MUJOCO].reshape(*controls.shape[:2], -1),
                ],
                axis=2,
            )
            spec |= mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
        with quiet():
            self._record = self._batch.rollout(
                self._frame_skip,
                controls,
                control_spec=int(spec),
                record=self._recorded,
                out=self._record,
            )
        self._steps += 1
        self._pose = None
        if ways is not None:
            tracks.go(ways)
            self._mocap_pos[:] = tracks.now.position
            self._mocap_quat[:] = tracks.now.orientation[..., TO_MUJOCO]
        with np.errstate(invalid="ignore", over="ignore"):  # Of a world that _check then names.
            self._read(ways)
        self._check()

    def _hold_absent(self) -> None:
        """Keeps obstacles that are not there from falling for ever."""
        absent = ~self._tracks.present[:, self._is_free]
        if absent.any():
            row, index = absent.nonzero()
            now = self._tracks.now
            self._free.hold(
                self._qpos, self._qvel, row, index, now.position[:, self._is_free][row, index]
            )

    def _drive_fingers(self, drive: bool) -> None:
        if len(self.finger_speed) and drive == self._fingers_rest:
            resting = 0 if drive else 1 << FINGER_GROUP
            self._batch.expand("opt.disableactuator")[:] = resting
            self._fingers_rest = not drive

    def _check(self) -> None:
        # One number that is not finite makes the sum so.
        warning = self._batch.warning
        if warning.any() or not np.isfinite(self._qpos.sum() + self._qvel.sum()):
            finite = np.isfinite(self._qpos).all(axis=1) & np.isfinite(self._qvel).all(axis=1)
            warned = warning[:, :, 1]
            rows = np.flatnonzero(warned.any(axis=1) | ~finite)
            kinds = [
                kind.name.removeprefix("mjWARN_")
                for kind in map(mujoco.mjtWarning, np.flatnonzero(warned[rows].any(axis=0)))
            ]
            raise FloatingPointError(
                f"The physics of world {', '.join(map(str, rows))} is not finite or unstable "
                f"(MuJoCo: {', '.join(kinds)}): reset it."
            )

    def _read(self, ways: Ways | None) -> None:
        """Reads what the last control step has recorded."""
        assert self._record is not None
        record, contacts = self._record["sensordata"], self._places["contacts"]
        self._contact_distance, self._contact_force = touches(contacts.of(record))
        if not self._senses:
            return
        if self._looks:
            # What MuJoCo records of a substep is how everything was before it.
            with quiet():
                self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
            after = np.concatenate([record[:, 1:], self._readings[:, None]], axis=1)
        else:
            after = record
        if self._sensing.clearance:
            ways = self._ways_after(ways)
        self._trace = self._measure(after, self._record.get("qpos"), ways, before=record)

    def _ways_after(self, ways: Ways | None) -> Ways:
        """Where the obstacles were after each substep."""
        assert self._record is not None
        if ways is not None:
            return Ways(*(part[:, 1:] for part in ways))
        shape = (len(self._goal), self._frame_skip)
        now = [np.broadcast_to(p[:, None], (*shape, *p.shape[1:])) for p in self._tracks.now]
        if self._some_free:
            present = self._tracks.present[:, None, self._is_free, None]
            moved = self._free.read(self._record["qpos"], self._record["qvel"])
            now = [part.copy() for part in now]
            for part, values in zip(now, moved, strict=True):
                part[:, :, self._is_free] = np.where(present, values, part[:, :, self._is_free])
        return Ways(*now)

    def _measure(
        self, after: Array, qpos: Array | None, ways: Ways | None, before: Array | None = None
    ) -> dict[str, Array]:
        """Names what the sensors have read in every substep.

        Args:
            after: what they read after each, ``(k, s, width)``.
            qpos: positions after each; not needed where no joints are measured.
            ways: obstacles after each.
            before: what they read before each.
        """
        places, sensing = self._places, self._sensing
        contacts = after if before is None else before
        trace: dict[str, Array] = {}
        if sensing.clearance:
            assert ways is not None
            trace |= nearest(places["closest"].of(after), places["motions"].of(after), ways)
        for name in ("table_distance", "self_distance"):
            if name in places:
                trace[name] = touch_distance(places[name].of(contacts))
        if sensing.joints:
            assert qpos is not None
            trace["joint_position"] = qpos.take(self._driven[: len(self.joint_lower)], axis=-1)
        if sensing.tool:
            trace |= {
                name: places[name].of(after).copy() for name in ("ee_position", "ee_velocity")
            }
        if sensing.links:
            trace["link_speed"] = np.sqrt(np.square(places["links"].of(after)).sum(axis=-1))
        return trace

    def _obstacles(self) -> Ways:
        """Where the obstacles are now, each ``(N, m, width)``."""
        now = Ways(*(part.copy() for part in self._tracks.now))
        if self._some_free:
            present = self._tracks.present[:, self._is_free, None]
            for part, values in zip(now, self._free.read(self._qpos, self._qvel), strict=True):
                part[:, self._is_free] = np.where(present, values, part[:, self._is_free])
        return now

    def _tool(self) -> tuple[Array, ToolPose]:
        if self._pose is None:
            joints = self._qpos.take(self._driven[: len(self.joint_lower)], axis=1)
            self._pose = joints, self._chain(joints)
        return self._pose

    def state(self) -> ArmState:
        """Returns the state of all worlds."""
        count = len(self.joint_lower)
        joints, tool = self._tool()
        speed = self._qvel.take(self._driven_speed[:count], axis=1)
        obstacles, objects = self._obstacles(), self._objects.read(self._qpos, self._qvel)
        return ArmState(
            joint_position=joints,
            joint_velocity=speed,
            joint_lower=self.joint_lower,
            joint_upper=self.joint_upper,
            finger_position=self._qpos.take(self._driven[count:], axis=1),
            ee_position=tool.position,
            ee_orientation=tool.orientation,
            ee_velocity=(tool.jacobian[:, :3] @ speed[:, :, None])[:, :, 0],
            goal=self._goal.copy(),
            **{f"object_{name}": part for name, part in objects._asdict().items()},
            **{f"obstacle_{name}": part for name, part in obstacles._asdict().items()},
            obstacle_present=self._tracks.present.copy(),
            obstacle_size=self._sizes,
            contact_distance=self._contact_distance.copy(),
            contact_force=self._contact_force.copy(),
            step=self._steps.copy(),
            time=self._steps * self._frame_skip * SUBSTEP,
            trace=Trace({name: values.copy() for name, values in self._trace.items()}),
        )

    def tool_at(self, joints: Array) -> tuple[Array, Array]:
        """Returns tool points and orientations."""
        tool = self._chain(joints)
        return tool.position, tool.orientation

    def jacobian(self, joints: Array) -> Array:
        """Returns the tool point's Jacobians."""
        angles, tool = self._tool()
        if np.array_equal(angles, joints):
            return tool.jacobian
        return self._chain(joints).jacobian

    def clearance(self, row: int) -> float:
        """Returns how far obstacles and objects are from arm and objects, up to 0.1 m."""
        return self._clearance(self._batch.state[row], self._tracks.present[row])

    def nearest(self, rows: NDArray[np.int_], joints: Array, fingers: Array) -> Nearest:
        """Measures how far the arm would be from obstacles and table."""
        if self._ruler is None:
            raise ValueError("reach must be given to build to measure distances, got None.")
        now = self._obstacles()
        angles = np.concatenate([joints, fingers], axis=1)
        return self._ruler(rows, angles, now.position[rows], now.orientation[rows][..., TO_MUJOCO])

    def save(self) -> Saved:
        """Returns the table of states, and what was measured last."""
        return {
            "state": self._batch.state.copy(),
            "steps": self._steps.copy(),
            "contact_distance": self._contact_distance.copy(),
            "contact_force": self._contact_force.copy(),
            **{f"trace_{name}": values.copy() for name, values in self._trace.items()},
        }

    def restore(self, saved: Saved) -> None:
        """Writes the table of states."""
        own = self.save()
        for name in own:
            shape = saved[name].shape if name in saved else "nothing"
            if shape != own[name].shape:
                raise ValueError(
                    f"{name} must be of an environment like this one, whose worlds have the shape "
                    f"{own[name].shape}, got {shape}."
                )
        self._steps[:] = saved["steps"]
        for row, steps in enumerate(self._steps.tolist()):
            self._tracks.seek(row, steps * self._frame_skip)
        self._batch.state[:] = saved["state"]
        self._contact_distance[:] = saved["contact_distance"]
        self._contact_force[:] = saved["contact_force"]
        self._trace = {name: saved[f"trace_{name}"].copy() for name in self._trace}
        self._pose = None
        placed = self._tracks.now.position[:, ~self._is_free]
        if not np.array_equal(placed, self._mocap_pos):
            warnings.warn(
                "The running episodes did not come back bit for bit: their obstacles are "
                f"{np.abs(placed - self._mocap_pos).max():.1e} m away from where they were.",
                stacklevel=2,
            )

    def pictures(self, camera: Camera, width: int, height: int) -> NDArray[np.uint8]:
        """Returns an RGB picture of every world."""
        if self._painter is None:
            names = [obstacle_name(index) for index in range(len(self._sizes))]
            self._painter = Painter(build_scenery(*self._build), names)
        return self._painter.paint(
            self._qpos, self._mocap_pos, self._mocap_quat, self._goal,
            is_touch(self._contact_distance, self._contact_force), camera, width, height,
        )  # fmt: skip

    def close(self) -> None:
        """Frees what pictures are drawn with."""
        if self._painter is not None:
            self._painter.close()
