"""The safety metrics, against hand numbers, limits and known distributions."""

from functools import partial

import pytest
import torch

from torchrl_safe.metrics import (
    conditional_value_at_risk,
    constraint_regret,
    cost_rate,
    interquartile_mean,
    longest_cost_run,
    mean,
    share,
    violation_rate,
    worst_seed,
)

NAN, INF = float("nan"), float("inf")


def column(*values):
    return torch.tensor(values).unsqueeze(-1)


def numbers(estimate):
    return torch.cat(estimate).tolist()


# ---------------------------------------------------------------- rates


def test_share_has_wilsons_interval():
    # 9 in 10, from the closed form with z = 1.96:
    # centre (0.9 + 0.19208) / 1.38416 = 0.78898, half width 0.26734 / 1.38416 = 0.19314.
    expected = [0.9, 0.59584, 0.98212]
    assert numbers(share(column(*[True] * 9, False))) == pytest.approx(expected, abs=1e-4)


def test_share_of_none_and_of_all():
    # The closed form leaves 0 to z^2 / (n + z^2) = 3.8415 / 103.8415.
    none = torch.zeros(100, 1, dtype=torch.bool)
    assert numbers(share(none)) == pytest.approx([0, 0, 0.036994], abs=1e-5)
    assert numbers(share(~none)) == pytest.approx([1, 1 - 0.036994, 1], abs=1e-5)


def test_share_of_other_confidence():
    # z = 1 at 68.27 %: 1 in 2 gives 0.5 +- sqrt(0.25 / 2 + 1 / 16) / 1.5.
    rate = share(column(True, False), confidence=0.682689)
    assert numbers(rate) == pytest.approx([0.5, 0.5 - 0.288675, 0.5 + 0.288675], abs=1e-5)


def test_violation_is_more_than_the_limit():
    costs = torch.tensor([[0.0, 5.0], [1.0, 6.0], [2.0, 7.0], [9.0, 8.0]])
    assert violation_rate(costs, torch.tensor([1.0, 7.5])).value.tolist() == [0.5, 0.25]
    assert violation_rate(costs, 1).value.tolist() == [0.5, 1]
    # Not above the limit as float32 has it, though 0.1 is more in float32 than in float64.
    assert violation_rate(column(0.1, 0.2), 0.1).value.tolist() == [0.5]
    assert violation_rate(column(1, 2, 3, 4), 1.5).value.tolist() == [0.75]


def test_violations_of_all_seeds_count():
    costs = torch.tensor([[[0.0], [2.0]], [[2.0], [2.0]], [[2.0], [0.0]]])
    pooled = violation_rate(costs.reshape(6, 1), 1.0)
    assert numbers(violation_rate(costs, 1.0)) == numbers(pooled)
    assert pooled.value.item() == pytest.approx(4 / 6)


def test_cost_rate_is_cost_per_frame():
    costs = torch.tensor([[[1.0, 0.0], [0.0, 0.0]], [[1.0, 3.0], [0.0, 5.0]]])
    assert cost_rate(costs).tolist() == [0.5, 2]
    assert cost_rate(costs.reshape(4, 2)).tolist() == [0.5, 2]


def test_regret_counts_the_excess_alone():
    curve = torch.tensor([[5.0, 1.0], [0.0, 2.0], [2.5, 3.0]])
    # over the limits 2 and 2: 3, -2, 0.5 and -1, 0, 1
    assert constraint_regret(curve, 2.0).tolist() == [3.5, 1]
    assert constraint_regret(curve, torch.tensor([0.0, 3.0])).tolist() == [7.5, 0]


# ---------------------------------------------------------------- means and their intervals


def test_mean_of_a_large_sample():
    # The standard error is 0.5 / sqrt(400) = 0.025, so 1.96 of them are 0.049.
    estimate = numbers(mean(column(0.0, 1.0).repeat(200, 1)))
    assert estimate == pytest.approx([0.5, 0.451, 0.549], abs=6e-3)
    assert numbers(mean(torch.zeros(50, 1))) == [0, 0, 0]


def test_interquartile_mean_leaves_out_a_quarter_at_each_end():
    costs = column(9.0, 1.0, 3.0, 1.0, 700.0, 2.0, 4.0, 0.0)
    # In order 0 1 | 1 2 3 4 | 9 700.
    assert interquartile_mean(costs).value.item() == 2.5
    assert interquartile_mean(costs.reshape(2, 4, 1)).value.item() == 2.5
    # A quarter of 6 is cut to 1 at each end: 0 | 1 2 3 6 | 9.
    assert interquartile_mean(column(0.0, 1.0, 2.0, 3.0, 6.0, 9.0)).value.item() == 3


@pytest.mark.parametrize("statistic", [mean, interquartile_mean])
def test_what_is_drawn_anew(statistic):
    """Two seeds, each always the same: no doubt about them, all about another seed."""
    costs = torch.stack([torch.zeros(8, 1), torch.ones(8, 1)])
    assert numbers(statistic(costs)) == [0.5, 0.5, 0.5]
    assert numbers(statistic(costs, resample="seeds")) == [0.5, 0, 1]


def test_each_cost_has_its_own_interval():
    costs = torch.stack([torch.arange(10.0), 5 * torch.arange(10.0)], -1)
    both = mean(costs)
    for one, figure in zip(costs.split(1, -1), zip(*both, strict=True), strict=True):
        assert numbers(mean(one)) == list(torch.stack(figure))
    assert both.high[1] - both.low[1] == pytest.approx(5 * (both.high[0] - both.low[0]).item())


@pytest.mark.parametrize("statistic", [mean, interquartile_mean])
def test_the_interval_depends_on_the_seed_and_on_nothing_else(statistic):
    torch.manual_seed(0)
    costs = torch.rand(20, 1)
    state = torch.get_rng_state()
    assert numbers(statistic(costs)) == numbers(statistic(costs))
    assert numbers(statistic(costs)) != numbers(statistic(costs, seed=1))
    assert torch.equal(torch.get_rng_state(), state)


def coverage(estimate, true):
    return ((estimate.low <= true) & (true <= estimate.high)).double().mean().item()


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_the_mean_of_a_uniform_distribution_is_covered(confidence):
    """200 samples of 60 numbers each; the standard error of a coverage is 0.03 or less."""
    torch.manual_seed(0)
    covered = coverage(mean(torch.rand(60, 200), confidence=confidence), 0.5)
    assert covered == pytest.approx(confidence, abs=0.06)


def test_the_interquartile_mean_of_a_normal_distribution_is_covered():
    torch.manual_seed(0)
    covered = coverage(interquartile_mean(torch.randn(3, 20, 100)), 0.0)
    assert covered == pytest.approx(0.95, abs=0.05)


def test_only_whole_seeds_cover_what_seeds_add():
    """20 seeds with 10 episodes each; half of the variance lies between the seeds."""
    torch.manual_seed(0)
    costs = torch.randn(20, 1, 150) + torch.randn(20, 10, 150)
    assert coverage(mean(costs, resample="seeds"), 0.0) == pytest.approx(0.95, abs=0.05)
    assert coverage(mean(costs), 0.0) < 0.6


# ---------------------------------------------------------------- worst cases


def test_conditional_value_at_risk_by_hand():
    costs = torch.tensor([[1.0, 10.0], [4.0, 10.0], [2.0, 10.0], [3.0, 30.0], [0.0, 0.0]])
    tail = partial(conditional_value_at_risk, costs)
    # 2 of 5 episodes: (4 + 3) / 2 and (30 + 10) / 2
    torch.testing.assert_close(tail(0.4), torch.tensor([3.5, 20.0], dtype=torch.float64))
    # 2.5 of 5: (4 + 3 + 2 / 2) / 2.5 and (30 + 10 + 10 / 2) / 2.5
    torch.testing.assert_close(tail(0.5), torch.tensor([3.2, 18.0], dtype=torch.float64))


def test_limits_of_conditional_value_at_risk():
    torch.manual_seed(0)
    costs = torch.rand(7, 3, dtype=torch.float64)
    torch.testing.assert_close(conditional_value_at_risk(costs, 1.0), costs.mean(0))
    for alpha in (1e-12, 0.01, 1 / 7):
        torch.testing.assert_close(conditional_value_at_risk(costs, alpha), costs.amax(0))


@pytest.mark.parametrize("alpha", [0.05, 0.29, 0.5, 0.77])
def test_conditional_value_at_risk_is_rockafellars_minimum(alpha):
    torch.manual_seed(0)
    costs = torch.rand(37, 1, dtype=torch.float64)
    # The minimum lies at one of the costs.
    excess = (costs - costs.T).clamp_min(0).mean(0) / alpha
    minimum = (costs.squeeze(-1) + excess).min()
    torch.testing.assert_close(conditional_value_at_risk(costs, alpha).squeeze(), minimum)


def test_worst_seed():
    costs = torch.tensor([[[0.0, 8.0], [2.0, 8.0]], [[3.0, 1.0], [4.0, 0.0]]])
    worst = worst_seed(costs)
    assert worst.value.tolist() == [3.5, 8]
    assert worst.seed.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("costs", "done", "longest"),
    [
        pytest.param("0000", None, 0, id="none"),
        pytest.param("1111", None, 4, id="all"),
        pytest.param("1011", None, 2, id="at-the-end"),
        pytest.param("110111010", None, 3, id="in-between"),
        pytest.param("110111010", "000010000", 2, id="cut"),
        pytest.param("1111", "0100", 2, id="cut-in-half"),
        pytest.param("1111", "1111", 1, id="episodes-of-one-step"),
        pytest.param("0111", "1000", 3, id="new-episode"),
        pytest.param("1", "1", 1, id="one-step"),
    ],
)
def test_longest_run(costs, done, longest):
    costs = column(*(0.5 * int(digit) for digit in costs))
    if done is not None:
        done = column(*(digit == "1" for digit in done))
    assert longest_cost_run(costs, done).tolist() == [longest]


def test_longest_run_of_each_row_and_cost():
    costs = torch.tensor(
        [[[1.0, 0.0], [1.0, 2.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 1.0], [0.0, 0.0]]]
    )
    done = torch.tensor([[[False], [True], [False]], [[False], [False], [True]]])
    assert longest_cost_run(costs).tolist() == [[3, 1], [1, 2]]
    assert longest_cost_run(costs, done).tolist() == [[2, 1], [1, 2]]


def test_longest_run_against_a_plain_loop():
    torch.manual_seed(0)
    costs = (torch.rand(6, 50, 2) < 0.8).float()
    done = torch.rand(6, 50, 1) < 0.1
    for row in range(6):
        for index in range(2):
            longest = run = 0
            for step in range(50):
                run = run + 1 if costs[row, step, index] else 0
                longest = max(longest, run)
                run = 0 if done[row, step] else run
            assert longest_cost_run(costs, done)[row, index].item() == longest


# ---------------------------------------------------------------- all of them


OF_EPISODES = [
    pytest.param(mean, id="mean"),
    pytest.param(interquartile_mean, id="interquartile-mean"),
    pytest.param(partial(violation_rate, cost_limit=0.5), id="violation-rate"),
    pytest.param(partial(conditional_value_at_risk, alpha=0.3), id="cvar"),
    pytest.param(worst_seed, id="worst-seed"),
]


def value_of(figure):
    return figure if isinstance(figure, torch.Tensor) else figure.value


@pytest.mark.parametrize("metric", OF_EPISODES)
def test_the_order_of_episodes_and_seeds_means_nothing(metric):
    torch.manual_seed(0)
    costs = torch.rand(4, 9, 2)
    shuffled = costs[torch.randperm(4)][:, torch.randperm(9)]
    torch.testing.assert_close(value_of(metric(shuffled)), value_of(metric(costs)))


@pytest.mark.parametrize("metric", OF_EPISODES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_one_number_for_each_cost(metric, dtype):
    costs = torch.arange(24).reshape(2, 4, 3).to(dtype).requires_grad_(dtype.is_floating_point)
    value = value_of(metric(costs))
    assert value.shape == (3,)
    assert value.dtype == torch.float64
    assert not value.requires_grad


OF_STEPS = [
    pytest.param(cost_rate, id="cost-rate"),
    pytest.param(partial(constraint_regret, cost_limit=0.5), id="regret"),
    pytest.param(longest_cost_run, id="longest-run"),
]


@pytest.mark.parametrize("metric", OF_EPISODES + OF_STEPS)
@pytest.mark.parametrize(
    ("costs", "message"),
    [
        pytest.param(torch.zeros(2, 0, 1), "cost must ", id="empty"),
        pytest.param(torch.zeros(0, 1), "cost must ", id="no-episodes"),
        pytest.param(torch.tensor([[[NAN], [1.0]]]), "cost must ", id="nan"),
        pytest.param(torch.tensor([[[1.0], [INF]]]), "cost must ", id="inf"),
        pytest.param(torch.zeros(5), r"cost must have shape .*, got \(5,\)", id="no-costs"),
        pytest.param(torch.tensor(1.0), r"cost must have shape .*, got \(\)", id="a-number"),
    ],
)
def test_bad_costs_are_refused(metric, costs, message):
    with pytest.raises(ValueError, match=message):
        metric(costs)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(mean, torch.zeros(1, 2, 3, 4)), r"\(E, k\) or \(S, E, k\), got \(1, 2, 3, 4\)"),
        (partial(share, torch.zeros(4, 1)), "true must be bool, got torch.float32"),
        (partial(share, torch.zeros(0, 1, dtype=torch.bool)), "true must not be empty"),
        (partial(share, column(True), confidence=1.0), "confidence must be .* got 1.0"),
        (partial(mean, column(1.0, 2.0), confidence=NAN), "confidence must be .* got nan"),
        (partial(mean, column(1.0, 2.0), seed=-1), "seed must be .* got -1"),
        (partial(mean, column(1.0, 2.0), seed=0.5), "seed must be .* got 0.5"),
        (partial(mean, column(1.0, 2.0), resample="runs"), "resample must be .* got 'runs'"),
        (partial(mean, column(1.0)), r"at least 2 episodes .* got shape \(1, 1\)"),
        (partial(mean, column(1.0, 2.0), resample="seeds"), r"at least 2 seeds .* \(2, 1\)"),
        (partial(violation_rate, column(1.0), torch.zeros(2)), r"cost_limit must be one .* \(2,\)"),
        (partial(violation_rate, column(1.0), NAN), "cost_limit must be finite, got nan"),
        (partial(conditional_value_at_risk, column(1.0), True), "alpha must be .* got True"),
        (partial(conditional_value_at_risk, column(1.0), 0.0), "alpha must be .* got 0.0"),
        (partial(conditional_value_at_risk, column(1.0), 1.5), "alpha must be .* got 1.5"),
        (partial(worst_seed, column(1.0, 2.0)), r"shape \(S, E, k\), got \(2, 1\)"),
        (partial(constraint_regret, torch.zeros(2, 3, 1), 1.0), r"\(N, k\), got \(2, 3, 1\)"),
        (
            partial(longest_cost_run, torch.zeros(3, 2), torch.zeros(3, 2, dtype=torch.bool)),
            r"done must be bool of shape \(3, 1\), got torch.bool of shape \(3, 2\)",
        ),
        (
            partial(longest_cost_run, torch.zeros(3, 1), torch.zeros(3, 1)),
            r"done must be bool of shape \(3, 1\), got torch.float32",
        ),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_an_interval_is_one_of_means_that_were_drawn():
    value, low, high = mean(torch.tensor([0.0] * 7 + [9.0]).unsqueeze(-1))
    assert low == 0
    assert high > 2 * value


def test_an_infinite_limit_is_refused():
    with pytest.raises(ValueError, match="cost_limit must be finite, got inf"):
        violation_rate(torch.ones(2, 1), INF)


def test_a_negative_cost_ends_a_run():
    assert longest_cost_run(column(1.0, -1.0, 1.0)).tolist() == [1]
