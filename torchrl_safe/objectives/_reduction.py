"""What a loss returns: the mean or sum over the steps that count, as in TorchRL, and reports."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import AUTO_LOSS_MASK_KEYS, LossModule


def counted(loss: LossModule, tensordict: TensorDictBase, values: Tensor) -> Tensor | None:
    """The steps that a loss counts, expanded to the shape of the values, or None if all."""
    key = loss.loss_mask_key
    keys = AUTO_LOSS_MASK_KEYS if key == "auto" else () if key is None else (key,)
    masks = []
    for key in keys:
        if (mask := tensordict.get(key, None)) is not None:
            if mask.dtype is not torch.bool:
                raise ValueError(f"The mask {key!r} must be bool, got {mask.dtype}.")
            masks.append(expanded_mask(mask, values))
    return torch.stack(masks).all(0) if masks else None


def reduced(
    loss: LossModule, values: Tensor, tensordict: TensorDictBase, reduction: str | None = None
) -> Tensor:
    """Reduces values as a loss reduces its own, over the steps that count.

    Use it in a loss of your own: ``values.mean()`` would count the steps that a mask leaves out.

    Args:
        loss (LossModule): gives ``loss_mask_key`` and ``reduction``.
        values (Tensor): one value or more for each step, shape ``(*B, ...)``.
        tensordict (TensorDictBase): the data, with the masks.
        reduction (str, optional): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to the loss's.

    Returns:
        A number, or with ``"none"`` the values, 0 where they do not count.

    Raises:
        ValueError: if there is no such reduction, or a mask is not bool or does not fit the values.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_safe.objectives import PPOLagrangianLoss, reduced
        >>> from torchrl_safe.testing import make_networks
        >>> loss = PPOLagrangianLoss(*make_networks())
        >>> mask = torch.tensor([[True], [True], [False]])
        >>> data = TensorDict({("collector", "mask"): mask}, batch_size=[3])
        >>> reduced(loss, torch.tensor([[1.0], [2.0], [60.0]]), data)
        tensor(1.5000)
    """
    reduction = loss.reduction if reduction is None else reduction
    if reduction not in ("mean", "sum", "none"):
        raise ValueError(f'reduction must be "mean", "sum" or "none", got {reduction!r}.')
    mask = counted(loss, tensordict, values)
    if mask is not None:  # Not multiplied by the mask: infinity times 0 is NaN.
        values = torch.where(mask, values, torch.zeros_like(values))
    if reduction == "none":
        return values
    if reduction == "sum":
        return values.sum()
    return values.mean() if mask is None else values.sum() / mask.sum().clamp_min(1)


def variances(values: Tensor, mask: Tensor | None) -> Tensor:
    """Variance of each of k columns over the steps that count, shape ``(k,)``."""
    if mask is None:
        return values.flatten(0, -2).var(0, correction=0)
    values, mask = values.flatten(0, -2), mask.flatten(0, -2)
    count = mask.sum(0).clamp_min(1)
    mean = torch.where(mask, values, 0.0).sum(0) / count
    return torch.where(mask, (values - mean).square(), 0.0).sum(0) / count


def expanded_mask(mask: Tensor, values: Tensor) -> Tensor:
    """A mask of steps in the shape of the values, a last dimension of 1 more or less."""
    while mask.ndim > values.ndim and mask.shape[-1] == 1:
        mask = mask.squeeze(-1)
    if mask.ndim > values.ndim:
        raise ValueError(
            f"A mask of shape {tuple(mask.shape)} does not fit values of shape "
            f"{tuple(values.shape)}."
        )
    return mask.reshape(*mask.shape, *(1,) * (values.ndim - mask.ndim)).expand_as(values)


def report_each(losses: TensorDictBase, name: str, values: Tensor) -> None:
    """Adds an output for each cost, from a buffer of shape ``(k,)``."""
    # Scalars, since trainers and loggers keep no others; cloned, since buffers change in place.
    for index, value in enumerate(values.clone().unbind()):
        losses.set(f"{name}_{index}", value)
