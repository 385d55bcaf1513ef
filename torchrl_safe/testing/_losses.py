"""How the checks make losses, call them and compare what they return."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_safe.testing._random import seeded

MakeLoss = Callable[..., LossModule]
MakeNetworks = Callable[..., tuple[Any, Any, Any]]
MakeData = Callable[..., TensorDictBase]
Constrain = Callable[[LossModule, Tensor], None]


def set_multiplier(loss: LossModule, strength: Tensor) -> None:
    """Sets the multipliers of a loss to ``strength``, shape ``(k,)``.

    Examples:
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> from torchrl_safe.testing import make_networks, set_multiplier
        >>> loss = PPOLagrangianLoss(*make_networks(num_costs=2), num_costs=2)
        >>> set_multiplier(loss, torch.tensor([0.0, 2.5]))
        >>> loss.lagrange_multiplier
        tensor([0.0000, 2.5000])
    """
    loss.lagrange_multiplier.copy_(strength)


def set_violation(loss: LossModule, strength: Tensor) -> None:
    """Sets the violations of a loss without multipliers, such as P3O, IPO and CRPO.

    A cost with a ``strength`` above 0 exceeds its limit by that much. One with a strength of 0 is
    so far below its limit that it has no effect.

    Examples:
        >>> from torchrl_safe.objectives import P3OLoss
        >>> from torchrl_safe.testing import make_networks, set_violation
        >>> loss = P3OLoss(*make_networks(num_costs=2), num_costs=2)
        >>> set_violation(loss, torch.tensor([0.0, 2.5]))
        >>> loss.cost_violation
        tensor([-1.0000e+30,  2.5000e+00])
    """
    loss.cost_violation.copy_(torch.where(strength > 0, strength, -1e30))


def build(
    make_loss: MakeLoss,
    make_networks: MakeNetworks,
    num_costs: int,
    *,
    seed: int = 0,
    keys: Mapping[str, NestedKey] | None = None,
) -> LossModule:
    """A loss on new networks, with target networks that differ from those they follow."""
    networks = make_networks(num_costs, seed=seed, keys=keys or {})
    return finish(lambda: make_loss(*networks, num_costs=num_costs), seed)


def constrained(
    make_loss: MakeLoss, make_networks: MakeNetworks, num_costs: int, constrain: Constrain
) -> LossModule:
    """A loss on new networks, under each constraint with strength 1."""
    loss = build(make_loss, make_networks, num_costs)
    constrain(loss, torch.ones(num_costs))
    return loss


def build_parent(make_parent: MakeLoss, make_networks: MakeNetworks, num_costs: int) -> LossModule:
    """A loss without costs on the same networks."""
    actor, critic, _ = make_networks(num_costs, seed=0, keys={})
    return finish(lambda: make_parent(actor, critic), 0)


def finish(make: Callable[[], LossModule], seed: int) -> LossModule:
    with seeded(seed):  # Ensembles draw their copies anew.
        loss = make()
        if follow_targets(loss) is not None:
            with torch.no_grad():
                for parameter in loss.parameters():
                    parameter.add_(0.2 * torch.randn_like(parameter))
    return loss


def follow_targets(loss: LossModule) -> SoftUpdate | None:
    """What moves the target networks of a loss, or None if it has none."""
    targets = any(name.startswith("target_") for name, _ in loss.named_children())
    return SoftUpdate(loss, tau=0.05) if targets else None


def call(loss: Callable[..., Any], *args: TensorDictBase, seed: int = 7, **kwargs: Tensor) -> Any:
    """The outputs of a loss for a copy of the data, its random numbers drawn from a seed."""
    with seeded(seed):
        return loss(*(data.clone() for data in args), **kwargs)


def loss_keys(losses: TensorDictBase) -> list[str]:
    """The outputs that are trained on."""
    return [key for key in losses.keys() if key.startswith("loss_")]  # noqa: SIM118


def total(losses: TensorDictBase) -> Tensor:
    """The sum that is trained on."""
    return torch.stack([losses[key].sum() for key in loss_keys(losses)]).sum()


def state_of(module: nn.Module) -> dict[str, Tensor]:
    """Parameters and targets by name."""
    targets = {name: value for name, value in module.named_buffers() if "target_" in name}
    return {**dict(module.named_parameters()), **targets}


def counterparts(loss: LossModule, parent: LossModule) -> dict[str, tuple[Tensor, Tensor]]:
    """What the parent trains, by name, and the same in the loss, which may wrap the parent."""
    ours, pairs = state_of(loss), {}
    for name, theirs in state_of(parent).items():
        found = [key for key in ours if key == name or key.endswith(f".{name}")]
        require(
            bool(found), f"{named(loss)} has no {name!r}, which {named(parent)} has: {sorted(ours)}"
        )
        pairs[name] = ours[min(found, key=len)], theirs
    return pairs


def named(loss: LossModule) -> str:
    return type(loss).__name__


def require(condition: bool, message: str) -> None:
    """Raises AssertionError; unlike ``assert`` also under ``python -O``."""
    if not condition:
        raise AssertionError(message)


def require_equal(what: str, actual: Any, expected: Any) -> None:
    """Raises AssertionError unless both are the same, bit for bit."""
    torch.testing.assert_close(
        actual, expected, rtol=0.0, atol=0.0, msg=lambda text: f"{what}: {text}"
    )


def require_close(what: str, actual: Any, expected: Any) -> None:
    """Raises AssertionError, which says what differs and how much, unless both are close."""
    torch.testing.assert_close(actual, expected, msg=lambda text: f"{what}: {text}")


def require_same_outputs(
    what: str, actual: TensorDictBase, expected: TensorDictBase, *, exact: bool = True
) -> None:
    """Every output of ``expected`` is in ``actual``, and equal or close."""
    missing = sorted(set(expected.keys()) - set(actual.keys()))
    require(not missing, f"{what}: no output {missing}, only {sorted(actual.keys())}")
    compare = require_equal if exact else require_close
    for key in list(expected.keys()):
        compare(f"{what}, output {key!r}", actual[key], expected[key])
