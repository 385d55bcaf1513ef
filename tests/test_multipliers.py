"""The multiplier updaters, against hand numbers and against the published formulas."""

import itertools
import math
from functools import partial

import pytest
import torch
from on_policy import make_loss
from rules import episodes, make_module
from torch.distributions.transforms import SoftplusTransform

from torchrl_safe.objectives import DualAscent, MultiplierUpdater, PIDControl

# ---------------------------------------------------------------- the step


@pytest.mark.parametrize("violation", [2.0, 4.0, -0.5], ids=["two", "four", "safe"])
def test_step_is_proportional_to_the_violation(violation):
    module = make_module(1.0)
    DualAscent(module, cost_limit=10.0, lr=0.1).step(episodes(10.0 + violation))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.0 + 0.1 * violation]))


def test_three_costs_with_three_limits():
    # violations 5 - 1 = 4, 5 - 5 = 0, 5 - 7 = -2; times lr 0.25: +1, 0, -0.5
    module = make_module(0.0, 2.0, 3.0)
    updater = DualAscent(module, cost_limit=torch.tensor([1.0, 5.0, 7.0]), lr=0.25)
    updater.step(episodes(5.0, 5.0, 5.0))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.0, 2.0, 2.5]))


def test_one_limit_holds_for_every_cost():
    module = make_module(0.0, 0.0)
    DualAscent(module, cost_limit=1.0, lr=1.0).step(episodes(2.0, 4.0))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.0, 3.0]))


def test_the_mean_is_over_episodes():
    module = make_module(0.0)
    DualAscent(module, cost_limit=0.0, lr=1.0).step(torch.tensor([[0.0], [0.0], [9.0]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([3.0]))


def test_integer_costs_are_averaged_as_numbers():
    module = make_module(0.0)
    DualAscent(module, cost_limit=0.0, lr=1.0).step(torch.tensor([[1], [2]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.5]))


def test_never_negative_and_back_at_once():
    module = make_module(0.5)
    updater = DualAscent(module, cost_limit=10.0, lr=1.0)
    updater.step(episodes(0.0))
    assert torch.equal(module.lagrange_multiplier, torch.zeros(1))
    # The overshoot below zero is forgotten: one violated batch is enough to react.
    updater.step(episodes(11.0))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.0]))


def test_never_above_the_bound_and_back_at_once():
    module = make_module(0.0, 0.0)
    updater = DualAscent(module, cost_limit=0.0, lr=1.0, max_multiplier=2.0)
    updater.step(episodes(100.0, 1.0))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([2.0, 1.0]))
    updater.step(torch.tensor([[-1.0, 0.0]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.0, 1.0]))


@pytest.mark.parametrize("optimizer", [torch.optim.SGD, torch.optim.Adam])
def test_survives_a_cast_of_the_loss(optimizer):
    loss = make_loss()
    updater = DualAscent(loss, cost_limit=0.0, lr=0.5, optimizer=optimizer)
    updater.step(torch.tensor([[1.0]]))
    loss.to(torch.float64)
    updater.step(torch.tensor([[1.0]]))
    assert loss.lagrange_multiplier.dtype == torch.float64
    torch.testing.assert_close(
        loss.lagrange_multiplier, torch.tensor([1.0], dtype=torch.float64), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("optimizer", [torch.optim.SGD, torch.optim.Adam])
def test_a_multiplier_set_by_hand_is_where_the_next_step_starts(optimizer):
    loss = make_loss()
    updater = DualAscent(loss, cost_limit=0.0, lr=0.5, optimizer=optimizer)
    updater.step(torch.tensor([[1.0]]))
    loss.lagrange_multiplier = torch.tensor([7.0])
    updater.step(torch.tensor([[1.0]]))
    torch.testing.assert_close(loss.lagrange_multiplier, torch.tensor([7.5]))
    loss.lagrange_multiplier = 3.0
    updater.step(torch.tensor([[1.0]]))
    torch.testing.assert_close(loss.lagrange_multiplier, torch.tensor([3.5]))


# ---------------------------------------------------------------- pessimism and normalization


def test_pessimism_adds_standard_errors():
    # 0 and 2: mean 1, standard deviation sqrt 2, standard error 1. 5 and 5: no error at all.
    module = make_module(0.0, 0.0)
    updater = DualAscent(module, cost_limit=1.0, lr=0.5, pessimism=2.0)
    updater.step(torch.tensor([[0.0, 5.0], [2.0, 5.0]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.0, 2.0]))


def test_pessimism_adds_nothing_to_a_single_episode():
    module = make_module(0.0)
    DualAscent(module, cost_limit=1.0, lr=1.0, pessimism=2.0).step(torch.tensor([[3.0]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([2.0]))


@pytest.mark.parametrize(
    ("costs", "limit", "pessimism", "expected"),
    [
        # Mean 2 of standard deviation sqrt 8.
        pytest.param([0.0, 4.0], 1.0, 0.0, 1 / math.sqrt(8), id="deviation"),
        pytest.param([0.0, 4.0], 1.0, 0.5, 2 / math.sqrt(8), id="pessimistic"),
        pytest.param([9.0, 9.0], 10.0, 0.0, -1 / 2, id="a-fifth-of-the-limit"),
        pytest.param([11.0], 10.0, 0.0, 1 / 2, id="one-episode"),
        pytest.param([200.0, 200.0], 10.0, 0.0, 1.0, id="far-above"),
        pytest.param([0.0, 0.0], 10.0, 0.0, -1.0, id="far-below"),
        pytest.param([3.0, 3.0], 0.0, 0.0, 1.0, id="limit-zero-no-deviation"),
        pytest.param([0.0, 0.0], 0.0, 2.0, 0.0, id="nothing-at-all"),
    ],
)
def test_relative_violation(costs, limit, pessimism, expected):
    module = make_module(5.0)
    updater = DualAscent(module, cost_limit=limit, lr=1.0, pessimism=pessimism, normalize=True)
    updater.step(torch.tensor(costs).unsqueeze(-1))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([5.0 + expected]))


@pytest.mark.parametrize("unit", [1e-3, 1e3, 1e6])
@pytest.mark.parametrize(
    "rule", [partial(DualAscent, lr=0.5, pessimism=1.0, normalize=True), partial(PIDControl, kd=1)]
)
def test_costs_in_another_unit_move_the_same_multipliers(rule, unit):
    generator = torch.Generator().manual_seed(0)
    plain, other = make_module(0.0), make_module(0.0)
    rules = rule(plain, cost_limit=2.0), rule(other, cost_limit=2.0 * unit)
    seen = []
    for scale in (50.0, 8.0, 1.0, 3.0, 0.0, 5.0):
        costs = scale * torch.rand(6, 1, generator=generator)
        rules[0].step(costs)
        rules[1].step(unit * costs)
        torch.testing.assert_close(other.lagrange_multiplier, plain.lagrange_multiplier)
        seen.append(plain.lagrange_multiplier.item())
    assert max(seen) > 0.5


def test_integer_costs_are_normalized_as_numbers():
    module = make_module(0.0)
    updater = DualAscent(module, cost_limit=5.0, lr=1.0, normalize=True)
    updater.step(torch.tensor([[5], [6]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([0.5]))
    torch.testing.assert_close(updater.cost_scale, torch.tensor([1.0]))


def test_violations_are_divided_by_the_largest_deviation_so_far():
    # Deviations sqrt 8, sqrt 32, 0, 0: the last counts by 0.8 sqrt 32 and a fifth of 2.
    module = make_module(0.0)
    updater = DualAscent(module, cost_limit=10.0, lr=1.0, normalize=True)
    seen = []
    for low, high in ((9.0, 13.0), (7.0, 15.0), (11.0, 11.0), (11.0, 11.0)):
        updater.step(torch.tensor([[low], [high]]))
        seen.append(module.lagrange_multiplier.item())
    widest = math.sqrt(32)
    steps = [1 / math.sqrt(8), 1 / widest, 1 / widest, 1 / (0.8 * widest + 0.2 * 2)]
    assert seen == pytest.approx(list(itertools.accumulate(steps)))
    other = DualAscent(make_module(seen[-1]), cost_limit=0.0, lr=1.0)
    other.load_state_dict(updater.state_dict())
    for each in (updater, other):
        each.step(torch.tensor([[13.0]]))
    assert torch.equal(other.loss_module.lagrange_multiplier, module.lagrange_multiplier)


@pytest.mark.parametrize(("chance", "grows"), [(0.1, True), (0.025, False)])
def test_rare_costs_are_judged_by_their_mean(chance, grows):
    """One episode in ten costs 10: twice the limit of 0.5; one in forty: half of it."""
    generator = torch.Generator().manual_seed(0)
    module = make_module(5.0)
    updater = DualAscent(module, cost_limit=0.5, lr=0.4, normalize=True)
    for _ in range(300):
        updater.step(10 * (torch.rand(16, 1, generator=generator) < chance).float())
    multiplier = module.lagrange_multiplier.item()
    assert multiplier > 10 if grows else multiplier < 1


# ---------------------------------------------------------------- the published variants


@pytest.mark.parametrize("violation", [0.01, 1.0, 100.0], ids=["small", "one", "large"])
def test_the_first_step_of_adam_is_lr_whatever_the_violation(violation):
    module = make_module(1.0)
    updater = DualAscent(module, cost_limit=5.0, lr=0.03, optimizer=torch.optim.Adam)
    updater.step(torch.tensor([[5.0 + violation]]))
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([1.03]))


def safety_gym(multiplier, costs, limit, lr):
    """Safety Gym's rule (Ray et al. 2019): Adam on p, loss -p * (J - d), multiplier softplus(p)."""
    param = math.log(math.expm1(multiplier))
    mean, square, history = 0.0, 0.0, []
    for step, cost in enumerate(costs, start=1):
        gradient = -(cost - limit)
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        corrected = math.sqrt(square / (1 - 0.999**step)) + 1e-8
        param -= lr * mean / (1 - 0.9**step) / corrected
        history.append(math.log1p(math.exp(param)))
    return torch.tensor(history)


def test_softplus_with_adam_is_the_rule_of_safety_gym():
    costs = [40.0, 35.0, 30.0, 22.0, 10.0, 24.0, 26.0, 5.0, 0.0, 60.0]
    module = make_module(1.0)
    updater = DualAscent(
        module,
        cost_limit=25.0,
        lr=0.05,
        optimizer=torch.optim.Adam,
        parametrization=SoftplusTransform(),
    )
    history = []
    for cost in costs:
        updater.step(torch.tensor([[cost]]))
        history.append(module.lagrange_multiplier.item())
    torch.testing.assert_close(
        torch.tensor(history), safety_gym(1.0, costs, limit=25.0, lr=0.05), atol=1e-5, rtol=1e-5
    )


def test_softplus_cannot_start_at_zero():
    with pytest.raises(ValueError, match=r"parametrization Softplus.*\[0\.0, 1\.0\]: pass another"):
        DualAscent(
            make_module(0.0, 1.0), cost_limit=1.0, lr=0.1, parametrization=SoftplusTransform()
        )


def test_softplus_comes_back_after_underflow():
    module = make_module(1.0)
    updater = DualAscent(module, cost_limit=0.0, lr=1.0, parametrization=SoftplusTransform())
    updater.step(torch.tensor([[-1000.0]]))
    assert module.lagrange_multiplier.item() == 0.0
    updater.step(torch.tensor([[90.0]]))
    # The parameter restarts at its lower bound of -80, so the sum is 10, and softplus(10) = 10.
    torch.testing.assert_close(module.lagrange_multiplier, torch.tensor([10.0]), atol=1e-4, rtol=0)


# ---------------------------------------------------------------- rules written by users


class Doubling(MultiplierUpdater):
    """The least a user writes."""

    def next_multiplier(self, multiplier, violation):
        return torch.where(violation > 0, 2 * multiplier, multiplier - 1)


def test_a_rule_is_one_method():
    loss = make_loss(num_costs=3, multiplier_init=torch.tensor([1.0, 0.5, 4.0]))
    updater = Doubling(
        loss,
        cost_limit=torch.tensor([1.0, 5.0, 1.0]),
        max_multiplier=5.0,
        pessimism=1.5,
        normalize=True,
    )
    updater.step(episodes(2.0, 2.0, 2.0))
    # Doubled; lowered and cut at 0; doubled and cut at 5.
    torch.testing.assert_close(loss.lagrange_multiplier, torch.tensor([2.0, 0.0, 5.0]))
    other = Doubling(make_loss(num_costs=3), cost_limit=0.0)
    other.load_state_dict(updater.state_dict())
    assert torch.equal(other.cost_limit, torch.tensor([1.0, 5.0, 1.0]))
    assert (other.max_multiplier, other.pessimism, other.normalize) == (5.0, 1.5, True)


def test_a_rule_without_the_method_cannot_be_made():
    with pytest.raises(TypeError, match="next_multiplier"):
        MultiplierUpdater(make_module(0.0), cost_limit=1.0)


def test_a_state_can_be_loaded_again():
    """A step after loading changes the optimizer, and not the state."""
    updater = DualAscent(make_module(0.0), cost_limit=1.0, lr=0.1, optimizer=torch.optim.Adam)
    updater.step(torch.tensor([[2.0]]))
    state = updater.state_dict()
    seen = []
    for _ in range(2):
        updater.loss_module.lagrange_multiplier.fill_(1.0)
        updater.load_state_dict(state)
        updater.step(torch.tensor([[3.0]]))
        seen.append(updater.loss_module.lagrange_multiplier.item())
    assert seen[0] == seen[1]


def test_a_normalizing_rule_survives_a_cast_of_the_loss():
    loss = make_loss()
    updater = DualAscent(loss, cost_limit=5.0, lr=1.0, normalize=True)
    updater.step(torch.tensor([[6.0]]))
    loss.to(torch.float64)
    updater.step(torch.tensor([[6.0]]))
    torch.testing.assert_close(loss.lagrange_multiplier, torch.tensor([2.0]).double())
