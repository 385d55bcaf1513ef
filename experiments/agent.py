"""The networks that the experiments train."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator


class Affine(torch.nn.Module):
    """Shifts and scales by constants, which are saved with the network."""

    loc: Tensor
    scale: Tensor

    def __init__(self, loc: Tensor | float, scale: Tensor | float) -> None:
        super().__init__()
        self.register_buffer("loc", torch.as_tensor(loc))
        self.register_buffer("scale", torch.as_tensor(scale))

    def forward(self, x: Tensor) -> Tensor:
        return self.loc + self.scale * x


@dataclass(frozen=True)
class ActorSpec:
    """The shape of a policy: with its weights, all that is needed to make it again.

    Args:
        observations: width of the observation.
        actions: width of the action.
        noise: whether the policy's deviation is the same in every state, chosen in each state, or
            there is none: it then gives the action itself.
        bounded: whether actions are between -1 and 1.
    """

    observations: int
    actions: int
    noise: Literal["same", "chosen", "none"]
    bounded: bool


class Agent(NamedTuple):
    """A policy, critics of the state, and the logarithm of the policy's deviation in all states."""

    actor: ProbabilisticActor
    critic: ValueOperator
    cost_critic: ValueOperator
    log_std: torch.nn.Parameter
    spec: ActorSpec


class QAgent(NamedTuple):
    """A policy, and critics of state and action."""

    actor: TensorDictModuleBase
    critic: ValueOperator
    cost_critic: ValueOperator
    spec: ActorSpec


def make_actor(
    spec: ActorSpec,
    loc: Tensor | None = None,
    scale: Tensor | None = None,
    log_std: float = 0.0,
) -> TensorDictModuleBase:
    """Makes a policy.

    Args:
        spec: its shape.
        loc: what is added to observations, shape ``(observations,)``; by default nothing.
        scale: what they are multiplied by before that, the same; by default 1.
        log_std: logarithm of a deviation that is the same in every state.
    """
    loc = torch.zeros(spec.observations) if loc is None else loc
    scale = torch.ones(spec.observations) if scale is None else scale
    outputs = spec.actions * (2 if spec.noise == "chosen" else 1)
    net = torch.nn.Sequential(Affine(loc, scale), _small_network(spec.observations, outputs))
    if spec.noise == "none":
        policy = torch.nn.Sequential(net, torch.nn.Tanh())
        return TensorDictModule(policy, ["observation"], ["action"])
    if spec.noise == "chosen":
        policy = torch.nn.Sequential(net, NormalParamExtractor())
    else:
        noise = AddStateIndependentNormalScale(spec.actions, init_value=log_std)
        policy = torch.nn.Sequential(net, noise)
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if spec.bounded else IndependentNormal,
        distribution_kwargs={"tanh_loc": False} if spec.bounded else {},
        return_log_prob=spec.noise == "same",
    )


def make_agent(env: EnvBase, *, gamma: float, log_std: float = 0.0) -> Agent:
    """Makes a policy and two critics of the state, with one output for each cost.

    Observations are standardized by what random actions bring about, and the critics predict
    the mean of a step, of which the value is ``1 / (1 - gamma)`` times as much: distances of
    centimetres and values of dozens are both out of reach of a small network that Adam has
    some hundred batches to train.

    Args:
        env: environment to read widths from, and to play in.
        gamma: discount of reward and costs.
        log_std: logarithm of the policy's deviation to start with.
    """
    loc, scale = _standardization(env, deviation=math.exp(log_std))
    spec = _actor_spec(env, noise="same")

    def critic(outputs: int, out_key: str) -> ValueOperator:
        net = _small_network(spec.observations, outputs)
        predict = torch.nn.Sequential(
            torch.nn.Sequential(Affine(loc, scale), net), Affine(0.0, 1 / (1 - gamma))
        )
        return ValueOperator(predict, in_keys=["observation"], out_keys=[out_key])

    actor = make_actor(spec, loc, scale, log_std)
    parameter = actor.get_parameter("0.module.1.state_independent_scale")
    critics = critic(1, "state_value"), critic(num_costs(env), "cost_value")
    return Agent(actor, *critics, parameter, spec)


def make_q_agent(env: EnvBase, *, gamma: float, stochastic: bool) -> QAgent:
    """Makes a policy and two critics of state and action, for algorithms that learn from replay.

    Args:
        env: see :func:`make_agent`.
        gamma: see :func:`make_agent`.
        stochastic: whether the policy is a distribution of which it chooses the width in every
            state, or gives the action itself.
    """
    loc, scale = _standardization(env)
    spec = _actor_spec(env, noise="chosen" if stochastic else "none")
    actor = make_actor(spec, loc, scale)

    def critic(outputs: int, out_key: str) -> ValueOperator:
        net = _small_network(spec.observations + spec.actions, outputs)
        predict = _OfStateAndAction(Affine(loc, scale), net, Affine(0.0, 1 / (1 - gamma)))
        return ValueOperator(predict, in_keys=["observation", "action"], out_keys=[out_key])

    costs = num_costs(env)
    critics = critic(1, "state_action_value"), critic(costs, "state_action_cost_value")
    return QAgent(actor, *critics, spec)


class _OfStateAndAction(torch.nn.Module):
    def __init__(self, standardize: Affine, net: MLP, unit: Affine) -> None:
        super().__init__()
        self.standardize, self.net, self.unit = standardize, net, unit

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.unit(self.net(self.standardize(observation), action))


def _actor_spec(env: EnvBase, *, noise: Literal["same", "chosen", "none"]) -> ActorSpec:
    return ActorSpec(
        observations=env.observation_spec["observation"].shape[-1],
        actions=env.action_spec.shape[-1],
        noise=noise,
        bounded=not isinstance(env.action_spec, Unbounded),
    )


def num_costs(env: EnvBase) -> int:
    """How many costs an environment has."""
    return env.reward_spec["cost"].shape[-1]


def _standardization(env: EnvBase, *, deviation: float = 1.0) -> tuple[Tensor, Tensor]:
    """Shift and scale that give what random actions bring about mean 0 and deviation 1.

    Actions without bounds are as far from 0 as those of a policy of that deviation.
    """

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        env.rand_action(tensordict)
        if isinstance(env.action_spec, Unbounded):
            tensordict["action"] *= deviation
        return tensordict

    with torch.no_grad():
        seen = env.rollout(200, act, break_when_any_done=False)["observation"].flatten(0, -2)
    # What hardly moves in these steps may do so later.
    scale = 1 / seen.std(0).clamp_min(0.05)
    return -seen.mean(0) * scale, scale


def _small_network(inputs: int, outputs: int) -> MLP:
    net = MLP(inputs, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
    # Nearly the same action and value everywhere to start with.
    torch.nn.init.orthogonal_(net[-1].weight, 0.01)
    torch.nn.init.zeros_(net[-1].bias)
    return net
