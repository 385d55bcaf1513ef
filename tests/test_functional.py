"""The mixed advantage, against numbers worked out by hand."""

import re

import pytest
import torch

from torchrl_safe.objectives import (
    cost_advantage_scale,
    penalized_advantage,
    scaled_advantages,
)


def test_one_cost_by_hand():
    # (1 - 0.5 * 3) / 1.5 = -1/3 and (-2 - 0.5 * -1) / 1.5 = -1
    mixed = penalized_advantage(
        torch.tensor([[1.0], [-2.0]]), torch.tensor([[3.0], [-1.0]]), torch.tensor([0.5])
    )
    torch.testing.assert_close(mixed, torch.tensor([[-1 / 3], [-1.0]]))


def test_three_costs_by_hand():
    # (10 - (1 * 1 + 2 * 2 + 0 * 100)) / (1 + 3) = 1.25
    # ( 0 - (1 * -1 + 2 * 0.5 + 0 * -7)) / (1 + 3) = 0
    mixed = penalized_advantage(
        torch.tensor([[10.0], [0.0]]),
        torch.tensor([[1.0, 2.0, 100.0], [-1.0, 0.5, -7.0]]),
        torch.tensor([1.0, 2.0, 0.0]),
    )
    torch.testing.assert_close(mixed, torch.tensor([[1.25], [0.0]]))


@pytest.mark.parametrize("batch", [(), (5,), (4, 6)], ids=["no-batch", "flat", "rows-and-time"])
@pytest.mark.parametrize("num_costs", [1, 3])
def test_zero_multiplier_gives_the_reward_advantage_exactly(batch, num_costs):
    torch.manual_seed(0)
    advantage = torch.randn(*batch, 1)
    mixed = penalized_advantage(advantage, torch.randn(*batch, num_costs), torch.zeros(num_costs))
    assert torch.equal(mixed, advantage)


def test_large_multiplier_follows_the_cost():
    torch.manual_seed(0)
    advantage, cost_advantage = torch.randn(50, 1), torch.randn(50, 2)
    mixed = penalized_advantage(advantage, cost_advantage, torch.tensor([0.0, 1e7]))
    torch.testing.assert_close(mixed, -cost_advantage[:, 1:], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("advantage", "cost_advantage", "multiplier"),
    [
        pytest.param((5, 1), (5, 2), (3,), id="a-column-too-few"),
        pytest.param((5, 1), (5, 2), (1,), id="one-multiplier-for-two-costs"),
        pytest.param((5, 1), (5, 1), (), id="multiplier-without-dimension"),
        pytest.param((5, 1), (5, 2), (5, 2), id="multiplier-for-each-row"),
    ],
)
def test_multiplier_and_cost_must_agree(advantage, cost_advantage, multiplier):
    named = f"{re.escape(str(cost_advantage))}.*{re.escape(str(multiplier))}"
    with pytest.raises(ValueError, match=named):
        penalized_advantage(
            torch.zeros(advantage), torch.zeros(cost_advantage), torch.zeros(multiplier)
        )


@pytest.mark.parametrize(
    ("advantage", "cost_advantage"),
    [
        pytest.param((5,), (5, 2), id="flat-advantage"),
        pytest.param((5, 2), (5, 2), id="advantage-with-two-columns"),
        pytest.param((4, 1), (5, 2), id="another-batch"),
        pytest.param((1, 1), (5, 2), id="advantage-that-would-broadcast"),
    ],
)
def test_advantage_and_cost_must_agree(advantage, cost_advantage):
    named = f"{re.escape(str(advantage))}.*{re.escape(str(cost_advantage))}"
    with pytest.raises(ValueError, match=named):
        penalized_advantage(torch.zeros(advantage), torch.zeros(cost_advantage), torch.zeros(2))


@pytest.mark.parametrize("masked", [False, True], ids=["all", "masked"])
@pytest.mark.parametrize("unit", [2.0**-60, 2.0**-20, 2.0**60], ids=["tiny", "small", "large"])
def test_the_unit_of_the_reward_does_not_matter(unit, masked):
    torch.manual_seed(0)
    advantage, cost_advantage = torch.randn(50, 1), torch.randn(50, 2)
    counted = torch.rand(50, 1) > 0.2 if masked else None
    expected, _ = scaled_advantages(advantage, cost_advantage, counted=counted)
    scaled, _ = scaled_advantages(unit * advantage, cost_advantage, counted=counted)
    torch.testing.assert_close(scaled, expected)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e6])
def test_an_advantage_that_is_always_the_same_stays_small(value):
    scaled, _ = scaled_advantages(torch.full((50, 1), value), torch.zeros(50, 1))
    assert scaled.abs().max() < 0.2  # The rounding of the mean.


@pytest.mark.parametrize("masked", [False, True], ids=["all", "masked"])
def test_advantages_whose_squares_are_zero_stay_small(masked):
    torch.manual_seed(0)
    counted = torch.rand(50, 1) > 0.2 if masked else None
    scaled, _ = scaled_advantages(
        2.0**-80 * torch.randn(50, 1), torch.zeros(50, 1), counted=counted
    )
    assert scaled.abs().max() < 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: scaled_advantages(torch.zeros(6, 1), torch.zeros(4, 1)), "with the same"),
        (
            lambda: scaled_advantages(*torch.zeros(2, 6, 1), cost_scale=torch.ones(3)),
            r"one column for each scale, got .*\(6, 1\) and scales of shape \(3,\)",
        ),
        (
            lambda: cost_advantage_scale(torch.zeros(3), torch.zeros(6, 1)),
            r"one column for each scale, got .*\(6, 1\) and scales of shape \(3,\)",
        ),
        (
            lambda: cost_advantage_scale(torch.zeros(1), torch.zeros(6, 1), memory=5.0),
            "memory must be a number from 0 to 1, got 5.0",
        ),
    ],
)
def test_what_would_broadcast_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_one_value_alone_has_no_deviation():
    advantage, cost = torch.tensor([[[1.0], [3.0], [5.0]]]), torch.zeros(1, 3, 1)
    assert torch.equal(scaled_advantages(advantage, cost, exclude_dims=(-2,))[0], advantage)
    with_more = torch.cat([advantage, advantage + 2])
    expected = torch.tensor([-1.0, 1.0]).mul(0.5**0.5).reshape(2, 1, 1).expand(2, 3, 1)
    scaled = scaled_advantages(with_more, torch.zeros(2, 3, 1), exclude_dims=(-2,))[0]
    torch.testing.assert_close(scaled, expected)


def test_nothing_stays_nothing():
    empty = torch.zeros(0, 1)
    assert [part.shape for part in scaled_advantages(empty, empty)] == [(0, 1), (0, 1)]
