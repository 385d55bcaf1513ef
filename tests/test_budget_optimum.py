"""Within a budget, the best plan of the augmented problem is the best of the problem."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_safe.envs import EarlyTermination, Saute


class Choices(EnvBase):
    """Three steps. An action of 1 earns 1 and costs 1; an action of 0 earns and costs nothing."""

    def __init__(self, num_envs):
        super().__init__(batch_size=[num_envs])
        column = Unbounded((num_envs, 1))
        self.observation_spec = Composite(observation=column.clone(), shape=[num_envs])
        self.action_spec = column.clone()
        self.reward_spec = Composite(reward=column.clone(), cost=column.clone(), shape=[num_envs])

    def _reset(self, tensordict=None, **kwargs):
        self.count = torch.zeros(*self.batch_size, 1)
        return TensorDict(observation=self.count.clone(), batch_size=self.batch_size)

    def _step(self, tensordict):
        self.count = self.count + 1
        action, done = tensordict["action"], self.count >= 3
        return TensorDict(
            observation=self.count.clone(),
            reward=action.clone(),
            cost=action.clone(),
            done=done,
            terminated=done.clone(),
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed):
        pass


def returns(transform, plans):
    """Sum of the rewards of each plan until it is done, and of all its costs until then."""
    env = Choices(len(plans))
    env = env if transform is None else TransformedEnv(env, transform)
    data, running = env.reset(), torch.ones(len(plans), 1, dtype=torch.bool)
    total, cost = torch.zeros(2, len(plans), 1)
    for step in range(3):
        following = env.step(data.set("action", plans[:, step : step + 1]))["next"]
        total = total + following["reward"] * running
        cost = cost + following["cost"] * running
        running = running & ~following["done"]
        data = following.exclude("reward", "cost")
    return total.flatten(), cost.flatten()


@pytest.mark.parametrize("budget", [0.0, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("kind", ["saute", "early"])
def test_the_best_plan_is_the_best_within_the_budget(kind, budget):
    """All eight plans tried: without constraints the best costs 3."""
    plans = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    best, cost = returns(None, plans)
    assert (best.max(), cost[best.argmax()]) == (3.0, 3.0)
    if kind == "saute":  # Which takes budgets above 0.
        transform = Saute(max(budget, 0.1), unsafe_reward=-10.0)
    else:
        transform = EarlyTermination(budget, termination_reward=-10.0)
    total, cost = returns(transform, plans)
    chosen = total == total.max()
    assert total.max() == budget
    assert (cost[chosen] == budget).all()
    assert chosen.sum() == math.comb(3, int(budget))
