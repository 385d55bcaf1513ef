"""The multiplier updaters, against hand numbers and against the published formulas."""

import copy
import itertools
import math
import re
from functools import partial

import pytest
import torch
from on_policy import make_loss
from torch.distributions.transforms import ExpTransform, SoftplusTransform
from torchrl.objectives import LossModule

from torchrl_safe.objectives import DualAscent, MultiplierUpdater, PIDControl

NAN, INF = float("nan"), float("inf")


def make_module(*multiplier):
    """The least a loss must have to be updated."""
    module = LossModule()
    module.register_buffer("lagrange_multiplier", torch.tensor(multiplier))
    return module


def episodes(*mean_costs):
    """Two episodes whose mean costs are the given ones."""
    mean = torch.tensor(mean_costs)
    return torch.stack([mean - 0.5, mean + 0.5])


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


def test_the_update_is_in_place():
    loss = make_loss(num_costs=2)
    address = loss.lagrange_multiplier.data_ptr()
    DualAscent(loss, cost_limit=0.0, lr=1.0).step(episodes(1.0, 2.0))
    assert loss.lagrange_multiplier.data_ptr() == address
    torch.testing.assert_close(loss.lagrange_multiplier, torch.tensor([1.0, 2.0]))


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


# ---------------------------------------------------------------- what must change nothing


def snapshot(updater):
    state = updater.optimizer.state_dict()["state"]
    values = [value for entry in state.values() for value in entry.values()]
    multiplier = updater.loss_module.lagrange_multiplier
    return [multiplier.clone(), *(torch.as_tensor(value).clone() for value in values)]


def assert_unchanged(updater, before):
    after = snapshot(updater)
    assert len(before) == len(after) > 1
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old, new)


@pytest.fixture
def adam():
    """An updater in the middle of its work, with optimizer state."""
    updater = DualAscent(make_module(1.0, 1.0), cost_limit=2.0, lr=0.1, optimizer=torch.optim.Adam)
    updater.step(episodes(5.0, 1.0))
    return updater


def test_no_finished_episode_changes_nothing(adam):
    before = snapshot(adam)
    adam.step(torch.zeros(0, 2))
    assert_unchanged(adam, before)


@pytest.mark.parametrize("bad", [NAN, INF, -INF], ids=["nan", "inf", "minus-inf"])
def test_a_cost_that_is_not_finite_is_refused(adam, bad):
    before = snapshot(adam)
    with pytest.raises(ValueError, match="episode_cost must be finite"):
        adam.step(torch.tensor([[1.0, 1.0], [1.0, bad]]))
    assert_unchanged(adam, before)


def test_a_cost_that_overflows_leaves_the_optimizer_as_it_was(adam):
    """Adam's moments would be NaN for ever after."""
    before = snapshot(adam)
    with pytest.raises(ValueError, match="episode_cost must have a mean"):
        adam.step(torch.full((2, 2), 2e38))
    assert_unchanged(adam, before)


@pytest.mark.parametrize(
    "shape", [(), (2,), (5, 1), (5, 3), (5, 2, 1), (0,)], ids=lambda shape: f"{shape}"
)
def test_a_cost_of_the_wrong_shape_is_refused(adam, shape):
    before = snapshot(adam)
    named = rf"episode_cost must have shape \(E, 2\), .* got {re.escape(str(shape))}"
    with pytest.raises(ValueError, match=named):
        adam.step(torch.zeros(shape))
    assert_unchanged(adam, before)


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("cost_limit", torch.zeros(3), id="limit-too-many"),
        pytest.param("cost_limit", torch.zeros(1), id="limit-too-few"),
        pytest.param("cost_limit", torch.zeros(2, 1), id="limit-two-dimensions"),
        pytest.param("cost_limit", NAN, id="limit-nan"),
        pytest.param("cost_limit", torch.tensor([1.0, INF]), id="limit-inf"),
        pytest.param("lr", 0.0, id="lr-zero"),
        pytest.param("lr", -0.1, id="lr-negative"),
        pytest.param("lr", NAN, id="lr-nan"),
        pytest.param("lr", INF, id="lr-inf"),
        pytest.param("max_multiplier", 0.0, id="bound-zero"),
        pytest.param("max_multiplier", -1.0, id="bound-negative"),
        pytest.param("max_multiplier", NAN, id="bound-nan"),
        pytest.param("pessimism", -1.0, id="pessimism-negative"),
        pytest.param("pessimism", NAN, id="pessimism-nan"),
        pytest.param("pessimism", INF, id="pessimism-inf"),
    ],
)
def test_bad_arguments_are_named(name, value):
    arguments = {"cost_limit": 1.0, "lr": 0.1, name: value}
    with pytest.raises(ValueError, match=f"^{name} must"):
        DualAscent(make_module(0.0, 0.0), **arguments)


NAMED = {"collision": 0.5, "speed": 2.0}
RULES = {
    "dual": partial(DualAscent, lr=0.1),
    "pid": partial(PIDControl, pessimism=0.0),
}
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES)


@every_rule
def test_a_limit_can_be_set_later_as_it_was_made(rule):
    names = ("collision", "speed")
    updater = rule(make_module(0.0, 0.0), cost_limit=NAMED, cost_names=names)
    for limit, expected in (
        (1, [1.0, 1.0]),
        ([3.0, 4.0], [3.0, 4.0]),
        ({"speed": 5.0, "collision": 6.0}, [6.0, 5.0]),
        (torch.tensor([7.0, 8.0]), [7.0, 8.0]),
    ):
        updater.cost_limit = limit
        assert updater.cost_limit.tolist() == expected
        updater.step(episodes(1.5, 2.0))
    for limit in (NAN, torch.zeros(3), {"collision": 1.0}, "much"):
        with pytest.raises(ValueError, match=r"^cost_limit must"):
            updater.cost_limit = limit
    assert updater.cost_limit.tolist() == [7.0, 8.0]


@every_rule
def test_limits_go_by_name(rule):
    """Whatever order they are written in; the state is that of limits in their order."""
    backwards = dict(reversed(NAMED.items()))
    named = [
        rule(make_module(0.0, 0.0), cost_limit=limits, cost_names=("collision", "speed"))
        for limits in (NAMED, backwards)
    ]
    plain = rule(make_module(0.0, 0.0), cost_limit=torch.tensor([0.5, 2.0]))
    for updater in named:
        assert updater.cost_names == ("collision", "speed")
        assert updater.state_dict().keys() == plain.state_dict().keys()
        assert torch.equal(updater.cost_limit, plain.cost_limit)
    for updater in (*named, plain):
        updater.step(episodes(1.5, 2.0))
    for updater in named:
        expected = plain.loss_module.lagrange_multiplier
        assert torch.equal(updater.loss_module.lagrange_multiplier, expected)
        assert expected[0] > 0 == expected[1]
    assert plain.cost_names == ("0", "1")
    plain.load_state_dict(named[0].state_dict())
    named[0].load_state_dict(plain.state_dict())


@every_rule
def test_the_state_of_costs_in_another_order_is_refused(rule):
    """Their limits would be swapped."""
    names = tuple(NAMED)
    one, two = (
        rule(make_module(0.0, 0.0), cost_limit=NAMED, cost_names=order)
        for order in (names, names[::-1])
    )
    with pytest.raises(ValueError, match=r"The state has the costs \['collision', 'speed'\], this"):
        two.load_state_dict(one.state_dict())
    assert two.cost_limit.tolist() == [2.0, 0.5]


def test_a_refused_step_leaves_the_optimizer_as_it_was():
    """Its momentum, which would carry the next step away as well."""
    one, two = (
        DualAscent(
            make_module(1.0),
            cost_limit=1.0,
            lr=0.01,
            optimizer=partial(torch.optim.SGD, momentum=0.9),
            parametrization=ExpTransform(),
        )
        for _ in range(2)
    )
    with pytest.raises(ValueError, match=r"finite numbers, got .*inf.* for a violation of .*99999"):
        one.step(torch.tensor([[1e5]]))
    for updater in (one, two):
        updater.step(torch.tensor([[0.0]]))
    assert torch.equal(one.loss_module.lagrange_multiplier, two.loss_module.lagrange_multiplier)


@pytest.mark.parametrize(
    ("limits", "names", "message"),
    [
        (NAMED, None, r"cost_names must give the costs in their order, .* got None and {'coll"),
        (
            NAMED,
            ["collision"],
            r"a different name for each of the 2 costs of the loss \(num_costs\), got",
        ),
        (
            1.0,
            ["one", "one"],
            r"a different name for each of the 2 costs of the loss \(num_costs\), got",
        ),
        (1.0, "ab", "cost_names must be a different name for each of the 2 costs .* got 'ab'"),
        (1.0, [0, 1], r"cost_names must be a different name for each of the 2 costs .* got \[0"),
        (
            {"collision": 0.5},
            ["collision", "speed"],
            r"each of cost_names \('collision', 'speed'\), got .* missing \['speed'\], unknown \[",
        ),
        (
            {**NAMED, "sped": 1.0},
            ["collision", "speed"],
            r"cost_limit must have .* missing \[\], unknown \['sped'\]",
        ),
        (
            {"a": 1.0, "b": "two"},
            ["a", "b"],
            "cost_limit must be finite, got {'a': 1.0, 'b': 'two'",
        ),
        ({"a": 1.0, "b": NAN}, ["a", "b"], "cost_limit must be finite, got {'a': 1.0, 'b': nan"),
    ],
)
@every_rule
def test_names_that_do_not_fit_are_refused(rule, limits, names, message):
    with pytest.raises(ValueError, match=message):
        rule(make_module(0.0, 0.0), cost_limit=limits, cost_names=names)


def test_a_rule_of_ones_own_has_limits_by_name():
    class Doubled(MultiplierUpdater):
        def next_multiplier(self, multiplier, violation):
            return 2 * violation

    updater = Doubled(make_module(0.0, 0.0), cost_limit=NAMED, cost_names=[*NAMED])
    updater.step(episodes(1.5, 3.0))
    assert updater.loss_module.lagrange_multiplier.tolist() == [2, 2]


def test_errors_name_the_cost():
    updater = DualAscent(make_module(0.0, 0.0), cost_limit=NAMED, cost_names=[*NAMED], lr=0.1)
    cost = torch.tensor([[1.0, 2.0], [1.0, NAN]])
    with pytest.raises(ValueError, match=r"finite, got (?s:.*)nan.* for cost speed\.") as raised:
        updater.step(cost)
    assert "collision" not in str(raised.value)
    largest = torch.finfo(torch.float32).max
    with pytest.raises(ValueError, match=r"a mean and deviation (?s:.*) for cost collision\."):
        updater.step(torch.tensor([[largest, 1.0], [largest, 1.0]]))
    with pytest.raises(ValueError, match=r"a column for each cost \(collision, speed\), got"):
        updater.step(torch.zeros(1, 3))
    unnamed = DualAscent(make_module(0.0, 0.0), cost_limit=1.0, lr=0.1)
    with pytest.raises(ValueError, match=r"finite, got (?s:.*) for cost 1\."):
        unnamed.step(cost)


def test_normalized_limits_are_not_negative():
    DualAscent(make_module(0.0), cost_limit=-1.0, lr=0.1)
    with pytest.raises(ValueError, match="cost_limit must not be negative with normalize, got -1"):
        DualAscent(make_module(0.0), cost_limit=-1.0, lr=0.1, normalize=True)
    updater = DualAscent(make_module(0.0), cost_limit=1.0, lr=0.1, normalize=True)
    with pytest.raises(ValueError, match="cost_limit must not be negative with normalize, got "):
        updater.cost_limit = -1.0
    assert updater.cost_limit == 1.0
    plain = DualAscent(make_module(0.0), cost_limit=-1.0, lr=0.1)
    updater.load_state_dict(plain.state_dict())  # With its option.
    assert not updater.normalize
    normalized = DualAscent(make_module(0.0), cost_limit=1.0, lr=0.1, normalize=True)
    with pytest.raises(ValueError, match="2 cost limits"):
        normalized.load_state_dict(DualAscent(make_module(0, 0), cost_limit=1, lr=1).state_dict())
    assert normalized.normalize


def test_a_loss_without_the_buffer_is_refused():
    with pytest.raises(ValueError, match="lagrange_multiplier"):
        DualAscent(LossModule(), cost_limit=1.0, lr=0.1)


def test_a_compiled_loss_is_moved_itself():
    loss = make_module(0.0)
    compiled = torch.compile(loss, backend="eager")
    DualAscent(compiled, cost_limit=1.0, lr=0.1).step(torch.tensor([[3.0]]))
    assert loss.lagrange_multiplier.item() == pytest.approx(0.2)


def test_anything_but_a_loss_is_refused():
    module = torch.nn.Module()
    module.register_buffer("lagrange_multiplier", torch.zeros(1))
    with pytest.raises(ValueError, match="loss_module must be a LossModule"):
        DualAscent(module, cost_limit=1.0, lr=0.1)


# ---------------------------------------------------------------- state


VARIANTS = [
    pytest.param({}, id="sgd"),
    pytest.param({"optimizer": torch.optim.Adam}, id="adam"),
    pytest.param(
        {"optimizer": torch.optim.Adam, "parametrization": SoftplusTransform()}, id="softplus"
    ),
]


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_restored_updater_continues_identically(variant):
    torch.manual_seed(0)
    costs = 5 * torch.rand(8, 3, 2)
    limit = torch.tensor([1.0, 4.0])
    loss = make_loss(num_costs=2, multiplier_init=0.5)
    updater = DualAscent(loss, cost_limit=limit, lr=0.1, max_multiplier=3.0, **variant)
    for cost in costs[:4]:
        updater.step(cost)
    saved = copy.deepcopy({"loss": loss.state_dict(), "updater": updater.state_dict()})

    # Every argument differs: what follows can only come from the state.
    restored_loss = make_loss(num_costs=2, multiplier_init=0.1, seed=3)
    restored = DualAscent(restored_loss, cost_limit=0.0, lr=0.7, **variant)
    restored_loss.load_state_dict(saved["loss"])
    restored.load_state_dict(saved["updater"])
    for cost in costs[4:]:
        updater.step(cost)
        restored.step(cost)
        assert torch.equal(loss.lagrange_multiplier, restored_loss.lagrange_multiplier)
    assert restored.max_multiplier == 3.0
    assert torch.equal(restored.cost_limit, limit)


def test_the_state_of_another_optimizer_changes_nothing(adam):
    """Its next step would fail."""
    before = snapshot(adam)
    other = DualAscent(make_module(1.0, 1.0), cost_limit=9.0, lr=0.3, max_multiplier=5.0)
    with pytest.raises(ValueError, match=r"another optimizer than Adam: it has the options .*mom"):
        adam.load_state_dict(other.state_dict())
    assert_unchanged(adam, before)


def test_a_state_in_memory_stays_as_it_was(adam):
    state = adam.state_dict()
    before = copy.deepcopy(state)
    adam.step(episodes(3.0, 3.0))
    torch.testing.assert_close(state, before, rtol=0, atol=0)


@pytest.mark.parametrize("rule", [PIDControl, partial(DualAscent, lr=0.1, normalize=True)])
def test_negative_costs_lower_the_multiplier_under_a_limit_of_zero(rule):
    module = make_module(1.0)
    rule(module, cost_limit=0.0).step(torch.tensor([[-1.0], [-1.0]]))
    assert module.lagrange_multiplier < 1


def test_limits_and_multipliers_are_no_part_of_a_graph():
    parameter = torch.nn.Parameter(torch.tensor(1.0))
    loss = make_loss(multiplier_init=parameter)
    updater = DualAscent(loss, cost_limit=parameter, lr=0.1)
    assert not loss.lagrange_multiplier.requires_grad
    assert not updater.cost_limit.requires_grad
    copy.deepcopy(loss)


def test_the_state_holds_its_own_limit():
    updater = DualAscent(make_module(0.0), cost_limit=1.0, lr=0.1)
    state = updater.state_dict()
    updater.cost_limit.fill_(9.0)
    assert state["cost_limit"].item() == 1.0
    updater.load_state_dict(state)
    updater.cost_limit.fill_(9.0)
    assert state["cost_limit"].item() == 1.0


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
