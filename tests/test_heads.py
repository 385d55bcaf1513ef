"""Critics that are heads of one network."""

import copy

import pytest
import torch
from on_policy import OTHERS, SUBCLASSES, all_losses, every_loss, free
from tensordict.nn import NormalParamExtractor, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import (
    ActorValueOperator,
    GRUModule,
    IndependentNormal,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import KLPENPPOLoss

from torchrl_safe.objectives import CUPLoss, PPOLagrangianLoss, TrustRegionLoss
from torchrl_safe.testing import OBSERVATION_SIZE, make_batch


class Trunk(nn.Linear):
    calls = 0

    def forward(self, observation):
        self.calls += 1
        return super().forward(observation).tanh()


def make_heads(num_costs=2, hidden="hidden"):
    """A trunk with an actor, a critic and a cost critic on it, as in TorchRL's documentation."""
    torch.manual_seed(0)
    trunk = Trunk(OBSERVATION_SIZE, 8)
    policy = nn.Sequential(nn.Linear(8, 4), NormalParamExtractor())
    value_head = ValueOperator(nn.Linear(8, 1), in_keys=[hidden])
    model = ActorValueOperator(
        TensorDictModule(trunk, ["observation"], [hidden]),
        ProbabilisticActor(
            TensorDictModule(policy, [hidden], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
            return_log_prob=True,
        ),
        value_head,
    )
    cost_head = ValueOperator(nn.Linear(8, num_costs), in_keys=[hidden], out_keys=["cost_value"])
    return trunk, (model.get_policy_operator(), value_head, cost_head)


def test_a_call_without_advantages_has_the_gradients_of_one_with_them():
    """Value targets have none, not even by the trunk that computes the critics' inputs."""
    trunk, networks = make_heads()
    loss = PPOLagrangianLoss(*networks, num_costs=2, entropy_bonus=False)
    data = make_batch(2)
    with torch.no_grad():
        networks[0](data)
    ready = loss.estimate_advantages(data.clone()).reshape(-1)
    for name in ("loss_objective", "loss_critic", "loss_cost_critic"):
        one, two = (
            torch.autograd.grad(loss(each.clone())[name], [trunk.weight])[0]
            for each in (data, ready)
        )
        torch.testing.assert_close(one, two)


def minibatch(num_costs=2):
    """Steps with advantages and targets, and features that an older trunk has left."""
    torch.manual_seed(2)
    data = make_batch(num_costs).reshape(-1)
    shape = data.shape
    data["advantage"], data["value_target"] = torch.randn(*shape, 1), torch.randn(*shape, 1)
    data["cost_advantage"] = torch.randn(*shape, num_costs)
    data["cost_value_target"] = torch.randn(*shape, num_costs)
    data["hidden"] = torch.full((*shape, 8), 100.0)
    return data


@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
# A2CLoss and ReinforceLoss want features in the data for their own head.
@pytest.mark.parametrize(
    ("make", "features"),
    [
        *((make, features) for make, _ in SUBCLASSES.values() for features in ("stale", "absent")),
        *((make, "stale") for make, _ in OTHERS.values()),
    ],
    ids=[
        *(f"{name}-{features}" for name in SUBCLASSES for features in ("stale", "absent")),
        *(f"{name}-stale" for name in OTHERS),
    ],
)
def test_a_cost_head_trains_on_the_features_of_this_call(make, features, functional):
    trunk, (actor, critic, cost_head) = make_heads()
    head = copy.deepcopy(cost_head)
    loss = make(actor, critic, cost_head, num_costs=2, functional=functional)
    data = minibatch()
    if features == "absent":
        del data["hidden"]
    weight = loss.actor_network_params["module", "0", "module", "weight"] if functional else None
    weight = trunk.weight if weight is None else weight
    hidden = nn.functional.linear(data["observation"], weight, trunk_bias(loss, trunk)).tanh()
    value = head.module(hidden)
    expected = (
        nn.functional.smooth_l1_loss(value, data["cost_value_target"], reduction="none")
        .sum(-1)
        .mean()
    )
    actual = loss(data)["loss_cost_critic"]
    torch.testing.assert_close(actual, expected)
    (gradient,) = torch.autograd.grad(actual, [weight], retain_graph=True)
    (wanted,) = torch.autograd.grad(expected, [weight])
    assert wanted.norm() > 1e-3
    torch.testing.assert_close(gradient, wanted)


def trunk_bias(loss, trunk):
    if not loss.functional:
        return trunk.bias
    return loss.actor_network_params["module", "0", "module", "bias"]


@every_loss
def test_the_trunk_is_evaluated_once_in_a_call(make):
    trunk, networks = make_heads()
    loss, data = make(*networks, num_costs=2), minibatch()
    before = trunk.calls
    loss(data)
    once = 2 if isinstance(getattr(loss, "loss_module", None), KLPENPPOLoss) else 1
    assert trunk.calls - before == once  # KLPENPPOLoss itself evaluates its policy twice.


# KLPENPPOLoss moves its coefficient at each call: two calls differ.
@pytest.mark.parametrize(
    ("make", "parent"),
    [pair for pair in SUBCLASSES.values() if pair[1] is not KLPENPPOLoss],
    ids=[name for name, pair in SUBCLASSES.items() if pair[1] is not KLPENPPOLoss],
)
def test_with_heads_and_no_constraint_it_is_its_parent_bit_for_bit(make, parent):
    loss = make(*make_heads()[1], num_costs=2)
    free(loss)
    actor, critic, _ = make_heads()[1]
    for data in (minibatch(), minibatch().exclude("hidden")):
        losses, expected = loss(data.clone()), parent(actor, critic)(data.clone())
        for key, value in expected.items():
            assert torch.equal(losses[key], value), key


@all_losses
def test_advantages_of_heads_are_estimated_from_features_computed_now(make):
    """Those of the next state too, which no collector has; and no feature stays in the batch."""
    networks = make_heads()[1]
    loss = make(*networks, num_costs=2)
    batch = make_batch(2)
    estimated = loss.estimate_advantages(batch.clone())
    full = batch.clone()
    actor, critic, cost_head = make_heads()[1]
    with torch.no_grad():
        for part in (full, full["next"]):
            part["hidden"] = actor[0](part.select("observation"))["hidden"]
            critic(part)
            cost_head(part)
    assert set(estimated.keys()) == set(batch.keys()) | {
        *("advantage", "value_target", "state_value"),
        *("cost_advantage", "cost_value_target", "cost_value"),
    }
    torch.testing.assert_close(estimated["state_value"], full["state_value"])
    torch.testing.assert_close(estimated["cost_value"], full["cost_value"])
    done = batch["next", "done"] & batch["next", "terminated"]
    last = batch["next", "cost"] + 0.99 * full["next", "cost_value"] * ~done
    # A truncated step's target is what its own next state is worth.
    torch.testing.assert_close(estimated["cost_value_target"][2, 3], last[2, 3])


def test_heads_of_a_recurrent_network_do_not_carry_an_episode_into_the_next():
    """The next state has the value that it has as a state, unless an episode ends between."""
    torch.manual_seed(0)
    cell = GRUModule(
        input_size=OBSERVATION_SIZE, hidden_size=8, in_key="observation", out_key="hidden"
    )
    _, (actor, critic, cost_critic) = make_heads()
    actor = ProbabilisticTensorDictSequential(cell, *[*actor][1:])
    loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2)
    batch = make_batch(2)
    batch["observation"][:, 1:] = batch["next", "observation"][:, :-1]
    done = torch.zeros_like(batch["next", "done"])
    done[:, 1] = True
    batch["next", "done"], batch["next", "terminated"] = done, done.clone()
    starts = torch.zeros_like(done)
    starts[:, 0] = starts[:, 2] = True
    batch["is_init"], batch["next", "is_init"] = starts, torch.zeros_like(done)
    state, before, after = torch.zeros(4, 1, 8), [], []
    for step in batch.unbind(1):  # As a collector does.
        before.append(state * ~step["is_init"].unsqueeze(-1))
        state = cell(step.set("recurrent_state", before[-1]))["next", "recurrent_state"].detach()
        after.append(state)
    batch["recurrent_state"] = torch.stack(before, 1)
    batch["next", "recurrent_state"] = torch.stack(after, 1)
    estimated = loss.estimate_advantages(batch)
    for key in ("state_value", "cost_value"):
        following = estimated["next", key][:, :-1]
        same = torch.isclose(estimated[key][:, 1:], following, atol=1e-6).all(-1, keepdim=True)
        assert torch.equal(same, ~done[:, :-1])


# tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.slow
@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
@pytest.mark.parametrize("name", ["ppo-lagrangian", "p3o", "lagrangian-clip-ppo"])
def test_heads_compile_to_one_graph(name, functional):
    loss = SUBCLASSES[name][0](*make_heads()[1], num_costs=2, functional=functional)
    data, expected = minibatch(), loss(minibatch())
    torch._dynamo.reset()
    actual = torch.compile(loss, fullgraph=True, backend="eager")(data)
    for key, value in expected.items():
        torch.testing.assert_close(actual[key], value)


def test_a_projection_leaves_no_features_in_the_batch():
    loss, data = CUPLoss(*make_heads()[1], num_costs=2), minibatch()
    before = data.clone()
    loss.start_projection()
    loss.projection_loss(data)
    assert set(data.keys(True)) == set(before.keys(True))
    assert (data == before).all()


def test_the_critics_alone_read_features_of_this_call():
    loss, data = TrustRegionLoss(*make_heads()[1], num_costs=2), minibatch()
    whole = loss(data.clone())
    for key, value in loss.critic_losses(data).items():
        assert torch.equal(value, whole[key]), key
