"""Trains PPO and PPO-Lagrangian on a robot arm and compares them.

The main job of the repository: ``make train``. Everything but the environment, the loss and
the multiplier rule is TorchRL's.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from time import perf_counter, strftime
from typing import Any, Literal

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.modules import ProbabilisticActor
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from experiments.agent import make_agent
from experiments.evaluation import evaluate, summarize
from experiments.report import plot_curves, save_animation, save_picture, table
from torchrl_safe.envs import (
    PAPER_CARTESIAN,
    PAPER_JOINT,
    ActionMode,
    ArmEnv,
    CartesianDelta,
    Collision,
    FullObservation,
    Human,
    InFront,
    JointDelta,
    Moving,
    NoObstacles,
    Obstacles,
    Scattered,
    gym,
    paper_env,
    paper_observation,
)
from torchrl_safe.objectives import DualAscent, MultiplierUpdater, PIDControl

Action = Literal["cartesian", "joint"]
Observation = Literal["full", "paper"]
MultiplierRule = Literal["dual-ascent", "pid", "fixed"]
ARMS = {name.lower(): arm for name, arm in gym.ARMS.items()}
OBSTACLES: dict[str, Obstacles] = {
    "none": NoObstacles(),
    "in-front": InFront(),
    "scattered": Scattered(),
    "moving": Moving(),
    "human": Human(),
}
ACTIONS: dict[str, ActionMode] = {"cartesian": CartesianDelta(), "joint": JointDelta()}
PAPER_ACTIONS: dict[str, ActionMode] = {"cartesian": PAPER_CARTESIAN, "joint": PAPER_JOINT}
OBSERVATIONS = {"full": FullObservation(), "paper": paper_observation}
COSTS = {"collision": Collision()}
# Called as rule(loss, rate, cost_limit=, pessimism=, normalize=). The gains stand to each other as
# in tests/test_constrained_optimum.py.
MULTIPLIER_RULES: dict[str, Callable[..., MultiplierUpdater]] = {
    "dual-ascent": lambda loss, rate, **settings: DualAscent(loss, lr=rate, **settings),
    "pid": lambda loss, rate, **settings: PIDControl(
        loss, kp=5 * rate, ki=rate, kd=5 * rate, smoothing=0.5, **settings
    ),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train PPO and PPO-Lagrangian on a robot arm and compare them."""

    arm: Literal["panda", "iiwa", "xarm6", "xarm7", "ur5", "ur10"] = "panda"
    """Robot arm."""
    obstacles: Literal["none", "in-front", "scattered", "moving", "human"] = "in-front"
    """What is in the way."""
    action: Action = "cartesian"
    """What an action moves: the tool point, by inverse kinematics, or each joint."""
    observation: Observation = "full"
    """What the policy sees: all that moves, or the paper's eight numbers."""
    paper: bool = False
    """Train in the paper's environment: its Panda, obstacle and actions, at 240 Hz."""
    algorithms: tuple[Literal["ppo", "ppo-lagrangian"], ...] = ("ppo", "ppo-lagrangian")
    """What to train; ppo is PPO-Lagrangian with its multiplier fixed at 0."""
    cost_limit: float = 0.5
    """Limit of the expected cost of an episode: control steps in which the arm collides."""
    frames: int = 128_000
    """Control steps to train for, with each algorithm."""
    envs: int = 32
    """Simulated worlds, shared among the workers."""
    workers: int = 2
    """Processes that simulate; with 1 this process does."""
    seed: int = 0
    """Seed of networks, environments and minibatches."""
    out: Path = dataclasses.field(
        default_factory=lambda: Path("runs", strftime("%Y-%m-%d_%H-%M-%S"))
    )
    """New folder for logs, checkpoints, results.json and pictures; named by date and time."""
    logger: Literal["csv", "tensorboard", "wandb", "mlflow"] = "csv"
    """TorchRL logger; wandb and mlflow are to be installed by you."""
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
    linearly to 0."""
    gamma: float = 0.97
    """Discount of reward and cost."""
    multiplier_rule: MultiplierRule = "dual-ascent"
    """What moves the multiplier: the violations added up, also the last one and its rise, or
    nothing."""
    multiplier_init: float = 0.0
    """Multiplier to start with."""
    multiplier_rate: float = 0.4
    """Step size of the multiplier, once a batch, in units of the episode cost's standard
    deviation; the integral gain of pid, whose other two gains are five times as large."""
    pessimism: float = 2.0
    """Standard errors added to the mean cost of a batch before it is compared with the limit."""

    def __post_init__(self) -> None:
        counts = ("frames", "envs", "workers", "eval_episodes", "frames_per_batch", "epochs")
        for name in (*counts, "minibatch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
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
        for name, divisor in (("envs", "workers"), ("frames_per_batch", "envs")):
            if getattr(self, name) % getattr(self, divisor):
                raise ValueError(
                    f"{name} must be a multiple of {divisor}, got {getattr(self, name)} and "
                    f"{getattr(self, divisor)}."
                )


def make_env(config: Config, num_envs: int, seed: int | None = None) -> EnvBase:
    """Makes the environment, with the sums of reward and cost over each episode."""
    settings: dict[str, Any] = {
        "observation": OBSERVATIONS[config.observation],
        "num_envs": num_envs,
        "seed": seed,
    }
    if config.paper:
        env = paper_env(PAPER_ACTIONS[config.action], **settings)
    else:
        env = ArmEnv(
            ARMS[config.arm],
            action=ACTIONS[config.action],
            obstacles=OBSTACLES[config.obstacles],
            costs=COSTS,
            **settings,
        )
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    return TransformedEnv(env, sums)


@contextmanager
def collecting(config: Config, policy: TensorDictModule) -> Iterator[BaseCollector]:
    """Opens TorchRL's collector, in this process or in workers, and shuts it down."""
    settings: dict[str, Any] = {
        "frames_per_batch": config.frames_per_batch,
        "total_frames": config.frames,
        "auto_register_policy_transforms": False,
    }
    if config.workers == 1:
        collector = Collector(make_env(config, config.envs), policy, **settings)
    else:
        factory = partial(make_env, config, config.envs // config.workers)
        collector = MultiSyncCollector([factory] * config.workers, policy, **settings)
    collector.set_seed(config.seed)
    try:
        yield collector
    finally:
        collector.shutdown()


def train(
    config: Config, algorithm: str, *, progress: bool = True
) -> tuple[ProbabilisticActor, list[dict[str, float]]]:
    """Trains with one algorithm; returns the policy and a row of figures for each batch."""
    # TorchRL's notes on each buffer would break up the progress bar.
    torchrl_logger.setLevel("WARNING")
    # The networks are small: more threads than one only wait for each other.
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    env = make_env(config, num_envs=8, seed=config.seed)
    constrained = algorithm == "ppo-lagrangian"
    multiplier_init = config.multiplier_init if constrained else 0.0
    actor, loss = make_agent(env, gamma=config.gamma, multiplier_init=multiplier_init)
    env.close()
    updater = None
    if constrained and config.multiplier_rule != "fixed":
        updater = MULTIPLIER_RULES[config.multiplier_rule](
            loss,
            config.multiplier_rate,
            cost_limit=config.cost_limit,
            pessimism=config.pessimism,
            normalize=True,
        )
    policy = list(loss.actor_network_params.values(True, True))
    critics = [*loss.critic_network_params.values(True, True)]
    critics += loss.cost_critic_network_params.values(True, True)
    optimizer = torch.optim.Adam(
        [
            {"params": policy, "lr": config.learning_rate},
            {"params": critics, "lr": 2 * config.learning_rate},
        ]
    )
    batches = math.ceil(config.frames / config.frames_per_batch)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=batches)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(config.frames_per_batch),
        sampler=SamplerWithoutReplacement(),
        batch_size=config.minibatch,
    )
    logger = get_logger(config.logger, str(config.out / "logs"), algorithm)
    history, frames = [], 0
    with (
        collecting(config, actor) as collector,
        tqdm(
            total=config.frames, desc=algorithm, unit="frame", unit_scale=True, disable=not progress
        ) as bar,
    ):
        for batch in collector:
            episodes = batch["next"][batch["next", "done"].squeeze(-1)]
            if updater is not None:
                updater.step(episodes["episode_cost"])
            buffer.extend(loss.estimate_advantages(batch).reshape(-1))
            for _ in range(config.epochs):
                for minibatch in buffer:
                    losses = loss(minibatch)
                    sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
                    torch.nn.utils.clip_grad_norm_(policy, 0.5)
                    optimizer.step()
                    optimizer.zero_grad()
            schedule.step()
            collector.update_policy_weights_()
            frames += batch.numel()
            bar.update(batch.numel())
            row = figures(episodes, loss.lagrange_multiplier)
            bar.set_postfix({name: f"{value:.2f}" for name, value in row.items()})
            logger.log_metrics(row, step=frames)
            history.append({"frames": frames, **row})
    state = {"loss": loss, "optimizer": optimizer, "schedule": schedule}
    if updater is not None:
        state["updater"] = updater
    Checkpoint(**state).save(config.out / algorithm / "checkpoint")
    return actor, history


def figures(episodes: TensorDictBase, multiplier: torch.Tensor) -> dict[str, float]:
    """Means over the episodes that ended in a batch (none if no episode did), and multipliers."""
    multipliers = {
        f"multiplier/{name}": value for name, value in zip(COSTS, multiplier.tolist(), strict=True)
    }
    if not len(episodes):
        return multipliers
    costs = episodes["episode_cost"].mean(0).tolist()
    return {
        "return": episodes["episode_reward"].mean().item(),
        **{f"cost/{name}": cost for name, cost in zip(COSTS, costs, strict=True)},
        "success": episodes["success"].float().mean().item(),
        **multipliers,
    }


def train_and_evaluate(
    config: Config, algorithm: str, *, progress: bool = True
) -> tuple[ProbabilisticActor, dict[str, Any]]:
    """Trains with one algorithm and plays with what it has learnt; returns policy and results."""
    start = perf_counter()
    actor, history = train(config, algorithm, progress=progress)
    seconds = perf_counter() - start
    env = make_env(config, num_envs=32)
    # Seeds that training does not use.
    episodes = evaluate(env, actor, config.eval_episodes, seed=config.seed + 1_000_000)
    env.close()
    return actor, {
        "seconds": seconds,
        "history": history,
        "evaluation": summarize(episodes, tuple(COSTS)),
        "episodes": {name: value.tolist() for name, value in episodes.items()},
    }


def main(config: Config) -> None:
    """Trains and evaluates each algorithm, then writes the comparison."""
    if config.out.exists() and any(config.out.iterdir()):
        raise FileExistsError(f"out must be a new or empty folder, got {str(config.out)!r}.")
    config.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {
        "config": dataclasses.asdict(config),
        "versions": {name: version(name) for name in ("torch", "torchrl", "pybullet")},
        "algorithms": {},
    }
    stage = make_env(config, num_envs=1, seed=config.seed)
    save_picture(stage, config.out / "scene.png")
    for algorithm in config.algorithms:
        actor, results["algorithms"][algorithm] = train_and_evaluate(config, algorithm)
        save_animation(stage, actor, config.out / algorithm / "policy.gif")
        (config.out / "results.json").write_text(json.dumps(results, indent=1, default=str))
    stage.close()
    plot_curves(results, config.out / "curves.png")
    text = table(results)
    (config.out / "table.md").write_text(text)
    print(f"\n{text}\nResults are in {config.out}.")


if __name__ == "__main__":
    main(tyro.cli(Config))
