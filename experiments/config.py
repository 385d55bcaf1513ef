"""What `make train` can be told: every option, with its default."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from time import strftime
from typing import Literal

Action = Literal["cartesian", "joint"]
Observation = Literal["full", "paper"]
AlgorithmName = Literal[
    "ppo",
    "ppo-shield",
    "ppo-lagrangian",
    "kl-ppo-lagrangian",
    "a2c-lagrangian",
    "trpo",
    "trpo-lagrangian",
    "cpo",
    "pcpo",
    "focops",
    "cup",
    "p3o",
    "ipo",
    "crpo",
    "ppo-saute",
    "ppo-early-termination",
    "sac-lagrangian",
    "td3-lagrangian",
]
Engine = Literal["bullet", "mujoco"]
MultiplierRule = Literal["pid", "dual-ascent", "fixed"]
#: The algorithms that learn from replay; they need bounded actions.
OFF_POLICY: tuple[AlgorithmName, ...] = ("sac-lagrangian", "td3-lagrangian")


@dataclasses.dataclass(frozen=True)
class Config:
    """Train PPO and PPO-Lagrangian on a robot arm and compare them."""

    arm: Literal["panda", "iiwa", "xarm6", "xarm7", "ur5", "ur10"] = "panda"
    """Robot arm."""
    task: Literal["reach", "push", "pick-and-place"] = "reach"
    """What the arm is to do."""
    obstacles: Literal["none", "in-front", "scattered", "moving", "human"] = "in-front"
    """What is in the way."""
    action: Action = "cartesian"
    """What an action moves: the tool point, by inverse kinematics, or each joint."""
    observation: Observation = "full"
    """What the policy sees: all that moves, or the paper's eight numbers."""
    physics: Engine = "bullet"
    """Engine that simulates the arm; mujoco is several times as fast, and needs that extra."""
    paper: bool = False
    """Train in the paper's environment: its Panda, obstacle and actions, at 240 Hz."""
    algorithms: tuple[AlgorithmName, ...] = ("ppo", "ppo-lagrangian")
    """What to train; ppo is PPO-Lagrangian with its multiplier fixed at 0, and ppo-shield the same
    with a filter of its actions that keeps the arm off the obstacles while it learns."""
    shield: bool = False
    """Train ppo-shield as well, and draw the collisions summed over all of training."""
    cost_limit: float = 0.5
    """Limit of the expected cost of an episode: control steps in which the arm collides."""
    frames: int = 128_000
    """Control steps to train for, with each algorithm."""
    envs: int = 32
    """Simulated worlds, shared among the workers."""
    workers: int | None = None
    """Processes that simulate; with 1 this process does. By default 2 with bullet, and 1 with
    mujoco, which has threads instead. Another number gives other episodes."""
    jobs: int | None = None
    """Algorithms that train side by side, each in a process. By default 1 with bullet, whose
    simulation takes all cores, and one for each core with mujoco."""
    seed: int = 0
    """Seed of networks, environments and minibatches."""
    out: Path = dataclasses.field(
        default_factory=lambda: Path("runs", strftime("%Y-%m-%d_%H-%M-%S"))
    )
    """Folder for logs, checkpoints, results.json and pictures; named by date and time."""
    logger: Literal["csv", "tensorboard", "wandb", "mlflow"] = "csv"
    """TorchRL logger; wandb and mlflow are to be installed by you."""
    resume: bool = False
    """Go on with the run in the folder where it was stopped, with the settings it has; if there
    is none, begin it."""
    checkpoint_every: int = 10
    """Batches between two checkpoints: what a run that is stopped has to do again at most."""
    eval_episodes: int = 256
    """Episodes of the final evaluation, with the deterministic policy."""
    frames_per_batch: int = 1024
    """Control steps between two updates of the policy."""
    epochs: int = 10
    """Passes over each batch."""
    minibatch: int = 256
    """Control steps in a minibatch."""
    learning_rate: float = 5e-4
    """Adam's learning rate of the policy at the start, half that of the critics; both fall
    linearly to 0. Off policy all networks have twice as much, and keep it."""
    episode_steps: int | None = None
    """Control steps after which an episode to learn from is cut off, if not at the limit of the
    environment; evaluations always play to that."""
    hidden: int = 64
    """Units in each of the two hidden layers of every network."""
    first_log_std: float = 0.0
    """Logarithm of the policy's standard deviation at the start, before the squashing."""
    last_log_std: float = -1.5
    """The same at the end; it moves from one to the other linearly."""
    gamma: float = 0.97
    """Discount of reward and cost."""
    multiplier_rule: MultiplierRule = "pid"
    """What moves the multiplier: the violations added up and the last one (pid), those added up
    alone, or nothing."""
    multiplier_init: float = 0.0
    """Multiplier to start with."""
    multiplier_rate: float = 0.2
    """What a batch far above its limit adds to the multiplier."""
    pessimism: float = 2.0
    """Standard errors added to the mean cost of a batch before it is compared with the limit; p3o,
    ipo and crpo do without."""

    def __post_init__(self) -> None:
        counts = ("frames", "envs", "workers", "jobs", "eval_episodes", "frames_per_batch")
        more = ("epochs", "minibatch", "checkpoint_every", "episode_steps", "hidden")
        for name in (*counts, *more):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        for name in ("first_log_std", "last_log_std"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}.")
        for name in ("learning_rate", "multiplier_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")
        for name in ("cost_limit", "multiplier_init", "pessimism"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}.")
        if not 0 < self.gamma < 1:
            raise ValueError(f"gamma must be between 0 and 1, got {self.gamma}.")
        if not self.algorithms:
            raise ValueError("algorithms must name at least one algorithm, got none.")
        for name in ("arm", "task", "obstacles", "physics"):
            value, own = getattr(self, name), getattr(Config, name)
            if self.paper and value != own:
                raise ValueError(f"{name} must be {own} with paper, got {value}.")
        if self.paper and "ppo-shield" in self.chosen:
            raise ValueError("shield must be False with paper, whose environment has none.")
        for name in self.algorithms:
            if self.paper and name in OFF_POLICY:
                raise ValueError(
                    f"algorithms must not contain {name} with paper: it needs bounded actions."
                )
            if name == "ppo-saute" and not self.cost_limit:
                raise ValueError("cost_limit must be positive with ppo-saute, got 0.")
        if self.envs % self.processes:
            raise ValueError(
                f"envs must be a multiple of workers, got {self.envs} and {self.processes}."
            )
        if self.frames_per_batch % self.envs:
            raise ValueError(
                f"frames_per_batch must be a multiple of envs, got {self.frames_per_batch} and "
                f"{self.envs}."
            )

    @property
    def chosen(self) -> tuple[AlgorithmName, ...]:
        """What to train: ``algorithms``, and what ``shield`` adds."""
        more = self.shield and "ppo-shield" not in self.algorithms
        return (*self.algorithms, "ppo-shield") if more else self.algorithms

    @property
    def processes(self) -> int:
        """Processes that simulate: what ``workers`` says, or what is fastest with the engine."""
        if self.workers is not None:
            return self.workers
        return 2 if self.physics == "bullet" else 1

    @property
    def side_by_side(self) -> int:
        """Algorithms that train at a time: what ``jobs`` says, or what is fastest."""
        if self.jobs is not None:
            return self.jobs
        return 1 if self.physics == "bullet" else os.cpu_count() or 1
