"""Small batches: as a collector returns them, and as a replay buffer hands them to a loss."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives.value import GAE

from torchrl_safe.objectives import CostGAE, scaled_advantages
from torchrl_safe.testing._random import seeded
from torchrl_safe.testing.networks import (
    ACTION_SIZE,
    OBSERVATION_SIZE,
    make_actor,
    make_networks,
)


def make_batch(num_costs: int = 1, *, seed: int = 1) -> TensorDictBase:
    """Makes a batch as a collector returns it: four trajectories of six steps.

    Each step continues the one before, except where an episode ends: the first row has no end, the
    second terminates on the way, the third is truncated, and in the fourth both happen, one after
    the other. Log-probabilities are those of another policy than :func:`make_networks` makes, so
    that ratios are far from 1. The global random number generators are left as they were.

    Args:
        num_costs (int, optional): number k of costs. Cost i is uniform in [0, i + 1].
        seed (int, optional): seed of all entries.

    Returns:
        A tensordict of shape (4, 6), the second dimension named ``"time"``, with
        ``observation`` (4 numbers), ``action`` (2 numbers), ``action_log_prob``, ``loc`` and
        ``scale``; under ``"next"``, ``observation``, ``reward``, ``cost`` of shape (4, 6, k),
        ``done``, ``terminated`` and ``truncated``.

    Examples:
        >>> batch = make_batch(num_costs=3)
        >>> batch["next", "cost"].shape
        torch.Size([4, 6, 3])
    """
    with seeded(seed):
        return _make_batch(num_costs)


def _make_batch(num_costs: int) -> TensorDictBase:
    rows, steps = 4, 6
    terminated = torch.zeros(rows, steps, 1, dtype=torch.bool)
    truncated = torch.zeros(rows, steps, 1, dtype=torch.bool)
    terminated[1, 2] = terminated[3, 1] = True
    truncated[2, 3] = truncated[3, 4] = truncated[3, 5] = True
    done = terminated | truncated
    next_observation = torch.randn(rows, steps, OBSERVATION_SIZE)
    first = torch.randn(rows, 1, OBSERVATION_SIZE)
    after_reset = torch.randn(rows, steps - 1, OBSERVATION_SIZE)
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


@torch.no_grad()
def make_minibatch(num_costs: int = 1, *, seed: int = 1) -> TensorDictBase:
    """Makes data for an on-policy loss: :func:`make_batch`, flat, with advantages and targets.

    The reward advantage is standardized and the cost advantages are centred, as
    ``estimate_advantages`` leaves them with ``normalize_cost_advantage=False``. With the advantages
    given, a loss computes none.

    Args:
        num_costs (int, optional): number k of costs.
        seed (int, optional): seed of all entries.

    Returns:
        A tensordict of shape (24,). Beside the entries of :func:`make_batch` it has
        ``advantage``, ``value_target``, ``state_value`` of shape (24, 1), and
        ``cost_advantage``, ``cost_value_target``, ``cost_value`` of shape (24, k).

    Examples:
        >>> make_minibatch(num_costs=3)["cost_advantage"].shape
        torch.Size([24, 3])
    """
    batch = make_batch(num_costs, seed=seed)
    _, critic, cost_critic = make_networks(num_costs)
    GAE(gamma=0.99, lmbda=0.95, value_network=critic)(batch)
    CostGAE(gamma=0.99, lmbda=0.95, value_network=cost_critic)(batch)
    batch["advantage"], batch["cost_advantage"] = scaled_advantages(
        batch["advantage"], batch["cost_advantage"]
    )
    return batch.reshape(-1)


def make_transitions(
    num_costs: int = 1, *, num_transitions: int = 12, seed: int = 1
) -> TensorDictBase:
    """Makes transitions of an off-policy replay buffer.

    Of four transitions, one terminates, one is truncated and two go on. The global random number
    generators are left as they were.

    Args:
        num_costs (int, optional): number k of costs. Cost i is uniform in [0, i + 1].
        num_transitions (int, optional): number B of transitions.
        seed (int, optional): seed of all entries.

    Returns:
        A tensordict of shape (B,) with ``observation`` (4 numbers) and ``action`` (2 numbers in
        [-1, 1]); under ``"next"``, ``observation``, ``reward``, ``cost`` of shape (B, k), ``done``,
        ``terminated`` and ``truncated``.

    Examples:
        >>> make_transitions(num_costs=3)["next", "cost"].shape
        torch.Size([12, 3])
    """
    size = num_transitions
    index = torch.arange(size).unsqueeze(-1)
    terminated, truncated = index % 4 == 1, index % 4 == 2
    with seeded(seed):
        return TensorDict(
            observation=torch.randn(size, OBSERVATION_SIZE),
            action=torch.rand(size, ACTION_SIZE) * 2 - 1,
            next=TensorDict(
                observation=torch.randn(size, OBSERVATION_SIZE),
                reward=torch.randn(size, 1),
                cost=torch.rand(size, num_costs) * torch.arange(1, num_costs + 1),
                done=terminated | truncated,
                terminated=terminated,
                truncated=truncated,
                batch_size=[size],
            ),
            batch_size=[size],
        )
