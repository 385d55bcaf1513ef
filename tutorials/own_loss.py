"""
A loss and a multiplier rule of your own, tested
================================================

You write a constrained loss and two rules that move its multiplier. Tests of
``torchrl_safe.testing`` find three faults in them, each of which would have cost you days of
training. At the end you see both rules on a problem whose best policy is known: one circles above
its limit, the other settles on it.

This page runs in half a minute. It needs TorchRL only, no robot.
"""

# %%
# A loss in one method
# --------------------
#
# PPO-Lagrangian mixes the advantages of reward and cost, then clips. You want to clip them
# separately: a step that gains no more reward may still lower the cost.
#
# Subclass the loss that is nearest, and write ``policy_losses``. It gets both advantages.
# ``self.unconstrained`` is TorchRL's own loss for the advantage that you pass. Networks, keys,
# advantages and the cost critic stay as they are.

from functools import partial
from textwrap import fill

import matplotlib.pyplot as plt
import torch
from torchrl import torchrl_logger
from torchrl.objectives import ClipPPOLoss

from torchrl_safe import testing
from torchrl_safe.objectives import MultiplierUpdater, PPOLagrangianLoss

torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")


class SeparatelyClippedLoss(PPOLagrangianLoss):
    def policy_losses(self, tensordict, advantage, cost_advantage):
        policy = self.evaluate(tensordict)
        losses = self.unconstrained(tensordict, advantage, policy)
        price = (cost_advantage * self.lagrange_multiplier).sum(-1, keepdim=True)
        penalty = self.unconstrained(tensordict, price, policy)["loss_objective"]
        total = losses["loss_objective"] + penalty
        losses["loss_objective"] = total / (1 + self.lagrange_multiplier.sum())
        return losses


# %%
# Test it
# -------
#
# It runs, and its losses look like any others. Still it would teach an arm to collide. Ask
# whether a multiplier lowers its cost:


def outcome(check, *arguments, **options):
    try:
        check(*arguments, **options)
    except AssertionError as error:
        return fill(f"{check.__name__} failed: {error}", 84)
    return f"{check.__name__} passed"


print(outcome(testing.check_equals_at_zero, SeparatelyClippedLoss, ClipPPOLoss))
print(outcome(testing.check_multiplier_direction, SeparatelyClippedLoss))

# %%
# The sign of the price is wrong. With a multiplier of 0 that has no effect, which is why the
# first check passed. Mend it:


class MendedLoss(PPOLagrangianLoss):
    def policy_losses(self, tensordict, advantage, cost_advantage):
        policy = self.evaluate(tensordict)
        losses = self.unconstrained(tensordict, advantage, policy)
        price = (cost_advantage * self.lagrange_multiplier).sum(-1, keepdim=True)
        penalty = self.unconstrained(tensordict, -price, policy)["loss_objective"]
        total = losses["loss_objective"] + penalty
        losses["loss_objective"] = total / (1 + self.lagrange_multiplier.sum())
        return losses


# %%
# ``check_loss`` runs all eleven checks: gradients, masks, keys, copies, casts, ``torch.compile``
# and more. In a project of yours this line is the test.

print(outcome(testing.check_loss, MendedLoss, ClipPPOLoss))

# %%
# A rule in one method
# --------------------
#
# A rule returns the next multiplier. ``violation`` is the mean episode cost minus the limit,
# shape ``(k,)``. This one raises the multiplier while the limit is exceeded and halves it when it
# is kept, as TCP does with its window:


class Halving(MultiplierUpdater):
    def next_multiplier(self, multiplier, violation):
        return torch.where(violation > 0, multiplier + 0.1, multiplier / 2)


print(outcome(testing.check_multiplier_updater, Halving))

# %%
# All is well: a violated limit raises the multiplier, a kept one lowers it, bad costs are
# refused. Does it also find the right multiplier? ``check_reaches_optimum`` trains on a problem
# with two actions. The best policy takes the first with a probability of 0.3, at a multiplier of
# 1.

make_loss = partial(MendedLoss, entropy_bonus=False)
print(outcome(testing.check_reaches_optimum, make_loss, Halving))

# %%
# It does not: the mean cost stays above the limit. A rule that falls faster than it rises lets
# the policy exceed its limit most of the time.

# %%
# A rule with a memory
# --------------------
#
# A better rule moves by the violation, and by how much the violation has changed. It has to
# remember the last one:


class Trend(MultiplierUpdater):
    last = 0.0

    def next_multiplier(self, multiplier, violation):
        change, self.last = violation - self.last, violation
        return multiplier + 0.3 * violation + 2.0 * change


print(outcome(testing.check_multiplier_updater, Trend))

# %%
# The check saves the rule in the middle of a run and restores it elsewhere. ``last`` was lost, so
# a resumed run is not the run that was stopped. A rule with a memory extends ``state_dict`` and
# ``load_state_dict``:


class SavedTrend(Trend):
    def state_dict(self):
        return {**super().state_dict(), "last": self.last}

    def load_state_dict(self, state_dict):
        super().load_state_dict(state_dict)
        self.last = state_dict["last"]


print(outcome(testing.check_multiplier_updater, SavedTrend))

# %%
# See it
# ------
#
# ``train_on_bandit`` is what the check trains, and returns what happened. The first action costs
# 1, so its share is the cost.

colours = {"Halving": "tab:orange", "SavedTrend": "tab:blue"}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5))
for rule in (Halving, SavedTrend):
    cost, multiplier = testing.train_on_bandit(make_loss, rule, num_batches=120)
    name = rule.__name__
    left.plot(cost, color=colours[name], label=f"{name}: {cost[60:].mean():.2f} in the second half")
    right.plot(multiplier[:, 0], color=colours[name], label=name)
left.axhline(0.3, color="black", ls="--")
left.text(1.01, 0.3, "limit", va="center", transform=left.get_yaxis_transform())
right.axhline(1.0, color="black", ls="--")
right.text(1.01, 1.0, "best", va="center", transform=right.get_yaxis_transform())
left.set(xlabel="batches", ylabel="mean cost of an episode", ylim=(0, 1))
left.legend()
right.set(xlabel="batches", ylabel="multiplier")
figure.suptitle("One rule circles above the limit, the other settles on it")
figure.tight_layout()

# %%
# Where to go from here
# ---------------------
#
# - ``PIDControl`` is such a rule, in relative units and with bounds. Read `what a multiplier
#   means <../background/multiplier.html>`_ before you write another.
# - Try a smaller step in ``Halving``, such as 0.95 instead of a half. How many batches does it
#   need?
# - All checks, also those of off-policy losses: `Test your own loss <../testing.html>`_,
#   `reference <../reference/testing.html>`_.
# - `A multiplier rule of your own <../howto/rule.html>`_.
