"""SACLagrangianLoss and TD3LagrangianLoss: keys, states, compilation, and what they refuse."""

import re

import pytest
import torch
from off_policy import (
    OWN,
    TRAINS,
    assert_same_outputs,
    call,
    each_loss,
    make_actor,
    make_cost_critic,
    make_kind,
    make_loss,
    parameters,
)
from programs import run_code
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP
from torchrl.objectives import SoftUpdate

from torchrl_safe.objectives import CostGAE, TD3LagrangianLoss
from torchrl_safe.testing import check_compile, make_q_critic, make_q_networks, make_transitions

# ---------------------------------------------------------------- what does not fit


@each_loss
def test_a_batch_without_cost_is_refused(kind):
    with pytest.raises(KeyError, match=r"\('next', 'cost'\)"):
        make_loss(kind)(make_transitions().exclude(("next", "cost")))


@each_loss
def test_a_termination_that_is_missing_is_named_where_keys_are_set(kind):
    loss = make_loss(kind)
    loss.set_keys(terminated="ended")
    with pytest.raises(KeyError, match=r"\('next', 'ended'\)"):
        loss(make_transitions())


@each_loss
def test_costs_of_the_wrong_width_are_refused(kind):
    with pytest.raises(
        ValueError, match=r"\('next', 'cost'\) must have shape \(12, 2\).*\(12, 3\)"
    ):
        make_loss(kind, 2)(make_transitions(3))


@each_loss
def test_cost_critics_of_the_wrong_width_are_refused(kind):
    loss = kind(make_actor(kind), make_q_critic(), make_cost_critic(3), num_costs=2, **OWN[kind])
    SoftUpdate(loss, tau=0.5)
    message = r"cost_qvalue_network must write .* of shape \(12, 2\).* got \(12, 3\)"
    with pytest.raises(ValueError, match=message):
        loss(make_transitions(2))


@each_loss
@pytest.mark.parametrize("wrong", [None, torch.nn.Linear(2, 1), [torch.nn.Linear(2, 1)] * 2])
def test_cost_critics_without_keys_are_refused(kind, wrong):
    with pytest.raises(TypeError, match="cost_qvalue_network must be an instance of TensorDictMod"):
        kind(make_actor(kind), make_q_critic(), wrong, **OWN[kind])


@each_loss
def test_cost_critics_that_write_another_key_are_refused(kind):
    critic = make_cost_critic(1, key="elsewhere")
    loss = kind(make_actor(kind), make_q_critic(), critic, **OWN[kind])
    SoftUpdate(loss, tau=0.5)
    with pytest.raises(KeyError, match="does not write the key 'state_action_cost_value'"):
        loss(make_transitions())


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 1)], ids=str)
@each_loss
def test_multiplier_init_must_have_one_number_for_each_cost(kind, shape):
    with pytest.raises(ValueError, match=rf"multiplier_init.* 2 costs.*{re.escape(str(shape))}"):
        make_loss(kind, 2, multiplier_init=torch.ones(shape))


@pytest.mark.parametrize("init", [-0.1, float("nan"), float("inf")])
@each_loss
def test_multiplier_init_must_be_finite_and_not_negative(kind, init):
    with pytest.raises(ValueError, match="multiplier_init must be a number from 0 to"):
        make_loss(kind, multiplier_init=init)


@each_loss
def test_there_is_at_least_one_of_each(kind):
    actor, critic, cost_critic = make_actor(kind), make_q_critic(), make_cost_critic()
    with pytest.raises(ValueError, match="num_costs must be a whole number of at least 1, got 0"):
        kind(actor, critic, cost_critic, num_costs=0, **OWN[kind])
    with pytest.raises(
        ValueError, match="num_cost_qvalue_nets must be a whole number of at least 1, got 0"
    ):
        kind(actor, critic, cost_critic, num_cost_qvalue_nets=0, **OWN[kind])
    message = "one network or num_cost_qvalue_nets = 2 of them, got 3"
    with pytest.raises(ValueError, match=message):
        kind(actor, critic, [cost_critic] * 3, **OWN[kind])


# ---------------------------------------------------------------- keys


BATCH_KEYS = {"reward": "reward", "done": "done", "terminated": "terminated", "cost": "cost"}


def run_with_keys(kind, keys):
    torch.manual_seed(0)
    loss = kind(
        *make_q_networks(2, keys=keys, deterministic=kind is TD3LagrangianLoss),
        num_costs=2,
        multiplier_init=0.7,
        **OWN[kind],
    )
    SoftUpdate(loss, tau=0.5)
    loss.set_keys(**keys)
    batch = make_transitions(2)
    for key in BATCH_KEYS.keys() & keys.keys():
        batch["next"].rename_key_(key, keys[key])
    if "action" in keys:
        batch.rename_key_("action", keys["action"])
    return call(loss, batch), batch


@pytest.mark.parametrize("name", ["renamed", ("nested", "renamed")], ids=["renamed", "nested"])
@pytest.mark.parametrize("key", ["action", "priority"])
@each_loss
def test_what_is_read_and_written_can_be_renamed(kind, key, name):
    """test_testing.py renames all keys; these show in the batch."""
    losses, batch = run_with_keys(kind, {key: name})
    expected, _ = run_with_keys(kind, {})
    assert_same_outputs(losses, expected)
    assert name in batch.keys(True)


@each_loss
def test_default_keys_and_back(kind):
    loss, batch = make_loss(kind, 2), make_transitions(2)
    loss(batch)  # Estimators exist from here on.
    keys = {"cost": "cost", "state_action_cost_value": "state_action_cost_value"}
    for key, default in keys.items():
        assert getattr(loss.tensor_keys, key) == default
        loss.set_keys(**{key: "renamed"})
    assert loss.cost_value_estimator.tensor_keys.reward == "renamed"
    assert loss.cost_value_estimator.tensor_keys.value == "renamed"
    loss.set_keys(**dict.fromkeys(keys))
    assert loss(batch)["loss_cost_qvalue"] > 0
    with pytest.raises(ValueError, match="cost_limit is not an accepted"):
        loss.set_keys(cost_limit="anything")


@each_loss
def test_in_keys_follow_the_keys(kind):
    loss = make_loss(kind)
    assert ("next", "cost") in loss.in_keys
    assert len(loss.in_keys) == len(set(loss.in_keys))
    assert ("next", "action") not in loss.in_keys
    loss.set_keys(cost=("info", "cost"))
    assert ("next", "info", "cost") in loss.in_keys
    assert ("next", "cost") not in loss.in_keys


@each_loss
def test_what_a_call_returns_is_announced(kind):
    loss = make_loss(kind, 2)
    assert set(loss.out_keys) == set(loss(make_transitions(2)).keys())


@pytest.mark.integration
def test_outputs_can_be_selected_before_torchrl_has_built_the_parent():
    """TorchRL makes a property of a class's list of outputs when that class itself is built."""
    code = (
        "from off_policy import *\n"
        "from torchrl_safe.testing import make_transitions\n"
        "for kind in (SACLagrangianLoss, TD3LagrangianLoss):\n"
        "    loss = make_loss(kind, 2)\n"
        "    print(*loss.select_out_keys('loss_actor', 'loss_cost_qvalue').out_keys)\n"
        "    print(*sorted(loss(make_transitions(2)).keys()))"
    )
    done = run_code(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["loss_actor loss_cost_qvalue"] * 4


@each_loss
def test_a_critic_may_read_what_the_actor_does_not(kind):
    class Privileged(nn.Linear):
        def forward(self, observation, state, action):
            return super().forward(torch.cat([observation, state, action], -1))

    critic = make_cost_critic()
    critic.module, critic.in_keys = Privileged(4 + 1 + 2, 1), ["observation", "state", "action"]
    loss = kind(make_actor(kind), make_q_critic(), critic, **OWN[kind])
    SoftUpdate(loss, tau=0.5)
    assert {"state", ("next", "state")} <= set(loss.in_keys)
    batch = make_transitions()
    batch["state"] = torch.randn(12, 1)
    batch["next", "state"] = torch.randn(12, 1)
    expected = call(loss, batch)["loss_cost_qvalue"]
    batch["next", "state"] += 1
    assert call(loss, batch)["loss_cost_qvalue"] != expected


# ---------------------------------------------------------------- state


@each_loss
def test_the_discount_of_the_costs_goes_with_the_state(kind):
    saved, loaded = make_loss(kind), make_loss(kind)
    saved.make_cost_value_estimator(gamma=0.5)
    loaded.load_state_dict(saved.state_dict(), strict=True)
    assert loaded.cost_value_estimator.gamma.item() == 0.5


@each_loss
def test_cost_critics_may_have_dropout(kind):
    """Also where those of the reward have none."""
    critic = make_cost_critic(2)
    net = MLP(out_features=2, num_cells=[8], dropout=0.5)
    net(*(make_transitions(2)[key] for key in critic.in_keys))  # It gets its shapes.
    critic = TensorDictModule(net, critic.in_keys, critic.out_keys)
    loss = kind(make_actor(kind), make_q_critic(), critic, num_costs=2, **OWN[kind])
    SoftUpdate(loss, tau=0.1)  # TorchRL warns without.
    assert call(loss, make_transitions(2))["loss_cost_qvalue"].isfinite()


@each_loss
def test_reset_reinitializes_the_cost_critics(kind):
    loss = make_loss(kind, 2)
    for target in (False, True):
        for parameter in parameters(loss, "cost_qvalue", target):
            parameter.data.add_(1000.0)
    loss.reset_parameters_recursive()
    for target in (False, True):
        for parameter in parameters(loss, "cost_qvalue", target):
            assert (parameter.abs() < 10).all()


@each_loss
def test_batch_of_rows_and_time_equals_the_flat_one(kind):
    loss, flat = make_loss(kind, 2, multiplier_init=0.7), make_transitions(2)
    rows = flat.reshape(3, 4)
    losses, expected = call(loss, rows), call(loss, flat)
    for key in TRAINS:
        torch.testing.assert_close(losses[key], expected[key])
    assert rows["td_error"].shape == (3, 4)


# ---------------------------------------------------------------- compilation


# SACLagrangianLoss is compiled in the doctest of check_q_loss.
@pytest.mark.slow
def test_compiles_to_one_graph_that_sees_the_multiplier_move():
    make, _, setting = make_kind(TD3LagrangianLoss)
    check_compile(make, **setting)


@each_loss
def test_advantages_are_no_values_of_actions(kind):
    estimator = CostGAE(gamma=0.9, lmbda=0.9, value_network=None)
    with pytest.raises(
        ValueError, match=r"estimator must estimate the value of an action, .* CostGAE"
    ):
        make_loss(kind).make_cost_value_estimator(estimator)
