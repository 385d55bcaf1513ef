"""Trains a policy within cost limits, in any Gymnasium environment that reports a cost.

::

    python -m experiments.safe_gym --env SafetySwimmerVelocity-v1 --cost-limit 25

Networks, statistics and loop are in this file, to be copied and changed; the algorithms' losses are
in ``experiments/algorithms.py``. Sizes do not matter: observations are standardized, advantages and
multiplier have no unit, and critics predict in units of their targets.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from pathlib import Path
from time import strftime
from typing import Any, Literal, NamedTuple

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, OneHot, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter
from torchrl.envs.utils import ExplorationType
from torchrl.modules import (
    MLP,
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import LossModule, ValueEstimators
from tqdm import tqdm

from experiments.algorithms import ALGORITHMS, OnPolicy, keep_multiplier, move_multiplier
from experiments.compiling import compiled
from experiments.files import as_json, lasting, run_to_resume, write_whole
from experiments.learners import NOT_LEARNT_FROM, Objective, moved_from_here, summed, tell_length
from experiments.log import Log, figures, versions
from torchrl_safe._checks import check_count, check_positive
from torchrl_safe.checkpoint import RunCheckpoints
from torchrl_safe.envs.gym import SafeGymEnv
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.objectives import (
    MultiplierUpdater,
    PIDControl,
    TrustRegionStep,
    ViolationUpdater,
)
from torchrl_safe.policy import save_policy

# The first seed that training does not use. Environments may take seeds of 32 bits only.
EVALUATION = 2**31
# What is evaluated. The limit is for the policy with its noise, which is the one that was trained.
EVALUATIONS = {
    "evaluation": ExplorationType.DETERMINISTIC,
    "evaluation_with_noise": ExplorationType.RANDOM,
}
# Settings that may differ when a run is resumed: they do not change what is learnt.
CHANGEABLE = ("out", "logger", "resume", "eval_episodes")


@dataclasses.dataclass(frozen=True)
class Config:
    """Train a policy within cost limits, in a Gymnasium environment that reports a cost."""

    env: str
    """Name of the environment, of Gymnasium or Safety-Gymnasium; "module:name" imports a module
    first."""
    cost_keys: tuple[str, ...] = ("cost",)
    """Entries of info that are costs; "costs.collision" is an entry of an entry."""
    cost_limit: tuple[float, ...] = (25.0,)
    """Limit of the expected cost of an episode: one number, or one for each cost."""
    algorithm: Literal[
        "ppo", "ppo-lagrangian", "kl-ppo-lagrangian", "a2c-lagrangian", "trpo", "trpo-lagrangian",
        "cpo", "pcpo", "focops", "cup", "p3o", "ipo", "crpo",
    ] = "ppo-lagrangian"  # fmt: skip
    """What to train with; ppo and trpo know no costs."""
    frames: int = 1_000_000
    """Steps to train for, rounded up to whole batches."""
    envs: int = 8
    """Environments that step side by side."""
    asynchronous: bool = False
    """Give each environment a process of its own: faster if a step takes milliseconds."""
    seed: int = 0
    """Seed of networks, environments and minibatches."""
    out: Path = dataclasses.field(
        default_factory=lambda: Path("runs", strftime("%Y-%m-%d_%H-%M-%S"))
    )
    """Folder for logs, checkpoints, policy.pt and results.json; named by date and time."""
    logger: Literal["csv", "tensorboard", "wandb", "mlflow"] = "csv"
    """TorchRL logger; install all but csv yourself."""
    resume: bool = False
    """Resume the run in the folder, which must have the same settings; without a run there, begin
    one."""
    checkpoint_every: int = 10
    """Batches between two checkpoints. At each, all episodes begin anew."""
    eval_episodes: int = 50
    """Episodes of each final evaluation: of the deterministic policy, and with its noise."""
    compile: bool = True
    """Compile the loss in long runs, if there is a C++ compiler: a minute at the start, then
    updates take a third of the time. Of the algorithms, ppo and ppo-lagrangian can be."""
    frames_per_batch: int = 8_000
    """Steps between two updates of the policy: some whole episodes at least."""
    epochs: int = 20
    """Passes over each batch at most."""
    max_kl: float = 0.02
    """Divergence from the policy that collected the batch at which the passes over it end; in a
    trust region, the size of the step."""
    minibatch: int = 64
    """Steps in a minibatch."""
    learning_rate: float = 3e-4
    """Adam's learning rate at the start; it falls linearly to 0."""
    max_grad_norm: float = 0.5
    """Largest norm of the policy's gradient."""
    random_frames: int = 1_000
    """Steps of random actions before all others, for the first statistics of observations."""
    log_std: float = -0.5
    """Logarithm of the policy's deviation at the start, before the squashing; it is learnt. Has no
    effect on discrete actions."""
    gamma: float = 0.99
    """Discount of reward and costs."""

    def __post_init__(self) -> None:
        counts = ("frames", "envs", "checkpoint_every", "eval_episodes", "frames_per_batch")
        names = (*counts, "epochs", "minibatch", "random_frames")
        check_count(**{name: getattr(self, name) for name in names})
        if self.envs == self.eval_episodes == 1:
            raise ValueError("eval_episodes must be at least 2 with one environment, got 1.")
        if not 0 <= self.seed < EVALUATION:
            raise ValueError(f"seed must be at least 0 and below {EVALUATION}, got {self.seed}.")
        check_positive(
            max_kl=self.max_kl,
            learning_rate=self.learning_rate,
            max_grad_norm=self.max_grad_norm,
        )
        if not 0 < self.gamma < 1:
            raise ValueError(f"gamma must be between 0 and 1, got {self.gamma}.")
        if not all(0 <= limit < math.inf for limit in self.cost_limit):
            raise ValueError(f"cost_limit must not be negative, got {self.cost_limit}.")
        if len(self.cost_limit) not in (1, len(self.cost_keys)):
            raise ValueError(
                f"cost_limit must be one number or one for each of {self.cost_keys}, got "
                f"{self.cost_limit}."
            )
        if self.frames_per_batch % self.envs or self.frames_per_batch < self.minibatch:
            raise ValueError(
                f"frames_per_batch must be a multiple of envs and at least a minibatch, got "
                f"{self.frames_per_batch}, {self.envs} and {self.minibatch}."
            )


class Standardize(torch.nn.Module):
    """Brings observations to mean 0 and deviation 1, by all that were shown to :meth:`update`.

    As a layer of the networks it is saved with them, and nothing changes it while they are
    evaluated.
    """

    mean: Tensor
    std: Tensor
    count: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width, dtype=torch.float64))
        self.register_buffer("std", torch.ones(width))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, observation: Tensor, layers: Iterable[torch.nn.Linear] = ()) -> None:
        """Adds observations to those that were shown before.

        Args:
            observation: of shape ``(*B, width)``.
            layers: what reads the standardized observations. Their outputs stay what they were,
                but for observations that hardly varied so far.
        """
        before, unit = self.mean.clone(), self.std.clone()
        rows = observation.reshape(-1, observation.shape[-1]).double()
        share = len(rows) / (self.count + len(rows))
        var, mean = torch.var_mean(rows, 0, correction=0)
        between = share * (1 - share) * (mean - self.mean).square()
        var = self.std.double().square().lerp(var, share) + between
        self.std.copy_(var.sqrt().clamp_min(1e-8))
        self.mean.lerp_(mean, share)
        self.count.add_(len(rows))
        # Networks have learnt nothing about those, and their weights would become too large.
        ratio = self.std / unit
        known = ratio < 2
        ratio = torch.where(known, ratio, 1.0)
        shift = torch.where(known, (self.mean - before) / unit, 0.0).to(unit.dtype)
        for layer in layers:
            layer.bias.add_(layer.weight @ shift)
            layer.weight.mul_(ratio)

    def forward(self, observation: Tensor) -> Tensor:
        return ((observation - self.mean) / self.std).clamp(-10, 10).to(self.std.dtype)


class Critic(torch.nn.Module):
    """Predicts values in units of their targets, so that the size of these does not matter.

    Its outputs stay what they were when the units change: PopArt, van Hasselt et al. 2016,
    https://arxiv.org/abs/1602.07714.
    """

    mean: Tensor
    std: Tensor
    changes: Tensor

    def __init__(self, standardize: Standardize, values: int) -> None:
        super().__init__()
        self.standardize = standardize
        self.net = small_network(len(standardize.mean), values, gain=0.0)
        self.register_buffer("mean", torch.zeros(values))
        self.register_buffer("std", torch.ones(values))
        self.register_buffer("changes", torch.zeros(()))

    @torch.no_grad()
    def change_units(self, targets: Tensor) -> None:
        """Takes mean and deviation of value targets, shape ``(*B, values)``, for units."""
        std, mean = torch.std_mean(targets.flatten(0, -2), 0)
        # Where costs have become rare, a critic must not magnify its own noise.
        std = torch.maximum(std, self.std.lerp(std, 0.02)) if self.changes else std
        std = torch.where(std > 0, std, self.std)
        last, ratio = self.net[-1], self.std / std
        last.weight.mul_(ratio[:, None])
        last.bias.mul_(ratio).add_((self.mean - mean) / std)
        self.mean.copy_(mean)
        self.std.copy_(std)
        self.changes.add_(1)

    def forward(self, observation: Tensor) -> Tensor:
        values = self.net(self.standardize(observation))
        # The gradient of a squared error in the targets' unit is std ** 2 times too large.
        values = values.detach().lerp(values, self.std**-2)
        return self.mean + self.std * values


class Explorer(torch.nn.Module):
    """Draws actions as TanhNormal does, without making one, which is twice as fast."""

    def __init__(self, policy: torch.nn.Module, bounds: dict[str, Tensor]) -> None:
        super().__init__()
        self.policy, self.bounded = policy, bool(bounds)
        if bounds:
            self.register_buffer("centre", (bounds["high"] + bounds["low"]) / 2)
            self.register_buffer("radius", (bounds["high"] - bounds["low"]) / 2)

    def forward(self, observation: Tensor) -> Tensor:
        loc, scale = self.policy(observation)
        drawn = loc + scale * torch.randn_like(loc)
        # TanhNormal keeps as far from the bounds, where the logarithm of the density is infinite.
        limit = 1 - 1e-6
        return (
            self.centre + self.radius * drawn.tanh().clamp(-limit, limit) if self.bounded else drawn
        )


class Agent(NamedTuple):
    """A policy and two critics, which share the statistics of observations.

    ``explorer`` is what collects with the policy: one of discrete actions does so itself.
    """

    standardize: Standardize
    explorer: TensorDictModule
    actor: ProbabilisticActor
    critic: ValueOperator
    cost_critic: ValueOperator


def small_network(inputs: int, outputs: int, gain: float) -> MLP:
    """Two hidden layers of 64 that give nearly the same everywhere to start with; 0 with gain 0."""
    net = MLP(inputs, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
    torch.nn.init.orthogonal_(net[-1].weight, gain)
    torch.nn.init.zeros_(net[-1].bias)
    return net


def make_agent(env: EnvBase, log_std: float) -> Agent:
    """Makes the networks for an environment."""
    observations, action = env.observation_spec_unbatched, env.action_spec_unbatched
    observation = observations.get("observation", observations)  # Some have others.
    # A spec of several whole numbers is Bounded or OneHot too.
    continuous = isinstance(action, Bounded | Unbounded) and action.domain == "continuous"
    known = action.ndim == 1 and (continuous or type(action) is OneHot)
    if observation.ndim != 1 or not known:
        raise ValueError(
            "env must have a vector for an observation, and actions that are a continuous vector "
            f"or one of n discrete ones, got {observation} and {action}."
        )
    standardize = Standardize(observation.shape[0])
    costs = env.reward_spec["cost"].shape[-1]
    return Agent(
        standardize,
        *make_policy(standardize, action, log_std),
        ValueOperator(Critic(standardize, 1), ["observation"], ["state_value"]),
        ValueOperator(Critic(standardize, costs), ["observation"], ["cost_value"]),
    )


def make_policy(
    standardize: Standardize, action: TensorSpec, log_std: float
) -> tuple[TensorDictModule, ProbabilisticActor]:
    """Makes what explores, and the policy."""
    net = small_network(len(standardize.mean), action.shape[0], gain=0.01)
    if isinstance(action, OneHot):
        policy = torch.nn.Sequential(standardize, net)
        actor = ProbabilisticActor(
            TensorDictModule(policy, ["observation"], ["logits"]),
            in_keys=["logits"],
            distribution_class=OneHotCategorical,
        )
        return actor, actor
    bounds = {}
    if isinstance(action, Bounded):
        finite = torch.stack([action.space.low, action.space.high]).isfinite()
        if not finite.all():
            raise ValueError(f"env must bound its actions on both sides or on none, got {action}.")
        bounds = {"low": action.space.low, "high": action.space.high}
    noise = AddStateIndependentNormalScale(action.shape[0], init_value=log_std)
    policy = torch.nn.Sequential(standardize, net, noise)
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if bounds else IndependentNormal,
        distribution_kwargs={**bounds, "tanh_loc": False} if bounds else {},
    )
    return TensorDictModule(Explorer(policy, bounds), ["observation"], ["action"]), actor


def make_env(config: Config) -> EnvBase:
    """Makes the environments, with sums of reward and costs over each episode."""
    env = SafeGymEnv(
        config.env,
        cost_keys=[tuple(key.split(".")) for key in config.cost_keys],
        num_envs=config.envs if config.envs > 1 else 0,
        asynchronous=config.asynchronous,
    )
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    algorithm = ALGORITHMS[config.algorithm]
    if isinstance(algorithm, OnPolicy) and algorithm.method is not None:
        sums = Compose(sums, StepCounter())  # How long episodes are.
    return env.append_transform(sums)


def make_collector(config: Config, env: EnvBase, agent: Agent) -> Collector:
    """Makes the collector, which yields batches without end."""
    return Collector(
        env,
        agent.explorer,
        frames_per_batch=config.frames_per_batch,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )


def make_updater(config: Config, loss: LossModule) -> MultiplierUpdater | ViolationUpdater | None:
    """Makes the updater, which tells the loss about the episode costs of each batch."""
    wanted = ALGORITHMS[config.algorithm].updater
    limits = torch.tensor(config.cost_limit).expand(len(config.cost_keys))
    if wanted is keep_multiplier:
        return None
    if wanted is move_multiplier:
        return PIDControl(loss, cost_limit=limits)
    return ViolationUpdater(loss, cost_limit=limits)


class Learner:
    """Goes through each batch in minibatches, until the policy is ``max_kl`` from what it was."""

    def __init__(self, config: Config, agent: Agent, batches: int) -> None:
        algorithm = ALGORITHMS[config.algorithm]
        assert isinstance(algorithm, OnPolicy)
        self.config, self.agent = config, agent
        networks = agent.actor, agent.critic, agent.cost_critic
        self.loss = algorithm.loss(*networks, num_costs=len(config.cost_keys))
        discount = {"gamma": config.gamma, "lmbda": 0.95, "vectorized": True}
        self.loss.make_value_estimator(ValueEstimators.GAE, **discount)
        self.loss.make_cost_value_estimator(**discount)
        self.policy = list(agent.actor.parameters())
        # New statistics alone would change the policy: one that keeps just below a speed limit
        # would exceed it after each batch, and the multiplier keep rising.
        readers = agent.explorer, agent.critic, agent.cost_critic
        self.first_layers = [
            next(part for part in network.modules() if isinstance(part, torch.nn.Linear))
            for network in readers
        ]
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=config.learning_rate, fused=True
        )
        self.schedule = torch.optim.lr_scheduler.LinearLR(
            self.optimizer, 1.0, 0.0, total_iters=batches
        )
        self.step = None
        if algorithm.method is not None:
            self.step = TrustRegionStep(self.loss, algorithm.method, max_kl=config.max_kl)
        self.epochs = algorithm.epochs or config.epochs
        self.objective = summed(self.loss if self.step is None else self.loss.critic_losses)
        if algorithm.compiles and config.compile:
            steps = batches * self.epochs * (config.frames_per_batch // config.minibatch)
            self.objective = compiled(self.objective, steps)
        # CUP has a second phase.
        self.projection = summed(self.loss.projection_loss) if algorithm.projects else None

    def learn(self, batch: TensorDictBase) -> float:
        """Learns from a batch as the collector returns it; returns how far the policy moved."""
        with torch.no_grad():  # Once for the batch, not in each step. Writes loc and scale too.
            policy = self.agent.actor.get_dist(batch)
            batch["action_log_prob"] = policy.log_prob(batch["action"])
        self.loss.estimate_advantages(batch)
        self.agent.critic.module.change_units(batch["value_target"])
        self.agent.cost_critic.module.change_units(batch["cost_value_target"])
        data = batch.exclude(*NOT_LEARNT_FROM).reshape(-1)
        moved = moved_from_here(self.agent.actor, data)
        if self.step is not None:
            tell_length(self.step, batch)
            self.step.step(data)
        self._descend(self.objective, data, moved)
        kl = moved()
        if self.projection is not None:
            self.loss.start_projection()
            self._descend(self.projection, data, moved_from_here(self.agent.actor, data))
        self.schedule.step()
        # Last: the policy that collected the batch is the one that learnt from it.
        self.agent.standardize.update(batch["observation"], self.first_layers)
        return kl

    def _descend(
        self, objective: Objective, data: TensorDictBase, moved: Callable[[], float]
    ) -> None:
        """Goes through the data until the policy has moved further than ``max_kl``."""
        size = self.config.minibatch
        for epoch in range(self.epochs):
            # The steps that do not fill a minibatch are left out, others in each pass.
            order = torch.randperm(len(data))[: len(data) // size * size]
            # All passes have the same shapes and modules, so the first checks them for all.
            with torch.compiler.set_stance(skip_guard_eval_unsafe=epoch > 0):
                for minibatch in data[order].split(size):
                    objective(minibatch).backward()
                    torch.nn.utils.clip_grad_norm_(self.policy, self.config.max_grad_norm)
                    self.optimizer.step()
                    self.optimizer.zero_grad()
            kl = moved()
            if not math.isfinite(kl):
                raise ValueError(f"The policy is not finite after pass {epoch}.")
            if kl > self.config.max_kl and self.step is None:
                break


def check_costs(episode_cost: Tensor, names: Sequence[str]) -> None:
    """Raises ValueError for episodes that cost less than 0, which no limit bounds."""
    if (negative := (episode_cost < 0).any(0)).any():
        wrong = [name for name, is_wrong in zip(names, negative.tolist(), strict=True) if is_wrong]
        raise ValueError(
            f"Episodes must not cost less than 0, since a limit is an upper bound; {wrong} cost "
            f"{episode_cost[:, negative].min():g}. Negate them in a wrapper."
        )


def check_finite(batch: TensorDictBase, *keys: str) -> None:
    """Raises ValueError for what no policy can learn from."""
    for key in keys:
        if not (values := batch[key]).isfinite().all():
            wrong = values[~values.isfinite()][0]
            raise ValueError(f"env must return a finite {key} in every step, got {wrong}.")


def begin_episodes(config: Config, collector: Collector, frames: int) -> None:
    """Begins all episodes anew; what follows depends on the seed and on ``frames`` only.

    Gymnasium's environments cannot be saved. So that a resumed run is the same as one that was
    never stopped, both do this at every checkpoint.
    """
    seed = (config.seed * 100_000_000 + frames) % EVALUATION
    torch.manual_seed(seed)
    collector.set_seed(seed)
    collector.reset()


def train(config: Config, *, progress: bool = True) -> tuple[Agent, Log]:
    """Trains; returns the networks and the figures of each batch."""
    torch.set_num_threads(1)  # The networks are small: more threads would only wait for each other.
    torch.manual_seed(config.seed)
    env = make_env(config)
    env.set_seed(config.seed)
    agent = make_agent(env, config.log_std)
    with torch.no_grad():
        random = env.rollout(
            math.ceil(config.random_frames / config.envs), break_when_any_done=False
        )
    check_finite(random["next"], "observation", "reward")
    agent.standardize.update(random["observation"])
    batches = math.ceil(config.frames / config.frames_per_batch)
    learner = Learner(config, agent, batches)
    loss, updater = learner.loss, make_updater(config, learner.loss)
    log = Log(config.logger, config.out / "logs", config.algorithm)
    state = {
        "agent": torch.nn.ModuleList(agent),
        "loss": loss,
        "optimizer": learner.optimizer,
        "schedule": learner.schedule,
        "updater": updater,
        "step": learner.step,
        "log": log,
    }
    checkpoints = RunCheckpoints(
        config.out / "checkpoints",
        {name: part for name, part in state.items() if part is not None},
        settings=lasting(dataclasses.asdict(config), CHANGEABLE),
    )
    # Environment and learner could be made: only now the folder is this run's.
    config.out.mkdir(parents=True, exist_ok=True)
    if not (results := config.out / "results.json").exists():
        write_whole(results, json.dumps({"config": as_json(config)}))
    if config.resume:
        checkpoints.load()
    else:
        checkpoints.clear()
    log.open()
    collector = make_collector(config, env, agent)
    begin_episodes(config, collector, log.frames)
    with tqdm(
        total=config.frames,
        initial=log.frames,
        unit="frame",
        unit_scale=True,
        disable=not progress,
    ) as bar:
        for batch in islice(collector, batches - len(log.rows)):
            check_finite(batch["next"], "observation", "reward")
            episodes = batch["next"][batch["next", "done"].squeeze(-1)]
            if updater is not None:
                check_costs(episodes["episode_cost"], config.cost_keys)
                updater.step(episodes["episode_cost"])
            kl = learner.learn(batch)
            row = {**figures(episodes, loss, config.cost_keys), "kl": kl}
            bar.update(batch.numel())
            bar.set_postfix({name: f"{value:.3g}" for name, value in row.items()})
            log.add({"frames": log.frames + batch.numel(), **row})
            if len(log.rows) % config.checkpoint_every == 0 or len(log.rows) == batches:
                if all("return" not in row for row in log.rows):
                    raise ValueError(
                        f"env must have episodes that end, got none from {config.env!r} in "
                        f"{len(log.rows)} batches: register it with max_episode_steps, or raise "
                        "frames_per_batch."
                    )
                checkpoints.save(log.frames)
                begin_episodes(config, collector, log.frames)
    collector.shutdown()
    return agent, log


def main(config: Config) -> dict[str, Any]:
    """Trains, evaluates, and writes the results."""
    run_to_resume(config, CHANGEABLE)
    agent, log = train(config)
    seconds = log.seconds
    env = make_env(config)
    save_policy(
        config.out / "policy.pt",
        agent.actor,
        env.observation_spec_unbatched,
        settings=as_json(config),
    )
    # The statistics of observations stay as they are. Episodes that ended in training end here too.
    torch.manual_seed(config.seed)
    evaluations = {
        name: summarize(
            evaluate(
                env,
                agent.actor,
                config.eval_episodes,
                seed=EVALUATION + config.seed,
                max_steps=max(10_000, config.frames),
                exploration_type=exploration_type,
            ),
            config.cost_keys,
        )
        for name, exploration_type in EVALUATIONS.items()
    }
    env.close()
    results = {
        "config": dataclasses.asdict(config),
        "versions": versions(),
        "seconds": seconds,
        "history": log.rows,
        **evaluations,
    }
    write_whole(config.out / "results.json", json.dumps(results, indent=1, default=str))
    print(json.dumps(evaluations, indent=1))
    print(f"Results and policy are in {config.out}.")
    return results


if __name__ == "__main__":
    main(tyro.cli(Config))
