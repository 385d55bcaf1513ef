"""The networks that the experiments train."""

from __future__ import annotations

import math
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

Noise = Literal["same", "chosen", "none"]


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


class Standardize(Affine):
    """An affine map of each number, clipped to [-5, 5]: to five deviations from the mean.

    Random actions hardly ever touch an object: they say nothing about its velocities when it is
    pushed. Without the clip, those could be a hundred deviations, and outweigh everything else that
    a network sees.
    """

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x).clamp(-5, 5)


class Agent(NamedTuple):
    """A policy, critics of the state, and the logarithm of the policy's deviation in all states."""

    actor: ProbabilisticActor
    critic: ValueOperator
    cost_critic: ValueOperator
    log_std: torch.nn.Parameter


class QAgent(NamedTuple):
    """A policy, and critics of state and action."""

    actor: TensorDictModuleBase
    critic: ValueOperator
    cost_critic: ValueOperator


def make_actor(
    env: EnvBase,
    loc: Tensor,
    scale: Tensor,
    *,
    noise: Noise,
    hidden: int = 64,
    log_std: float = 0.0,
) -> TensorDictModuleBase:
    """Makes a policy.

    Args:
        env: environment that it acts in.
        loc: what is added to observations, shape ``(observations,)``.
        scale: what they are multiplied by before that, the same.
        noise: one deviation for all states, one that the network chooses in each state, or none:
            the policy then gives the action itself.
        hidden: units in each of its two hidden layers.
        log_std: logarithm of a deviation that is the same in every state.
    """
    actions = env.action_spec.shape[-1]
    outputs = actions * (2 if noise == "chosen" else 1)
    net = torch.nn.Sequential(Standardize(loc, scale), _small_network(len(loc), hidden, outputs))
    if noise == "none":
        policy = torch.nn.Sequential(net, torch.nn.Tanh())
        return TensorDictModule(policy, ["observation"], ["action"])
    if noise == "chosen":
        policy = torch.nn.Sequential(net, NormalParamExtractor())
    else:
        deviation = AddStateIndependentNormalScale(actions, init_value=log_std)
        policy = torch.nn.Sequential(net, deviation)
    bounded = not isinstance(env.action_spec, Unbounded)
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if bounded else IndependentNormal,
        distribution_kwargs={"tanh_loc": False} if bounded else {},
        return_log_prob=noise == "same",
    )


def make_agent(env: EnvBase, *, gamma: float, hidden: int = 64, log_std: float = 0.0) -> Agent:
    """Makes a policy and two critics of the state, with one output for each cost.

    Observations are standardized by their mean and deviation under random actions. The critics
    predict the mean of a step, and the value is ``1 / (1 - gamma)`` times that. Otherwise distances
    of centimetres and values of dozens would be too hard to learn for a small network in some
    hundred batches.

    Args:
        env: environment to read widths from, and to play in.
        gamma: discount of reward and costs.
        hidden: units in each of the two hidden layers of every network.
        log_std: logarithm of the policy's deviation to start with.
    """
    loc, scale = _standardization(env, deviation=math.exp(log_std))

    def critic(outputs: int, out_key: str) -> ValueOperator:
        net = _small_network(len(loc), hidden, outputs)
        predict = torch.nn.Sequential(
            torch.nn.Sequential(Standardize(loc, scale), net), Affine(0.0, 1 / (1 - gamma))
        )
        return ValueOperator(predict, in_keys=["observation"], out_keys=[out_key])

    actor = make_actor(env, loc, scale, noise="same", hidden=hidden, log_std=log_std)
    parameter = actor.get_parameter("0.module.1.state_independent_scale")
    critics = critic(1, "state_value"), critic(num_costs(env), "cost_value")
    return Agent(actor, *critics, parameter)


def make_q_agent(env: EnvBase, *, gamma: float, stochastic: bool, hidden: int = 64) -> QAgent:
    """Makes a policy and two critics of state and action, for algorithms that learn from replay.

    Args:
        env: see :func:`make_agent`.
        gamma: see :func:`make_agent`.
        stochastic: whether the policy gives a distribution, with a width for each state, or the
            action itself.
        hidden: see :func:`make_agent`.
    """
    loc, scale = _standardization(env)
    noise: Noise = "chosen" if stochastic else "none"
    actor = make_actor(env, loc, scale, noise=noise, hidden=hidden)
    actions = env.action_spec.shape[-1]

    def critic(outputs: int, out_key: str) -> ValueOperator:
        net = _small_network(len(loc) + actions, hidden, outputs)
        predict = _OfStateAndAction(Standardize(loc, scale), net, Affine(0.0, 1 / (1 - gamma)))
        return ValueOperator(predict, in_keys=["observation", "action"], out_keys=[out_key])

    costs = num_costs(env)
    critics = critic(1, "state_action_value"), critic(costs, "state_action_cost_value")
    return QAgent(actor, *critics)


class _OfStateAndAction(torch.nn.Module):
    def __init__(self, standardize: Standardize, net: MLP, unit: Affine) -> None:
        super().__init__()
        self.standardize, self.net, self.unit = standardize, net, unit

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.unit(self.net(self.standardize(observation), action))


def num_costs(env: EnvBase) -> int:
    """How many costs an environment has."""
    return env.reward_spec["cost"].shape[-1]


def _standardization(env: EnvBase, *, deviation: float = 1.0) -> tuple[Tensor, Tensor]:
    """Shift and scale that bring observations under random actions to mean 0 and deviation 1.

    Actions without bounds are drawn with that deviation.
    """

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        env.rand_action(tensordict)
        if isinstance(env.action_spec, Unbounded):
            tensordict["action"] *= deviation
        return tensordict

    with torch.no_grad():
        seen = env.rollout(200, act, break_when_any_done=False)["observation"].flatten(0, -2)
    # A number that hardly changes in these steps may change later.
    scale = 1 / seen.std(0).clamp_min(0.05)
    return -seen.mean(0) * scale, scale


def _small_network(inputs: int, hidden: int, outputs: int) -> MLP:
    net = MLP(inputs, outputs, num_cells=[hidden, hidden], activation_class=torch.nn.Tanh)
    # Nearly the same action and value everywhere to start with.
    torch.nn.init.orthogonal_(net[-1].weight, 0.01)
    torch.nn.init.zeros_(net[-1].bias)
    return net
