"""PIDControl with its defaults: relative violations, by hand and at the bounds."""

import math

import pytest
import torch
from rules import make_module

from torchrl_safe.objectives import PIDControl


def make_updater(*multiplier, cost_limit=10.0, pessimism=0.0, **kwargs):
    module = make_module(*(multiplier or (0.0,)))
    return PIDControl(module, cost_limit=cost_limit, pessimism=pessimism, **kwargs)


def multiplier(updater):
    return updater.loss_module.lagrange_multiplier


def step(updater, *costs):
    updater.step(torch.tensor(costs).reshape(len(costs), -1))
    return multiplier(updater)


def test_the_integral_stays_and_the_other_parts_do_not():
    # v is 1/2, then 1, then 0: the last rise is one half, and a fall is none.
    updater = make_updater(kp=0.5, ki=0.1, kd=0.3)
    expected = [0.05 + 0.25, 0.15 + 0.5 + 0.3 * 0.5, 0.15]
    for cost, value in zip((11.0, 12.0, 10.0), expected, strict=True):
        torch.testing.assert_close(step(updater, cost), torch.tensor([value]))


def test_pessimism_adds_standard_errors():
    # Mean 10 and a standard error of 1, which is half of a fifth of the limit.
    updater = make_updater(pessimism=1.0, kp=0.5, ki=0.1)
    torch.testing.assert_close(step(updater, 9.0, 11.0), torch.tensor([0.6 * 0.5]))


@pytest.mark.parametrize("limit", [0.025, 25.0, 25_000.0])
def test_a_limit_that_is_far_away_is_answered_at_the_same_pace_up_and_down(limit):
    """To 3 in 16 batches: by 0.1 in each up to 1, by a factor of e ** 0.1 above."""

    def multipliers(sums):
        return [math.exp(value - 1) if value > 1 else max(value, 0) for value in sums]

    updater = make_updater(cost_limit=limit)
    up = [step(updater, 50 * limit, 50 * limit).item() for _ in range(16)]
    assert up == pytest.approx(multipliers(0.5 + 0.1 * batch for batch in range(1, 17)))
    # The integral is 1.6; each batch takes 0.1 off it, and the proportional part 0.5 off the sum.
    sums = [1.1 - 0.1 * batch for batch in range(1, 12)]
    down = [step(updater, 0.0, 0.0).item() for _ in sums]
    assert down == pytest.approx(multipliers(sums), abs=1e-6)
    assert down[-1] == 0


def test_an_assigned_multiplier_is_where_the_next_step_starts():
    # v is 1/2, so the sum rises by 0.1 in each batch, and e ** 0.1 is the factor above 1.
    updater = make_updater(kp=0.0, ki=0.2)
    for start, expected in [(0.5, 0.6), (0.95, math.exp(0.05)), (4.0, 4 * math.exp(0.1))]:
        multiplier(updater).fill_(start)
        torch.testing.assert_close(step(updater, 11.0), torch.tensor([expected]))


def test_without_a_bound_it_stays_finite():
    updater = make_updater(max_multiplier=None)
    for _ in range(1000):
        step(updater, 500.0)  # Finite, or the updater would refuse it.
    assert multiplier(updater).item() > 1e30


def test_it_winds_up_no_further_than_its_bounds():
    updater = make_updater(max_multiplier=20.0, kp=0.5, ki=0.1)
    for _ in range(1000):
        assert step(updater, 500.0) <= 20
    # The first batch within the limit is answered.
    torch.testing.assert_close(step(updater, 0.0), torch.tensor([20 * math.exp(-0.6)]))
    for _ in range(1000):
        assert step(updater, 0.0) >= 0
    torch.testing.assert_close(step(updater, 500.0), torch.tensor([0.6]))


@pytest.mark.parametrize(("chance", "grows"), [(0.1, True), (0.025, False)])
def test_rare_costs_are_judged_by_their_mean(chance, grows):
    """One episode in ten costs 10: twice the limit of 0.5; one in forty: half of it."""
    generator = torch.Generator().manual_seed(0)
    updater = make_updater(5.0, cost_limit=0.5)
    seen = []
    for _ in range(300):
        updater.step(10 * (torch.rand(16, 1, generator=generator) < chance).float())
        seen.append(multiplier(updater).item())
    mean = sum(seen[200:]) / 100
    assert mean > 8 if grows else mean < 1


@pytest.mark.parametrize("limit", [0.0, 1.0])
@pytest.mark.parametrize("cost", [0.0, 1e-38, 1e-9, 1e6, 3e20])
def test_it_stays_finite_and_comes_back(cost, limit):
    updater = make_updater(1.0, cost_limit=limit, pessimism=2.0)
    spread = 0.5 + torch.rand(8, 1, generator=torch.Generator().manual_seed(0))
    for episode_cost in (cost * spread, torch.tensor([[cost]])):
        for _ in range(20):
            updater.step(episode_cost)
            assert 0 <= multiplier(updater).item() <= 20
    if limit:
        # The spread forgets a fifth in each batch: 3e20 in some 220.
        for _ in range(400):
            step(updater, 0.0, 0.0)
        assert multiplier(updater).item() == 0


def test_each_cost_for_itself():
    both = make_updater(0.0, 3.0, cost_limit=torch.tensor([1.0, 50.0]))
    alone = [make_updater(0.0, cost_limit=1.0), make_updater(3.0, cost_limit=50.0)]
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        costs = torch.tensor([2.0, 100.0]) * torch.rand(4, 2, generator=generator)
        both.step(costs)
        for index, updater in enumerate(alone):
            updater.step(costs[:, index : index + 1])
            torch.testing.assert_close(multiplier(both)[index], multiplier(updater)[0])


def test_it_starts_at_the_multiplier_of_the_loss():
    updater = PIDControl(make_module(4.0), cost_limit=10.0, kp=0.0, ki=0.2, pessimism=0.0)
    updater.step(torch.tensor([[11.0]]))
    expected = torch.tensor([4 * math.exp(0.1)])
    torch.testing.assert_close(updater.loss_module.lagrange_multiplier, expected)
