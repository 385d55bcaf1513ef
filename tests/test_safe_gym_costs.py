"""What SafeGymWrapper and SafeGymEnv take for a cost, and what they refuse."""

from functools import partial

import numpy as np
import pytest
import torch
from counting import Counting, Forgetful, Torque, by_mode, check_counts, vector
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from torchrl_safe.envs.gym import SafeGymEnv, SafeGymWrapper


def test_costs_have_the_names_of_their_keys(make_env):
    env = make_env(SafeGymWrapper, Counting(), cost_keys=["cost", ("costs", "heat")])
    assert env.cost_names == ("cost", "costs.heat")
    assert make_env(SafeGymEnv, "counting:Counting-v0").cost_names == ("cost",)


def test_a_step_without_a_cost_raises(make_env):
    env = make_env(SafeGymEnv, "counting:Forgetful-v0")
    with pytest.raises(KeyError, match=r"info must have \('cost',\) in every step, got only \[\]"):
        env.rollout(2)
    nested = make_env(SafeGymWrapper, Counting(), cost_keys=[("costs", "heat")])
    with pytest.raises(KeyError, match=r"info must have \('costs', 'heat'\) in every step"):
        nested.rollout(1)
    dotted = make_env(SafeGymWrapper, Counting(), cost_keys=["costs.heat"])
    with pytest.raises(KeyError, match=r"got only \['cost'.*a tuple: \('costs', 'heat'\)"):
        dotted.rollout(2)
    group = make_env(SafeGymWrapper, Counting(), cost_keys=["costs"])
    with pytest.raises(
        ValueError, match=r"cost 'costs' must be a number, got a group: .*'costs', "
    ):
        group.rollout(1)
    masked = make_env(SafeGymWrapper, vector(AutoresetMode.DISABLED), cost_keys=["costs"])
    without_masks = r"\[\('costs', 'one'\), \('costs', 'count'\)\]"
    with pytest.raises(ValueError, match=f"name its entries, {without_masks}"):
        masked.rollout(1)
    no_mapping = make_env(SafeGymWrapper, Counting(), cost_keys=[("cost", "heat")])
    with pytest.raises(KeyError, match=r"info must have \('cost', 'heat'\) in every step"):
        no_mapping.rollout(1)


def test_entries_that_look_like_masks(make_env):
    class Private(Counting):
        def info(self):
            return {**super().info(), "_cost": False}

    check_counts(make_env(SafeGymWrapper, Private()).rollout(4), [4])


@by_mode
def test_a_row_without_a_cost_raises(make_env, mode):
    env = make_env(SafeGymWrapper, vector(mode, Counting, Forgetful))
    with pytest.raises(KeyError, match=r"\('cost',\) .* environments \[1\] have none"):
        env.rollout(2)


@pytest.mark.parametrize("steps", [2, 4], ids=["that ends", "beside one that ends"])
def test_a_step_without_a_cost_raises_at_an_end(make_env, steps):
    """The cost of the reset, which stands in its place, is not taken for it."""
    rows = partial(Counting, 2), partial(Forgetful, steps)
    env = make_env(SafeGymWrapper, vector(AutoresetMode.SAME_STEP, *rows))
    with pytest.raises(KeyError, match=r"environments \[1\] have none"):
        env.rollout(2)


class Returns(Counting):
    def __init__(self, value):
        super().__init__()
        self.value = value

    def info(self):
        return {"cost": self.value}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), None])
def test_cost_must_be_finite(make_env, value):
    with pytest.raises(ValueError, match=r"cost 'cost' must be (finite|numbers)"):
        make_env(SafeGymWrapper, Returns(value)).rollout(1)


def test_cost_must_be_a_number(make_env):
    with pytest.raises(ValueError, match=r"cost 'cost' must have shape \(\), got \(2,\)"):
        make_env(SafeGymWrapper, Returns([1.0, 2.0])).rollout(1)


@pytest.mark.parametrize("kind", [int, np.float32, bool, np.array])
def test_kinds_of_numbers(make_env, kind):
    env = make_env(SafeGymWrapper, Returns(kind(1)))
    assert env.rollout(2)["next", "cost"].tolist() == [[1.0], [1.0]]


@pytest.mark.parametrize("asynchronous", [False, True])
def test_rows_may_report_costs_of_other_types(make_env, forked_workers, asynchronous):
    """Gymnasium gives the array of a cost the type that it has in the first environment."""
    env = make_env(
        SafeGymEnv,
        "counting:Torque-v0",
        cost_keys=[("costs", "pushes"), ("costs", "torque"), ("costs", "push")],
        num_envs=2,
        asynchronous=asynchronous,
    )
    after = env.step(env.reset().set("action", torch.tensor([[-0.5], [0.5]])))
    assert after["next", "cost"].tolist() == [[0, 0, 0], [1, 0.5, 0.5]]


@by_mode
def test_an_integer_in_the_first_row_truncates_no_other(make_env, mode):
    env = make_env(SafeGymWrapper, vector(mode, partial(Returns, 0), partial(Returns, 0.75)))
    assert env.rollout(2)["next", "cost"].squeeze(-1).tolist() == [[0, 0], [0.75, 0.75]]


def test_integers_of_processes_warn(make_env, forked_workers):
    """Their fractions are lost in Gymnasium."""
    rows = partial(Returns, 0), partial(Returns, 0.75)
    env = make_env(SafeGymWrapper, vector(AutoresetMode.DISABLED, *rows, kind=AsyncVectorEnv))
    with pytest.warns(UserWarning, match=r"cost 'cost' is int64 .* Return float\(cost\)"):
        env.rollout(1)


@by_mode
def test_numpys_bools_are_costs(make_env, mode):
    made = vector(mode, Torque, Torque)
    env = make_env(SafeGymWrapper, made, cost_keys=[("costs", "pushes")])
    after = env.step(env.reset().set("action", torch.tensor([[-0.5], [0.5]])))
    assert after["next", "cost"].tolist() == [[0], [1]]


@pytest.mark.parametrize("keys", ["cost", []], ids=repr)
def test_wrong_keys(keys):
    with pytest.raises(ValueError, match="cost_keys must be a sequence of at least one key"):
        SafeGymWrapper(Counting(), cost_keys=keys)


@pytest.mark.parametrize("key", [0, ("cost", 0), ("costs", ("speed", None)), ()], ids=repr)
def test_keys_are_names(key):
    with pytest.raises(ValueError, match=r"cost_keys must be strings or tuples of .*, got \[.+\]"):
        SafeGymWrapper(Counting(), cost_keys=[key])


def test_a_key_twice_is_refused():
    with pytest.raises(ValueError, match="cost_keys must be different keys"):
        SafeGymWrapper(Counting(), cost_keys=["cost", ("cost",)])
