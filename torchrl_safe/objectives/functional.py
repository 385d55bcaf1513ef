"""Pure functions that the constrained losses are made of."""

from __future__ import annotations

from torch import Tensor


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
    if lagrange_multiplier.ndim != 1 or cost_advantage.shape[-1:] != lagrange_multiplier.shape:
        raise ValueError(
            "cost_advantage must have one column for each multiplier, got cost_advantage of shape "
            f"{tuple(cost_advantage.shape)} and lagrange_multiplier of shape "
            f"{tuple(lagrange_multiplier.shape)}."
        )
    if advantage.shape != (*cost_advantage.shape[:-1], 1):
        raise ValueError(
            "advantage must have shape (*B, 1) and cost_advantage (*B, k) with the same *B, got "
            f"{tuple(advantage.shape)} and {tuple(cost_advantage.shape)}."
        )
    penalized = advantage - (lagrange_multiplier * cost_advantage).sum(-1, keepdim=True)
    return penalized / (1 + lagrange_multiplier.sum()) if rescale else penalized
