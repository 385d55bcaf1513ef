"""With multipliers of 0, a constrained loss is the loss that it constrains."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe.testing._losses import (
    Constrain,
    MakeData,
    MakeLoss,
    MakeNetworks,
    build,
    build_parent,
    call,
    counterparts,
    follow_targets,
    loss_keys,
    named,
    require_equal,
    require_same_outputs,
    set_multiplier,
    total,
)
from torchrl_safe.testing.batches import make_minibatch
from torchrl_safe.testing.networks import make_networks as make_default_networks


def check_equals_at_zero(
    make_loss: MakeLoss,
    make_parent: MakeLoss,
    *,
    num_costs: int = 2,
    num_updates: int = 20,
    make_networks: MakeNetworks = make_default_networks,
    make_data: MakeData = make_minibatch,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks that a loss whose multipliers are 0 is another loss, bit for bit.

    It compares the outputs, the gradients of each of them, the state of the random number generator
    after a call, and the weights after some updates with Adam on minibatches.

    Args:
        make_loss (callable): makes the loss, called as ``make_loss(actor, critic, cost_critic,
            num_costs=k)``. A class with this signature will do.
        make_parent (callable): makes the other loss, called as ``make_parent(actor, critic)``.

    Keyword Args:
        num_costs (int, optional): number k of costs. Defaults to ``2``.
        num_updates (int, optional): updates with Adam. Defaults to ``20``.
        make_networks (callable, optional): makes actor, critic and cost critic, as
            :func:`make_networks` does. :func:`make_q_networks` is for off-policy losses.
        make_data (callable, optional): makes what the loss is called with, as
            :func:`make_minibatch` does. :func:`make_transitions` is for off-policy losses.
        constrain (callable, optional): applies constraints to a loss, called with the loss and
            the strength of each constraint, shape (k,). A strength of 0 removes the constraint.
            Defaults to :func:`set_multiplier`.

    Raises:
        AssertionError: if anything differs. It names the output, the gradient or the weight.

    Examples:
        >>> from torchrl.objectives import ClipPPOLoss
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_equals_at_zero(PPOLagrangianLoss, ClipPPOLoss)
    """
    loss = build(make_loss, make_networks, num_costs)
    parent = build_parent(make_parent, make_networks, num_costs)
    with torch.no_grad():
        for ours, theirs in counterparts(loss, parent).values():
            theirs.copy_(ours)
    constrain(loss, torch.zeros(num_costs))
    data = make_data(num_costs)
    what = f"{named(loss)} without constraint and {named(parent)} differ"

    losses, state = _with_state(loss, data)
    expected, expected_state = _with_state(parent, data)
    require_same_outputs(what, losses, expected)
    require_equal(f"{what}, random numbers drawn", state, expected_state)
    for key in loss_keys(expected):
        if not expected[key].requires_grad:  # As the loss of a temperature that is fixed.
            continue
        _compare_gradients(f"{what}, gradient of {key!r}", losses[key], expected[key], loss, parent)

    for each in (loss, parent):
        _train(each, data, num_updates)
    for name, (ours, theirs) in counterparts(loss, parent).items():
        require_equal(f"{what}, {name} after {num_updates} updates", ours, theirs)


def _with_state(loss: LossModule, data: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
    """Outputs, and the random number generator afterwards."""
    return call(lambda data: (loss(data), torch.get_rng_state()), data)


def _compare_gradients(
    what: str, ours: Tensor, theirs: Tensor, loss: LossModule, parent: LossModule
) -> None:
    pairs = counterparts(loss, parent)
    pairs = {name: pair for name, pair in pairs.items() if pair[1].requires_grad}
    gradients = (
        torch.autograd.grad(
            value.sum(),
            [pair[index] for pair in pairs.values()],
            retain_graph=True,
            allow_unused=True,
        )
        for index, value in enumerate((ours, theirs))
    )
    for name, mine, other in zip(pairs, *gradients, strict=True):
        nothing = torch.zeros_like(pairs[name][1])
        require_equal(
            f"{what} by {name}",
            nothing if mine is None else mine,
            nothing if other is None else other,
        )


def _train(loss: LossModule, data: TensorDictBase, num_updates: int) -> None:
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    targets, order = follow_targets(loss), torch.Generator().manual_seed(3)
    for update in range(num_updates):
        minibatch = data[torch.randperm(len(data), generator=order)[: max(1, len(data) // 3)]]
        total(call(loss, minibatch, seed=update)).backward()
        optimizer.step()
        optimizer.zero_grad()
        if targets is not None:
            targets.step()
