"""Checks for losses and multiplier rules of your own. Needs TorchRL only.

A check is a function that raises an :class:`AssertionError` which says what differs, so it works
in every test runner. Pass a loss as a callable, since a check makes several:
``check_loss(MyLoss, ClipPPOLoss)`` runs all checks of an on-policy loss, :func:`check_q_loss` those
of an off-policy one, and each can be called by itself.
"""

from torchrl_safe.testing._losses import set_multiplier, set_violation
from torchrl_safe.testing.bandits import (
    ConstrainedBandit,
    ContinuousConstrainedBandit,
    check_reaches_optimum,
    run_epochs,
    train_on_bandit,
)
from torchrl_safe.testing.batches import make_batch, make_minibatch, make_transitions
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
    ON_POLICY_KEYS,
    check_cast,
    check_compile,
    check_dispatch,
    check_input_unchanged,
    check_keys,
    check_state_dict,
)
from torchrl_safe.testing.networks import (
    ACTION_SIZE,
    OBSERVATION_SIZE,
    make_actor,
    make_critic,
    make_networks,
    make_q_actor,
    make_q_critic,
    make_q_networks,
)
from torchrl_safe.testing.suite import check_loss, check_q_loss
from torchrl_safe.testing.updaters import check_multiplier_updater

__all__ = [
    "ACTION_SIZE",
    "OBSERVATION_SIZE",
    "OFF_POLICY_KEYS",
    "ON_POLICY_KEYS",
    "ConstrainedBandit",
    "ContinuousConstrainedBandit",
    "check_cast",
    "check_compile",
    "check_dispatch",
    "check_equals_at_zero",
    "check_gradients",
    "check_input_unchanged",
    "check_keys",
    "check_loss",
    "check_masked_steps",
    "check_multiplier_direction",
    "check_multiplier_updater",
    "check_num_costs",
    "check_q_loss",
    "check_q_multiplier_direction",
    "check_reaches_optimum",
    "check_state_dict",
    "make_actor",
    "make_batch",
    "make_critic",
    "make_minibatch",
    "make_networks",
    "make_q_actor",
    "make_q_critic",
    "make_q_networks",
    "make_transitions",
    "run_epochs",
    "set_multiplier",
    "set_violation",
    "train_on_bandit",
]
