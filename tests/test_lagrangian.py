"""LagrangianLoss: the wrapped loss at multiplier zero, PPOLagrangianLoss around ClipPPOLoss."""

import copy
from functools import partial
from itertools import product

import pytest
import torch
from on_policy import around, assert_same_outputs, make_loss, make_trunk, train
from torch import nn
from torch.distributions.transforms import SoftplusTransform
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import PopArtValueNorm, QValueActor, ValueOperator, recurrent_mode
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    DQNLoss,
    KLPENPPOLoss,
    PPOLoss,
    ReinforceLoss,
    SACLoss,
    SoftUpdate,
)
from torchrl.objectives.llm import GRPOLoss

from torchrl_safe.objectives import DualAscent, LagrangianLoss, PIDControl, penalized_advantage
from torchrl_safe.testing import (
    OBSERVATION_SIZE,
    check_equals_at_zero,
    check_state_dict,
    make_batch,
    make_critic,
    make_networks,
)

PARENTS = {
    "a2c": A2CLoss,
    "reinforce": ReinforceLoss,
    "ppo": PPOLoss,
    "clip-ppo": ClipPPOLoss,
    "kl-ppo": KLPENPPOLoss,
    "a2c-options": partial(A2CLoss, clip_value=0.1, loss_critic_type="l2", entropy_coeff=0.3),
    "clip-ppo-options": partial(ClipPPOLoss, clip_value=0.1, reduction="sum", clip_epsilon=0.1),
    "not-functional": partial(ClipPPOLoss, functional=False),
    "a2c-not-functional": partial(A2CLoss, functional=False),
    "reinforce-not-functional": partial(ReinforceLoss, functional=False),
}
every_parent = pytest.mark.parametrize("parent", PARENTS.values(), ids=PARENTS.keys())


def wrap(parent, num_costs=1, seed=0, **kwargs):
    actor, critic, cost_critic = make_networks(num_costs, seed=seed)
    return LagrangianLoss(parent(actor, critic), cost_critic, num_costs=num_costs, **kwargs)


def bare(parent, seed=0):
    actor, critic, _ = make_networks(seed=seed)
    return parent(actor, critic)


# ---------------------------------------------------------------- multiplier zero


@every_parent
@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
def test_multiplier_zero_is_the_wrapped_loss_bit_for_bit(parent, precomputed, num_costs):
    loss, expected_loss = wrap(parent, num_costs), bare(parent)
    batch = make_batch(num_costs)
    if precomputed:
        batch = loss.estimate_advantages(batch).reshape(-1)
    losses = loss(batch.clone())
    if not precomputed:  # Where there are no advantages, the loss does this itself.
        batch = loss.estimate_advantages(batch)
    expected = expected_loss(batch)
    assert_same_outputs(losses, expected)
    extra = {"loss_cost_critic", "cost_explained_variance"}
    extra |= {f"lagrange_multiplier_{index}" for index in range(num_costs)}
    extra |= {"cost_value_clip_fraction"} if loss.clip_value else set()
    assert set(losses.keys()) == set(expected.keys()) | extra


@every_parent
@pytest.mark.parametrize("num_costs", [1, 3])
def test_multiplier_zero_trains_like_the_wrapped_loss_bit_for_bit(parent, num_costs):
    check_equals_at_zero(around(LagrangianLoss, parent), parent, num_costs=num_costs)


# ---------------------------------------------------------------- any multiplier


@pytest.mark.parametrize(
    "options",
    [{}, {"clip_value": 0.1}, {"reduction": "none"}, {"functional": False}, {"entropy_coeff": 0.3}],
    ids=str,
)
@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
def test_ppo_lagrangian_is_the_wrapped_clip_ppo_bit_for_bit(precomputed, options):
    multiplier = torch.tensor([0.5, 0.0, 2.0])
    ours = wrap(partial(ClipPPOLoss, **options), 3, multiplier_init=multiplier)
    theirs = make_loss(3, multiplier_init=multiplier, **options)
    data, batch = ours.estimate_advantages(make_batch(3)), theirs.estimate_advantages(make_batch(3))
    assert set(data.keys(True)) == set(batch.keys(True))
    assert (data == batch).all()
    data = data.reshape(-1) if precomputed else make_batch(3)
    outputs, expected = ours(data), theirs(data)
    assert set(outputs.keys()) == set(expected.keys())
    assert_same_outputs(outputs, expected)
    if "reduction" not in options:
        train(ours, batch.reshape(-1), 10)
        train(theirs, batch.reshape(-1), 10)
        assert_same_outputs(ours(data), theirs(data))
        assert not torch.equal(ours(data)["loss_objective"], expected["loss_objective"])


@every_parent
def test_the_wrapped_loss_sees_the_penalized_advantage(parent):
    multiplier = torch.tensor([0.5, 0.0, 2.0])
    loss = wrap(parent, 3, multiplier_init=multiplier)
    data = loss.estimate_advantages(make_batch(3)).reshape(-1)
    losses = loss(data)
    data["advantage"] = penalized_advantage(data["advantage"], data["cost_advantage"], multiplier)
    assert_same_outputs(losses, bare(parent)(data))


RULES = {
    "dual-ascent": partial(DualAscent, lr=1.0),
    "softplus-adam": partial(
        DualAscent, lr=0.1, optimizer=torch.optim.Adam, parametrization=SoftplusTransform()
    ),
    "pid": partial(
        PIDControl, kp=1.0, ki=1.0, kd=1.0, max_multiplier=None, pessimism=0.0, normalize=False
    ),
}


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
def test_every_rule_moves_the_multiplier(rule):
    loss = wrap(A2CLoss, 2, multiplier_init=0.5)
    before = loss(make_batch(2))
    rule(loss, cost_limit=torch.tensor([1.0, 2.0])).step(torch.tensor([[3.0, 1.0]]))
    assert loss.lagrange_multiplier[0] > 0.5 > loss.lagrange_multiplier[1]
    assert not torch.equal(loss(make_batch(2))["loss_objective"], before["loss_objective"])


# ---------------------------------------------------------------- gradients, keys, state


@pytest.mark.parametrize("separate", [True, False], ids=["separate_losses", "joint"])
@pytest.mark.parametrize("parent", [A2CLoss, ClipPPOLoss])
def test_only_the_policy_trains_a_shared_trunk_with_separate_losses(parent, separate):
    (actor, critic, cost_critic), trunk = make_trunk(2)
    wrapped = parent(actor, critic, separate_losses=separate)
    loss = LagrangianLoss(wrapped, cost_critic, num_costs=2, separate_losses=separate)
    assert len({id(p) for p in loss.parameters()}) == len(list(loss.parameters())) == 2 + 3 * 2
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    for key, shared in (("loss_objective", True), ("loss_cost_critic", not separate)):
        loss.zero_grad()
        trunk.weight.grad = None
        loss(data)[key].backward()
        assert (trunk.weight.grad is not None) == shared


@pytest.mark.parametrize("parent", [A2CLoss, ReinforceLoss, ClipPPOLoss])
def test_all_keys_can_be_nested(parent):
    values = {"value": ("estimates", "v"), "cost_value": ("estimates", "c")}
    actor, critic, cost_critic = make_networks(2, keys=values)
    loss = LagrangianLoss(parent(actor, critic), cost_critic, num_costs=2, multiplier_init=0.7)
    keys = {
        **values,
        "advantage": ("estimates", "a"),
        "cost_advantage": ("estimates", "ca"),
        "value_target": ("estimates", "t"),
        "cost_value_target": ("estimates", "ct"),
        "reward": ("info", "reward"),
        "cost": ("info", "cost"),
    }
    loss.set_keys(**keys)
    assert ("next", "info", "cost") in loss.in_keys
    assert ("next", "info", "reward") in loss.in_keys
    batch = make_batch(2)
    for key in ("reward", "cost"):
        batch["next"].rename_key_(key, ("info", key))
    data = loss.estimate_advantages(batch).reshape(-1)
    assert {("estimates", "a"), ("estimates", "ca"), ("estimates", "ct")} <= set(data.keys(True))
    expected = wrap(parent, 2, multiplier_init=0.7)
    assert_same_outputs(
        loss(data), expected(expected.estimate_advantages(make_batch(2)).reshape(-1))
    )
    loss.set_keys(cost_advantage=None, advantage=None)
    assert loss.tensor_keys.cost_advantage == "cost_advantage"
    assert loss.loss_module.tensor_keys.advantage == "advantage"


def test_an_unknown_key_is_refused():
    with pytest.raises(ValueError, match="cost_limit is not an accepted"):
        wrap(A2CLoss).set_keys(cost_limit="anything")


@every_parent
def test_states_and_copies(parent):
    check_state_dict(around(LagrangianLoss, parent), make_data=make_batch)


def test_cast_and_reset():
    loss = wrap(ClipPPOLoss, 2, multiplier_init=0.7).to(torch.float64)
    batch = make_batch(2).apply(lambda x: x.double() if x.is_floating_point() else x)
    assert loss(batch)["loss_objective"].dtype == torch.float64
    for parameter in loss.parameters():
        parameter.data.add_(1000.0)
    loss.reset_parameters_recursive()
    assert all((parameter.abs() < 10).all() for parameter in loss.parameters())


def test_a_delayed_policy_is_updated_in_the_wrapped_loss():
    options = {"delay_actor": True}
    loss, expected = wrap(partial(ClipPPOLoss, **options), 2), bare(partial(ClipPPOLoss, **options))
    data = make_loss(2).estimate_advantages(make_batch(2)).reshape(-1)
    for target in (loss.loss_module, expected):
        updater = SoftUpdate(target, eps=0.5)
        train(target, data, 3)
        updater.step()
    assert_same_outputs(loss(data), expected(data))


# tensordict 0.14 reads a dynamo option that torch 2.13 deprecates.
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.slow
@pytest.mark.parametrize("parent", [A2CLoss, ReinforceLoss])
def test_compiles_to_one_graph_that_sees_the_multiplier_move(parent):
    graphs = []

    def eager(graph, inputs):
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    loss = wrap(parent, 2, multiplier_init=0.5)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    compiled = torch.compile(loss, fullgraph=True, backend=eager)
    compiled(data)
    loss.lagrange_multiplier.fill_(2.5)
    second, expected = compiled(data), loss(data)
    for key, value in expected.items():
        torch.testing.assert_close(second[key], value)
    assert second["lagrange_multiplier_1"].item() == 2.5
    assert len(graphs) == 1


# ---------------------------------------------------------------- what does not fit


def test_what_is_no_advantage_loss_is_refused():
    actor, _, cost_critic = make_networks()
    with pytest.raises(ValueError, match=r"loss_module must be a LossModule, got .*Linear"):
        LagrangianLoss(torch.nn.Linear(1, 1), cost_critic)
    sac = SACLoss(actor, make_critic("state_action_value"))
    q_actor = QValueActor(torch.nn.Linear(4, 3), in_keys=["observation"], action_space="one_hot")
    dqn = DQNLoss(q_actor, action_space="one_hot")
    for parent in (sac, dqn, GRPOLoss(actor)):  # All but SAC have the key.
        name = type(parent).__name__
        with pytest.raises(ValueError, match=f"reads an advantage, and has a critic .* got {name}"):
            LagrangianLoss(parent, cost_critic)


@pytest.mark.parametrize(
    ("parent", "argument"),
    [
        (partial(ClipPPOLoss, normalize_advantage=True), "normalize_advantage=True"),
        (partial(ClipPPOLoss, advantage_norm=PopArtValueNorm(shape=1)), "advantage_norm"),
        (partial(A2CLoss, advantage_norm=PopArtValueNorm(shape=1)), "advantage_norm"),
    ],
    ids=["normalize_advantage", "ppo-advantage_norm", "a2c-advantage_norm"],
)
def test_a_loss_that_would_normalize_the_mixture_is_refused(parent, argument):
    with pytest.raises(ValueError, match=argument):
        wrap(parent)


def test_the_entry_that_masks_is_that_of_the_wrapped_loss():
    loss = wrap(PARENTS["clip-ppo"], 2)
    data = loss.estimate_advantages(make_batch(2)).reshape(-1)
    kept = torch.arange(len(data)) % 3 > 0
    expected = loss(data[kept])
    data["mine"] = kept
    loss.loss_mask_key = "mine"
    losses = loss(data)
    for key in ("loss_objective", "loss_critic", "loss_cost_critic"):
        torch.testing.assert_close(losses[key], expected[key])


def test_the_mode_of_sampling_is_that_of_the_wrapped_loss():
    loss = wrap(ClipPPOLoss)
    seen = []
    for module in loss.actor_network.modules():
        module.register_forward_pre_hook(lambda *_: seen.append(exploration_type()))
    loss.deterministic_sampling_mode = ExplorationType.RANDOM
    loss(loss.estimate_advantages(make_batch()).reshape(-1))
    assert set(seen) == {ExplorationType.RANDOM}


def test_coefficients_of_the_wrapped_loss_can_be_scheduled():
    loss = wrap(ClipPPOLoss)
    data = loss.estimate_advantages(make_batch()).reshape(-1)
    loss.clip_epsilon, loss.entropy_coeff, loss.cost_critic_coeff = 0.05, 0.5, 0.25
    assert not {"clip_epsilon", "entropy_coeff"} & vars(loss).keys()
    expected = wrap(partial(ClipPPOLoss, clip_epsilon=0.05, entropy_coeff=0.5))
    expected.cost_critic_coeff = 0.25
    losses, others = loss(data), expected(data)
    for key in ("loss_objective", "loss_cost_critic", "clip_fraction"):
        assert torch.equal(losses[key], others[key]), key
    # Its entropy is estimated from samples.
    assert loss.loss_module.entropy_coeff == 0.5


def test_the_keys_are_a_view():
    loss = wrap(ClipPPOLoss)
    keys = copy.copy(loss.tensor_keys)
    loss.tensor_keys.cost, loss.tensor_keys.reward = "contacts", "gain"
    assert (keys.cost, keys.reward) == ("contacts", "gain")
    assert loss.loss_module.tensor_keys.reward == "gain"


def test_stateful_nets():
    loss = wrap(ClipPPOLoss)
    data = make_batch().reshape(-1)
    expected = loss.loss_module.get_stateful_net("actor_network")
    actual = loss.get_stateful_net("actor_network")
    for name, parameter in expected.named_parameters():
        assert torch.equal(actual.get_parameter(name), parameter)
    assert torch.equal(actual(data.clone())["loc"], expected(data.clone())["loc"])


def test_recurrent_critics_see_whole_sequences_in_both_ways():
    """As they do in a call of the loss, around which TorchRL says so."""
    modes = []

    class Critic(nn.Linear):
        def forward(self, observation):
            modes.append(recurrent_mode())
            return super().forward(observation)

    actor, critic, _ = make_networks()
    cost_critic = ValueOperator(Critic(OBSERVATION_SIZE, 1), out_keys=["cost_value"])
    loss = LagrangianLoss(ClipPPOLoss(actor, critic, entropy_bonus=False), cost_critic)
    loss.estimate_advantages(make_batch())
    loss(make_batch())
    assert modes
    assert all(modes)


def test_an_option_that_is_neither_true_nor_false_is_refused():
    """A tensor would be asked for its truth, which it has not."""
    actor, critic, cost_critic = make_networks()
    wrapped = ClipPPOLoss(actor, critic, entropy_bonus=False)
    with pytest.raises(TypeError, match=r"separate_losses must be True or False, got tensor"):
        LagrangianLoss(wrapped, cost_critic, separate_losses=torch.zeros(3))


def test_costs_that_do_not_fit_are_refused():
    actor, critic, cost_critic = make_networks(3)
    with pytest.raises(ValueError, match="num_costs must be a whole number of at least 1, got 0"):
        LagrangianLoss(A2CLoss(actor, critic), cost_critic, num_costs=0)
    with pytest.raises(ValueError, match=r"multiplier_init.* 2 costs.*\(3,\)"):
        wrap(A2CLoss, 2, multiplier_init=torch.ones(3))
    loss = LagrangianLoss(A2CLoss(actor, critic), cost_critic, num_costs=2)
    with pytest.raises(ValueError, match=r"'cost'.* one column for each of the 2 costs"):
        loss(loss.estimate_advantages(make_batch(3)).reshape(-1))
    for key, call in product(("cost", "reward", "done"), (loss, loss.estimate_advantages)):
        with pytest.raises(KeyError, match=rf"\('next', '{key}'\) was not found"):
            call(make_batch(2).exclude(("next", key)))


def test_choosing_an_estimator_returns_the_loss():
    loss = wrap(ClipPPOLoss)
    assert loss.make_value_estimator(gamma=0.5) is loss


def test_reset_is_that_of_the_wrapped_loss():
    called = []

    class Mine(ClipPPOLoss):
        def reset(self):
            called.append(self)

    loss = wrap(Mine)
    loss.reset()
    assert called == [loss.loss_module]
