"""The networks that the experiments train."""

from __future__ import annotations

from typing import NamedTuple

import torch
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


def make_agent(env: EnvBase, *, gamma: float) -> Agent:
    """Makes a policy and two critics of the state, with one output for each cost.

    Observations are standardized by what random actions bring about, and the critics predict
    the mean of a step, of which the value is ``1 / (1 - gamma)`` times as much: distances of
    centimetres and values of dozens are both out of reach of a small network that Adam has
    some hundred batches to train.

    Args:
        env: environment to read widths from, and to play in.
        gamma: discount of reward and costs.
    """
    loc, scale = _standardization(env)
    actions, costs = env.action_spec.shape[-1], env.reward_spec["cost"].shape[-1]

    def network(outputs: int) -> torch.nn.Sequential:
        return torch.nn.Sequential(Affine(loc, scale), _small_network(len(loc), outputs))

    def critic(outputs: int, out_key: str) -> ValueOperator:
        predict = torch.nn.Sequential(network(outputs), Affine(0.0, 1 / (1 - gamma)))
        return ValueOperator(predict, in_keys=["observation"], out_keys=[out_key])

    noise = AddStateIndependentNormalScale(actions)
    policy = torch.nn.Sequential(network(actions), noise)
    bounded = not isinstance(env.action_spec, Unbounded)
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal if bounded else IndependentNormal,
        distribution_kwargs={"tanh_loc": False} if bounded else {},
        return_log_prob=True,
    )
    critics = critic(1, "state_value"), critic(costs, "cost_value")
    return Agent(actor, *critics, noise.state_independent_scale)


def make_q_agent(env: EnvBase, *, gamma: float, stochastic: bool) -> QAgent:
    """Makes a policy and two critics of state and action, for algorithms that learn from replay.

    Args:
        env: see :func:`make_agent`.
        gamma: see :func:`make_agent`.
        stochastic: whether the policy is a distribution of which it chooses the width in every
            state, or gives the action itself.
    """
    loc, scale = _standardization(env)
    actions, costs = env.action_spec.shape[-1], env.reward_spec["cost"].shape[-1]
    outputs = 2 * actions if stochastic else actions
    net = torch.nn.Sequential(Affine(loc, scale), _small_network(len(loc), outputs))
    if stochastic:
        policy = torch.nn.Sequential(net, NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(policy, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            distribution_kwargs={"tanh_loc": False},
        )
    else:
        policy = torch.nn.Sequential(net, torch.nn.Tanh())
        actor = TensorDictModule(policy, ["observation"], ["action"])

    def critic(outputs: int, out_key: str) -> ValueOperator:
        net = _small_network(len(loc) + actions, outputs)
        predict = _OfStateAndAction(Affine(loc, scale), net, Affine(0.0, 1 / (1 - gamma)))
        return ValueOperator(predict, in_keys=["observation", "action"], out_keys=[out_key])

    critics = critic(1, "state_action_value"), critic(costs, "state_action_cost_value")
    return QAgent(actor, *critics)


class _OfStateAndAction(torch.nn.Module):
    def __init__(self, standardize: Affine, net: MLP, unit: Affine) -> None:
        super().__init__()
        self.standardize, self.net, self.unit = standardize, net, unit

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.unit(self.net(self.standardize(observation), action))


def _standardization(env: EnvBase) -> tuple[Tensor, Tensor]:
    """Shift and scale that give what random actions bring about mean 0 and deviation 1."""
    with torch.no_grad():
        seen = env.rollout(200, break_when_any_done=False)["observation"].flatten(0, -2)
    # What hardly moves in these steps may do so later.
    scale = 1 / seen.std(0).clamp_min(0.05)
    return -seen.mean(0) * scale, scale


def _small_network(inputs: int, outputs: int) -> MLP:
    net = MLP(inputs, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
    # Nearly the same action and value everywhere to start with.
    torch.nn.init.orthogonal_(net[-1].weight, 0.01)
    torch.nn.init.zeros_(net[-1].bias)
    return net
