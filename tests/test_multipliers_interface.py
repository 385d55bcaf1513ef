"""Multiplier rules: arguments and names, states, and what must change nothing."""

import copy
import re
from functools import partial

import pytest
import torch
from on_policy import make_loss
from rules import episodes, make_module
from torch.distributions.transforms import ExpTransform, SoftplusTransform
from torchrl.objectives import LossModule

from torchrl_safe.objectives import (
    DualAscent,
    MultiplierUpdater,
    P3OLoss,
    PIDControl,
    ViolationUpdater,
)
from torchrl_safe.testing import make_networks

NAN, INF = float("nan"), float("inf")


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


def test_limits_are_where_the_loss_is():
    """A rule of one's own divides by them."""
    updater = DualAscent(make_module(1.0, 1.0), cost_limit=[2.0, 3.0], lr=0.1)
    updater.loss_module.to("meta")
    assert updater.cost_limit.device.type == "meta"
    updater.loss_module.to(torch.float64)
    assert updater.cost_limit.dtype == torch.float64


def test_limits_are_set_all_at_once():
    """What is read is a copy, whatever the loss's type, so no limit is set unchecked."""
    updater = DualAscent(make_module(1.0, 1.0), cost_limit=[2.0, 3.0], lr=0.1)
    updater.cost_limit[0] = NAN
    assert updater.cost_limit.tolist() == [2, 3]
    updater.cost_limit = [50.0, 3.0]
    assert updater.cost_limit.tolist() == [50, 3]


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


def test_a_cost_that_is_no_tensor_is_refused(adam):
    with pytest.raises(TypeError, match=r"episode_cost must be a tensor, got \[\[1.0, 2.0\]\]"):
        adam.step([[1.0, 2.0]])
    with pytest.raises(TypeError, match=r"episode_cost must be numbers, got torch.bool"):
        adam.step(torch.ones(3, 2, dtype=torch.bool))


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


def test_a_bound_that_is_set_later_is_checked():
    rule = DualAscent(make_module(0.0), cost_limit=1.0, lr=0.1)
    for value in (-1.0, 0.0, NAN):
        with pytest.raises(ValueError, match="max_multiplier must be a number from 1e-18 to"):
            rule.max_multiplier = value
    assert rule.max_multiplier is None


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("parametrization", "softplus", r"must be an instance of Transform, got 'softplus'"),
        ("optimizer", "adam", r"must be a class such as torch.optim.Adam, got 'adam'"),
    ],
)
def test_what_dual_ascent_is_made_of_is_checked(argument, value, message):
    with pytest.raises(TypeError, match=f"{argument} {message}"):
        DualAscent(make_module(0.0), cost_limit=1.0, lr=0.1, **{argument: value})


def test_a_multiplier_in_half_precision_is_refused():
    """100 steps of 0.001 would leave it where it was."""
    loss = make_module(1.0).to(torch.bfloat16)
    rule = DualAscent(loss, cost_limit=0.0, lr=1e-3)
    with pytest.raises(TypeError, match=r"lagrange_multiplier must be float32 .* torch.bfloat16"):
        rule.step(torch.ones(1, 1))


@pytest.mark.parametrize("value", [None, 0.5, [0.5]])
def test_a_rule_that_returns_no_tensor_changes_nothing(value):
    class Forgetful(MultiplierUpdater):
        def next_multiplier(self, multiplier, violation):
            multiplier += 0.1
            return value

    loss = make_module(1.0)
    with pytest.raises(TypeError, match=r"must return a tensor of shape \(1,\), got"):
        Forgetful(loss, cost_limit=0.0).step(torch.ones(1, 1))
    assert loss.lagrange_multiplier.item() == 1.0


def test_an_optimizer_is_as_it_was_if_a_rule_returns_no_tensor():
    class Forgetful(DualAscent):
        def next_multiplier(self, multiplier, violation):
            super().next_multiplier(multiplier, violation)

    rule = Forgetful(make_module(1.0), cost_limit=0.0, lr=0.1, optimizer=torch.optim.Adam)
    with pytest.raises(TypeError, match="must return a tensor"):
        rule.step(torch.ones(1, 1))
    assert not rule.optimizer.state_dict()["state"]


def test_the_bound_of_a_state_is_checked_before_anything_is_loaded():
    rule = DualAscent(make_module(1.0), cost_limit=1.0, lr=0.1)
    state = {**rule.state_dict(), "max_multiplier": -1.0, "cost_limit": torch.tensor([7.0])}
    with pytest.raises(ValueError, match="max_multiplier must be a number from 1e-18 to"):
        rule.load_state_dict(state)
    assert rule.cost_limit.item() == 1.0


def test_violations_in_half_precision_are_told():
    """They are not summed up."""
    loss = P3OLoss(*make_networks()).to(torch.bfloat16)
    ViolationUpdater(loss, cost_limit=1.0).step(torch.full((2, 1), 3.0))
    assert loss.cost_violation.item() == 2.0


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
            "a different name for each of the 2 costs, got",
        ),
        (
            1.0,
            ["one", "one"],
            "a different name for each of the 2 costs, got",
        ),
        (1.0, "ab", "cost_names must be a different name for each of the 2 costs, got 'ab'"),
        (1.0, [0, 1], r"cost_names must be a different name for each of the 2 costs, got \[0"),
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


def test_a_refused_step_leaves_the_scale_of_the_costs():
    class Broken(MultiplierUpdater):
        def next_multiplier(self, multiplier, violation):
            return multiplier + torch.nan

    updater = Broken(make_module(1.0), cost_limit=1.0, normalize=True)
    with pytest.raises(ValueError, match="must return 1 finite numbers"):
        updater.step(torch.tensor([[0.0], [9.0]]))
    assert updater.cost_scale == 0
