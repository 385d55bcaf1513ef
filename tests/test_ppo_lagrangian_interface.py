"""PPOLagrangianLoss: how it plugs in. Keys, state, copies, compilation, batches that do not fit."""

import copy
from functools import partial

import pytest
import torch
from on_policy import (
    NETWORKS,
    TRAINS,
    around,
    assert_close_outputs,
    assert_same_outputs,
    estimated,
    make_composite,
    make_loss,
    networks_with_gradient,
    parameters,
)
from tensordict.nn import set_composite_lp_aggregate
from tensordict.utils import unravel_key
from torch import nn
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.objectives import (
    CostGAE,
    DualAscent,
    LagrangianLoss,
    PPOLagrangianLoss,
    penalized_advantage,
)
from torchrl_safe.testing import check_state_dict, make_batch, make_critic, make_networks

# ---------------------------------------------------------------- data that do not fit


@pytest.mark.parametrize("call", ["forward", "estimate_advantages"])
def test_a_batch_without_cost_is_refused(call):
    loss = make_loss()
    with pytest.raises(KeyError, match=r"\('next', 'cost'\)"):
        getattr(loss, call)(make_batch().exclude(("next", "cost")))


@pytest.mark.parametrize("name", ["done", "terminated"])
def test_a_termination_that_is_missing_is_named_where_keys_are_set(name):
    """TorchRL's estimators take done for it: the end of time would be the end of the task."""
    loss, batch = make_loss(), make_batch()
    batch.rename_key_(("next", name), ("next", "ended"))
    loss.set_keys(**{name: "ended"})
    loss.estimate_advantages(batch)
    batch.rename_key_(("next", loss.tensor_keys.terminated), ("next", "other"))
    with pytest.raises(KeyError, match=rf"'{loss.tensor_keys.terminated}'"):
        loss.estimate_advantages(batch)


@pytest.mark.parametrize("key", ["cost_value", "cost_value_target"])
def test_what_the_cost_critic_needs_is_named_when_missing(key):
    loss = make_loss(clip_value=0.1)
    data = estimated(loss)
    with pytest.raises(KeyError, match=f"'{key}'"):
        loss(data.exclude(key))


@pytest.mark.parametrize("call", ["forward", "estimate_advantages"])
def test_a_cost_critic_of_the_wrong_width_is_refused(call):
    actor, critic, _ = make_networks()
    loss = PPOLagrangianLoss(actor, critic, make_critic("cost_value", 2), num_costs=3)
    with pytest.raises(ValueError, match=r"\(4, 6, 3\) and \(4, 6, 2\)"):
        getattr(loss, call)(make_batch(3))


def test_a_loss_of_the_wrong_width_is_refused():
    loss = PPOLagrangianLoss(*make_networks(3), num_costs=2)
    with pytest.raises(ValueError, match=r"'cost'.* one column for each of the 2 costs"):
        loss(estimated(loss, 3))


# ---------------------------------------------------------------- keys


DEFAULT_KEYS = {
    "advantage": "advantage",
    "value_target": "value_target",
    "value": "state_value",
    "reward": "reward",
    "done": "done",
    "terminated": "terminated",
    "cost": "cost",
    "cost_value": "cost_value",
    "cost_advantage": "cost_advantage",
    "cost_value_target": "cost_value_target",
}
FROM_THE_BATCH = {"reward", "done", "terminated", "cost"}


def run_with_keys(keys, **kwargs):
    """Outputs and batch with the entries named as in ``keys``."""
    networks = make_networks(2, keys=keys)
    loss = PPOLagrangianLoss(*networks, num_costs=2, multiplier_init=0.7, clip_value=0.1, **kwargs)
    loss.set_keys(**keys)
    batch = make_batch(2)
    for key in FROM_THE_BATCH & keys.keys():
        batch["next"].rename_key_(DEFAULT_KEYS[key], keys[key])
    loss.estimate_advantages(batch)
    return loss(batch.reshape(-1)), batch


@pytest.mark.parametrize("name", ["renamed", ("nested", "renamed")], ids=["renamed", "nested"])
@pytest.mark.parametrize("key", DEFAULT_KEYS)
def test_any_key_can_be_renamed(key, name):
    losses, batch = run_with_keys({key: name})
    expected, _ = run_with_keys({})
    assert_same_outputs(losses, expected)
    assert (("next", name) if key in FROM_THE_BATCH else name) in batch
    assert DEFAULT_KEYS[key] not in batch


@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
def test_all_keys_can_be_nested_at_once(functional):
    # GAE stacks root and next: a value may not share its parent with an entry of next alone.
    parents = {key: "info" if key in FROM_THE_BATCH else "estimates" for key in DEFAULT_KEYS}
    keys = {key: (parent, "deeper", key) for key, parent in parents.items()}
    losses, batch = run_with_keys(keys, functional=functional)
    expected, _ = run_with_keys({}, functional=functional)
    assert_same_outputs(losses, expected)
    assert not set(batch.keys()) & set(DEFAULT_KEYS)


def test_keys_can_be_set_one_by_one_whatever_the_critics_write():
    networks = make_networks(2, keys={"value": "v", "cost_value": ("costs", "v")})
    loss = PPOLagrangianLoss(*networks, num_costs=2)
    loss.set_keys(cost_value=("costs", "v"))
    loss.set_keys(value="v")
    assert {"v", ("costs", "v")} <= set(loss.estimate_advantages(make_batch(2)).keys(True))


def test_default_keys_and_back():
    loss = make_loss(2)
    loss.estimate_advantages(make_batch(2))  # Estimators exist from here on.
    for key, default in DEFAULT_KEYS.items():
        assert getattr(loss.tensor_keys, key) == default
    for key in ("cost", "cost_advantage", "cost_value_target"):
        loss.set_keys(**{key: "renamed"})
        assert getattr(loss.tensor_keys, key) == "renamed"
    assert loss.cost_value_estimator.tensor_keys.reward == "renamed"
    loss.set_keys(**dict.fromkeys(DEFAULT_KEYS))
    for key, default in DEFAULT_KEYS.items():
        assert getattr(loss.tensor_keys, key) == default
    batch = loss.estimate_advantages(make_batch(2))
    assert {"cost_advantage", "cost_value_target"} <= set(batch.keys())


def test_an_unknown_key_is_refused():
    with pytest.raises(ValueError, match="cost_limit is not an accepted"):
        make_loss().set_keys(cost_limit="anything")


def test_in_keys_follow_the_keys():
    loss = make_loss()
    assert ("next", "cost") in loss.in_keys
    assert len(loss.in_keys) == len(set(loss.in_keys))
    loss.set_keys(cost=("info", "cost"))
    assert ("next", "info", "cost") in loss.in_keys
    assert ("next", "cost") not in loss.in_keys


def test_in_keys_hold_what_only_the_cost_critic_reads():
    actor, critic, _ = make_networks()
    cost_critic = make_critic("cost_value", observation=("privileged", "state"))
    loss = PPOLagrangianLoss(actor, critic, cost_critic)
    expected = {("privileged", "state"), ("next", "privileged", "state"), "observation"}
    assert expected <= set(loss.in_keys)


def by_keyword(loss, batch):
    keys = {"_".join(k) if isinstance(k, tuple) else k: k for k in map(unravel_key, loss.in_keys)}
    return {name: batch[key] for name, key in keys.items()}


@pytest.mark.parametrize("options", [{}, {"clip_value": 0.1, "entropy_bonus": False}], ids=str)
def test_call_with_keywords_equals_call_with_tensordict(options):
    loss, batch = make_loss(2, multiplier_init=0.7, **options), make_batch(2)
    expected = loss(batch)
    outputs = loss(**by_keyword(loss, batch))
    assert len(outputs) == len(loss.out_keys)
    for key, output in zip(loss.out_keys, outputs, strict=True):
        torch.testing.assert_close(output, expected[key])
    # All that the call returns is announced, but for one that ClipPPOLoss does not announce.
    assert set(expected.keys()) - set(loss.out_keys) == {"explained_variance"}


def test_select_out_keys():
    loss, batch = make_loss(2), make_batch(2)
    expected = loss(batch)
    loss.select_out_keys("loss_cost_critic", "lagrange_multiplier_1")
    assert loss.out_keys == ["loss_cost_critic", "lagrange_multiplier_1"]
    cost_critic, multiplier = loss(**by_keyword(loss, batch))
    torch.testing.assert_close(cost_critic, expected["loss_cost_critic"])
    torch.testing.assert_close(multiplier, expected["lagrange_multiplier_1"])


# ---------------------------------------------------------------- state, casts, copies


def test_states_and_copies_of_networks_that_are_not_functional():
    check_state_dict(partial(PPOLagrangianLoss, functional=False), make_data=make_batch)


def test_state_includes_the_discounts_and_works_inside_a_module():
    saved = nn.ModuleList([make_loss(multiplier_init=2.0)])
    saved[0].make_cost_value_estimator(gamma=0.5)
    loaded = nn.ModuleList([make_loss()])
    loaded.load_state_dict(saved.state_dict(), strict=True)
    assert loaded[0].cost_value_estimator.gamma.item() == 0.5
    assert loaded[0].lagrange_multiplier.item() == 2.0


@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
@pytest.mark.parametrize("used", [True, False], ids=["used", "fresh"])
def test_cast_to_double(used, functional):
    loss = make_loss(2, multiplier_init=0.7, clip_value=0.1, functional=functional)
    expected = loss(estimated(loss, 2)) if used else None
    loss.to(torch.float64)
    assert loss.lagrange_multiplier.dtype == torch.float64
    batch = make_batch(2).apply(lambda x: x.double() if x.is_floating_point() else x)
    data = loss.estimate_advantages(batch).reshape(-1)
    assert data["cost_advantage"].dtype == torch.float64
    losses = loss(data)
    assert {losses[key].dtype for key in TRAINS} == {torch.float64}
    if used:
        for key in TRAINS:
            torch.testing.assert_close(losses[key].float(), expected[key])


@pytest.mark.parametrize("used", [True, False], ids=["used", "fresh"])
def test_a_copy_is_independent(used):
    loss, batch = make_loss(2), make_batch(2)
    if used:
        loss(batch)
    twin = copy.deepcopy(loss)
    assert_same_outputs(twin(batch), loss(batch))
    twin.lagrange_multiplier.fill_(1.0)
    assert loss.lagrange_multiplier.tolist() == [0.0, 0.0]
    assert twin.state_dict().keys() == loss.state_dict().keys()


@pytest.mark.parametrize("name", ["value_estimator", "cost_value_estimator"])
@pytest.mark.parametrize(
    "make", [PPOLagrangianLoss, around(LagrangianLoss, ClipPPOLoss)], ids=["own", "wrapped"]
)
def test_estimators_are_not_assigned(make, name):
    loss = make(*make_networks())
    with pytest.raises(AttributeError, match=f"{name} cannot be assigned: pass it to make_{name}"):
        setattr(loss, name, CostGAE(gamma=0.5, lmbda=0.5, value_network=None))


def test_networks_are_functional_like_those_of_clip_ppo():
    loss = make_loss(2)
    for name in NETWORKS:
        assert f"{name}_network" not in dict(loss.named_children())
        assert f"{name}_network_params" in dict(loss.named_children())
    actual = loss.target_cost_critic_network_params.values(True, True)
    for target, parameter in zip(actual, parameters(loss, "cost_critic"), strict=True):
        assert torch.equal(target, parameter)
        assert not target.requires_grad
    total = sum(p.numel() for network in make_networks(2) for p in network.parameters())
    assert sum(p.numel() for p in loss.parameters()) == total


def test_reset_reinitializes_all_three_networks():
    loss = make_loss(2)
    for name in NETWORKS:
        for parameter in parameters(loss, name):
            parameter.data.add_(1000.0)
    loss.reset_parameters_recursive()
    for name in NETWORKS:
        for parameter in parameters(loss, name):
            assert (parameter.abs() < 10).all()


# ---------------------------------------------------------------- compilation


# tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
# It is compiled in the doctest of check_loss too, where nothing but a rule moves the multiplier.
@pytest.mark.slow
def test_compiles_to_one_graph_that_sees_the_multiplier_move():
    graphs = []

    def eager(graph, inputs):
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    loss = make_loss(2, multiplier_init=0.5)
    data = estimated(loss, 2)
    rule = DualAscent(loss, cost_limit=0.0, lr=1.0)
    # tensordict remembers the classes that it has met, and graphs are made anew for more of them.
    rule.step(torch.zeros(1, 2))
    loss(data)
    compiled = torch.compile(loss, fullgraph=True, backend=eager)
    first = compiled(data)
    assert_close_outputs(first, loss(data))
    rule.step(torch.tensor([[1.0, 2.0]]))
    second = compiled(data)
    assert_close_outputs(second, loss(data))
    assert second["lagrange_multiplier_1"].item() == 2.5
    assert (second["loss_objective"] - first["loss_objective"]).abs() > 1e-3
    assert len(graphs) == 1
    sum(second[key] for key in TRAINS).backward()
    assert networks_with_gradient(loss) == set(NETWORKS)


# ---------------------------------------------------------------- composite actions


@pytest.fixture
def no_aggregation():
    """Composite log-probabilities stay apart for the length of a test."""
    with set_composite_lp_aggregate(False):
        yield


@pytest.mark.usefixtures("no_aggregation")
@pytest.mark.parametrize(
    "options",
    [{}, {"entropy_coeff": {"move_entropy": 0.1, "grip_entropy": 0.3}}],
    ids=["one-coefficient", "one-for-each-head"],
)
def test_composite_actions(options):
    actor, critic, cost_critic, batch = make_composite(2)
    clip_loss = ClipPPOLoss(copy.deepcopy(actor), copy.deepcopy(critic), **options)
    loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, **options)
    assert loss.tensor_keys.action == ["move", "grip"]
    data = loss.estimate_advantages(batch).reshape(-1)
    expected = clip_loss(data)
    assert expected["clip_fraction"] > 0
    losses = loss(data)
    assert (losses.pop("composite_entropy") == expected.pop("composite_entropy")).all()
    assert_same_outputs(losses, expected)

    loss.lagrange_multiplier.fill_(0.5)
    mixed = loss(data)
    data["advantage"] = penalized_advantage(
        data["advantage"], data["cost_advantage"], torch.tensor([0.5, 0.5])
    )
    torch.testing.assert_close(mixed["loss_objective"], clip_loss(data)["loss_objective"])
    mixed["loss_objective"].backward()
    assert networks_with_gradient(loss) == {"actor"}


# ---------------------------------------------------------------- the batch


@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
def test_the_loss_writes_nothing_into_its_input(precomputed):
    loss, batch = make_loss(2, clip_value=0.1), make_batch(2)
    if precomputed:
        loss.estimate_advantages(batch)
    before = batch.clone()
    loss(batch)
    assert set(batch.keys(True)) == set(before.keys(True))
    assert (batch == before).all()


def test_batch_of_rows_and_time_equals_the_flat_one():
    loss = make_loss(2, multiplier_init=0.7)
    batch = loss.estimate_advantages(make_batch(2))
    rows, flat = loss(batch), loss(batch.reshape(-1))
    for key in (*TRAINS, "cost_explained_variance"):
        torch.testing.assert_close(rows[key], flat[key])


def test_separate_losses_need_a_functional_loss():
    """TorchRL ignores the option without one."""
    with pytest.raises(ValueError, match="separate_losses must be False with functional=False"):
        PPOLagrangianLoss(*make_networks(), functional=False, separate_losses=True)
