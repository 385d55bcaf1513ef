"""PID control of the multipliers, against hand numbers and against dual ascent.

test_testing.py checks of it what it shares with every rule.
"""

import copy
import math

import pytest
import torch
from on_policy import make_loss
from rules import make_module

from torchrl_safe.objectives import DualAscent, PIDControl

NAN, INF = float("nan"), float("inf")


def follow(updater, *mean_costs):
    """Multipliers after each batch; a batch is one episode with the given cost or costs."""
    history = []
    for cost in mean_costs:
        updater.step(torch.tensor(cost).reshape(1, -1))
        history.append(updater.loss_module.lagrange_multiplier.clone())
    return torch.stack(history).squeeze(-1).tolist()


# In the unit of the cost, as published.
PUBLISHED = {"max_multiplier": None, "pessimism": 0.0, "normalize": False}


def make(*multiplier, kp=0.0, ki=0.0, kd=0.0, cost_limit=10.0, **kwargs):
    module = make_module(*(multiplier or (0.0,)))
    settings = {**PUBLISHED, **kwargs}
    return PIDControl(module, cost_limit=cost_limit, kp=kp, ki=ki, kd=kd, **settings)


# ---------------------------------------------------------------- each term alone


def test_integral_adds_up_the_violations():
    # violations 2, 4, -1
    assert follow(make(ki=0.5), 12.0, 14.0, 9.0) == [1, 3, 2.5]


def test_integral_starts_at_the_multiplier_of_the_loss():
    assert follow(make(3.0, ki=0.5), 12.0) == [4]


def test_proportional_is_the_violation_of_this_batch_and_forgets():
    assert follow(make(kp=0.5), 12.0, 16.0, 10.0, 4.0, 12.0) == [1, 3, 0, 0, 1]


def test_proportional_acts_on_the_smoothed_cost():
    # averages 18; 0.75 * 18 + 0.25 * 10 = 16; 0.75 * 16 + 0.25 * 4 = 13: less 10, halved
    assert follow(make(kp=0.5, smoothing=0.75), 18.0, 10.0, 4.0) == [4, 3, 1.5]


def test_derivative_answers_a_rise_alone():
    # Rises: none for the first batch, 3, 0 for a fall of 5, 1, 0. All below the limit.
    assert follow(make(kd=2.0), 5.0, 8.0, 3.0, 4.0, 4.0) == [0, 6, 0, 2, 0]


def test_derivative_is_that_of_the_smoothed_cost():
    # averages 0, 4, 2 + 6 = 8, 4 + 1 = 5: rises 4, 4, none
    assert follow(make(kd=1.0, smoothing=0.5), 0.0, 8.0, 12.0, 2.0) == [0, 4, 4, 0]


def test_a_changed_limit_is_no_rise_of_the_cost():
    updater = make(kd=2.0)
    follow(updater, 5.0)
    updater.cost_limit.fill_(1.0)
    assert follow(updater, 5.0) == [0]


def test_the_three_terms_together():
    # I 1, 3, 2.5; kp 2 on violations 2, 4, -1; kd 4 on rises -, 2, -
    assert follow(make(kp=2.0, ki=0.5, kd=4.0), 12.0, 14.0, 9.0) == [5, 19, 0.5]


def test_three_costs_each_with_its_own_state():
    updater = make(0.0, 1.0, 2.0, kp=1.0, ki=0.5, kd=1.0, cost_limit=torch.tensor([1.0, 5.0, 7.0]))
    # Violations 2, 0, -2: I 1, 1, 1; no rise yet. P + I = 3, 1, -1 cut at 0.
    # Violations 0, 2, 0: I 1, 2, 1; P 0, 2, 0; rises 0, 2, 2.
    assert follow(updater, [3.0, 5.0, 5.0], [1.0, 7.0, 7.0]) == [[3, 1, 0], [1, 6, 3]]


# ---------------------------------------------------------------- bounds


def test_the_integral_does_not_wind_up_below_zero():
    # Ten batches far below the limit are forgotten at once.
    assert follow(make(ki=1.0), *[0.0] * 10, 11.0)[-1] == 1


@pytest.mark.parametrize("kp", [0.0, 2.0], ids=["integral", "with-proportional"])
def test_the_integral_does_not_wind_up_at_the_bound(kp):
    updater = make(kp=kp, ki=1.0, max_multiplier=5.0)
    assert follow(updater, *[100.0] * 10)[-1] == 5
    # One below the limit: the integral falls to 4 at once, the proportional term is -kp.
    assert follow(updater, 9.0) == [4 - kp]


def test_the_output_keeps_to_the_bounds_while_the_integral_goes_on():
    # I 2, 4; the proportional term alone would be 20; then -50.
    updater = make(kp=10.0, ki=1.0, max_multiplier=5.0)
    assert follow(updater, 12.0, 12.0) == [5, 5]
    assert updater.integral.item() == 4
    assert follow(updater, 9.0) == [0]
    assert updater.integral.item() == 3


# ---------------------------------------------------------------- dual ascent is a special case


@pytest.mark.parametrize("costs", [1, 3, 40])
@pytest.mark.parametrize("smoothing", [0.0, 0.9])
@pytest.mark.parametrize("bound", [None, 1.0])
@pytest.mark.parametrize("lr", [0.1, 1.3])
def test_the_integral_alone_is_dual_ascent_bit_for_bit(costs, smoothing, bound, lr):
    torch.manual_seed(costs)
    start, limit = torch.rand(costs), 1.5 + 0.5 * torch.rand(costs)
    modules = [make_module(*start.tolist()) for _ in range(2)]
    settings = {**PUBLISHED, "cost_limit": limit, "max_multiplier": bound}
    ascent = DualAscent(modules[0], lr=lr, **settings)
    control = PIDControl(modules[1], kp=0.0, ki=lr, kd=0.0, smoothing=smoothing, **settings)
    seen = []
    for batch in range(200):
        # Long ways up and down, so that both bounds are met.
        episodes = 3 * torch.rand(4, costs) * (1 + math.sin(batch / 16))
        ascent.step(episodes)
        control.step(episodes)
        seen.append(modules[1].lagrange_multiplier.clone())
        assert torch.equal(modules[0].lagrange_multiplier, seen[-1])
    seen = torch.stack(seen)
    assert (seen == 0).any(), "the lower projection was at work"
    assert bound is None or (seen == bound).any(), "and the upper one"


# ---------------------------------------------------------------- the buffer of the loss


def test_survives_a_cast_of_the_loss():
    updater = make(kp=1.0, ki=0.5, kd=1.0, smoothing=0.5)
    follow(updater, 12.0)
    updater.loss_module.to(torch.float64)
    # I 1 + 2; average 14, so P 4 and a rise of 2
    assert follow(updater, 16.0) == [1 + 3 + 4 + 2]
    assert updater.loss_module.lagrange_multiplier.dtype == torch.float64


def test_a_multiplier_set_by_hand_is_where_the_next_step_starts():
    updater = make(kp=1.0, ki=0.5)
    assert follow(updater, 12.0) == [3]
    updater.loss_module.lagrange_multiplier.fill_(7.0)
    # Raised by 4, so I is 1 + 4, and 0.5 * 2 more now; P is 2.
    assert follow(updater, 12.0) == [8]


# ---------------------------------------------------------------- what must change nothing


def snapshot(updater):
    state = updater.state_dict()
    return [state[name] for name in ("integral", "smoothed_cost", "last_multiplier")] + [
        updater.loss_module.lagrange_multiplier.clone()
    ]


def assert_unchanged(updater, before):
    for old, new in zip(before, snapshot(updater), strict=True):
        assert torch.equal(old, new)


@pytest.fixture
def updater():
    """One in the middle of its work."""
    updater = make(1.0, 2.0, kp=1.0, ki=0.5, kd=1.0, smoothing=0.5)
    follow(updater, [12.0, 7.0], [14.0, 9.0])
    return updater


def test_a_multiplier_that_would_overflow_is_refused(updater):
    before = snapshot(updater)
    with pytest.raises(ValueError, match="next_multiplier must return 2 finite numbers"):
        updater.step(torch.tensor([[1.0, 3e38]]))
    assert_unchanged(updater, before)


# ---------------------------------------------------------------- state


@pytest.mark.parametrize("when", [0, 1, 5], ids=["before-any-batch", "after-one", "mid-run"])
@pytest.mark.parametrize("loss_first", [True, False])
def test_a_restored_updater_continues_identically(when, loss_first):
    torch.manual_seed(0)
    costs = 5 * torch.rand(10, 3, 2)
    limit = torch.tensor([1.0, 4.0])
    loss = make_loss(num_costs=2, multiplier_init=0.5)
    settings = {"kp": 0.7, "ki": 0.1, "kd": 0.3, "smoothing": 0.6}
    updater = PIDControl(loss, cost_limit=limit, max_multiplier=3.0, **settings)
    for cost in costs[:when]:
        updater.step(cost)
    saved = copy.deepcopy({"loss": loss.state_dict(), "updater": updater.state_dict()})

    # Every argument differs: what follows can only come from the state.
    restored_loss = make_loss(num_costs=2, multiplier_init=0.1, seed=3)
    restored = PIDControl(restored_loss, cost_limit=0.0, kp=9.0, ki=9.0, kd=9.0)
    parts = [(restored_loss, saved["loss"]), (restored, saved["updater"])]
    for part, state in parts if loss_first else reversed(parts):
        part.load_state_dict(state)
    for cost in costs[when:]:
        updater.step(cost)
        restored.step(cost)
        assert torch.equal(loss.lagrange_multiplier, restored_loss.lagrange_multiplier)
    for name, value in settings.items():
        assert getattr(restored, name) == value
    assert restored.max_multiplier == 3.0
    assert torch.equal(restored.cost_limit, limit)


def test_the_state_is_a_copy(updater):
    state = updater.state_dict()
    before = copy.deepcopy(state)
    follow(updater, [100.0, 100.0])
    updater.load_state_dict(state)
    follow(updater, [100.0, 100.0])
    for name in ("integral", "smoothed_cost", "last_multiplier"):
        assert torch.equal(state[name], before[name])


def test_the_state_of_another_number_of_costs_is_refused(updater):
    before = snapshot(updater)
    with pytest.raises(ValueError, match="The state has 3 cost limits, this updater 2"):
        updater.load_state_dict(make(0.0, 0.0, 0.0).state_dict())
    assert_unchanged(updater, before)


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((gain, value) for gain in ("kp", "ki", "kd") for value in (-0.1, NAN, INF)),
        *(("smoothing", value) for value in (-0.1, 1.0, NAN)),
        ("cost_limit", NAN),
        ("max_multiplier", 0.0),
    ],
)
def test_bad_arguments_are_named(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must .* got {value}"):
        make(**{name: value})
    updater = make()
    before = getattr(updater, name)
    with pytest.raises(ValueError, match=rf"^{name} must .* got {value}"):
        setattr(updater, name, value)
    assert getattr(updater, name) == before


def test_a_gain_that_is_set_later_counts():
    updater = make(ki=0.5)
    assert follow(updater, 12.0) == [1]
    updater.ki = 1.0
    assert follow(updater, 12.0) == [3]


def test_what_the_state_depends_on_cannot_be_set():
    with pytest.raises(AttributeError):
        make().normalize = True


def test_a_gain_that_would_overflow_is_refused():
    with pytest.raises(ValueError, match=r"kp must be a number from 0 to 1e\+18, got 1e\+30"):
        PIDControl(make_module(0.0), cost_limit=1.0, kp=1e30)
