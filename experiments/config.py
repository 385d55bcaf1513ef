"""What `make train` can be told: every option, with its default."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from time import strftime
from typing import Any, Literal

import tyro

from experiments.options import check_once, short_help
from torchrl_safe._checks import check_count, check_not_negative, check_positive
from torchrl_safe._cores import cores
from torchrl_safe.envs import SUITE, PickAndPlace, Push, Reach

Action = Literal["cartesian", "joint"]
Observation = Literal["full", "paper"]
AlgorithmName = Literal[
    "ppo",
    "ppo-shield",
    "ppo-lagrangian-shield",
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
SuiteTaskName = Literal[
    "panda-reach-in-front",
    "panda-reach-scattered",
    "ur5-reach-moving",
    "panda-reach-human",
    "iiwa-reach-joints",
    "xarm6-push-in-front",
    "panda-push-human",
    "panda-pick-in-front",
    "ur10-pick-workspace",
    "xarm7-pick-scattered",
]
CostName = Literal[
    "collision",
    "contact-force",
    "correction",
    "joint-limit",
    "proximity",
    "separation",
    "speed",
]
MultiplierRule = Literal["pid", "dual-ascent", "fixed"]
#: The algorithms that learn from replay; they need bounded actions.
OFF_POLICY: tuple[AlgorithmName, ...] = ("sac-lagrangian", "td3-lagrangian")
#: Those that train with a shield.
SHIELDED: tuple[AlgorithmName, ...] = ("ppo-shield", "ppo-lagrangian-shield")
#: Options that a task of the suite sets.
SET_BY_SUITE = (
    "arm", "task", "obstacles", "action", "observation", "paper", "costs", "cost_limit",
)  # fmt: skip


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
    suite_task: SuiteTaskName | None = None
    """Train in a task of the suite: its arm, obstacles, actions, costs and their limits, with the
    settings that all tasks of its kind have."""
    algorithms: tuple[AlgorithmName, ...] = ("ppo", "ppo-lagrangian")
    """Algorithms to train; ppo is PPO-Lagrangian with its multiplier fixed at 0. ppo-shield is ppo
    with a shield, which corrects actions so that the arm stays clear of obstacles while it learns.
    With ppo-lagrangian-shield and a limit on the correction, the policy needs no shield later."""
    own_settings: bool = True
    """Let algorithms set options that are at their defaults; make train says which. With
    --no-own-settings they do not, so that --frames 128000 is 128,000 for all of them."""
    shield: bool = False
    """Train ppo-shield as well, and draw the collisions summed over all of training."""
    cost_limit: float = 0.5
    """Limit of the expected cost of an episode: control steps in which the arm collides."""
    costs: dict[CostName, float] = dataclasses.field(default_factory=dict)
    """Several costs instead, each with its limit: --costs collision 0.5 speed 2. The speed is that
    of the tool above 1 m/s; the others are as the library has them by default. The correction needs
    an algorithm with a shield."""
    frames: int = 128_000
    """Control steps to train for, with each algorithm."""
    demonstrations: int = 0
    """Control steps that a scripted pilot demonstrates before the training; the policy imitates
    them."""
    care: Literal["careful", "hurried"] = "careful"
    """How the scripted pilot demonstrates; a hurried one exceeds limits, so the policy begins with
    the task learnt, and has to learn the limits."""
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
    """TorchRL logger; install wandb or mlflow yourself."""
    resume: bool = False
    """Resume the run in the folder, which must have the same settings; without a run there, begin
    one."""
    checkpoint_every: int = 10
    """Batches between two checkpoints: a resumed run repeats at most so many."""
    eval_episodes: int = 256
    """Episodes of the final evaluation, with the deterministic policy."""
    frames_per_batch: int = 1024
    """Control steps between two updates of the policy."""
    epochs: int = 10
    """Passes over each batch; a2c-lagrangian makes one. Has no effect off policy."""
    minibatch: int = 256
    """Control steps in a minibatch."""
    learning_rate: float = 5e-4
    """Adam's learning rate of the policy at the start, half that of the critics. Off policy, all
    networks have twice that rate. Rates fall linearly to 0."""
    episode_steps: int | None = None
    """Control steps after which a training episode is cut off; by default the limit of the
    environment, to which evaluations always play."""
    hidden: int = 64
    """Units in each of the two hidden layers of every network."""
    # Wide noise exceeds a small limit by itself. Multipliers then rise before the task is learnt.
    first_log_std: float = -1.0
    """Logarithm of the policy's standard deviation at the start, before the squashing. Algorithms
    that learn off policy have noise of their own."""
    last_log_std: float = -1.5
    """The same at the end; it moves from one to the other linearly."""
    gamma: float = 0.97
    """Discount of reward and cost."""
    multiplier_rule: MultiplierRule = "pid"
    """What moves the multiplier: the sum of all violations and the last one (pid), the sum alone
    (dual-ascent), or nothing (fixed)."""
    multiplier_init: float = 0.0
    """Multiplier to start with."""
    multiplier_rate: float = 0.1
    """What a batch far above its limit adds to the multiplier."""
    limit_share: float = 0.7
    """Share of each limit that training aims at; reports have the whole limit. Less than 1 leaves a
    margin: costs may drift faster than the multiplier follows, and a policy may cost more without
    its noise, and in another engine. A budget, of ppo-saute and ppo-early-termination, is all of
    the limit."""
    pessimism: float = 2.0
    """Standard errors added to the mean cost of a batch: twice as many with cpo and pcpo, none
    with p3o and ipo."""

    def __post_init__(self) -> None:
        counts = ("frames", "envs", "workers", "jobs", "eval_episodes", "frames_per_batch")
        more = ("epochs", "minibatch", "checkpoint_every", "episode_steps", "hidden")
        values = {name: getattr(self, name) for name in (*counts, *more)}
        check_count(**{name: value for name, value in values.items() if value is not None})
        for name in ("first_log_std", "last_log_std"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}.")
        check_positive(learning_rate=self.learning_rate, multiplier_rate=self.multiplier_rate)
        check_not_negative(
            cost_limit=self.cost_limit,
            multiplier_init=self.multiplier_init,
            pessimism=self.pessimism,
        )
        if not 0 < self.limit_share <= 1:
            raise ValueError(
                f"limit_share must be more than 0 and at most 1, got {self.limit_share}."
            )
        if not 0 < self.gamma < 1:
            raise ValueError(f"gamma must be between 0 and 1, got {self.gamma}.")
        for name in ("demonstrations", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}.")
        if self.demonstrations and self.action == "joint":
            raise ValueError(
                f"demonstrations must be 0 with joint actions, got {self.demonstrations}: pilots "
                "say where the tool is to go."
            )
        check_once("algorithms", self.algorithms)
        for cost, limit in self.costs.items():
            if not 0 <= limit < math.inf:
                raise ValueError(f"costs must have limits of at least 0, got {limit} for {cost}.")
        self._refuse("paper", self.paper, "arm", "task", "obstacles", "physics", "costs")
        self._refuse("suite_task", self.suite_task is not None, *SET_BY_SUITE)
        self._refuse("costs", bool(self.costs), "cost_limit")
        if self.paper and set(SHIELDED) & set(self.chosen):
            raise ValueError("shield must be False with paper, whose environment has none.")
        if "correction" in self.costs and not set(SHIELDED) >= set(self.chosen):
            raise ValueError(
                f"costs must not contain correction with algorithms without a shield, got "
                f"{self.chosen}."
            )
        if [*self.costs] == ["correction"]:
            raise ValueError(
                "costs must contain another cost beside correction, such as collision: that is "
                "what is left without the shield."
            )
        for name in self.algorithms:
            if self.paper and name in OFF_POLICY:
                raise ValueError(
                    f"algorithms must not contain {name} with paper: it needs bounded actions."
                )
            if name in ("cpo", "pcpo") and len(self.cost_limits) > 1:
                raise ValueError(
                    f"algorithms must not contain {name} with several costs, got "
                    f"{', '.join(self.cost_limits)}: it limits one."
                )
            if self.demonstrations and name in OFF_POLICY:
                raise ValueError(
                    f"demonstrations must be 0 with {name}, which learns off policy, got "
                    f"{self.demonstrations}."
                )
            if name == "ppo-saute" and not all(self.cost_limits.values()):
                limits = ", ".join(f"{cost} {limit:g}" for cost, limit in self.cost_limits.items())
                raise ValueError(f"cost_limit must be positive with ppo-saute, got {limits}.")
        if self.envs % self.processes:
            raise ValueError(
                f"envs must be a multiple of workers, got {self.envs} and {self.processes}."
            )
        if self.frames_per_batch % self.envs:
            raise ValueError(
                f"frames_per_batch must be a multiple of envs, got {self.frames_per_batch} and "
                f"{self.envs}."
            )

    def _refuse(self, option: str, given: bool, *others: str) -> None:
        """Raises unless each of the others is at its default where an option is given."""
        defaults = {field.name: field for field in dataclasses.fields(self)}
        for name in others if given else ():
            value, field = getattr(self, name), defaults[name]
            own = field.default if field.default_factory is dataclasses.MISSING else {}
            if value != own and option in ("suite_task", "costs"):
                raise ValueError(
                    f"{name} must not be given with {option}, which sets it, got {value}."
                )
            if value != own:
                raise ValueError(f"{name} must be {own} with {option}, got {value}.")

    @property
    def cost_limits(self) -> dict[str, float]:
        """The limit of each cost, by its name and in the order of the costs."""
        if self.suite_task is not None:
            return dict(SUITE[self.suite_task].cost_limits)
        chosen = {str(name): limit for name, limit in self.costs.items()}
        return chosen or {"collision": self.cost_limit}

    @property
    def aims(self) -> dict[str, float]:
        """What training takes for the limits: ``limit_share`` of each."""
        return {name: self.limit_share * limit for name, limit in self.cost_limits.items()}

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
        return 1 if self.physics == "bullet" else cores()


# Four times as many episodes in a batch: a mean of more of them tells a rare cost from none.
_LARGE = {
    "envs": 64,
    "frames_per_batch": 4096,
    "minibatch": 512,
    "hidden": 128,
    "learning_rate": 1e-3,
}
# The demonstrations do the task and do not keep its limits, which are left to learn.
_HANDLING = {**_LARGE, "care": "hurried", "frames": 262_144}
# More noise pushes the cube away, and the hand against what is beside it. With as little noise a
# rate of 1e-3 undoes what was imitated, and leaves states in which the arm gets stuck.
_PUSHING = {
    **_HANDLING,
    "learning_rate": 3e-4,
    "demonstrations": 98_304,
    "first_log_std": -1.7,
    "last_log_std": -2.5,
}
# With less noise in the end, the limit is kept too late.
_PICKING = {
    **_HANDLING,
    "frames": 393_216,
    "demonstrations": 65_536,
    "first_log_std": -1.2,
    "last_log_std": -2.0,
}
#: The kinds of task, by the names that options give them.
TASKS: dict[str, type] = {"reach": Reach, "push": Push, "pick-and-place": PickAndPlace}
# What differs between reaching, pushing and picking up; within a kind of task nothing does.
KINDS: dict[type, dict[str, Any]] = {Reach: {}, Push: _PUSHING, PickAndPlace: _PICKING}

# Less noise in the end than otherwise, but some: without any, an arm in contact would stay there.
_SUITE_KINDS = {**KINDS, Reach: {**_LARGE, "last_log_std": -2.0}}

#: How ``--help`` groups the options.
GROUPS = {
    "What to train in": (
        "task", "arm", "obstacles", "action", "observation", "physics", "suite_task", "paper",
    ),
    "What to train": (
        "algorithms", "own_settings", "shield", "cost_limit", "costs", "frames", "seed",
    ),
    "The run": ("out", "resume", "logger", "checkpoint_every", "eval_episodes"),
    "Speed": ("envs", "workers", "jobs"),
    "Learning": (
        "frames_per_batch", "epochs", "minibatch", "learning_rate", "gamma", "hidden",
        "first_log_std", "last_log_std", "episode_steps", "demonstrations", "care",
    ),
    "The multiplier": (
        "multiplier_rule", "multiplier_init", "multiplier_rate", "limit_share", "pessimism",
    ),
}  # fmt: skip
_MORE = (
    "Values shown are the defaults. --help-all says more about each option, with all choices.\n"
    'Example: make train ARGS="--physics mujoco --obstacles human --cost-limit 1"'
)


def suite_config(name: SuiteTaskName, **others: Any) -> Config:
    """Returns what a task of the suite is trained with.

    Args:
        name: the task.
        **others: other fields of :class:`Config`.

    Raises:
        ValueError: if there is no such task, or a field is not usable with it.
    """
    if name not in SUITE:
        raise ValueError(f"suite_task must be one of {', '.join(SUITE)}, got {name!r}.")
    task = SUITE[name]
    chosen = {**_SUITE_KINDS[type(task.task)], "frames": task.frames, **others}
    return Config(**{**chosen, "suite_task": name})


def command_line(arguments: Sequence[str] | None = None) -> Config:
    """Reads the options; what is not given is what the task of the suite has, if one is named."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--suite-task", "--suite_task", choices=[*SUITE])
    first.add_argument("--task", default="reach")
    first.add_argument("-h", "--help", action="store_true")
    first.add_argument("--help-all", "--help_all", action="store_true")
    known, _ = first.parse_known_args(arguments)
    if known.suite_task is not None:
        default = suite_config(known.suite_task)
    else:
        default = Config(**KINDS[TASKS.get(known.task, Reach)])
    if known.help:
        print(f"{Config.__doc__}\n\n{short_help(default, GROUPS)}\n\n{_MORE}")
        raise SystemExit
    return tyro.cli(Config, args=["--help"] if known.help_all else arguments, default=default)
