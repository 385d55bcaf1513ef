"""The algorithms of ``make train`` by name: what differs from one to the next, and no more."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.data import Composite
from torchrl.envs import CatTensors, EnvBase, StepCounter, Transform
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss, LossModule, ValueEstimators

from experiments.agent import make_agent, make_q_agent, num_costs
from experiments.compiling import compiled
from experiments.config import AlgorithmName, Config
from experiments.learners import Learner, NoiseSchedule, OnPolicyLearner, ReplayLearner, summed
from torchrl_safe.envs import EarlyTermination, Saute, Shield
from torchrl_safe.objectives import (
    CPO,
    PCPO,
    TRPO,
    CRPOLoss,
    CUPLoss,
    DualAscent,
    FOCOPSLoss,
    IPOLoss,
    LagrangianLoss,
    MultiplierUpdater,
    P3OLoss,
    PIDControl,
    PPOLagrangianLoss,
    SACLagrangianLoss,
    TD3LagrangianLoss,
    TrustRegionLoss,
    TrustRegionMethod,
    TrustRegionStep,
    ViolationUpdater,
)

Updater = MultiplierUpdater | ViolationUpdater
# Called as rule(loss, rate, cost_limit=, cost_names=, pessimism=).
MULTIPLIER_RULES: dict[str, Callable[..., MultiplierUpdater]] = {
    "pid": lambda loss, rate, **settings: PIDControl(loss, ki=rate, **settings),
    "dual-ascent": lambda loss, rate, **settings: DualAscent(
        loss, lr=rate, normalize=True, **settings
    ),
}


@dataclass(frozen=True)
class Training:
    """What a training run is made of.

    Args:
        actor: the policy.
        observation_spec: what the policy can read.
        collector: the policy that collects, which may add noise of its own.
        loss: the loss.
        updater: tells the loss about the episode costs of a batch.
        learner: what learns from each batch.
    """

    actor: TensorDictModuleBase
    observation_spec: Composite
    collector: TensorDictModuleBase
    loss: LossModule
    updater: Updater | None
    learner: Learner

    def state(self) -> dict[str, Any]:
        """What has been learnt, and what it is learnt with, by name."""
        state = self.learner.state()
        return state if self.updater is None else {**state, "updater": self.updater}


def _limits(config: Config) -> dict[str, Any]:
    return {"cost_limit": config.aims, "cost_names": tuple(config.aims)}


def keep_multiplier(loss: LossModule, config: Config) -> None:
    """No rule: the multiplier stays where it starts."""


def move_multiplier(loss: LossModule, config: Config) -> Updater | None:
    """The multiplier rule that was chosen, and the multiplier that it starts with."""
    loss.lagrange_multiplier.fill_(config.multiplier_init)
    if config.multiplier_rule == "fixed":
        return None
    return MULTIPLIER_RULES[config.multiplier_rule](
        loss,
        config.multiplier_rate,
        **_limits(config),
        pessimism=config.pessimism,
    )


def tell_violation(loss: LossModule, config: Config, *, errors: float) -> Updater:
    """No multiplier: the loss reads the violation itself, with so many times the pessimism.

    A multiplier sums up the violations of many batches. A trust-region step knows one, and goes
    only as far as the region lets it: it takes twice the pessimism. Losses that act on any
    violation with all their weight take less. Where costs are rare, two standard errors are more
    than the limit, and the arm would keep away from everything before it has learnt to reach.
    """
    return ViolationUpdater(loss, **_limits(config), pessimism=errors * config.pessimism)


def no_transforms(config: Config) -> list[Transform]:
    """The environment as it is."""
    return []


@dataclass(frozen=True)
class Algorithm(ABC):
    """What each algorithm has.

    Args:
        loss: called as ``loss(actor, critic, cost_critic, num_costs=)``; off policy also with
            ``action_spec=``.
        updater: called as ``updater(loss, config)``.
        transforms: called as ``transforms(config)``, what is appended to the environment.
        training_transforms: the same, but not when the policy is evaluated.
        shield: filters the actions, if given.
        settings: options of its own, in place of the defaults of :class:`Config`.
    """

    loss: Callable[..., LossModule]
    updater: Callable[[LossModule, Config], Updater | None] = move_multiplier
    transforms: Callable[[Config], list[Transform]] = no_transforms
    training_transforms: Callable[[Config], list[Transform]] = no_transforms
    shield: Shield | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    @abstractmethod
    def build(self, env: EnvBase, config: Config) -> Training:
        """Makes networks, loss, updater and learner."""


@dataclass(frozen=True)
class OnPolicy(Algorithm):
    """An algorithm that learns from each batch while it is fresh.

    Args:
        epochs: passes over a batch, if not those of the configuration.
        method: the step that a trust-region method takes with the actor.
        projects: whether each batch has a second phase, CUP's projection.
        max_kl: how far the policy may move in a phase, in nats, before it ends.
        compiles: whether the loss is compiled in long runs. (Losses that ask PyTorch for the
            divergence of two distributions do not compile to one graph.)
    """

    epochs: int | None = None
    method: TrustRegionMethod | None = None
    projects: bool = False
    max_kl: float = math.inf
    compiles: bool = False

    def build(self, env: EnvBase, config: Config) -> Training:
        agent = make_agent(
            env, gamma=config.gamma, hidden=config.hidden, log_std=config.first_log_std
        )
        networks = agent.actor, agent.critic, agent.cost_critic
        loss = self.loss(*networks, num_costs=num_costs(env))
        discount = {"gamma": config.gamma, "lmbda": 0.95, "vectorized": True}
        loss.make_value_estimator(ValueEstimators.GAE, **discount)
        loss.make_cost_value_estimator(**discount)
        batches = math.ceil(config.frames / config.frames_per_batch)
        step = None if self.method is None else TrustRegionStep(loss, self.method, max_kl=0.02)
        epochs = self.epochs or config.epochs
        steps = batches * epochs * math.ceil(config.frames_per_batch / config.minibatch)
        # Where a trust-region step moves the actor, the optimizer has the critics only.
        objective = summed(loss if step is None else loss.critic_losses)
        phases = [(None, compiled(objective, steps) if self.compiles else objective)]
        if self.projects:
            phases.append((loss.start_projection, summed(loss.projection_loss)))
        learner = OnPolicyLearner(
            loss,
            agent.actor,
            NoiseSchedule(agent.log_std, last=config.last_log_std, batches=batches),
            learning_rate=config.learning_rate,
            batches=batches,
            epochs=epochs,
            minibatch=config.minibatch,
            phases=phases,
            max_kl=self.max_kl,
            actor_step=step,
        )
        updater = self.updater(loss, config)
        spec = env.observation_spec_unbatched
        return Training(agent.actor, spec, agent.actor, loss, updater, learner)


@dataclass(frozen=True)
class OffPolicy(Algorithm):
    """An algorithm that learns from all it has ever seen.

    Args:
        stochastic: whether the policy is a distribution; else noise is added to collect.
    """

    stochastic: bool = field(kw_only=True)

    def build(self, env: EnvBase, config: Config) -> Training:
        agent = make_q_agent(
            env, gamma=config.gamma, stochastic=self.stochastic, hidden=config.hidden
        )
        spec = env.action_spec_unbatched
        loss = self.loss(
            agent.actor,
            agent.critic,
            agent.cost_critic,
            num_costs=num_costs(env),
            action_spec=spec,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        loss.make_cost_value_estimator(gamma=config.gamma)
        collector = agent.actor
        if not self.stochastic:
            noise = AdditiveGaussianModule(spec, sigma_init=0.3, sigma_end=0.3)
            collector = TensorDictSequential(agent.actor, noise)
        learner = ReplayLearner(
            loss,
            agent.actor,
            learning_rate=2 * config.learning_rate,
            batches=math.ceil(config.frames / config.frames_per_batch),
            capacity=config.frames,
            minibatch=config.minibatch,
            steps_per_update=8,
        )
        updater = self.updater(loss, config)
        observation_spec = env.observation_spec_unbatched
        return Training(agent.actor, observation_spec, collector, loss, updater, learner)


# On-policy losses have no target networks, so their networks need no functional form. A gradient
# step takes an eighth less time without it.
_OPTIONS: dict[str, Any] = {
    "entropy_bonus": False,
    "loss_critic_type": "l2",
    "functional": False,
}


def _wrapping(make: Callable[..., LossModule], parent: Callable[..., LossModule]) -> Any:
    """``make`` around TorchRL's loss ``parent``, as a function of actor and critics."""

    def build(actor: Any, critic: Any, cost_critic: Any, **options: Any) -> LossModule:
        wrapped = parent(actor, critic, **_OPTIONS)
        return make(wrapped, cost_critic, **options)

    return build


def _of_ppo(make: Callable[..., LossModule]) -> Any:
    """``make`` with the options of PPO that all these runs have."""
    return partial(make, **_OPTIONS)


def _budgets(config: Config) -> torch.Tensor:
    # No margin: each episode keeps its budget, not their mean.
    return torch.tensor([*config.cost_limits.values()])


def _with_budget(config: Config) -> list[Transform]:
    # The reward of a step is around -1 and better.
    saute = Saute(_budgets(config), unsafe_reward=-2.0)
    return [saute, CatTensors(["observation", "remaining_budget"], "observation", del_keys=False)]


def _trust_region(**options: Any) -> OnPolicy:
    """With the lengths of episodes, which :func:`~experiments.learners.tell_length` reads."""
    loss = _of_ppo(TrustRegionLoss)
    return OnPolicy(loss, training_transforms=lambda config: [StepCounter()], **options)


def _terminating(config: Config) -> list[Transform]:
    # Worse than any episode. Otherwise ending early would pay.
    return [EarlyTermination(_budgets(config), termination_reward=-20.0)]


# One step for each batch, and what collides by chance forbids any that raises the cost: larger
# batches, which tell better what a policy costs, and as many of them.
_TRUST_REGION = {"frames": 256_000, "frames_per_batch": 2048}
_A2C = {"frames": 768_000, "frames_per_batch": 512, "minibatch": 128, "multiplier_rate": 0.01}
# Nearer and faster than the default, and less safe in PyBullet. In MuJoCo, where these policies are
# trained, the motors follow twice as large a change of velocity.
_SHIELD = Shield(margin=0.0075, rate=40.0, table=0.015, acceleration=20.0)
ALGORITHMS: dict[AlgorithmName, Algorithm] = {
    "ppo": OnPolicy(_of_ppo(PPOLagrangianLoss), keep_multiplier, compiles=True),
    "ppo-shield": OnPolicy(
        _of_ppo(PPOLagrangianLoss), keep_multiplier, compiles=True, shield=_SHIELD
    ),
    "ppo-lagrangian-shield": OnPolicy(_of_ppo(PPOLagrangianLoss), compiles=True, shield=_SHIELD),
    "ppo-lagrangian": OnPolicy(_of_ppo(PPOLagrangianLoss), compiles=True),
    "kl-ppo-lagrangian": OnPolicy(
        # TorchRL's target for the divergence, 0.01 a batch, is too slow to follow the multiplier.
        _wrapping(LagrangianLoss, partial(KLPENPPOLoss, dtarg=0.02)),
        # More batches, and a multiplier that does not rise before it has learnt to reach.
        settings={"frames": 256_000, "multiplier_rate": 0.05},
    ),
    "a2c-lagrangian": OnPolicy(
        _wrapping(LagrangianLoss, A2CLoss),
        epochs=1,
        # It uses each batch once, and without an importance ratio only for one gradient step (Mnih
        # et al. 2016, arXiv 1602.01783, take five steps a batch): small batches, more of them, and
        # a multiplier that moves as much less in each.
        settings=_A2C,
    ),
    "trpo": _trust_region(updater=keep_multiplier, method=TRPO()),
    # One step for each batch: with 128,000 control steps one seed had not learnt to the end.
    "trpo-lagrangian": _trust_region(method=TRPO(), settings={"frames": 256_000}),
    "cpo": _trust_region(
        updater=partial(tell_violation, errors=2.0),
        method=CPO(),
        settings=_TRUST_REGION,
    ),
    "pcpo": _trust_region(
        updater=partial(tell_violation, errors=2.0),
        method=PCPO(),
        settings=_TRUST_REGION,
    ),
    # Nothing in these losses brings the policy back. Their authors end the passes over a batch once
    # it has moved too far; where its noise is small, one pass is already too far.
    # FOCOPS moves less in each batch then, and takes more of them.
    "focops": OnPolicy(_of_ppo(FOCOPSLoss), max_kl=0.02, settings={"frames": 256_000}),
    "cup": OnPolicy(_of_ppo(CUPLoss), projects=True, max_kl=0.02),
    "p3o": OnPolicy(_of_ppo(P3OLoss), partial(tell_violation, errors=0.0)),
    "ipo": OnPolicy(_of_ppo(IPOLoss), partial(tell_violation, errors=0.0)),
    "crpo": OnPolicy(
        _wrapping(CRPOLoss, ClipPPOLoss),
        # It swings about what it is told, above the limit as often as below.
        partial(tell_violation, errors=1.0),
    ),
    "ppo-saute": OnPolicy(_of_ppo(PPOLagrangianLoss), keep_multiplier, transforms=_with_budget),
    "ppo-early-termination": OnPolicy(
        _of_ppo(PPOLagrangianLoss), keep_multiplier, training_transforms=_terminating
    ),
    "sac-lagrangian": OffPolicy(SACLagrangianLoss, stochastic=True, settings={"frames": 192_000}),
    "td3-lagrangian": OffPolicy(
        TD3LagrangianLoss,
        stochastic=False,
        # Its critics learn from old episodes too, and follow a multiplier slowly. One that rises
        # before it has learnt to reach keeps it away from the target.
        settings={"frames": 192_000, "multiplier_rate": 0.02},
    ),
}


def own_settings(config: Config, algorithm: AlgorithmName) -> dict[str, Any]:
    """Returns what the algorithm sets: options of its own where the configuration has defaults."""
    if not config.own_settings:
        return {}
    default, own = Config(), ALGORITHMS[algorithm].settings
    return {name: own[name] for name in own if getattr(config, name) == getattr(default, name)}


def configured(config: Config, algorithm: AlgorithmName) -> Config:
    """Returns the configuration with what the algorithm sets."""
    return replace(config, **own_settings(config, algorithm))
