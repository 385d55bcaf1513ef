"""Trust-region methods end where the mathematics of the tiny problem of ``cmdp.py`` says.

The best policy takes action A with probability p = d = 0.3. TRPO-Lagrangian must find the
multiplier too at which the gradient vanishes there, 1 / sqrt(d (1 - d)) = 2.182 as derived in
``test_constrained_optimum.py``, and 0 for the cost that never binds; CPO and PCPO, which limit
one cost, have none. An episode is one step.
"""

import math
from functools import partial

import pytest
from cmdp import LIMIT, epochs, train

from torchrl_safe.objectives import (
    CPO,
    PCPO,
    TRPO,
    DualAscent,
    PIDControl,
    TrustRegionLoss,
    TrustRegionStep,
    ViolationUpdater,
)


def run(method, rule, *, num_costs, batches, seed=0):
    """Share of action A and multipliers, batch by batch; and the counts of the step."""
    steps = []

    def make_loss(*networks):
        loss = TrustRegionLoss(*networks, num_costs=num_costs, entropy_bonus=False)
        # One step moves p by up to sqrt(2 * max_kl * p (1 - p)), here 0.02.
        steps.append(TrustRegionStep(loss, method, max_kl=1e-3, damping=1e-3, episode_length=1))
        return loss

    def learn(loss, optimizer, buffer):
        steps[0].step(buffer[:])
        critics = "loss_critic", "loss_cost_critic"
        epochs(lambda data: loss(data).select(*critics), optimizer, buffer, count=1)

    shares, multipliers = train(
        seed,
        make_loss,
        rule,
        batches,
        learn=learn,
        read=lambda loss: loss.lagrange_multiplier,
        num_costs=num_costs,
    )
    return shares, multipliers, steps[0].state_dict()


@pytest.mark.parametrize(
    "method", [CPO(), PCPO(), PCPO(kl_projection=False)], ids=["cpo", "pcpo", "pcpo-euclid"]
)
def test_constrained_steps_reach_the_optimum(method):
    shares, _, counts = run(method, ViolationUpdater, num_costs=1, batches=60)
    # 512 episodes leave a noise of 0.02 in each batch; over ten seeds the means stayed within
    # half of the tolerance.
    assert shares[-30:].mean().item() == pytest.approx(LIMIT, abs=0.02)
    assert shares[-30:].max() < LIMIT + 0.1
    assert counts["rejected_steps"] == counts["indefinite_steps"] == 0


@pytest.mark.parametrize(
    "rule",
    [
        partial(DualAscent, lr=1.0),
        partial(PIDControl, kp=5.0, ki=0.3, kd=0.0, smoothing=0.5),
    ],
    ids=["dual-ascent", "pid"],
)
def test_trpo_lagrangian_reaches_the_optimum_and_its_multiplier(rule):
    shares, multipliers, counts = run(TRPO(), rule, num_costs=2, batches=120)
    assert shares[-60:].mean().item() == pytest.approx(LIMIT, abs=0.02)
    best = 1 / math.sqrt(LIMIT * (1 - LIMIT))
    assert multipliers[-60:, 0].mean().item() == pytest.approx(best, abs=0.15)
    assert multipliers[-60:, 1].mean().item() == pytest.approx(0.0, abs=1e-3)
    assert counts["rejected_steps"] == counts["indefinite_steps"] == 0


def test_trpo_exceeds_the_limit():
    shares, multipliers, _ = run(TRPO(), None, num_costs=1, batches=60)
    assert shares[-10:].mean() > 0.95
    assert (multipliers == 0).all()
