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
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ValueEstimators
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from experiments.evaluation import evaluate, summarize
from experiments.report import plot_curves, save_animation, save_picture, table
from torchrl_safe.envs import (
    ActionMode,
    ArmEnv,
    CartesianDelta,
    Collision,
    Human,
    InFront,
    JointDelta,
    Moving,
    NoObstacles,
    Obstacles,
    Scattered,
    gym,
)
from torchrl_safe.objectives import DualAscent, MultiplierUpdater, PIDControl, PPOLagrangianLoss

ARMS = {name.lower(): arm for name, arm in gym.ARMS.items()}
OBSTACLES: dict[str, Obstacles] = {
    "none": NoObstacles(),
    "in-front": InFront(),
    "scattered": Scattered(),
    "moving": Moving(),
    "human": Human(),
}
ACTIONS: dict[str, ActionMode] = {"cartesian": CartesianDelta(), "joint": JointDelta()}
COSTS = {"collision": Collision()}
# Called as rule(loss, limit, rate). The gains stand to each other as in
# tests/test_constrained_optimum.py.
MULTIPLIER_RULES: dict[str, Callable[[PPOLagrangianLoss, float, float], MultiplierUpdater]] = {
    "dual-ascent": lambda loss, limit, rate: DualAscent(loss, cost_limit=limit, lr=rate),
    "pid": lambda loss, limit, rate: PIDControl(
        loss, cost_limit=limit, kp=5 * rate, ki=rate, kd=5 * rate, smoothing=0.5
    ),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train PPO and PPO-Lagrangian on a robot arm and compare them."""

    arm: Literal["panda", "iiwa", "xarm6", "xarm7", "ur5", "ur10"] = "panda"
    """Robot arm."""
    obstacles: Literal["none", "in-front", "scattered", "moving", "human"] = "in-front"
    """What is in the way."""
    action: Literal["cartesian", "joint"] = "cartesian"
    """What an action moves: the tool point, by inverse kinematics, or each joint."""
    algorithms: tuple[Literal["ppo", "ppo-lagrangian"], ...] = ("ppo", "ppo-lagrangian")
    """What to train; ppo is PPO-Lagrangian with its multiplier fixed at 0."""
    cost_limit: float = 0.5
    """Limit of the expected cost of an episode: control steps in which the arm collides."""
    frames: int = 256_000
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
    frames_per_batch: int = 2048
    """Control steps between two updates of the policy."""
    epochs: int = 10
    """Passes over each batch."""
    minibatch: int = 256
    """Control steps in a minibatch."""
    learning_rate: float = 5e-4
    """Adam's learning rate at the start, of all three networks; it falls linearly to 0."""
    gamma: float = 0.97
    """Discount of reward and cost."""
    multiplier_rule: Literal["dual-ascent", "pid"] = "dual-ascent"
    """What moves the multiplier: the violations added up, or also the last one and its rise."""
    multiplier_rate: float = 0.2
    """Multiplier added for each unit of violated cost, once a batch; the integral gain of pid,
    whose other two gains are five times as large."""
    margin: float = 0.4
    """Share of the cost limit held back in training. A limit that binds is met on average only:
    policies trained for exactly the limit are found above it about as often as below."""

    def __post_init__(self) -> None:
        counts = ("frames", "envs", "workers", "eval_episodes", "frames_per_batch", "epochs")
        for name in (*counts, "minibatch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
        for name in ("learning_rate", "multiplier_rate", "gamma"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")
        if not 0 <= self.cost_limit < math.inf:
            raise ValueError(f"cost_limit must not be negative, got {self.cost_limit}.")
        if not 0 <= self.margin < 1:
            raise ValueError(f"margin must be at least 0 and less than 1, got {self.margin}.")
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
    env = ArmEnv(
        ARMS[config.arm],
        action=ACTIONS[config.action],
        obstacles=OBSTACLES[config.obstacles],
        costs=COSTS,
        num_envs=num_envs,
        seed=seed,
    )
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    return TransformedEnv(env, sums)


def make_agent(config: Config) -> tuple[ProbabilisticActor, PPOLagrangianLoss]:
    """Makes the policy, and the loss with the policy, both critics and the multipliers."""
    env = make_env(config, num_envs=1)
    width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    env.close()

    def network(outputs: int) -> MLP:
        net = MLP(width, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
        # Nearly the same action and value everywhere to start with.
        torch.nn.init.orthogonal_(net[-1].weight, 0.01)
        torch.nn.init.zeros_(net[-1].bias)
        return net

    policy = torch.nn.Sequential(network(actions), AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"tanh_loc": False},
        return_log_prob=True,
    )
    loss = PPOLagrangianLoss(
        actor,
        ValueOperator(network(1), in_keys=["observation"]),
        ValueOperator(network(len(COSTS)), in_keys=["observation"], out_keys=["cost_value"]),
        num_costs=len(COSTS),
        entropy_bonus=False,
        loss_critic_type="l2",
    )
    discount = {"gamma": config.gamma, "lmbda": 0.95, "vectorized": True}
    loss.make_value_estimator(ValueEstimators.GAE, **discount)
    loss.make_cost_value_estimator(**discount)
    return actor, loss


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


def train(config: Config, algorithm: str) -> tuple[ProbabilisticActor, list[dict[str, float]]]:
    """Trains with one algorithm; returns the policy and a row of figures for each batch."""
    torch.manual_seed(config.seed)
    actor, loss = make_agent(config)
    target = (1 - config.margin) * config.cost_limit
    updater = MULTIPLIER_RULES[config.multiplier_rule](loss, target, config.multiplier_rate)
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.learning_rate)
    batches = math.ceil(config.frames / config.frames_per_batch)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=batches)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(config.frames_per_batch),
        sampler=SamplerWithoutReplacement(),
        batch_size=config.minibatch,
    )
    logger = get_logger(config.logger, str(config.out / "logs"), algorithm)
    history = []
    with (
        collecting(config, actor) as collector,
        tqdm(total=config.frames, desc=algorithm, unit="frame", unit_scale=True) as bar,
    ):
        for batch in collector:
            episodes = batch["next"][batch["next", "done"].squeeze(-1)]
            if algorithm == "ppo-lagrangian":
                updater.step(episodes["episode_cost"])
            buffer.extend(loss.estimate_advantages(batch).reshape(-1))
            for _ in range(config.epochs):
                for minibatch in buffer:
                    losses = loss(minibatch)
                    sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
                    torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                    optimizer.step()
                    optimizer.zero_grad()
            schedule.step()
            collector.update_policy_weights_()
            bar.update(batch.numel())
            row = figures(episodes, loss.lagrange_multiplier)
            bar.set_postfix({name: f"{value:.2f}" for name, value in row.items()})
            logger.log_metrics(row, step=bar.n)
            history.append({"frames": bar.n, **row})
    checkpoint = Checkpoint(loss=loss, optimizer=optimizer, schedule=schedule, updater=updater)
    checkpoint.save(config.out / algorithm / "checkpoint")
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


def main(config: Config) -> None:
    """Trains and evaluates each algorithm, then writes the comparison."""
    # TorchRL's notes on each buffer would break up the progress bar.
    torchrl_logger.setLevel("WARNING")
    # The networks are small: more threads than one only wait for each other.
    torch.set_num_threads(1)
    if config.out.exists() and any(config.out.iterdir()):
        raise FileExistsError(f"out must be a new or empty folder, got {str(config.out)!r}.")
    config.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {
        "config": dataclasses.asdict(config),
        "versions": {name: version(name) for name in ("torch", "torchrl", "pybullet")},
        "algorithms": {},
    }
    env, stage = make_env(config, num_envs=32), make_env(config, num_envs=1, seed=config.seed)
    save_picture(stage, config.out / "scene.png")
    for algorithm in config.algorithms:
        start = perf_counter()
        actor, history = train(config, algorithm)
        seconds = perf_counter() - start
        # Seeds that training does not use.
        episodes = evaluate(env, actor, config.eval_episodes, seed=config.seed + 1_000_000)
        results["algorithms"][algorithm] = {
            "seconds": seconds,
            "history": history,
            "evaluation": summarize(episodes, tuple(COSTS)),
        }
        save_animation(stage, actor, config.out / algorithm / "policy.gif")
        (config.out / "results.json").write_text(json.dumps(results, indent=1, default=str))
    env.close()
    stage.close()
    plot_curves(results, config.out / "curves.png")
    text = table(results)
    (config.out / "table.md").write_text(text)
    print(f"\n{text}\nResults are in {config.out}.")


if __name__ == "__main__":
    main(tyro.cli(Config))
