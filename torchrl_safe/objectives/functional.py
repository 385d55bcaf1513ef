"""Pure functions that the constrained losses are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_safe.objectives._checks import check_columns, check_number, check_rows


def scaled_advantages(
    advantage: Tensor,
    cost_advantage: Tensor,
    *,
    cost_scale: Tensor | None = None,
    counted: Tensor | None = None,
    standardize: bool = True,
    exclude_dims: Sequence[int] = (),
) -> tuple[Tensor, Tensor]:
    r"""Scales the advantages of a whole batch, for all on-policy losses.

    .. math::
        \hat A_r = \frac{A_r - \overline{A_r}}{\mathrm{std}(A_r)}, \qquad
        \hat A_{c_i} = \frac{A_{c_i} - \overline{A_{c_i}}}{\sigma_i}

    The reward advantage is **standardized**, so that the objective does not depend on the scale of
    the rewards. The cost advantages are **centred**, and divided by ``cost_scale`` if you pass one.
    Do this once for the collected batch, before :func:`penalized_advantage` mixes the advantages: a
    multiplier then means the same in every minibatch.

    - Without ``cost_scale`` a multiplier is in standard deviations of the reward advantage per
      unit of cost, as in the code of Ray et al. 2019. A cost in another unit needs another
      multiplier, and so does a policy whose rewards vary less than before.
    - With the scale of :func:`cost_advantage_scale` (``normalize_cost_advantage=True`` of the
      losses) a multiplier has no unit: it says how many standard deviations of the reward
      advantage one standard deviation of the cost advantage is worth.

    P3O and IPO compare a cost advantage with a violation, and need both in the unit of the cost.

    Args:
        advantage (Tensor): reward advantage, shape ``(*B, 1)``.
        cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.

    Keyword Args:
        cost_scale (Tensor, optional): what the advantages of the costs are divided by, shape
            ``(k,)``; where it is 0, nothing is divided. Defaults to ``None``, the unit of the cost.
        counted (Tensor, optional): the steps that count, bool, shape ``(*B, 1)``. Defaults to
            ``None``, all of them.
        standardize (bool, optional): standardize the reward advantage. Pass ``False`` if something
            else scales it. Defaults to ``True``.
        exclude_dims (sequence of int, optional): dimensions of the reward advantage along which
            each entry is standardized by itself, such as that of the agents. Defaults to ``()``.

    Returns:
        Both advantages, scaled.

    Raises:
        ValueError: if the shapes do not fit together.

    Examples:
        >>> import torch
        >>> reward, cost = torch.tensor([[1.0], [3.0]]), torch.tensor([[1.0], [5.0]])
        >>> scaled_advantages(reward, cost)
        (tensor([[-0.7071],
                [ 0.7071]]), tensor([[-2.],
                [ 2.]]))
        >>> scale = cost_advantage_scale(torch.zeros(1), cost)
        >>> scaled_advantages(reward, cost, cost_scale=scale)[1]
        tensor([[-0.7071],
                [ 0.7071]])
    """
    check_rows(advantage, cost_advantage)
    if cost_scale is not None:
        check_columns(cost_advantage, "scale", cost_scale)
    if standardize:
        advantage = standardized(advantage, counted, exclude_dims)
    cost_advantage = centred(cost_advantage, counted)
    if cost_scale is not None:
        cost_advantage = cost_advantage / torch.where(cost_scale > 0, cost_scale, 1.0)
    return advantage, cost_advantage


def cost_advantage_scale(
    past: Tensor, cost_advantage: Tensor, counted: Tensor | None = None, *, memory: float = 0.98
) -> Tensor:
    r"""The scale of the cost advantages after one more batch.

    .. math::
        \sigma \leftarrow \max\big(s,\ m \sigma + (1 - m) s\big), \qquad
        s = \mathrm{std}(A_c)

    The scale rises at once to the standard deviation of the batch, and falls to it slowly. A policy
    that has learnt to avoid a cost sees it rarely, and its cost advantage is then mostly the noise
    of the critic. Dividing by the batch's own deviation would make that noise as large as the
    advantage of the reward.

    Args:
        past (Tensor): the scale until now, shape ``(k,)``; 0 at the start.
        cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.
        counted (Tensor, optional): the steps that count, bool, shape ``(*B, 1)``. Defaults to
            ``None``, all of them.

    Keyword Args:
        memory (float, optional): the share m of the past. Defaults to ``0.98``: half of a
            difference is left after 34 calls.

    Returns:
        The scale, shape ``(k,)``; that of the past where the batch has a NaN or an infinity.

    Raises:
        ValueError: if ``past`` has another number of costs, or ``memory`` is not from 0 to 1.

    Examples:
        >>> import torch
        >>> scale = cost_advantage_scale(torch.zeros(1), torch.tensor([[3.0], [-3.0]]))
        >>> scale, cost_advantage_scale(scale, torch.zeros(2, 1))
        (tensor([4.2426]), tensor([4.1578]))
    """
    check_columns(cost_advantage, "scale", past)
    memory = check_number("memory", memory, most=1)
    rows = tuple(range(cost_advantage.ndim - 1))
    if counted is not None:  # What does not count may be NaN.
        counted = counted.expand_as(cost_advantage)
        cost_advantage = torch.where(counted, cost_advantage, 0.0)
    # Near the ends of single precision squares would be 0 or infinite.
    unit = cost_advantage.abs().amax(rows).clamp_min(torch.finfo(cost_advantage.dtype).tiny)
    values = centred(cost_advantage / unit, counted)
    if counted is None:
        count = torch.tensor(values[..., 0].numel())
    else:
        values, count = torch.where(counted, values, 0.0), counted.sum(rows)
    # Unbiased, and 0 for a single step.
    current = unit * (values.square().sum(rows) / (count - 1).clamp_min(1)).sqrt()
    # In half precision small steps would be lost: it would stay where it is.
    current = current.to(torch.promote_types(past.dtype, current.dtype))
    past = past.to(current)
    scale = torch.maximum(current, past.lerp(current, 1 - memory))
    return torch.where(current.isfinite(), scale, past)  # NaN would never be forgotten.


def standardized(
    values: Tensor, counted: Tensor | None = None, exclude_dims: Sequence[int] = ()
) -> Tensor:
    """Brings values to mean 0 and standard deviation 1, over those that count.

    As TorchRL's ``normalize_advantage``: the deviation of a masked batch is divided by its count.
    A deviation below a millionth of the largest value counts as rounding. One value alone has none,
    and stays as it is.
    """
    excluded = {dim % values.ndim for dim in exclude_dims}
    dims = tuple(dim for dim in range(values.ndim) if dim not in excluded)
    if math.prod(values.shape[dim] for dim in dims) <= 1:
        return values
    of_counted = values if counted is None else torch.where(counted, values, 0.0)
    # The squares of less are 0, and so would the deviation be.
    least = torch.finfo(values.dtype).tiny ** 0.5
    floor = (1e-6 * of_counted.abs().amax(dims, keepdim=True)).clamp_min(least)
    if counted is None:
        scale = values.std(dims, keepdim=True).maximum(floor)
        return (values - values.mean(dims, keepdim=True)) / scale
    count = counted.expand_as(values).sum(dims, keepdim=True).clamp_min(1)
    mean = of_counted.sum(dims, keepdim=True) / count
    square = torch.where(counted, values - mean, 0.0).square().sum(dims, keepdim=True)
    return (values - mean) / (square / count).sqrt().maximum(floor)


def centred(values: Tensor, counted: Tensor | None = None) -> Tensor:
    """Takes off the mean of each column, over the rows that count."""
    rows = tuple(range(values.ndim - 1))
    if counted is None:
        return values - values.mean(rows, keepdim=True)
    counted = counted.expand_as(values).contiguous()
    count = counted.sum(rows, keepdim=True).clamp_min(1)
    return values - torch.where(counted, values, 0.0).sum(rows, keepdim=True) / count


def penalized_advantage(
    advantage: Tensor,
    cost_advantage: Tensor,
    lagrange_multiplier: Tensor,
    *,
    rescale: bool = True,
) -> Tensor:
    r"""Mixes the reward advantage with the advantages of the costs.

    .. math::
        A = \frac{A_r - \sum_i \lambda_i A_{c_i}}{1 + \sum_i \lambda_i}

    The denominator keeps the size of the policy step independent of the multipliers, as in the
    code of Ray et al. 2019, "Benchmarking Safe Exploration in Deep Reinforcement Learning". With
    every multiplier at zero the result equals ``advantage`` exactly.

    Args:
        advantage (Tensor): reward advantage, shape ``(*B, 1)``.
        cost_advantage (Tensor): advantage of each of the k costs, shape ``(*B, k)``.
        lagrange_multiplier (Tensor): non-negative multipliers, shape ``(k,)``.

    Keyword Args:
        rescale (bool, optional): divide by the denominator. Defaults to ``True``.

    Returns:
        The mixed advantage, shape ``(*B, 1)``.

    Raises:
        ValueError: if the three shapes do not fit together.

    Examples:
        >>> import torch
        >>> reward, cost = torch.tensor([[1.0], [2.0]]), torch.tensor([[3.0], [-2.0]])
        >>> penalized_advantage(reward, cost, torch.tensor([1.0]))
        tensor([[-1.],
                [ 2.]])
    """
    check_columns(cost_advantage, "multiplier", lagrange_multiplier)
    check_rows(advantage, cost_advantage)
    penalized = advantage - (lagrange_multiplier * cost_advantage).sum(-1, keepdim=True)
    return penalized / (1 + lagrange_multiplier.sum()) if rescale else penalized


def per_step(episode_length: float | None, gamma: Tensor) -> Tensor | float:
    r"""Returns the factor from an amount per episode to one per step, the unit of a surrogate.

    A surrogate is a mean over steps, a violation a mean over whole episodes. The papers take
    :math:`1 - \gamma`, as if every episode had :math:`1 / (1 - \gamma)` steps. With a discount of
    0.99 an episode of 40 steps then counts as one of 100, and a change of the policy seems to
    change the cost 2.5 times as much as it does.

    Args:
        episode_length (float, optional): mean number of steps of an episode; if ``None``,
            :math:`1 / (1 - \gamma)`.
        gamma (Tensor): discount of the costs.

    Returns:
        The share of one step in an episode.
    """
    return 1 - gamma if episode_length is None else 1 / episode_length
