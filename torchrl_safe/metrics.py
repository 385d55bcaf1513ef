"""How safe a policy is beyond its mean cost: rates, tails, worst cases, with intervals.

Pure functions of tensors; they need neither an environment nor a loss. ``episode_cost`` is the
undiscounted cost of whole episodes, shape ``(E, k)`` for E episodes and k costs, or ``(S, E, k)``
with the same number of episodes for each of S training seeds. Results are float64 on the CPU,
one number for each cost. Needs SciPy: ``pip install "torchrl-safe[metrics]"``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from numbers import Integral
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_safe._checks import as_number, as_tensor, check_one_each

try:
    from scipy import stats
except ImportError as error:
    raise ImportError(
        'torchrl_safe.metrics needs SciPy: pip install "torchrl-safe[metrics]".'
    ) from error

__all__ = [
    "Estimate",
    "WorstSeed",
    "conditional_value_at_risk",
    "constraint_regret",
    "cost_rate",
    "interquartile_mean",
    "longest_cost_run",
    "mean",
    "share",
    "violation_rate",
    "worst_seed",
]

Resampled = Literal["episodes", "seeds"]


class Estimate(NamedTuple):
    """An estimate and the ends of its confidence interval, each of shape ``(k,)``.

    Examples:
        >>> estimate = share(torch.ones(100, 1, dtype=torch.bool))
        >>> round(estimate.value.item(), 2), round(estimate.low.item(), 2)
        (1.0, 0.96)
        >>> value, low, high = estimate
    """

    value: Tensor
    low: Tensor
    high: Tensor


# ---------------------------------------------------------------- rates


def share(true: Tensor, *, confidence: float = 0.95) -> Estimate:
    """Share of episodes for which something is true, with Wilson's interval.

    Source: Wilson 1927. Unlike the usual normal interval it holds near 0 and 1 too: no violation
    in 100 episodes leaves up to 3.7 %. Seeds are pooled. The interval is then conservative for
    these S policies; it says nothing about a seed that you have not trained.

    Args:
        true (Tensor): bool, shape ``(E, k)`` or ``(S, E, k)``.

    Keyword Args:
        confidence (float, optional): coverage of the interval. Defaults to ``0.95``.

    Raises:
        ValueError: if ``true`` is empty, not bool or of the wrong shape, or ``confidence`` is
            not between 0 and 1.

    Examples:
        >>> import torch
        >>> rate = share(torch.zeros(100, 1, dtype=torch.bool))
        >>> print(f"{rate.value.item():.3f} [{rate.low.item():.3f}, {rate.high.item():.3f}]")
        0.000 [0.000, 0.037]
    """
    if true.dtype != torch.bool:
        raise ValueError(f"true must be bool, got {true.dtype}.")
    _check_confidence(confidence)
    columns = _by_seed("true", true).bool().flatten(0, 1)
    rows = []
    for hits in columns.sum(0).tolist():
        test = stats.binomtest(hits, len(columns))
        interval = test.proportion_ci(confidence, method="wilson")
        rows.append((test.statistic, interval.low, interval.high))
    return _estimate(rows)


def violation_rate(
    episode_cost: Tensor, cost_limit: float | Tensor, *, confidence: float = 0.95
) -> Estimate:
    """Share of episodes that cost more than the limit, with Wilson's interval.

    A policy that meets its limit on average may exceed it in every second episode, and this figure
    shows it. With the limit 0 it is the share of episodes with any cost.

    Args:
        episode_cost (Tensor): cost of each episode, shape ``(E, k)`` or ``(S, E, k)``.
        cost_limit (float or Tensor): limit of each cost, one number or k.

    Keyword Args:
        confidence (float, optional): coverage of the interval. Defaults to ``0.95``.

    Raises:
        ValueError: if the costs are empty, not finite or of the wrong shape, or another
            argument is not usable.

    Examples:
        >>> import torch
        >>> violation_rate(torch.tensor([[0.0], [1.0], [3.0], [0.0]]), 1.0).value
        tensor([0.2500], dtype=torch.float64)
    """
    cost = _by_seed("episode_cost", episode_cost)
    return share(cost > _limit(cost_limit, episode_cost), confidence=confidence)


def cost_rate(cost: Tensor) -> Tensor:
    """Cost of training: total cost divided by the number of frames.

    Ray et al. 2019, "Benchmarking Safe Exploration in Deep Reinforcement Learning", measure safety
    during training by it.

    Args:
        cost (Tensor): cost of every frame of training, shape ``(*B, k)`` with at least one
            batch dimension, as in ``batch["next", "cost"]``.

    Returns:
        Cost per frame, shape ``(k,)``.

    Raises:
        ValueError: if the costs are empty, not finite or of the wrong shape.

    Examples:
        >>> import torch
        >>> cost_rate(torch.tensor([[[0.0], [1.0]], [[0.0], [0.0]]]))
        tensor([0.2500], dtype=torch.float64)
    """
    if cost.ndim < 2:
        raise ValueError(f"cost must have shape (*B, k), got {tuple(cost.shape)}.")
    return _finite("cost", cost).flatten(0, -2).mean(0)


def constraint_regret(mean_cost: Tensor, cost_limit: float | Tensor) -> Tensor:
    r"""How far training was above the limit, added up over its batches.

    .. math::
        \sum_n (J_n - d)_+

    Batches below the limit do not make up for batches above it. Source: Efroni, Mannor, Pirotta
    2020 (https://arxiv.org/abs/2003.02189), who use the true expected cost of each
    policy. Here it is an estimate, whose noise adds to the sum even at the limit.

    Args:
        mean_cost (Tensor): mean episode cost of each batch of training, shape ``(N, k)``; leave
            out batches in which no episode ended.
        cost_limit (float or Tensor): limit of each cost, one number or k.

    Returns:
        The sum, in units of cost times batches, shape ``(k,)``.

    Raises:
        ValueError: if the costs are empty, not finite or of the wrong shape, or the limit is
            not usable.

    Examples:
        >>> import torch
        >>> constraint_regret(torch.tensor([[4.0], [1.5], [0.0]]), 1.0)
        tensor([3.5000], dtype=torch.float64)
    """
    if mean_cost.ndim != 2:
        raise ValueError(f"mean_cost must have shape (N, k), got {tuple(mean_cost.shape)}.")
    excess = _finite("mean_cost", mean_cost) - _limit(cost_limit, mean_cost)
    return excess.clamp_min(0).sum(0)


# ---------------------------------------------------------------- means


def mean(
    episode_cost: Tensor,
    *,
    resample: Resampled = "episodes",
    confidence: float = 0.95,
    seed: int = 0,
) -> Estimate:
    """Mean over episodes and seeds, with the interval of the percentile bootstrap.

    Args:
        episode_cost (Tensor): cost (or return) of each episode, shape ``(E, k)`` or
            ``(S, E, k)``.

    Keyword Args:
        resample ("episodes" or "seeds", optional): what the bootstrap draws. ``"episodes"`` draws
            within each seed (stratified): the interval is about these S policies. ``"seeds"``
            draws whole seeds: the interval is about the algorithm, of which each seed is one
            sample. It is wider, and needs more than a handful of seeds. Defaults to
            ``"episodes"``.
        confidence (float, optional): coverage of the interval. Defaults to ``0.95``.
        seed (int, optional): seed of the bootstrap. Defaults to ``0``.

    Raises:
        ValueError: if the costs are empty, not finite or of the wrong shape, if there are fewer
            than two things to draw from, or another argument is not usable.

    Examples:
        >>> import torch
        >>> cost = torch.tensor([0.0, 1.0]).repeat(200).unsqueeze(-1)
        >>> estimate = mean(cost)  # standard error 0.5 / sqrt(400) = 0.025
        >>> print(f"{estimate.value.item()} [{estimate.low.item()}, {estimate.high.item()}]")
        0.5 [0.45, 0.55]
    """
    return _bootstrap(np.mean, episode_cost, resample, confidence, seed)


def interquartile_mean(
    episode_cost: Tensor,
    *,
    resample: Resampled = "episodes",
    confidence: float = 0.95,
    seed: int = 0,
) -> Estimate:
    """Mean of the middle half of all episodes of all seeds, with a bootstrap interval.

    Source: Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical
    Precipice" (https://arxiv.org/abs/2108.13264). It is less noisy than the mean, and uses more of
    the data than the median. For their figure, whose strata are tasks and whose samples are runs,
    pass ``(tasks, runs, 1)`` and ``resample="episodes"``.

    It leaves out the worst quarter, so report it together with
    :func:`conditional_value_at_risk`. If fewer than a quarter of the episodes cost anything, it
    is 0.

    Args:
        episode_cost (Tensor): see :func:`mean`.

    Keyword Args:
        resample ("episodes" or "seeds", optional): see :func:`mean`.
        confidence (float, optional): see :func:`mean`.
        seed (int, optional): see :func:`mean`.

    Raises:
        ValueError: see :func:`mean`.

    Examples:
        >>> import torch
        >>> interquartile_mean(torch.tensor([[0.0], [1.0], [2.0], [99.0]])).value
        tensor([1.5000], dtype=torch.float64)
    """
    middle = partial(stats.trim_mean, proportiontocut=0.25)
    return _bootstrap(middle, episode_cost, resample, confidence, seed)


# ---------------------------------------------------------------- worst cases


def conditional_value_at_risk(episode_cost: Tensor, alpha: float) -> Tensor:
    r"""Mean cost of the worst share ``alpha`` of the episodes.

    .. math::
        \min_t\ t + \frac{1}{\alpha E} \sum_e (c_e - t)_+

    Source: Rockafellar & Uryasev 2000, "Optimization of Conditional Value-at-Risk", whose beta
    is ``1 - alpha``. The highest ``alpha * E`` costs count; if that is not a whole number, the
    lowest of them counts in part. So ``alpha = 1`` gives the mean, and every alpha up to
    ``1 / E`` the highest cost.

    Args:
        episode_cost (Tensor): cost of each episode, shape ``(E, k)``, or ``(S, E, k)``, where the
            seeds are pooled.
        alpha (float): the share, above 0 and up to 1.

    Returns:
        The mean of the tail, shape ``(k,)``.

    Raises:
        ValueError: if the costs are empty, not finite or of the wrong shape, or ``alpha`` is not
            usable.

    Examples:
        >>> import torch
        >>> cost = torch.tensor([[1.0], [5.0], [2.0], [0.0]])
        >>> conditional_value_at_risk(cost, 0.375)  # (5 + 0.5 * 2) / 1.5
        tensor([4.], dtype=torch.float64)
    """
    if not 0 < as_number(alpha) <= 1:
        raise ValueError(f"alpha must be above 0 and at most 1, got {alpha}.")
    cost = _by_seed("episode_cost", episode_cost).flatten(0, 1).sort(0, descending=True).values
    weight = (alpha * len(cost) - torch.arange(len(cost), dtype=cost.dtype)).clamp(0, 1)
    return weight @ cost / weight.sum()


class WorstSeed(NamedTuple):
    """What :func:`worst_seed` returns: the highest mean cost of a seed, and which seed it is.

    Each has shape ``(k,)``.

    Examples:
        >>> import torch
        >>> worst_seed(torch.tensor([[[0.0], [1.0]], [[2.0], [3.0]]])).seed
        tensor([1])
    """

    value: Tensor
    seed: Tensor


def worst_seed(episode_cost: Tensor) -> WorstSeed:
    """Highest mean cost among the training seeds, for each cost.

    Args:
        episode_cost (Tensor): cost of each episode, shape ``(S, E, k)``.

    Returns:
        The mean cost of that seed, and its index.

    Raises:
        ValueError: if the costs are empty, not finite or of the wrong shape.

    Examples:
        >>> import torch
        >>> worst_seed(torch.tensor([[[0.0], [1.0]], [[2.0], [3.0]]]))
        WorstSeed(value=tensor([2.5000], dtype=torch.float64), seed=tensor([1]))
    """
    if episode_cost.ndim != 3:
        raise ValueError(
            f"episode_cost must have shape (S, E, k), got {tuple(episode_cost.shape)}."
        )
    return WorstSeed(*_finite("episode_cost", episode_cost).mean(1).max(0))


def longest_cost_run(cost: Tensor, done: Tensor | None = None) -> Tensor:
    """Longest run of steps in a row that all cost something.

    It tells one long contact from many short ones. A run ends with its episode.

    Args:
        cost (Tensor): cost of each step, shape ``(*B, T, k)``.
        done (Tensor, optional): whether an episode ended with the step, bool, shape
            ``(*B, T, 1)``. Defaults to a single episode in each row.

    Returns:
        Number of steps, shape ``(*B, k)``, int64.

    Raises:
        ValueError: if the costs are empty or not finite, or a shape or dtype is wrong.

    Examples:
        >>> import torch
        >>> cost = torch.tensor([[1.0], [1.0], [1.0], [0.0], [1.0]])
        >>> longest_cost_run(cost)
        tensor([3])
        >>> longest_cost_run(cost, torch.tensor([[False], [True], [False], [False], [False]]))
        tensor([2])
    """
    if cost.ndim < 2:
        raise ValueError(f"cost must have shape (*B, T, k), got {tuple(cost.shape)}.")
    cost = _finite("cost", cost)
    step = torch.arange(1, cost.shape[-2] + 1).unsqueeze(-1)
    # The last step before the run that each step is in: itself if it costs nothing, ...
    before = torch.where(cost > 0, 0, step)
    if done is not None:
        if done.dtype != torch.bool or done.shape != (*cost.shape[:-1], 1):
            raise ValueError(
                f"done must be bool of shape {(*cost.shape[:-1], 1)}, got {done.dtype} of shape "
                f"{tuple(done.shape)}."
            )
        # ... or the end of the previous episode.
        end = torch.where(done.cpu(), step, 0)[..., :-1, :]
        before[..., 1:, :] = before[..., 1:, :].maximum(end)
    return (step - before.cummax(-2).values).amax(-2)


# ---------------------------------------------------------------- what they share


def _finite(name: str, values: Tensor) -> Tensor:
    if not values.numel():
        raise ValueError(f"{name} must not be empty, got shape {tuple(values.shape)}.")
    values = values.detach().double().cpu()
    if not values.isfinite().all():
        raise ValueError(f"{name} must be finite, got {values}.")
    return values


def _by_seed(name: str, values: Tensor) -> Tensor:
    """Returns the values in shape ``(S, E, k)``."""
    if values.ndim not in (2, 3):
        raise ValueError(f"{name} must have shape (E, k) or (S, E, k), got {tuple(values.shape)}.")
    values = _finite(name, values)
    return values if values.ndim == 3 else values.unsqueeze(0)


def _limit(cost_limit: float | Tensor, cost: Tensor) -> Tensor:
    # Rounded as the costs are: a float32 cost of 0.1 is not above a limit of 0.1.
    dtype = cost.dtype if cost.is_floating_point() else torch.float64
    limit = as_tensor("cost_limit", cost_limit, dtype).double().cpu()
    check_one_each("cost_limit", limit, cost.shape[-1])
    if not limit.isfinite().all():
        raise ValueError(f"cost_limit must be finite, got {cost_limit}.")
    return limit


def _check_confidence(confidence: float) -> None:
    if not 0 < as_number(confidence) < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}.")


def _estimate(rows: list[tuple[float, float, float]]) -> Estimate:
    return Estimate(*torch.tensor(rows, dtype=torch.float64).unbind(-1))


def _bootstrap(
    statistic: Callable[..., Any],
    episode_cost: Tensor,
    resample: Resampled,
    confidence: float,
    seed: int,
) -> Estimate:
    """Applies a statistic to each cost, and the percentile bootstrap to the statistic."""
    cost = _by_seed("episode_cost", episode_cost).numpy()
    _check_confidence(confidence)
    counts = {"seeds": cost.shape[0], "episodes": cost.shape[1]}
    if not isinstance(seed, Integral) or seed < 0:
        raise ValueError(f"seed must be a whole number and not negative, got {seed!r}.")
    if not isinstance(resample, str) or resample not in counts:
        raise ValueError(f'resample must be "episodes" or "seeds", got {resample!r}.')
    if counts[resample] < 2:
        raise ValueError(
            f"episode_cost must have at least 2 {resample} to draw from, got shape "
            f"{tuple(episode_cost.shape)}."
        )
    rows = []
    for column in np.moveaxis(cost, -1, 0):
        samples, of_samples = _samples(statistic, column, resample)
        interval = stats.bootstrap(
            samples,
            of_samples,
            vectorized=True,
            batch=max(1, 2**24 // column.size),  # keeps the memory to some 100 MB
            confidence_level=confidence,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).confidence_interval
        rows.append((statistic(column.ravel(), axis=-1), interval.low, interval.high))
    return _estimate(rows)


def _samples(
    statistic: Callable[..., Any], column: np.ndarray, resample: Resampled
) -> tuple[tuple[np.ndarray, ...], Callable[..., Any]]:
    """Returns what SciPy draws from, sample by sample, and the statistic of what it has drawn."""

    def of_episodes(*strata: np.ndarray, axis: int) -> Any:
        return statistic(np.concatenate(strata, axis=axis), axis=axis)

    def of_seeds(drawn: np.ndarray, axis: int) -> Any:
        return statistic(column[drawn].reshape(*drawn.shape[:-1], -1), axis=axis)

    if resample == "episodes":
        return tuple(column), of_episodes
    return (np.arange(len(column)),), of_seeds
