"""Tiny networks and a batch as a collector returns it, for the tests of the objectives."""

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator

from torchrl_safe.objectives import PPOLagrangianLoss

OBSERVATION, ACTION = 4, 2


def mlp(in_features, out_features):
    return nn.Sequential(nn.Linear(in_features, 8), nn.Tanh(), nn.Linear(8, out_features))


def make_actor(observation="observation", action="action"):
    # A plain normal has an analytic entropy: no Monte Carlo, hence no random numbers in a loss.
    policy = nn.Sequential(mlp(OBSERVATION, 2 * ACTION), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(policy, [observation], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def make_critic(out_key="state_value", num_values=1, observation="observation"):
    return ValueOperator(mlp(OBSERVATION, num_values), in_keys=[observation], out_keys=[out_key])


def make_networks(num_costs=1, value="state_value", cost_value="cost_value", seed=0):
    """Actor, critic and cost critic; the first two are the same for every ``num_costs``."""
    torch.manual_seed(seed)
    return make_actor(), make_critic(value), make_critic(cost_value, num_costs)


def make_loss(num_costs=1, seed=0, **kwargs):
    networks = make_networks(num_costs, seed=seed)
    return PPOLagrangianLoss(*networks, num_costs=num_costs, **kwargs)


def make_batch(num_costs=1, seed=1):
    """A [4, 6] batch: a running row, a terminated one, a truncated one, one with both.

    The log-probabilities are those of another policy, so that the clipping of PPO is at work.
    """
    rows, steps = 4, 6
    torch.manual_seed(seed)
    terminated = torch.zeros(rows, steps, 1, dtype=torch.bool)
    truncated = torch.zeros(rows, steps, 1, dtype=torch.bool)
    terminated[1, 2] = terminated[3, 1] = True
    truncated[2, 3] = truncated[3, 4] = truncated[3, 5] = True
    done = terminated | truncated
    next_observation = torch.randn(rows, steps, OBSERVATION)
    first = torch.randn(rows, 1, OBSERVATION)
    after_reset = torch.randn(rows, steps - 1, OBSERVATION)
    carried = torch.where(done[:, :-1], after_reset, next_observation[:, :-1])
    batch = TensorDict(
        observation=torch.cat([first, carried], 1),
        next=TensorDict(
            observation=next_observation,
            reward=torch.randn(rows, steps, 1),
            cost=torch.rand(rows, steps, num_costs) * torch.arange(1, num_costs + 1),
            done=done,
            terminated=terminated,
            truncated=truncated,
            batch_size=[rows, steps],
        ),
        batch_size=[rows, steps],
        names=[None, "time"],
    )
    with torch.no_grad():
        make_actor()(batch)
    return batch
