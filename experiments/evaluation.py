"""Evaluates a policy on whole episodes and puts confidence intervals on what it sees."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_safe.metrics import mean, share, violation_rate


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
    estimates = {
        "success": share(episodes["success"]),
        "return": mean(episodes["episode_reward"]),
        "steps": mean(episodes["steps"]),
    }
    for name, column in zip(cost_names, costs.split(1, -1), strict=True):
        estimates[f"cost/{name}"] = mean(column)
        estimates[f"any/{name}"] = violation_rate(column, 0.0)
    return {name: torch.cat(estimate).tolist() for name, estimate in estimates.items()}
