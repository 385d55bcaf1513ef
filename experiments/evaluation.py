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
    max_steps: int | None = None,
) -> TensorDict:
    """Runs the deterministic policy.

    Every world plays one episode from start to end, as often as needed. (Taking the first
    episodes to end, as TorchRL's ``Evaluator`` does, would favour short ones.)

    Args:
        env: environment, batched or not, with ``episode_reward`` and ``episode_cost``.
        policy: the policy.
        episodes: how many episodes at least.
        seed: seed of the episodes, so that every policy meets the same ones.
        max_steps: steps in which every episode ends. Defaults to the environment's
            ``max_episode_steps``.

    Returns:
        One row for each episode, with ``episode_reward``, ``episode_cost``, ``steps``, and
        ``success`` if the environment tells.

    Raises:
        ValueError: if an episode has not ended after ``max_steps``.
    """
    max_steps = env.max_episode_steps if max_steps is None else max_steps
    rounds = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(math.ceil(episodes / env.batch_size.numel())):
            seed = env.set_seed(seed)
            play = env.rollout(max_steps, policy, break_when_any_done=False)
            play = play.reshape(-1, play.shape[-1])["next"]
            done = play["done"].squeeze(-1)
            if not done.any(1).all():
                raise ValueError(
                    f"max_steps must let every episode end, got {max_steps}, after which "
                    f"{int((~done.any(1)).sum())} of {len(done)} go on."
                )
            last = done.int().argmax(1)
            end = play[torch.arange(len(done)), last]
            end = end.select("success", "episode_reward", "episode_cost", strict=False)
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
    success = episodes.get("success", None)
    estimates = {} if success is None else {"success": share(success)}
    estimates["return"] = mean(episodes["episode_reward"])
    estimates["steps"] = mean(episodes["steps"])
    for name, column in zip(cost_names, costs.split(1, -1), strict=True):
        estimates[f"cost/{name}"] = mean(column)
        estimates[f"any/{name}"] = violation_rate(column, 0.0)
    return {name: torch.cat(estimate).tolist() for name, estimate in estimates.items()}
