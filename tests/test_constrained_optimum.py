"""Training ends where the mathematics of a tiny constrained problem says it must.

One step, two actions: A pays reward 1 at cost 1, B pays nothing and costs nothing. With p the
probability of A, the expected reward is p and the expected cost is p, so under the limit d the
best policy has p = d; nothing else about the problem matters.

Its multiplier is the one at which the policy gradient vanishes at p = d. The observation is
constant, so each critic is one number that drops out when an advantage is centred, and
``estimate_advantages`` leaves

    reward, standardized:   A_r = (1[A] - p) / s   with  s = sqrt(p (1 - p)),
    cost, centred:          A_c = (1[A] - p).

Hence A_r - lambda A_c = (1 / s - lambda) (1[A] - p), which vanishes at p = d for

    lambda = 1 / sqrt(d (1 - d)) = 2.182 at d = 0.3:

one in units of reward per cost, times 1 / s since the reward advantage is standardized.
A second cost, 1 for B, has the limit 0.9 and the mean 1 - d = 0.7: it never binds, so by
complementary slackness its multiplier is 0.
"""

import math
from functools import partial

import pytest

from torchrl_safe.objectives import DualAscent, PIDControl, PPOLagrangianLoss
from torchrl_safe.testing import ConstrainedBandit, train_on_bandit

pytestmark = pytest.mark.integration

LIMIT = ConstrainedBandit.optimal_probability

# In the unit of the cost.
train_ppo = partial(
    train_on_bandit,
    partial(PPOLagrangianLoss, entropy_bonus=False, normalize_cost_advantage=False),
)

RULES = {
    "dual-ascent": partial(DualAscent, lr=1.0),
    "pid": partial(
        PIDControl,
        kp=5.0,
        ki=1.0,
        kd=5.0,
        smoothing=0.5,
        max_multiplier=None,
        pessimism=0.0,
        normalize=False,
    ),
}


# Dual ascent circles for longer.
BATCHES = {"dual-ascent": 240, "pid": 120}


@pytest.fixture(scope="module")
def trained():
    return {name: train_ppo(rule, num_batches=BATCHES[name]) for name, rule in RULES.items()}


@pytest.mark.parametrize("rule", RULES)
def test_policy_and_multipliers_reach_the_optimum(trained, rule):
    shares, multipliers = trained[rule]
    # Ascent on the multiplier and descent on the policy circle inwards, so the means of the last
    # third are compared; over ten seeds they stayed within half of these tolerances.
    last = BATCHES[rule] // 3
    share, multiplier = shares[-last:].mean(), multipliers[-last:].mean(0)
    assert share.item() == pytest.approx(LIMIT, abs=0.02)
    assert multiplier[0].item() == pytest.approx(1 / math.sqrt(LIMIT * (1 - LIMIT)), abs=0.1)
    assert multiplier[1].item() == pytest.approx(0.0, abs=1e-3)


def test_pid_control_damps_the_circling(trained):
    """Against dual ascent with the same integral gain, in the share of action A, here the cost.

    Means (and standard deviations) over ten seeds, dual ascent and PID control: swing below the
    limit 0.235 (0.014) and 0.093 (0.039), and above it again 0.280 (0.038) and 0.064 (0.007);
    excess summed over 120 batches 11.2 (1.9) and 4.0 (0.9). 512 episodes a batch make 0.02 of
    noise.
    """
    below, above, total = {}, {}, {}
    for name, (shares, _) in trained.items():
        excess = shares[:120] - LIMIT
        after = excess[(excess <= 0).int().argmax() :]
        below[name], above[name], total[name] = -after.min(), after.max(), excess.relu().sum()
    for swing in (below, above, total):
        assert swing["pid"] < 0.6 * swing["dual-ascent"]


def test_the_defaults_reach_the_optimum():
    """Reward and cost are the same here: one deviation of the one is worth one of the other.

    Two standard errors of 512 episodes, 0.04, are what the rule stays below the limit.
    """
    loss = partial(PPOLagrangianLoss, entropy_bonus=False)
    shares, multipliers = train_on_bandit(loss, PIDControl, num_batches=120)
    share, multiplier = shares[-60:].mean(), multipliers[-60:].mean(0)
    assert share.item() == pytest.approx(LIMIT - 0.04, abs=0.015)
    assert multiplier[0].item() == pytest.approx(1.0, abs=0.1)
    assert multiplier[1].item() == pytest.approx(0.0, abs=1e-3)


def test_without_the_multiplier_the_limit_is_exceeded():
    shares, multipliers = train_ppo(None, num_batches=60)
    assert shares[-20:].mean() > 0.95
    assert (multipliers == 0).all()
