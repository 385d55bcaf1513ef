"""All checks of a loss in one call."""

from __future__ import annotations

from functools import partial
from typing import Any

from torchrl_safe.testing._losses import Constrain, MakeLoss, set_multiplier
from torchrl_safe.testing.batches import make_batch, make_transitions
from torchrl_safe.testing.equality import check_equals_at_zero
from torchrl_safe.testing.gradients import (
    check_gradients,
    check_masked_steps,
    check_multiplier_direction,
    check_num_costs,
    check_q_multiplier_direction,
)
from torchrl_safe.testing.interface import (
    OFF_POLICY_KEYS,
    check_cast,
    check_compile,
    check_dispatch,
    check_input_unchanged,
    check_keys,
    check_state_dict,
)
from torchrl_safe.testing.networks import make_q_networks


def check_loss(
    make_loss: MakeLoss,
    make_parent: MakeLoss | None = None,
    *,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks a constrained on-policy loss: every check of this package that fits it.

    Args:
        make_loss (callable): makes the loss, called as ``make_loss(actor, critic, cost_critic,
            num_costs=k)``. A class with this signature will do.
        make_parent (callable, optional): makes the loss that it constrains, called as
            ``make_parent(actor, critic)``, for :func:`check_equals_at_zero`.

    Keyword Args:
        constrain (callable, optional): how the loss is put under constraint.
            Defaults to :func:`set_multiplier`; :func:`set_violation` is for losses without
            multipliers.

    Raises:
        AssertionError: if a check fails.

    Examples:
        >>> from torchrl.objectives import ClipPPOLoss
        >>> from torchrl_safe.objectives import PPOLagrangianLoss
        >>> check_loss(PPOLagrangianLoss, ClipPPOLoss)
    """
    if make_parent is not None:
        check_equals_at_zero(make_loss, make_parent, constrain=constrain)
    for check in (
        check_gradients,
        check_multiplier_direction,
        check_num_costs,
        check_masked_steps,
        check_keys,
        partial(check_keys, nested=False, make_data=make_batch),
        check_dispatch,
        check_input_unchanged,
        check_state_dict,
        check_cast,
        check_compile,  # Takes seconds, so it is the last.
    ):
        check(make_loss, constrain=constrain)


def check_q_loss(
    make_loss: MakeLoss,
    make_parent: MakeLoss | None = None,
    *,
    deterministic: bool = False,
    constrain: Constrain = set_multiplier,
) -> None:
    """Checks a constrained off-policy loss: every check of this package that fits it.

    Args:
        make_loss (callable): makes the loss, called as ``make_loss(actor, qvalue, cost_qvalue,
            num_costs=k)``.
        make_parent (callable, optional): makes the loss that it constrains, called as
            ``make_parent(actor, qvalue)``, for :func:`check_equals_at_zero`.

    Keyword Args:
        deterministic (bool, optional): give the loss a deterministic actor, as TD3's.
            Defaults to ``False``.
        constrain (callable, optional): how the loss is put under constraint.
            Defaults to :func:`set_multiplier`.

    Raises:
        AssertionError: if a check fails.

    Examples:
        >>> from functools import partial
        >>> from torchrl.objectives import SACLoss
        >>> from torchrl_safe.objectives import SACLagrangianLoss
        >>> options = {"target_entropy": -2.0, "alpha_init": 0.5}
        >>> check_q_loss(partial(SACLagrangianLoss, **options), partial(SACLoss, **options))
    """
    setting: dict[str, Any] = {
        "make_networks": partial(make_q_networks, deterministic=deterministic),
        "make_data": make_transitions,
        "constrain": constrain,
    }
    if make_parent is not None:
        check_equals_at_zero(make_loss, make_parent, **setting)
    check_keys(make_loss, OFF_POLICY_KEYS, **setting)
    check_input_unchanged(make_loss, writes=["td_error"], **setting)
    for check in (
        check_gradients,
        check_q_multiplier_direction,
        check_masked_steps,
        check_dispatch,
        check_state_dict,
        check_cast,
        check_compile,
    ):
        check(make_loss, **setting)
