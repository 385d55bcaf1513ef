"""Checks of a rule that moves multipliers."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_safe._checks import check_positive
from torchrl_safe.objectives import MultiplierUpdater
from torchrl_safe.testing._losses import require, require_close, require_equal

MakeUpdater = Callable[..., MultiplierUpdater]


def check_multiplier_updater(make_updater: MakeUpdater, *, multiplier_init: float = 1.0) -> None:
    """Checks that a multiplier rule does what every loss and training loop relies on.

    A violated limit raises its multiplier and a kept one lowers it, each cost for itself; no
    multiplier is ever negative or not finite; a batch without a finished episode changes nothing,
    nor does one that is refused; the buffer is written in place, so that compiled losses see it;
    and a restored rule goes on as the one that was saved.

    Args:
        make_updater (callable): makes the rule, called as ``make_updater(loss, cost_limit=limit)``
            with a loss that has nothing but its multipliers, and one limit for each.

    Keyword Args:
        multiplier_init (float, optional): multiplier to start with. Defaults to ``1.0``.

    Raises:
        AssertionError: if one of these does not hold.
        ValueError: if ``multiplier_init`` is not positive: a kept limit could not lower it.

    Examples:
        >>> from functools import partial
        >>> from torchrl_safe.objectives import DualAscent
        >>> check_multiplier_updater(partial(DualAscent, lr=0.1))
    """
    check_positive(multiplier_init=multiplier_init)
    _check_directions(make_updater, multiplier_init)
    _check_refusals(make_updater, multiplier_init)
    _check_restored(make_updater, multiplier_init)


def _make(make_updater: MakeUpdater, *limits: float, init: float) -> MultiplierUpdater:
    loss = LossModule()
    loss.register_buffer("lagrange_multiplier", torch.full((len(limits),), init))
    return make_updater(loss, cost_limit=torch.tensor(limits))


def _multiplier(updater: MultiplierUpdater) -> Tensor:
    return updater.loss_module.lagrange_multiplier


def _check_directions(make_updater: MakeUpdater, init: float) -> None:
    limits, costs = (1.0, 5.0), torch.tensor([[2.0, 1.0], [4.0, 1.0]])
    updater = _make(make_updater, *limits, init=init)
    buffer, address = _multiplier(updater), _multiplier(updater).data_ptr()
    updater.step(costs)
    require(buffer[0].item() > init, f"cost 3 under a limit of 1 moved {init} to {buffer[0]}")
    require(buffer[1].item() < init, f"cost 1 under a limit of 5 moved {init} to {buffer[1]}")
    for index, limit in enumerate(limits):
        alone = _make(make_updater, limit, init=init)
        alone.step(costs[:, index : index + 1])
        require_close(
            f"cost {index} moves its multiplier as it does alone",
            buffer[index : index + 1],
            _multiplier(alone),
        )
    for cost in (0.0, 100.0, 0.0, 0.0):
        for _ in range(20):
            updater.step(torch.full((2, 2), cost))
            require(
                bool((buffer.isfinite() & (buffer >= 0)).all()),
                f"multipliers must be finite and not negative, costs of {cost} made them {buffer}",
            )
    require(
        _multiplier(updater) is buffer and buffer.data_ptr() == address,
        "the multiplier must be updated in place: it is another tensor now",
    )


def _check_refusals(make_updater: MakeUpdater, init: float) -> None:
    updater, twin = (_make(make_updater, 1.0, 5.0, init=init) for _ in range(2))
    for each in (updater, twin):
        each.step(torch.tensor([[3.0, 1.0]]))
    before = _multiplier(updater).clone()
    updater.step(torch.empty(0, 2))
    require_equal(
        "multipliers after a batch without a finished episode", _multiplier(updater), before
    )
    bad = {
        "a cost of NaN": torch.tensor([[float("nan"), 1.0]]),
        "an infinite cost": torch.tensor([[float("inf"), 1.0]]),
        "one cost instead of two": torch.ones(3, 1),
        "costs without episodes": torch.ones(2),
    }
    for what, episode_cost in bad.items():
        try:
            updater.step(episode_cost)
        except ValueError:
            pass
        else:
            raise AssertionError(f"{what}, {episode_cost}, must raise a ValueError")
        require_equal(f"multipliers after {what}", _multiplier(updater), before)
    for each in (updater, twin):  # Nothing hidden has moved either.
        each.step(torch.tensor([[2.0, 4.0]]))
    require_equal(
        "multipliers of the batch after those that changed nothing",
        _multiplier(updater),
        _multiplier(twin),
    )


def _check_restored(make_updater: MakeUpdater, init: float) -> None:
    saved, loaded = (_make(make_updater, 1.0, 5.0, init=init) for _ in range(2))
    costs = torch.rand(6, 3, 2, generator=torch.Generator().manual_seed(0)) * 8
    for batch in costs[:3]:
        saved.step(batch)
    # As from a file: the state of torch's optimizers is not a copy.
    loaded.loss_module.load_state_dict(copy.deepcopy(saved.loss_module.state_dict()))
    loaded.load_state_dict(copy.deepcopy(saved.state_dict()))
    for batch in costs[3:]:
        for updater in (saved, loaded):
            updater.step(batch)
        require_equal("multipliers of a restored updater", _multiplier(loaded), _multiplier(saved))
