"""Evaluates a policy on whole episodes and puts confidence intervals on what it sees."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy import stats
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int,
    seed: int,
) -> TensorDict:
    """Runs the deterministic policy.

    Every world plays one episode from start to end, as often as needed. (Taking the first
    episodes to end, as TorchRL's ``Evaluator`` does, would favour short ones.)

    Args:
        env: batched environment with ``episode_reward`` and ``episode_cost``.
        policy: the policy.
        episodes: how many episodes at least.
        seed: seed of the episodes, so that every policy meets the same ones.

    Returns:
        One row for each episode, with ``success``, ``episode_reward``, ``episode_cost`` and
        ``steps``.
    """
    rounds = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(math.ceil(episodes / env.num_envs)):
            seed = env.set_seed(seed)
            play = env.rollout(env.max_episode_steps, policy, break_when_any_done=False)
            last = play["next", "done"].squeeze(-1).int().argmax(1)
            end = play["next"][torch.arange(env.num_envs), last]
            end = end.select("success", "episode_reward", "episode_cost")
            rounds.append(end.set("steps", last.unsqueeze(-1) + 1))
    return torch.cat(rounds)


def summarize(episodes: TensorDict, cost_names: tuple[str, ...]) -> dict[str, list[float]]:
    """Returns estimate, lower and upper end of the 95 % confidence interval of each figure.

    Shares have Wilson's interval, means that of the percentile bootstrap.

    Args:
        episodes: what :func:`evaluate` returns.
        cost_names: names of the columns of ``episode_cost``.
    """
    costs = episodes["episode_cost"]
    summary = {
        "success": share(episodes["success"]),
        "return": mean(episodes["episode_reward"]),
        "steps": mean(episodes["steps"]),
    }
    for name, column in zip(cost_names, costs.unbind(-1), strict=True):
        summary[f"cost/{name}"] = mean(column)
        summary[f"any/{name}"] = share(column > 0)
    return summary


def share(values: torch.Tensor) -> list[float]:
    """Share of true values with Wilson's 95 % interval."""
    test = stats.binomtest(int(values.sum()), values.numel())
    interval = test.proportion_ci(method="wilson")
    return [test.statistic, interval.low, interval.high]


def mean(values: torch.Tensor) -> list[float]:
    """Mean with the 95 % interval of the percentile bootstrap."""
    sample = values.flatten().double().numpy()
    interval = stats.bootstrap(
        (sample,), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return [float(sample.mean()), float(interval.low), float(interval.high)]
