"""The environment: arms, actions, tasks, obstacles and costs put together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl._utils import seed_generator
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_safe.envs.actions import ActionMode, CartesianDelta
from torchrl_safe.envs.arms import PANDA, ArmModel
from torchrl_safe.envs.bullet import World
from torchrl_safe.envs.costs import Collision
from torchrl_safe.envs.observations import full_observation
from torchrl_safe.envs.obstacles import InFront, Obstacles
from torchrl_safe.envs.scene import SUBSTEP, Camera, Scene
from torchrl_safe.envs.state import ArmState, Array
from torchrl_safe.envs.tasks import Reach, Task

Cost = Callable[[ArmState], Array]


class ArmEnv(EnvBase):
    """A robot arm that has a task to do and costs to keep low.

    Natively batched: every row is a PyBullet world of its own, all in this process. What can
    be chosen is passed as an object: any arm with any action, task, obstacles and costs.

    The keys, for N worlds and k costs: ``observation`` (N, width), ``action`` (N, width), and
    under ``"next"`` also ``reward`` (N, 1), ``cost`` (N, k), ``success`` (N, 1), ``terminated``
    (N, 1; the task is done), ``truncated`` (N, 1; the time is up) and ``done`` (N, 1).
    ``cost`` stands in the reward spec, so that
    ``RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])`` sums both.

    Args:
        arm (ArmModel, optional): the arm. Defaults to ``PANDA``.

    Keyword Args:
        num_envs (int, optional): number N of worlds. Defaults to ``1``.
        action (ActionMode, optional): what an action does. Actions beyond its bound (here 1)
            are clipped. Defaults to ``CartesianDelta()``.
        task (Task, optional): goal, reward and success. Defaults to ``Reach()``.
        obstacles (Obstacles, optional): what stands where. Defaults to ``InFront()``.
        costs (Mapping[str, Callable], optional): the costs by name, each a callable from
            :class:`~torchrl_safe.envs.ArmState` to an array of shape ``(N,)``. They are read
            over all physics substeps. Defaults to ``{"collision": Collision()}``.
        observation (Callable, optional): maps the state to named fields, which are
            concatenated. Defaults to :func:`~torchrl_safe.envs.full_observation`.
        frame_skip (int, optional): physics substeps of 1/240 s for each action. Defaults to
            ``12``: a control rate of 20 Hz.
        max_episode_steps (int, optional): time limit; sets ``truncated``. Defaults to ``40``,
            2 s at 20 Hz.
        scene (Scene, optional): how the world is simulated. Defaults to ``Scene()``.
        seed (int, optional): seed of the goals and obstacles. Every row has a generator of its
            own; the seeds follow TorchRL's chain, so that two environments of one world in a
            ``ParallelEnv`` draw what one environment of two worlds draws.
        device (torch.device, optional): device of the tensors. Defaults to ``None``.
        gui (bool, optional): show the first world in PyBullet's window. Defaults to ``False``.

    Raises:
        ValueError: if an argument is not usable, or an action, reward or cost is NaN or has
            the wrong shape.

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
    _supports_set_state = False

    def __init__(
        self,
        arm: ArmModel = PANDA,
        *,
        num_envs: int = 1,
        action: ActionMode = CartesianDelta(),
        task: Task = Reach(),
        obstacles: Obstacles = InFront(),
        costs: Mapping[str, Cost] | None = None,
        observation: Callable[[ArmState], dict[str, Array]] = full_observation,
        frame_skip: int = 12,
        max_episode_steps: int = 40,
        scene: Scene = Scene(),
        seed: int | None = None,
        device: torch.device | str | None = None,
        gui: bool = False,
    ) -> None:
        for name, number in (
            ("num_envs", num_envs),
            ("frame_skip", frame_skip),
            ("max_episode_steps", max_episode_steps),
        ):
            if not (isinstance(number, int) and number >= 1):
                raise ValueError(f"{name} must be a whole number of at least 1, got {number!r}.")
        costs = {"collision": Collision()} if costs is None else dict(costs)
        if not costs:
            raise ValueError("costs must name at least one cost, got an empty mapping.")
        super().__init__(device=device, batch_size=(num_envs,))
        self.arm = arm
        self.action_mode = action
        self.task = task
        self.obstacles = obstacles
        self.costs = costs
        self.frame_skip = frame_skip
        self.max_episode_steps = max_episode_steps
        self._observation = observation
        self._scene = scene
        self._picture_world: World | None = None
        shapes = obstacles.shapes
        self._obstacle_size = np.array([s.half_extents for s in shapes]).reshape(-1, 3)
        self._elapsed = np.zeros(num_envs, dtype=int)
        self._rows: list[tuple[float, ...]] = [()] * num_envs
        self._worlds: list[World] = []
        try:
            for index in range(num_envs):
                self._worlds.append(World(arm, scene, shapes, gui=gui and index == 0))
            self._make_specs()
        except BaseException:
            self._close_worlds()
            raise
        self.set_seed(seed)

    @property
    def num_envs(self) -> int:
        """Number of worlds."""
        return len(self._worlds)

    @property
    def cost_names(self) -> tuple[str, ...]:
        """Names of the costs, in the order of the columns of ``cost``."""
        return tuple(self.costs)

    @property
    def arm_state(self) -> ArmState:
        """The state after the last step or reset: what tasks and costs have read."""
        return self._state

    @property
    def control_rate(self) -> float:
        """Actions a second, Hz."""
        return 1 / (SUBSTEP * self.frame_skip)

    def _make_specs(self) -> None:
        # Everything the arguments can get wrong shows here, before anything is lost.
        for row in range(self.num_envs):
            self._reset_world(row, np.random.default_rng(0))
        self._state = self._make_state(self._no_contact())
        self._costs_of(self._state)
        fields = self._observation(self._state)
        ends = np.cumsum([field.shape[1] for field in fields.values()])
        self.observation_fields = {
            name: slice(int(end) - field.shape[1], int(end))
            for (name, field), end in zip(fields.items(), ends, strict=True)
        }
        batch, device = self.batch_size, self.device
        self.observation_spec = Composite(
            observation=Unbounded((*batch, int(ends[-1])), device=device),
            success=Binary(1, shape=(*batch, 1), dtype=torch.bool, device=device),
            shape=batch,
        )
        shape = (*batch, self.action_mode.width(self._state.joint_position.shape[1]))
        bound = self.action_mode.bound
        self.action_spec = (
            Bounded(-bound, bound, shape, device=device, dtype=torch.float32)
            if np.isfinite(bound)
            else Unbounded(shape, device=device)
        )
        self.reward_spec = Composite(
            reward=Unbounded((*batch, 1), device=device),
            cost=Unbounded((*batch, len(self.costs)), device=device),
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
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        rows = range(self.num_envs) if chosen is None else chosen.flatten().nonzero().flatten()
        for row in rows:
            self._reset_world(int(row), self._generators[int(row)])
        self._state = self._make_state(self._no_contact())
        return self._pack(
            observation=self._observe(self._state),
            success=np.zeros((self.num_envs, 1), dtype=bool),
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._check_action(tensordict.get("action"))
        joints, fingers = self.action_mode.targets(action, self._state, self._worlds)
        distances = [
            world.advance(joint_target, finger_target, self.frame_skip)
            for world, joint_target, finger_target in zip(
                self._worlds, joints.tolist(), fingers.tolist(), strict=True
            )
        ]
        self._rows = [world.read() for world in self._worlds]
        self._elapsed += 1
        self._state = state = self._make_state(np.reshape(distances, (self.num_envs, -1)))
        success = self.task.success(state)[:, None]
        truncated = (self._elapsed >= self.max_episode_steps)[:, None] & ~success
        return self._pack(
            observation=self._observe(state),
            success=success,
            reward=_checked("reward", self.task.reward(state), self.num_envs)[:, None],
            cost=self._costs_of(state),
            terminated=success,
            truncated=truncated,
            done=success | truncated,
        )

    def _set_seed(self, seed: int | None) -> None:
        self._generators = []
        for _ in range(self.num_envs):
            self._generators.append(np.random.default_rng(seed))
            seed = None if seed is None else seed_generator(seed)
        self._next_seed = seed

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds every row and returns the seed for the next environment.

        TorchRL's own method advances its chain of seeds by one; this one advances it by one
        for each row, so that the rows of the next worker do not repeat those of this one.
        """
        self._set_seed(seed)
        return seed if static_seed else self._next_seed

    def render(self, width: int = 320, height: int = 240, camera: Camera = Camera()) -> Tensor:
        """Draws every world.

        Args:
            width: width in pixels.
            height: height in pixels.
            camera: where to look from.

        Returns:
            RGB pictures, uint8, shape ``(N, height, width, 3)``.
        """
        if self._picture_world is None:
            self._picture_world = World(self.arm, self._scene, self.obstacles.shapes, visuals=True)
        pictures = []
        for world in self._worlds:
            self._picture_world.copy_from(world)
            pictures.append(self._picture_world.picture(camera, width, height))
        return torch.from_numpy(np.stack(pictures))

    def close(self, *, raise_if_closed: bool = True) -> None:
        super().close(raise_if_closed=raise_if_closed)
        self._close_worlds()

    def _close_worlds(self) -> None:
        for world in self._worlds:
            world.close()
        if self._picture_world is not None:
            self._picture_world.close()

    def _check_action(self, action: Tensor) -> Array:
        shape = self.action_spec.shape
        if action.shape != shape:
            raise ValueError(f"action must have shape {tuple(shape)}, got {tuple(action.shape)}.")
        array = action.detach().cpu().numpy().astype(float)
        if not np.isfinite(array).all():
            rows = np.flatnonzero(~np.isfinite(array).all(axis=1)).tolist()
            raise ValueError(f"action must be finite, got NaN or infinity in rows {rows}.")
        return np.clip(array, -self.action_mode.bound, self.action_mode.bound)

    def _reset_world(self, row: int, generator: np.random.Generator) -> None:
        world = self._worlds[row]
        goal = self.task.sample_goal(generator)
        start = np.array(world.home_position)
        world.reset(self.obstacles.sample(generator, start, goal), goal)
        self._rows[row] = world.read(fresh=True)
        self._elapsed[row] = 0

    def _no_contact(self) -> Array:
        return np.full((self.num_envs, len(self._obstacle_size)), np.inf)

    def _make_state(self, contact_distance: Array) -> ArmState:
        table = np.array(self._rows)
        widths = self._worlds[0].widths()
        columns = np.split(table, np.cumsum([*widths.values()])[:-1], axis=1)
        parts = dict(zip(widths, columns, strict=True))
        for name in ("obstacle_position", "obstacle_velocity"):
            parts[name] = parts[name].reshape(self.num_envs, -1, 3)
        return ArmState(
            **parts,
            joint_lower=self._worlds[0].joint_lower,
            joint_upper=self._worlds[0].joint_upper,
            obstacle_size=self._obstacle_size,
            contact_distance=contact_distance,
        )

    def _observe(self, state: ArmState) -> Array:
        return np.concatenate([*self._observation(state).values()], axis=1)

    def _costs_of(self, state: ArmState) -> Array:
        columns = [
            _checked(f"cost {name!r}", cost(state), self.num_envs)
            for name, cost in self.costs.items()
        ]
        return np.stack(columns, axis=1)

    def _pack(self, **arrays: np.ndarray) -> TensorDict:
        tensors = {
            name: torch.from_numpy(array if array.dtype == bool else array.astype(np.float32))
            for name, array in arrays.items()
        }
        return TensorDict(tensors, batch_size=self.batch_size, device=self.device)


def _checked(name: str, values: Array, num_envs: int) -> Array:
    if np.shape(values) != (num_envs,):
        raise ValueError(f"{name} must have shape ({num_envs},), got {np.shape(values)}.")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite, got {values}.")
    return values
