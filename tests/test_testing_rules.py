"""What tests multiplier rules finds their faults."""

from functools import partial

import pytest
import torch

from torchrl_safe import testing
from torchrl_safe.objectives import (
    DualAscent,
    MultiplierUpdater,
    PPOLagrangianLoss,
)

# ---------------------------------------------------------------- faults of rules


class Rule(MultiplierUpdater):
    def next_multiplier(self, multiplier, violation):
        return multiplier + 0.1 * violation


class Backwards(Rule):
    def next_multiplier(self, multiplier, violation):
        return multiplier - 0.1 * violation


class Together(Rule):
    def next_multiplier(self, multiplier, violation):
        return multiplier + 0.1 * violation * torch.tensor(1.0 + 0.1 * (len(violation) - 1))


class Leaks(Rule):
    """The first cost moves the multiplier of the second too."""

    def next_multiplier(self, multiplier, violation):
        return multiplier + 0.1 * violation.cumsum(0)


class Unbounded(Rule):
    def _move(self, buffer, episode_cost):
        buffer.add_(0.1 * self._violation(episode_cost))


class NewTensor(Rule):
    def _move(self, buffer, episode_cost):
        moved = (buffer + 0.1 * self._violation(episode_cost)).clamp_min(0)
        self.loss_module._buffers["lagrange_multiplier"] = moved


class Trusting(Rule):
    def step(self, episode_cost):
        if len(episode_cost):
            self._move(self.loss_module.lagrange_multiplier, episode_cost.nan_to_num(0.0))


class Decays(Rule):
    def step(self, episode_cost):
        if not len(episode_cost):
            self.loss_module.lagrange_multiplier.mul_(0.9)
        super().step(episode_cost)


class Amnesiac(Rule):
    """Has a step size that shrinks, and forgets by how much."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.count = 1

    def next_multiplier(self, multiplier, violation):
        self.count += 1
        return multiplier + 0.1 * violation / self.count


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (Backwards, r"cost 3 under a limit of 1 moved 1\.0 to 0\.8"),
        (Together, "cost 0 moves its multiplier as it does alone"),
        (Leaks, "cost 1 moves its multiplier as it does alone"),
        (Unbounded, "multipliers must be finite and not negative"),
        (NewTensor, "moved|in place"),
        (Trusting, r"a cost of NaN, .* must raise a ValueError"),
        (Decays, "after a batch without a finished episode"),
        (Amnesiac, "multipliers of a restored updater"),
    ],
)
def test_a_faulty_rule(rule, message):
    with pytest.raises(AssertionError, match=message):
        testing.check_multiplier_updater(rule)


def test_a_rule_that_does_not_find_the_optimum():
    make = partial(PPOLagrangianLoss, entropy_bonus=False)
    with pytest.raises(AssertionError, match=r"The probability of action A is 0\.\d+ after 10 bat"):
        testing.check_reaches_optimum(make, partial(DualAscent, lr=1e-3), num_batches=10)
    wide = {"probability_tolerance": 1.0, "multiplier_tolerance": 10.0}
    testing.check_reaches_optimum(make, partial(DualAscent, lr=1e-3), num_batches=10, **wide)
