"""PPOLagrangianLoss in the cases that TorchRL tests ClipPPOLoss in.

Every way to estimate advantages, functional or not, one action or a composite one, keys, keyword
calls, reductions, clipping; each beside ClipPPOLoss at multiplier zero, and with multipliers.
"""

import itertools
from functools import partial

import pytest
import torch
from on_policy import TRAINS, Heads, make_trunk
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    TensorDictModule,
    set_composite_lp_aggregate,
)
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss, ValueEstimators
from torchrl.objectives.value import GAE, TD1Estimator, TDLambdaEstimator, VTrace

from torchrl_safe.objectives import CostGAE, PPOLagrangianLoss
from torchrl_safe.testing import OBSERVATION_SIZE, make_batch, make_critic, make_networks
from torchrl_safe.testing.networks import mlp

PARTS = [("moves", "arm"), ("moves", "gripper")]


@pytest.fixture(autouse=True)
def no_aggregation():
    """Log-probabilities of composite actions stay apart, as TorchRL recommends."""
    with set_composite_lp_aggregate(False):
        yield


def make_composite_actor(seed=0):
    """Actions in two parts, both nested under one key."""
    torch.manual_seed(seed)
    params = [("params", *part, name) for part, names in zip(
        PARTS, (("loc", "scale"), ("logits",)), strict=True
    ) for name in names]  # fmt: skip
    return ProbabilisticActor(
        TensorDictModule(Heads(), ["observation"], params),
        in_keys=["params"],
        out_keys=PARTS,
        distribution_class=partial(
            CompositeDistribution,
            distribution_map={PARTS[0]: IndependentNormal, PARTS[1]: Categorical},
        ),
        return_log_prob=True,
    )


def make_setting(composite, num_costs=2):
    """Actor, critics, and a batch of another policy's."""
    actor, critic, cost_critic = make_networks(num_costs)
    batch = make_batch(num_costs)
    if composite:
        actor = make_composite_actor()
        batch = batch.exclude("action", "action_log_prob", "loc", "scale")
        with torch.no_grad():
            make_composite_actor(seed=5)(batch)
    return actor, critic, cost_critic, batch


def make_pair(composite=False, **options):
    """The loss, ClipPPOLoss with the same networks, and a batch."""
    actor, critic, cost_critic, batch = make_setting(composite)
    loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, **options)
    actor, critic, *_ = make_setting(composite)
    return loss, ClipPPOLoss(actor, critic, **options), batch


def reached(loss):
    """Networks that have a gradient."""
    return {
        name.split("_network")[0]
        for name, parameter in loss.named_parameters()
        if parameter.grad is not None and parameter.grad.any()
    }


def check(loss, parent, data):
    """Equal to the parent at zero; with multipliers, each output trains its own network."""
    losses, expected = loss(data.clone()), parent(data.clone())
    for key, value in expected.items():
        same = (losses[key] == value).all() if key == "composite_entropy" else None
        assert torch.equal(losses[key], value) if same is None else same, key
    loss.lagrange_multiplier.fill_(0.7)
    moved = loss(data.clone())
    assert not torch.equal(moved["loss_objective"], expected["loss_objective"])
    for key, network in TRAINS.items():
        loss.zero_grad()
        moved[key].sum().backward(retain_graph=True)
        assert reached(loss) == {network}, key


functional = pytest.mark.parametrize("functional", [True, False], ids=["functional", "modules"])
composite = pytest.mark.parametrize("composite", [False, True], ids=["one-action", "composite"])

ESTIMATORS = {
    "gae": lambda critic, actor, **k: GAE(gamma=0.9, lmbda=0.9, value_network=critic, **k),
    "vtrace": lambda critic, actor, **k: VTrace(
        gamma=0.9, value_network=critic, actor_network=actor, **k
    ),
    "td1": lambda critic, actor, **k: TD1Estimator(gamma=0.9, value_network=critic, **k),
    "td-lambda": lambda critic, actor, **k: TDLambdaEstimator(
        gamma=0.9, lmbda=0.9, value_network=critic, **k
    ),
}


@composite
@functional
@pytest.mark.parametrize("differentiable", [True, False], ids=["differentiable", "detached"])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_advantages_from_any_estimator(name, differentiable, functional, composite):
    """Also from one whose advantages carry a graph: the objective trains the policy alone."""
    loss, parent, batch = make_pair(composite, functional=functional)
    actor, critic, cost_critic, _ = make_setting(composite)
    reward = ESTIMATORS[name](critic, actor, differentiable=differentiable)
    if composite and name == "vtrace":
        reward.set_keys(sample_log_prob=[(*part[:-1], f"{part[-1]}_log_prob") for part in PARTS])
    with torch.set_grad_enabled(differentiable):
        reward(batch)
        cost = CostGAE(gamma=0.9, lmbda=0.9, value_network=cost_critic)
        with torch.no_grad():
            cost(batch)
    check(loss, parent, batch.detach() if not differentiable else batch)


@composite
@functional
@pytest.mark.parametrize("estimator", [*ValueEstimators, None], ids=str)
def test_the_loss_estimates_with_any_estimator(estimator, functional, composite):
    """The reward's; the costs keep their own."""
    loss, parent, batch = make_pair(composite, functional=functional)
    for each in (loss, parent):
        if estimator is not None:
            each.make_value_estimator(estimator, gamma=0.9)
    data = loss.estimate_advantages(batch).reshape(-1)
    assert isinstance(loss.cost_value_estimator, CostGAE)
    plain = make_setting(composite)[-1]
    parent.value_estimator(plain)
    advantage = plain["advantage"].reshape(-1, 1)
    torch.testing.assert_close(
        data["advantage"], (advantage - advantage.mean()) / advantage.std(), rtol=1e-4, atol=1e-5
    )
    check(loss, parent, data)


@pytest.mark.parametrize("estimator", [*ValueEstimators], ids=str)
def test_keys_reach_any_estimator(estimator):
    """Set before or after it is made."""
    keys = {
        "advantage": "a", "value_target": "t", "value": "v", "reward": "r",
        "done": ("flags", "d"), "terminated": ("flags", "t"),
    }  # fmt: skip
    for order in ("before", "after"):
        if order == "after":
            del keys["value"]
        loss = PPOLagrangianLoss(*make_networks(2, keys=keys), num_costs=2)
        if order == "before":
            loss.set_keys(**keys, cost="c")
        loss.make_value_estimator(estimator)
        _ = loss.cost_value_estimator
        if order == "after":  # TorchRL refuses an estimator of a value that nothing writes.
            loss.set_keys(**keys, cost="c")
        for name, key in keys.items():
            assert getattr(loss.value_estimator.tensor_keys, name) == key
        of_costs = loss.cost_value_estimator.tensor_keys
        assert (of_costs.reward, of_costs.done) == ("c", ("flags", "d"))
        assert (of_costs.advantage, of_costs.value) == ("cost_advantage", "cost_value")


@composite
def test_parameters_can_be_swapped_in(composite):
    """As for second derivatives: the loss computes with the parameters of ``to_module``."""
    loss, _, batch = make_pair(composite)
    data = loss.estimate_advantages(batch).reshape(-1)
    before = loss(data)

    def zero(value):
        if not isinstance(value, nn.Parameter):
            return value
        return torch.zeros_like(value).requires_grad_()

    zeros = TensorDict.from_module(loss).apply(zero)
    with zeros.to_module(loss):
        losses = loss(data)
    # Critics that predict 0 everywhere.
    for key, target in (("loss_critic", "value_target"), ("loss_cost_critic", "cost_value_target")):
        value = nn.functional.smooth_l1_loss(
            torch.zeros_like(data[target]), data[target], reduction="none"
        )
        torch.testing.assert_close(losses[key], value.sum(-1).mean())
        losses[key].backward()
        network = f"{TRAINS[key]}_network_params"
        gradients = {name: p.grad for name, p in zeros.items(True, True) if p.grad is not None}
        assert gradients
        assert all(name[0] == network for name in gradients)
        zeros.apply(lambda p: setattr(p, "grad", None))
    after = loss(data)
    for key in TRAINS:
        assert torch.equal(after[key], before[key])


@composite
@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
def test_reductions(reduction, composite):
    loss, parent, batch = make_pair(composite, reduction=reduction)
    data = loss.estimate_advantages(batch)
    losses = loss(data)
    for key in TRAINS:
        assert losses[key].shape == (data.shape if reduction == "none" else ())
    mean, _, _ = make_pair(composite)
    if reduction is None:  # The default.
        for key in TRAINS:
            assert torch.equal(losses[key], mean(data)[key])
    check(loss, parent, data)


@composite
@pytest.mark.parametrize("clip_value", [True, False, None, 0.5, torch.tensor(0.5)], ids=str)
def test_value_clipping(clip_value, composite):
    loss, parent, batch = make_pair(composite, clip_value=clip_value)
    data = loss.estimate_advantages(batch).reshape(-1)
    check(loss, parent, data)
    reported = {"value_clip_fraction", "cost_value_clip_fraction"}
    assert reported & set(loss(data).keys()) == (reported if clip_value else set())
    if clip_value:
        with pytest.raises(KeyError, match="state_value was not found"):
            loss(data.exclude("state_value"))


def test_asymmetric_clipping():
    """Two bounds are two buffers, each of which can be scheduled, and no other."""
    loss, parent, batch = make_pair(clip_epsilon=(0.1, 0.4))
    data = loss.estimate_advantages(batch).reshape(-1)
    check(loss, parent, data)
    buffers = dict(loss.named_buffers())
    assert "clip_epsilon" not in buffers
    assert buffers["clip_epsilon_low"] == pytest.approx(0.1)
    assert buffers["clip_epsilon_high"] == pytest.approx(0.4)
    for each in (loss, parent):
        each.clip_epsilon_high = 0.9
    loss.lagrange_multiplier.zero_()
    check(loss, parent, data)
    with pytest.raises(AttributeError, match="asymmetric"):
        loss.clip_epsilon = 0.1
    symmetric, _, _ = make_pair(clip_epsilon=0.2)
    with pytest.raises(AttributeError, match="symmetric"):
        symmetric.clip_epsilon_low = 0.1
    equal, _, _ = make_pair(clip_epsilon=(0.2, 0.2))
    assert torch.equal(equal(data)["loss_objective"], symmetric(data)["loss_objective"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip_epsilon": (0.1, 0.2, 0.3)}, "length 2"),
        ({"clip_epsilon": (-0.1, 0.2)}, "non-negative"),
        ({"clip_epsilon": (1.0, 0.2)}, "must be < 1"),
        ({"clip_epsilon": (0.2, 0.28), "clip_value": True}, "clip_value=True"),
    ],
    ids=["three", "negative", "too-large", "with-clip_value"],
)
def test_options_that_clip_ppo_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        PPOLagrangianLoss(*make_networks(), **options)


@pytest.mark.parametrize("key", ["advantage", "cost_advantage"])
def test_a_flat_advantage_is_refused(key):
    """It would be broadcast to the product of all steps with all steps."""
    loss, _, batch = make_pair()
    loss.lagrange_multiplier.fill_(0.5)
    data = loss.estimate_advantages(batch).reshape(-1)
    data[key] = data[key][..., 0]
    with pytest.raises(ValueError, match=r"outer\s+product|advantage.*\(24,"):
        loss(data)


NAMES = {
    "action": ("action", "doing"),
    "sample_log_prob": ("action_log_prob", "likely"),
    "observation": ("observation", "seen"),
    "reward": ("reward", "gain"),
    "done": ("done", "over"),
    "terminated": ("terminated", "ended"),
    "cost": ("cost", "price"),
}


@pytest.mark.parametrize("choice", [*itertools.product((0, 1), repeat=len(NAMES))][::3], ids=str)
def test_keyword_calls_under_other_names(choice):
    """And with two of the outputs selected."""
    key = {name: both[which] for (name, both), which in zip(NAMES.items(), choice, strict=True)}
    policy = nn.Sequential(mlp(OBSERVATION_SIZE, 4), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, [key["observation"]], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[key["action"]],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        log_prob_key=key["sample_log_prob"],
    )
    critics = (
        make_critic("state_value", 1, key["observation"]),
        make_critic("cost_value", 2, key["observation"]),
    )
    loss = PPOLagrangianLoss(actor, *critics, num_costs=2, multiplier_init=0.5)
    loss.set_keys(**{name: key[name] for name in NAMES if name != "observation"})
    batch = make_batch(2)
    for name, (old, _) in NAMES.items():
        if key[name] != old:
            for part in (batch, batch["next"]):
                if old in part:
                    part.rename_key_(old, key[name])
    values = {
        **{key[name]: batch[key[name]] for name in ("action", "sample_log_prob", "observation")},
        **{
            f"next_{key[name]}": batch["next", key[name]]
            for name in ("reward", "done", "terminated", "cost", "observation")
        },
    }
    expected = loss(batch.select(*loss.in_keys))
    for name, output in zip(loss.out_keys, loss(**values), strict=True):
        torch.testing.assert_close(output, expected[name], msg=name)
    loss.select_out_keys("loss_objective", "loss_cost_critic")
    objective, cost_critic = loss(**values)
    torch.testing.assert_close(objective, expected["loss_objective"])
    torch.testing.assert_close(cost_critic, expected["loss_cost_critic"])


@pytest.mark.parametrize("estimator", [*ESTIMATORS, None])
@pytest.mark.parametrize("separate", [True, False], ids=["separate_losses", "joint"])
def test_a_trunk_that_actor_and_critics_share(separate, estimator):
    """Run by each of them: with separate losses only the policy trains it."""
    (actor, critic, cost_critic), trunk = make_trunk(2)
    batch = make_batch(2)
    if estimator is not None:
        with torch.no_grad():
            ESTIMATORS[estimator](critic, actor)(batch)
            CostGAE(gamma=0.9, lmbda=0.9, value_network=cost_critic)(batch)
    loss = PPOLagrangianLoss(
        actor, critic, cost_critic, num_costs=2, multiplier_init=0.5, separate_losses=separate
    )
    assert len({id(p) for p in loss.parameters()}) == len([*loss.parameters()]) == 2 + 3 * 2
    losses = loss(batch)
    for key, network in TRAINS.items():
        loss.zero_grad()
        trunk.weight.grad = None
        losses[key].backward(retain_graph=True)
        trained = trunk.weight.grad is not None and bool(trunk.weight.grad.any())
        assert trained == (network == "actor" or not separate), key


@pytest.mark.parametrize("coefficients", [0.5, {PARTS[0]: 0.3, PARTS[1]: 0.7}], ids=["one", "each"])
def test_weights_of_the_entropies(coefficients):
    actor, critic, cost_critic, batch = make_setting(composite=True)
    if isinstance(coefficients, dict):
        coefficients = {
            (*part[:-1], f"{part[-1]}_entropy"): weight for part, weight in coefficients.items()
        }
    loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, entropy_coeff=coefficients)
    data = loss.estimate_advantages(batch).reshape(-1)
    losses = loss(data)
    entropies = losses["composite_entropy"]
    if isinstance(coefficients, dict):
        expected = -sum(weight * entropies[key].mean() for key, weight in coefficients.items())
    else:
        expected = -0.5 * sum(value.mean() for value in entropies.values(True, True))
    torch.testing.assert_close(losses["loss_entropy"], expected.squeeze())


def test_a_weight_of_an_entropy_that_is_not_there():
    actor, critic, cost_critic, batch = make_setting(composite=True)
    loss = PPOLagrangianLoss(
        actor, critic, cost_critic, num_costs=2, entropy_coeff={"elsewhere": 0.5}
    )
    with pytest.raises(KeyError, match="Missing entropy coeff"):
        loss(loss.estimate_advantages(batch).reshape(-1))


def test_actions_of_several_agents():
    """Log-probabilities of a group of agents, an advantage for each, and costs shared by all."""
    agents, rows = 3, 5
    net = nn.Linear(OBSERVATION_SIZE, 4)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(net, NormalParamExtractor()),
            [("agents", "observation")],
            [("agents", "loc"), ("agents", "scale")],
        ),
        in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[("agents", "action")],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critics = [
        ValueOperator(
            nn.Linear(OBSERVATION_SIZE, width),
            in_keys=[("agents", "observation")],
            out_keys=[("agents", key)],
        )
        for key, width in (("state_value", 1), ("cost_value", 2))
    ]
    parent = ClipPPOLoss(actor, critics[0])
    loss = PPOLagrangianLoss(actor, *critics, num_costs=2)
    keys = {
        name: ("agents", name) for name in ("value_target", "advantage")
    } | {"value": ("agents", "state_value"), "action": ("agents", "action")}  # fmt: skip
    for each in (parent, loss):
        each.set_keys(**keys, sample_log_prob=("agents", "action_log_prob"))
    of_costs = ("cost_value", "cost_advantage", "cost_value_target")
    loss.set_keys(**{name: ("agents", name) for name in of_costs})
    data = TensorDict(
        agents=TensorDict(
            observation=torch.randn(rows, agents, OBSERVATION_SIZE),
            advantage=torch.randn(rows, agents, 1),
            value_target=torch.randn(rows, agents, 1),
            cost_advantage=torch.randn(rows, agents, 2),
            cost_value_target=torch.randn(rows, agents, 2),
            batch_size=[rows, agents],
        ),
        batch_size=[rows],
    )
    with torch.no_grad():
        data = actor(data)
    data["agents", "action_log_prob"] += 0.3 * torch.randn(rows, agents)
    check(loss, parent, data)


def test_the_critic_of_the_reward_may_write_several_values():
    """``loss_critic`` of ClipPPOLoss takes a tensordict of them, and so does ours."""
    actor, _, cost_critic = make_networks()

    class Two(nn.Module):
        def forward(self, observation):
            zero = torch.zeros_like(observation[..., :1])
            return zero, zero

    critic = TensorDictModule(
        Two(), ["observation"], [("state_value", "one"), ("state_value", "other")]
    )
    options = {"loss_critic_type": "l2", "clip_value": 0.1}
    data = TensorDict(
        observation=torch.zeros(1, OBSERVATION_SIZE),
        value_target={"one": torch.tensor([[-1.0]]), "other": torch.tensor([[2.0]])},
        state_value={"one": torch.zeros(1, 1), "other": torch.zeros(1, 1)},
        batch_size=[1],
    )
    value, clipped, explained = PPOLagrangianLoss(
        actor, critic, cost_critic, **options
    ).loss_critic(data)
    assert (value["one"].item(), value["other"].item()) == (1.0, 4.0)
    assert isinstance(clipped, TensorDict)
    assert isinstance(explained, TensorDict)
