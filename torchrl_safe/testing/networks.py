"""Small networks for losses: an actor, a critic of the reward and one of the costs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import (
    Actor,
    IndependentNormal,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from torchrl_safe.testing._random import seeded

#: Numbers in an observation and in an action.
OBSERVATION_SIZE, ACTION_SIZE = 4, 2

_NO_KEYS: Mapping[str, NestedKey] = MappingProxyType({})


def mlp(in_features: int, out_features: int) -> nn.Sequential:
    """One hidden layer of eight units."""
    return nn.Sequential(nn.Linear(in_features, 8), nn.Tanh(), nn.Linear(8, out_features))


def make_actor(
    observation: NestedKey = "observation", action: NestedKey = "action"
) -> ProbabilisticActor:
    """Makes a Gaussian policy that writes its log-probability.

    Its entropy is analytic, so a loss with an entropy bonus draws no random numbers.

    Args:
        observation (NestedKey, optional): key of the observation, of 4 numbers.
        action (NestedKey, optional): key of the action, of 2 numbers.

    Examples:
        >>> actor = make_actor()
        >>> actor.in_keys, actor.out_keys
        (['observation'], ['loc', 'scale', 'action', 'action_log_prob'])
    """
    policy = nn.Sequential(mlp(OBSERVATION_SIZE, 2 * ACTION_SIZE), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(policy, [observation], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(
    out_key: NestedKey = "state_value",
    num_values: int = 1,
    observation: NestedKey = "observation",
) -> ValueOperator:
    """Makes a value operator.

    Args:
        out_key (NestedKey, optional): what it writes, of shape ``(*B, num_values)``.
        num_values (int, optional): numbers that it predicts.
        observation (NestedKey, optional): key of the observation, of 4 numbers.

    Examples:
        >>> critic = make_critic("cost_value", num_values=2)
        >>> critic(observation=torch.zeros(3, 4)).shape
        torch.Size([3, 2])
    """
    network = mlp(OBSERVATION_SIZE, num_values)
    return ValueOperator(network, in_keys=[observation], out_keys=[out_key])


def make_networks(
    num_costs: int = 1, *, seed: int = 0, keys: Mapping[str, NestedKey] = _NO_KEYS
) -> tuple[ProbabilisticActor, ValueOperator, ValueOperator]:
    """Makes the networks of an on-policy loss: actor, critic and cost critic.

    Actor and critic are the same for every ``num_costs``. The global random number generators are
    left as they were.

    Args:
        num_costs (int, optional): number k of costs, the width of the cost critic.

    Keyword Args:
        seed (int, optional): seed of the weights.
        keys (mapping, optional): other keys than the default, named as in the ``tensor_keys`` of a
            loss: ``value`` and ``cost_value`` are what the critics write. Names that belong to
            the batch have no effect here.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> from torchrl_safe.testing import make_batch, make_networks
        >>> loss = PPOLagrangianLoss(*make_networks(num_costs=2), num_costs=2)
        >>> losses = loss(loss.estimate_advantages(make_batch(num_costs=2)).reshape(-1))
        >>> losses["loss_cost_critic"].isfinite()
        tensor(True)
    """
    with seeded(seed):
        return (
            make_actor(),
            make_critic(keys.get("value", "state_value")),
            make_critic(keys.get("cost_value", "cost_value"), num_costs),
        )


class _QValue(nn.Module):
    """Values of an observation and an action."""

    def __init__(self, num_values: int) -> None:
        super().__init__()
        self.body = mlp(OBSERVATION_SIZE + ACTION_SIZE, num_values)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.body(torch.cat([observation, action], -1))


def make_q_actor(*, deterministic: bool = False, action: NestedKey = "action") -> TensorDictModule:
    """Makes a policy with actions in [-1, 1]: as SAC's, or deterministic as TD3's.

    Keyword Args:
        deterministic (bool, optional): return an :class:`~torchrl.modules.Actor` without
            randomness. Defaults to ``False``.
        action (NestedKey, optional): key of the action, of 2 numbers.

    Examples:
        >>> actor = make_q_actor(deterministic=True)
        >>> actor(observation=torch.zeros(3, 4)).shape
        torch.Size([3, 2])
    """
    if deterministic:
        policy = nn.Sequential(mlp(OBSERVATION_SIZE, ACTION_SIZE), nn.Tanh())
        return Actor(policy, in_keys=["observation"], out_keys=[action])
    policy = nn.Sequential(mlp(OBSERVATION_SIZE, 2 * ACTION_SIZE), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_q_critic(
    out_key: NestedKey = "state_action_value", num_values: int = 1, action: NestedKey = "action"
) -> ValueOperator:
    """Makes a critic of an observation and an action.

    Args:
        out_key (NestedKey, optional): what it writes, of shape ``(*B, num_values)``.
        num_values (int, optional): numbers that it predicts.
        action (NestedKey, optional): key of the action, of 2 numbers.

    Examples:
        >>> critic = make_q_critic("state_action_cost_value", num_values=2)
        >>> critic(observation=torch.zeros(3, 4), action=torch.zeros(3, 2)).shape
        torch.Size([3, 2])
    """
    return ValueOperator(_QValue(num_values), in_keys=["observation", action], out_keys=[out_key])


def make_q_networks(
    num_costs: int = 1,
    *,
    seed: int = 0,
    keys: Mapping[str, NestedKey] = _NO_KEYS,
    deterministic: bool = False,
) -> tuple[TensorDictModule, ValueOperator, ValueOperator]:
    """Makes the networks of an off-policy loss: actor, Q-critic and Q-critic of the costs.

    Actor and critic are the same for every ``num_costs``. The global random number generators are
    left as they were.

    Args:
        num_costs (int, optional): number k of costs, the width of the cost critic.

    Keyword Args:
        seed (int, optional): seed of the weights.
        keys (mapping, optional): other keys than the default, named as in the ``tensor_keys`` of a
            loss: ``action``, ``state_action_value`` and ``state_action_cost_value``. Names that
            belong to the batch have no effect here.
        deterministic (bool, optional): make the actor of TD3 in place of SAC's.

    Examples:
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_safe.objectives import SACLagrangianLoss
        >>> from torchrl_safe.testing import make_q_networks, make_transitions
        >>> networks = make_q_networks(num_costs=2)
        >>> loss = SACLagrangianLoss(*networks, num_costs=2, target_entropy=-2.0)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> loss(make_transitions(num_costs=2))["loss_cost_qvalue"].isfinite()
        tensor(True)
    """
    action = keys.get("action", "action")
    value = keys.get("state_action_value", "state_action_value")
    cost_value = keys.get("state_action_cost_value", "state_action_cost_value")
    with seeded(seed):
        return (
            make_q_actor(deterministic=deterministic, action=action),
            make_q_critic(value, action=action),
            make_q_critic(cost_value, num_costs, action),
        )
