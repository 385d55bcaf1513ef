"""A whole optimizer step as one function, of which ``torch.compile`` can make one graph."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8


def whole_update(
    module: nn.Module,
    objective: Callable[..., Tensor],
    *,
    learning_rate: float,
    max_grad_norm: float,
) -> Callable[..., None]:
    """Forward, backward, clipped gradient and Adam without ``.backward()`` and optimizer.

    Compiled, it wants ``torch._dynamo.config.trace_autograd_ops``.

    Args:
        module: what is trained.
        objective: what is minimized, called with the arguments of the step.
        learning_rate: Adam's.
        max_grad_norm: norm to which the gradient is clipped.
    """
    parameters = list(module.parameters())
    means = [torch.zeros_like(parameter) for parameter in parameters]
    squares = [torch.zeros_like(parameter) for parameter in parameters]
    count = torch.zeros((), device=parameters[0].device)

    def step(*inputs: object) -> None:
        gradients = torch.autograd.grad(objective(*inputs), parameters)
        norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
        scale = (max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        with torch.no_grad():
            count.add_(1)
            rate, spread = learning_rate / (1 - _BETA1**count), (1 - _BETA2**count).sqrt()
            for parameter, gradient, mean, square in zip(
                parameters, gradients, means, squares, strict=True
            ):
                clipped = scale * gradient
                mean.lerp_(clipped, 1 - _BETA1)
                square.mul_(_BETA2).addcmul_(clipped, clipped, value=1 - _BETA2)
                parameter.sub_(rate * mean / (square.sqrt() / spread + _EPS))

    return step
