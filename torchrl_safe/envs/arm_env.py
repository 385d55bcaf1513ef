"""The environment: arms, actions, tasks, obstacles and costs put together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, reduce
from numbers import Integral
from operator import or_
from typing import Any, NoReturn

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

# What TorchRL's own set_seed draws the next seed with: batched environments count on it.
from torchrl._utils import seed_generator
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_safe._checks import check_array, check_callable, check_count, check_flag, check_kind
from torchrl_safe.envs.actions import ActionMode, CartesianDelta, check_bound
from torchrl_safe.envs.arms import PANDA, ArmModel
from torchrl_safe.envs.costs import Collision
from torchrl_safe.envs.generators import PACKED_SIZE, pack, unpack
from torchrl_safe.envs.observations import FullObservation
from torchrl_safe.envs.obstacles import InFront, Obstacles
from torchrl_safe.envs.obstacles.shapes import check_shapes
from torchrl_safe.envs.physics.bullet import Bullet
from torchrl_safe.envs.physics.scene import SUBSTEP, Camera, Scene
from torchrl_safe.envs.physics.simulator import Physics
from torchrl_safe.envs.shield import Shield
from torchrl_safe.envs.shield.projection import check_solver
from torchrl_safe.envs.starts import Starts
from torchrl_safe.envs.state import ArmState, Array, Sensing, Sensor
from torchrl_safe.envs.tasks import Reach, Task

Cost = Callable[[ArmState], Array]

# What the names of the simulator's own arrays begin with in a saved state.
_PHYSICS = "physics."


class ArmEnv(EnvBase):
    """A robot arm that has a task to do and costs to keep low.

    The environment is batched: each of its N rows is a world of its own, and all of them run in
    this process. You can combine any arm with any action, task, obstacles, costs and physics.

    For N worlds and k costs it writes ``observation`` (N, width) and reads ``action`` (N, width).
    Under ``"next"`` it also writes ``reward`` (N, 1), ``cost`` (N, k), ``success`` (N, 1),
    ``terminated`` (N, 1; the task is done), ``truncated`` (N, 1; the time is up) and ``done``
    (N, 1). ``cost`` is part of the reward spec, like ``reward``. TorchRL's
    ``RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])`` therefore sums both over
    an episode. With a shield there are also ``shield_correction`` (N, 1; how far it has moved the
    joint targets, rad) and ``shield_braked`` (N, 1; whether it braked).

    Attributes:
        observation_fields: the slice of the observation that each field has, by name.
        arm_state: the :class:`~torchrl_safe.envs.ArmState` after the last step or reset, which
            tasks and costs read.

    Args:
        arm (ArmModel, optional): the arm. Defaults to ``PANDA``.

    Keyword Args:
        num_envs (int, optional): number N of worlds. Defaults to ``1``.
        action (ActionMode, optional): what an action does. Actions beyond its bound (here 1)
            are clipped. Defaults to ``CartesianDelta()``.
        task (Task, optional): goal, reward and success. Defaults to ``Reach()``.
        obstacles (Obstacles, optional): the obstacles and where they are. Defaults to
            ``InFront()``.
        costs (Mapping[str, Callable], optional): the costs by name, each a callable from
            :class:`~torchrl_safe.envs.ArmState` to an array of shape ``(N,)``. They are read
            over all physics substeps. Defaults to ``{"collision": Collision()}``.
        observation (Callable, optional): maps the state to named fields, which are
            concatenated. Defaults to :class:`~torchrl_safe.envs.FullObservation`.
        frame_skip (int, optional): physics substeps of 1/240 s for each action. Defaults to
            ``12``: a control rate of 20 Hz. With fewer, MuJoCo's arm lags behind the first
            actions after rest.
        max_episode_steps (int, optional): time limit; sets ``truncated``. Defaults to ``40``,
            2 s at 20 Hz.
        scene (Scene, optional): gravity, fingers and motors. Defaults to ``Scene()``.
        physics (Physics, optional): the engine that simulates it. Defaults to ``Bullet()``.
        shield (Shield, optional): changes actions as little as needed to keep the arm off obstacles
            and table. ``action`` stays what was asked for. Defaults to ``None``.
        seed (int, optional): seed of the goals and obstacles. Every row has a generator of its
            own, and the seeds follow TorchRL's chain: two environments of one world, seeded by a
            ``ParallelEnv`` or a collector, draw what one environment of two worlds draws. Do not
            pass ``seed`` in a factory for several workers: all of them would draw the same.
        device (torch.device, optional): device of the tensors. Defaults to ``None``.
        gui (bool, optional): show the first world in a window. Defaults to ``False``.

    Raises:
        ImportError: if the physics engine is missing or, with a shield, DAQP.
        TypeError: if an argument has the wrong type.
        ValueError: if an argument cannot be used, an action, observation, reward or cost is not
            finite or has the wrong shape, or the obstacles overlap the arm at home.
        RuntimeError: if the environment is closed or not yet reset, or ``gui`` is wanted and there
            is no screen.

    Examples:
        >>> env = ArmEnv(num_envs=2, seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["next", "cost"].shape
        torch.Size([2, 3, 1])
        >>> env.cost_names
        ('collision',)
        >>> env.close()
    """

    # The substeps are taken here: TorchRL must not add a FrameSkipTransform.
    _has_frame_skip = True

    def __init__(
        self,
        arm: ArmModel = PANDA,
        *,
        num_envs: int = 1,
        action: ActionMode = CartesianDelta(),
        task: Task = Reach(),
        obstacles: Obstacles = InFront(),
        costs: Mapping[str, Cost] | None = None,
        observation: Callable[[ArmState], dict[str, Array]] = FullObservation(),
        frame_skip: int = 12,
        max_episode_steps: int = 40,
        scene: Scene = Scene(),
        physics: Physics = Bullet(),
        shield: Shield | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
        gui: bool = False,
    ) -> None:
        check_count(num_envs=num_envs, frame_skip=frame_skip, max_episode_steps=max_episode_steps)
        check_flag(gui=gui)
        check_kind("arm", arm, ArmModel, such_as="PANDA")
        check_kind("action", action, ActionMode, such_as="JointDelta()")
        check_kind("task", task, Task, such_as="Reach()")
        check_kind("obstacles", obstacles, Obstacles, such_as="InFront()")
        check_kind("scene", scene, Scene, such_as="Scene()")
        check_kind("physics", physics, Physics, such_as="MuJoCo()")
        if shield is not None:
            check_kind("shield", shield, Shield, such_as="Shield()")
            check_solver()
        costs = {"collision": Collision()} if costs is None else costs
        check_kind("costs", costs, Mapping, such_as='{"collision": Collision()}')
        if not costs:
            raise ValueError("costs must name at least one cost, got an empty mapping.")
        if wrong := [name for name in costs if not isinstance(name, str)]:
            raise TypeError(f"costs must have names that are strings, got {wrong}.")
        named = [(f"cost {name!r}", cost) for name, cost in costs.items()]
        for name, function in [*named, ("observation", observation)]:
            check_callable(name, function)
        check_bound(action.bound)
        check_shapes("shapes of obstacles", obstacles.shapes)
        check_shapes("objects of task", task.objects, movable=True)
        super().__init__(device=device, batch_size=(num_envs,))
        self.arm = arm
        self.action_mode = action
        self.task = task
        self.obstacles = obstacles
        self.costs = dict(costs)
        self.frame_skip = frame_skip
        self.max_episode_steps = max_episode_steps
        self.observation = observation
        self.physics = physics
        self.shield = shield
        self.scene = replace(scene, free_fingers=scene.free_fingers or action.moves_fingers)
        self._begun = False
        # What the shield has done in the last control step.
        self._correction, self._braked = np.zeros(num_envs), np.zeros(num_envs, dtype=bool)
        # States of the generators before the running episodes were drawn.
        self._draws = np.zeros((num_envs, PACKED_SIZE), dtype=np.uint8)
        self.set_seed(seed)
        sensors = {name: cost.sensing for name, cost in costs.items() if isinstance(cost, Sensor)}
        for name, sensing in sensors.items():
            check_kind(f"sensing of cost {name!r}", sensing, Sensing)
        self._simulator = physics.build(
            arm,
            self.scene,
            num_envs=num_envs,
            shapes=obstacles.shapes,
            objects=task.objects,
            sensing=reduce(or_, sensors.values(), Sensing()),
            frame_skip=frame_skip,
            reach=None if shield is None else shield.reach,
            gui=gui,
        )
        self._starts = Starts(arm, task, obstacles, self._simulator)
        try:
            self._starts.check()
            self._make_specs()
        except BaseException:
            self._simulator.close()
            raise
        self.is_closed = False

    def extra_repr(self) -> str:
        parts = {
            "arm": self.arm.urdf,
            "num_envs": self.num_envs,
            "action": self.action_mode,
            "task": self.task,
            "obstacles": self.obstacles,
            "costs": self.costs,
            "shield": self.shield,
        }
        return "\n".join(f"{name}={part}" for name, part in parts.items())

    @property
    def num_envs(self) -> int:
        """Number of worlds."""
        return self.batch_size[0]

    @property
    def cost_names(self) -> tuple[str, ...]:
        """Names of the costs, in the order of the columns of ``cost``."""
        return tuple(self.costs)

    @property
    def arm_state(self) -> ArmState:
        """The state after the last step or reset, which tasks and costs read."""
        return self._state

    @property
    def control_rate(self) -> float:
        """Actions a second, Hz."""
        return 1 / (SUBSTEP * self.frame_skip)

    def _make_specs(self) -> None:
        for row in range(self.num_envs):
            self._reset_world(row, np.random.default_rng(0))
        self._state = state = self._read_state()
        # Checks once what the arguments compute, so that errors show when the environment is made.
        action_width = self.action_mode.width(state.joint_position.shape[1])
        self._targets(np.zeros((self.num_envs, action_width)))
        self._outcome(replace(state, previous=state))  # Rewards may read what has changed.
        fields = self.observation(state)
        check_kind("what observation returns", fields, Mapping)
        if not fields:
            raise ValueError("observation must return at least one field, got none.")
        for name, field in fields.items():
            shape = (self.num_envs, *np.shape(field)[1:2])
            if len(check_array(f"observation field {name!r}", field, shape).shape) != 2:
                raise ValueError(
                    f"observation field {name!r} must have shape (num_envs, width), got {shape}."
                )
        self._field_shapes = [(name, np.shape(field)) for name, field in fields.items()]
        ends = np.cumsum([width for _, (_, width) in self._field_shapes])
        self.observation_fields = {
            name: slice(int(end) - width, int(end))
            for (name, (_, width)), end in zip(self._field_shapes, ends, strict=True)
        }
        batch, device = self.batch_size, self.device
        unbounded = partial(Unbounded, device=device, dtype=torch.float32)
        self.observation_spec = Composite(
            observation=unbounded((*batch, int(ends[-1]))),
            **{
                key: Binary(1, shape=(*batch, 1), dtype=torch.bool, device=device)
                for key in (["success"] if self.shield is None else ["success", "shield_braked"])
            },
            **({} if self.shield is None else {"shield_correction": unbounded((*batch, 1))}),
            shape=batch,
        )
        bound, self._action_shape = self.action_mode.bound, (*batch, action_width)
        self.action_spec = (
            Bounded(-bound, bound, self._action_shape, device=device, dtype=torch.float32)
            if np.isfinite(bound)
            else unbounded(self._action_shape)
        )
        self.reward_spec = Composite(
            reward=unbounded((*batch, 1)),
            cost=unbounded((*batch, len(self.costs))),
            shape=batch,
        )
        self.done_spec = Composite(
            {
                key: Categorical(2, shape=(*batch, 1), dtype=torch.bool, device=device)
                for key in ("done", "terminated", "truncated")
            },
            shape=batch,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._check_open()
        if kwargs:
            raise TypeError(
                f"reset takes no {', '.join(kwargs)}: call set_seed, or pass a tensordict."
            )
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        rows = range(self.num_envs) if chosen is None else chosen.flatten().nonzero().flatten()
        for row in rows:
            self._reset_world(int(row), self._generators[int(row)])
        self._begun = True
        self._state = self._read_state()
        return self._pack(
            observation=self._observe(self._state),
            success=np.zeros((self.num_envs, 1), dtype=bool),
            **self._shield_keys(),
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_open()
        if not self._begun:
            raise RuntimeError("ArmEnv must be reset before its first step.")
        mask = tensordict.get("_step", None)
        if mask is not None and not mask.all():
            raise RuntimeError(
                "ArmEnv steps all of its worlds together, but '_step' leaves some out, as "
                "MultiAction and ConditionalSkip do: put single ones in a SerialEnv."
            )
        action = self._check_action(tensordict["action"])
        joints, fingers = self._targets(action)
        if self.scene.motor_limits:
            joints, fingers = self._within_speed(joints, fingers)
        if self.shield is not None:
            joints, fingers = self._shielded(self.shield, joints, fingers)
        self._simulator.advance(joints, fingers)
        before = replace(self._state, previous=None)
        self._state = state = replace(self._read_state(), previous=before)
        reward, cost, success = self._outcome(state)
        truncated = (state.step >= self.max_episode_steps)[:, None] & ~success
        return self._pack(
            observation=self._observe(state),
            success=success,
            **self._shield_keys(),
            reward=reward,
            cost=cost,
            terminated=success,
            truncated=truncated,
            done=success | truncated,
        )

    def _set_seed(self, seed: int | None) -> int | None:
        if seed is not None and not (isinstance(seed, Integral) and seed >= 0):
            raise ValueError(f"seed must be a whole number and not negative, got {seed!r}.")
        self._generators = []
        for _ in range(self.num_envs):
            self._generators.append(np.random.default_rng(seed))
            seed = None if seed is None else seed_generator(seed)
        return seed

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds every row and returns the seed for the next environment.

        TorchRL's own method advances its chain of seeds by one; this one advances it by one
        for each row, so that the rows of the next worker do not repeat those of this one.
        """
        following = self._set_seed(seed)
        return seed if static_seed else following

    def get_extra_state(self) -> dict[str, Tensor]:
        """Returns what the running episodes are, as part of ``state_dict``."""
        self._check_open()
        arrays = {
            "generators": np.stack([pack(generator) for generator in self._generators]),
            "draws": self._draws,
            "frame_skip": np.full(self.num_envs, self.frame_skip),
            "home": np.tile(np.asarray(self.arm.home, dtype=float), (self.num_envs, 1)),
            "begun": np.full(self.num_envs, self._begun),
            **({} if self.shield is None else self._shield_state()),
            **{_PHYSICS + name: array for name, array in self._simulator.save().items()},
        }
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}

    def set_extra_state(self, state: Mapping[str, Tensor]) -> None:
        """Brings the running episodes back, as part of ``load_state_dict``.

        Raises:
            ValueError: if the state has another number of worlds, or of numbers in each, or is of
                another ``frame_skip`` or home pose; the episodes go on then as they were.
        """
        self._check_open()
        own = self.get_extra_state()
        if absent := sorted(own.keys() - state.keys()):
            raise ValueError(f"state must be of an environment like this one, got no {absent}.")
        if len(state["draws"]) != self.num_envs:
            raise ValueError(
                f"state must be of an environment like this one, of {self.num_envs} worlds, got "
                f"{len(state['draws'])}."
            )
        for name in ("frame_skip", "home"):
            if not torch.equal(state[name].cpu(), own[name]):
                raise ValueError(
                    f"state must be of an environment like this one, whose {name} is "
                    f"{own[name][0].tolist()}, got {state[name][0].tolist()}."
                )
        try:
            self._restore(state)
        except Exception:
            self._restore(own)
            raise

    def _restore(self, state: Mapping[str, Tensor]) -> None:
        arrays = {name: tensor.numpy(force=True).copy() for name, tensor in state.items()}
        # A placement may hold a path, which is code: it is drawn again.
        for row, draws in enumerate(arrays["draws"]):
            self._reset_world(row, unpack(draws))
        self._simulator.restore(
            {
                name.removeprefix(_PHYSICS): array
                for name, array in arrays.items()
                if name.startswith(_PHYSICS)
            }
        )
        self._begun = bool(arrays["begun"].all())
        self._generators = [unpack(packed) for packed in arrays["generators"]]
        if self.shield is not None:
            for name, array in self._shield_state().items():
                array[:] = arrays[name]
        self._state = self._read_state()

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        # TorchRL's Collector saves nothing of an environment without transforms, and loads that.
        return super().load_state_dict(state_dict, strict and bool(state_dict), assign)

    def render(self, width: int = 320, height: int = 240, camera: Camera = Camera()) -> Tensor:
        """Draws every world.

        An obstacle that the arm has touched in the last control step is drawn in red.

        Args:
            width: width in pixels.
            height: height in pixels.
            camera: where to look from.

        Returns:
            RGB pictures, uint8, shape ``(N, height, width, 3)``.

        Raises:
            TypeError: if the camera is not a Camera.
            ValueError: if a size is not a whole number of at least 1.
        """
        check_count(width=width, height=height)
        check_kind("camera", camera, Camera)
        self._check_open()
        return torch.from_numpy(self._simulator.pictures(camera, width, height))

    def close(self, *, raise_if_closed: bool = True) -> None:
        super().close(raise_if_closed=raise_if_closed)
        self._simulator.close()

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "A simulated world cannot be copied or pickled; pass a factory, such as "
            "functools.partial(ArmEnv, num_envs=8)."
        )

    def _check_open(self) -> None:
        if self.is_closed:
            raise RuntimeError(
                "This ArmEnv is closed. A collector closes its environment after its last frame: "
                "make a new one."
            )

    def _check_action(self, action: Tensor) -> Array:
        shape = self._action_shape
        if action.shape != shape:
            raise ValueError(f"action must have shape {tuple(shape)}, got {tuple(action.shape)}.")
        if action.is_complex():
            raise ValueError(f"action must be real, got {action.dtype}.")
        array = action.detach().to("cpu", torch.float64).numpy()
        if not np.isfinite(array).all():
            rows = np.flatnonzero(~np.isfinite(array).all(axis=1)).tolist()
            raise ValueError(f"action must be finite, got NaN or infinity in rows {rows}.")
        return np.clip(array, -self.action_mode.bound, self.action_mode.bound)

    def _targets(self, action: Array) -> tuple[Array, Array]:
        joints, fingers = self.action_mode.targets(action, self._state, self._simulator)
        count = len(self._simulator.finger_speed) if np.size(fingers) else 0
        return (
            check_array("joint targets of the action", joints, self._state.joint_position.shape),
            check_array("finger targets of the action", fingers, (self.num_envs, count)),
        )

    def _within_speed(self, joints: Array, fingers: Array) -> tuple[Array, Array]:
        # All joints are slowed alike, so that the tool keeps to its path.
        simulator, state = self._simulator, self._state
        change = joints - state.joint_position
        longest = simulator.joint_speed / self.control_rate
        slowdown = np.maximum(1, np.abs(change / longest).max(axis=1, keepdims=True))
        joints = state.joint_position + change / slowdown
        if not fingers.shape[1]:
            return joints, fingers
        longest = simulator.finger_speed / self.control_rate
        change = np.clip(fingers - state.finger_position, -longest, longest)
        return joints, state.finger_position + change

    def _shielded(self, shield: Shield, joints: Array, fingers: Array) -> tuple[Array, Array]:
        simulator = self._simulator
        speed = simulator.joint_speed if self.scene.motor_limits else np.inf
        done = shield(
            joints,
            fingers,
            self._state,
            simulator,
            longest=np.broadcast_to(speed / self.control_rate, joints.shape[1:]),
            duration=1 / self.control_rate,
        )
        self._correction = np.linalg.norm(done.joints - joints, axis=1)
        self._braked = done.braked
        return done.joints, done.fingers

    def _shield_state(self) -> dict[str, np.ndarray]:
        return {"shield_correction": self._correction, "shield_braked": self._braked}

    def _shield_keys(self) -> dict[str, np.ndarray]:
        if self.shield is None:
            return {}
        return {name: array[:, None] for name, array in self._shield_state().items()}

    def _reset_world(self, row: int, generator: np.random.Generator) -> None:
        self._draws[row] = pack(generator)
        self._correction[row], self._braked[row] = 0, False
        self._starts.begin(row, generator)

    def _read_state(self) -> ArmState:
        state = self._simulator.state()
        if self.shield is not None:
            state = replace(
                state, shield_correction=self._correction.copy(), shield_braked=self._braked.copy()
            )
        # Costs, tasks and observations share the arrays: what one writes, the others would read.
        for array in [*vars(state).values(), *state.trace.values()]:
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        return state

    def _observe(self, state: ArmState) -> Array:
        fields = self.observation(state)
        if [(name, np.shape(field)) for name, field in fields.items()] != self._field_shapes:
            now = {name: np.shape(field) for name, field in fields.items()}
            raise ValueError(
                f"observation must return the fields {dict(self._field_shapes)} in every step, "
                f"got {now}."
            )
        observation = np.concatenate([*fields.values()], axis=1)
        try:
            return check_array("observation", observation, observation.shape)
        except ValueError:
            for name, field in fields.items():
                check_array(f"observation field {name!r}", field, np.shape(field))
            raise

    def _outcome(self, state: ArmState) -> tuple[Array, Array, np.ndarray]:
        """Reward (N, 1), costs (N, k) and success (N, 1) of a state."""
        shape = (self.num_envs,)
        costs = [check_array(f"cost {name!r}", c(state), shape) for name, c in self.costs.items()]
        reward = check_array("reward", self.task.reward(state), shape)
        success = self.task.success(state)
        check_array("success", success, shape)
        success = np.array(success)  # A copy: the task may keep its array, and change it.
        if success.dtype != bool:  # A distance would be true nearly everywhere.
            raise ValueError(
                f"success must be True or False for each environment, got dtype {success.dtype}."
            )
        return reward[:, None], np.stack(costs, axis=1), success[:, None]

    def _pack(self, **arrays: np.ndarray) -> TensorDict:
        tensors = {
            name: torch.from_numpy(array.astype(bool if array.dtype == bool else np.float32))
            for name, array in arrays.items()
        }
        return TensorDict(tensors, batch_size=self.batch_size, device=self.device)
