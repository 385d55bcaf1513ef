"""Every algorithm ends at the constrained optimum of one small problem, see ``ConstrainedBandit``.

With p the share of action A, the reward advantage is standardized and the cost advantage centred:
A_r = (1[A] - p) / s with s = sqrt(p (1 - p)), and A_c = (1[A] - p) for the cost that binds,
-(1[A] - p) for the one that does not. Each step of an episode is its last, so that the discount of
the costs is 0 where a loss asks how a step's cost adds up to an episode's.
"""

import math
from functools import partial

import pytest
import torch
from on_policy import around
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss, ReinforceLoss

from torchrl_safe.objectives import (
    CRPOLoss,
    CUPLoss,
    DualAscent,
    FOCOPSLoss,
    IPOLoss,
    LagrangianLoss,
    P3OLoss,
    PIDControl,
    PPOLagrangianLoss,
    ViolationUpdater,
)
from torchrl_safe.testing import ConstrainedBandit, run_epochs, train_on_bandit

pytestmark = pytest.mark.integration

LIMIT = ConstrainedBandit.optimal_probability

# A_r - lambda A_c vanishes here at p = LIMIT.
MULTIPLIER = 1 / math.sqrt(LIMIT * (1 - LIMIT))
IN_UNITS = {"normalize_cost_advantage": False}
SHARPNESS = 5.0

pid = partial(
    PIDControl,
    kp=5.0,
    ki=1.0,
    kd=5.0,
    smoothing=0.5,
    max_multiplier=None,
    pessimism=0.0,
    normalize=False,
)


def of_one_step(make, **kwargs):
    """``make`` for episodes of one step, as a function of the networks."""

    def build(*networks, num_costs):
        loss = make(*networks, num_costs=num_costs, entropy_bonus=False, **kwargs)
        # GAE's vectorized recursion of TorchRL 0.14 fails for a discount of 0.
        return loss.make_cost_value_estimator(gamma=0.0, vectorized=False)

    return build


def learn_in_two_phases(loss, optimizer, buffer):
    run_epochs(loss, optimizer, buffer)
    loss.start_projection()
    run_epochs(loss.projection_loss, optimizer, buffer)


def violation(loss):
    return loss.cost_violation


NO_BONUS = {"entropy_bonus": False}
LAGRANGIAN = {
    "a2c": around(partial(LagrangianLoss, **IN_UNITS), partial(A2CLoss, **NO_BONUS)),
    "reinforce": around(partial(LagrangianLoss, **IN_UNITS), ReinforceLoss),
    "clip-ppo": around(partial(LagrangianLoss, **IN_UNITS), partial(ClipPPOLoss, **NO_BONUS)),
    "kl-ppo": around(partial(LagrangianLoss, **IN_UNITS), partial(KLPENPPOLoss, **NO_BONUS)),
    "focops": of_one_step(FOCOPSLoss, **IN_UNITS),
}
CRPO = {
    "a2c": around(CRPOLoss, partial(A2CLoss, **NO_BONUS)),
    "clip-ppo": around(CRPOLoss, partial(ClipPPOLoss, **NO_BONUS)),
}


def last(outcome, count):
    """Means over the last batches."""
    return tuple(each[-count:].mean(0) for each in outcome)


# The tolerances are twice or more what five seeds differed from the optimum at most.


@pytest.mark.parametrize("make", LAGRANGIAN.values(), ids=LAGRANGIAN.keys())
def test_lagrangian_losses_reach_the_optimum_and_its_multipliers(make):
    outcome = train_on_bandit(make, pid, num_batches=80)
    share, multiplier = last(outcome, 40)
    assert share.item() == pytest.approx(LIMIT, abs=0.01)
    assert multiplier[0].item() == pytest.approx(MULTIPLIER, abs=0.05)
    assert multiplier[1].item() == pytest.approx(0.0, abs=1e-3)


def test_cup_reaches_the_optimum():
    make = of_one_step(CUPLoss, multiplier_init=1.0)
    rule = partial(
        PIDControl, kp=5.0, ki=0.5, kd=0.0, max_multiplier=None, pessimism=0.0, normalize=False
    )
    outcome = train_on_bandit(make, rule, num_batches=50, learn=learn_in_two_phases)
    share, multiplier = last(outcome, 30)
    assert share.item() == pytest.approx(LIMIT, abs=0.01)
    assert multiplier[0] > 0.5
    assert multiplier[1].item() == pytest.approx(0.0, abs=1e-3)


def test_p3o_reaches_the_optimum():
    """Its coefficient is above the optimal multiplier, so the penalty is exact.

    Noise makes it fall short of the limit by a little: it pushes whenever a batch is above.
    """
    make = of_one_step(P3OLoss, penalty_coeff=5.0)
    outcome = train_on_bandit(make, ViolationUpdater, num_batches=50, lr=0.03, read=violation)
    share, _ = last(outcome, 30)
    assert share.item() == pytest.approx(LIMIT, abs=0.02)


def test_ipo_keeps_the_distance_of_its_barrier():
    """The forces of reward and of both barriers are in balance, a little before the limit."""

    def force(share):
        reward = 1 / math.sqrt(share * (1 - share))
        binding, other = LIMIT - share, share - (1 - 0.9)
        return reward - 1 / (SHARPNESS * binding) + 1 / (SHARPNESS * other)

    low, high = 0.11, LIMIT - 0.01
    assert force(low) > 0 > force(high)
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if force(middle) > 0 else (low, middle)
    make = of_one_step(IPOLoss, sharpness=SHARPNESS)
    outcome = train_on_bandit(make, ViolationUpdater, num_batches=50, lr=0.03, read=violation)
    share, excess = last(outcome, 30)
    assert share.item() == pytest.approx(low, abs=0.006)
    assert (excess < 0).all()


@pytest.mark.parametrize("make", CRPO.values(), ids=CRPO.keys())
def test_crpo_swings_about_the_limit(make):
    """It learns of a violation only after it happened: its mean is a little above the limit."""
    shares, _ = train_on_bandit(make, ViolationUpdater, num_batches=50, lr=0.03, read=violation)
    assert shares[-30:].mean().item() == pytest.approx(LIMIT, abs=0.05)
    assert shares[-30:].min() < LIMIT < shares[-30:].max()


UNCONSTRAINED = {**LAGRANGIAN, "crpo": CRPO["clip-ppo"], "cup": of_one_step(CUPLoss)}


@pytest.mark.parametrize("make", UNCONSTRAINED.values(), ids=UNCONSTRAINED.keys())
def test_without_its_rule_each_exceeds_the_limit(make):
    shares, _ = train_on_bandit(make, num_batches=20, read=lambda loss: loss.cost_critic_coeff)
    assert shares[-5:].mean() > 2 * LIMIT


def test_the_optimum_is_the_same_for_ppo_lagrangian_to_the_bit():
    wrapped = LAGRANGIAN["clip-ppo"]
    outcomes = [
        train_on_bandit(make, partial(DualAscent, lr=1.0), num_batches=10)
        for make in (wrapped, partial(PPOLagrangianLoss, **NO_BONUS, **IN_UNITS))
    ]
    for ours, theirs in zip(*outcomes, strict=True):
        assert torch.equal(ours, theirs)
