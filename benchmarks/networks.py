"""The networks and the data of the update benchmarks: two hidden layers of 64 everywhere."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

#: Widths of ArmEnv's observation and action with one obstacle and seven joints.
OBSERVATION, ACTION = 40, 7


def network(outputs: int) -> MLP:
    """A network that reads an observation."""
    return MLP(OBSERVATION, outputs, num_cells=[64, 64], activation_class=nn.Tanh)


def make_actor() -> ProbabilisticActor:
    """A Gaussian policy with the same deviation in all states."""
    policy = nn.Sequential(network(ACTION), AddStateIndependentNormalScale(ACTION))
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(out_key: str) -> ValueOperator:
    """A critic with one output."""
    return ValueOperator(network(1), in_keys=["observation"], out_keys=[out_key])


def make_minibatch(size: int) -> TensorDict:
    """Made-up control steps with advantages and value targets, as they come from a buffer."""
    data = TensorDict(observation=torch.randn(size, OBSERVATION), batch_size=[size])
    with torch.no_grad():
        data = make_actor()(data)
    for key in ("advantage", "value_target", "cost_advantage", "cost_value_target"):
        data[key] = torch.randn(size, 1)
    return data.exclude("loc", "scale")
