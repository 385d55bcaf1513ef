"""TrustRegionLoss: what it shares with PPOLoss, and the cost surrogate that it adds."""

import pytest
import torch
from torchrl.modules import ValueOperator, recurrent_mode
from torchrl.objectives import PPOLoss

from torchrl_safe.objectives import DualAscent, PIDControl, TrustRegionLoss, ViolationUpdater
from torchrl_safe.testing import OBSERVATION_SIZE, make_batch, make_critic, make_networks

OPTIONS = {
    "default": {},
    "normalize_advantage": {"normalize_advantage": True},
    "clip_value": {"clip_value": 0.1},
    "reduction_none": {"reduction": "none"},
    "reduction_sum": {"reduction": "sum"},
    "not_functional": {"functional": False},
    "separate_losses": {"separate_losses": True},
    "no_entropy": {"entropy_bonus": False},
    "max_importance_ratio": {"max_importance_ratio": 1.1},
}


def make_loss(num_costs=1, **kwargs):
    return TrustRegionLoss(*make_networks(num_costs), num_costs=num_costs, **kwargs)


def estimated(num_costs=1):
    return make_loss(num_costs).estimate_advantages(make_batch(num_costs)).reshape(-1)


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_multiplier_zero_is_ppo_bit_for_bit(options, num_costs):
    loss = make_loss(num_costs, **options)
    actor, critic, _ = make_networks()
    ppo = PPOLoss(actor, critic, **options)
    data = estimated(num_costs)
    losses, expected = loss(data.clone()), ppo(data.clone())
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    extra = {"loss_cost_critic", "cost_explained_variance"}
    for index in range(num_costs):
        extra |= {f"lagrange_multiplier_{index}", f"cost_violation_{index}"}
    extra |= {"cost_value_clip_fraction"} if "clip_value" in options else set()
    assert set(losses.keys()) == set(expected.keys()) | extra
    assert set(loss.out_keys) <= set(losses.keys())
    assert expected["loss_objective"].abs().max() > 0


@pytest.mark.parametrize("num_costs", [1, 3])
def test_cost_surrogate_is_the_mean_of_ratio_times_cost_advantage(num_costs):
    loss, data = make_loss(num_costs, functional=False), estimated(num_costs)
    with torch.no_grad():
        log_prob = loss.actor_network.get_dist(data.clone()).log_prob(data["action"])
    ratio = (log_prob - data["action_log_prob"]).exp()
    expected = (ratio.unsqueeze(-1) * data["cost_advantage"]).mean(0)
    surrogate = loss.cost_surrogate_loss(data)
    assert surrogate.shape == (num_costs,)
    torch.testing.assert_close(surrogate, expected)
    assert (ratio - 1).abs().max() > 0.1  # The data show a wrong ratio.


def test_three_multipliers_mix_reward_and_costs():
    """-(reward surrogate - sum of multiplier times cost surrogate) / (1 + sum)."""
    loss = make_loss(3, multiplier_init=torch.tensor([0.5, 1.0, 0.0]), entropy_bonus=False)
    plain, data = make_loss(3, entropy_bonus=False), estimated(3)
    costs = loss.cost_surrogate_loss(data)
    expected = (plain(data)["loss_objective"] + 0.5 * costs[0] + costs[1]) / 2.5
    torch.testing.assert_close(loss(data)["loss_objective"], expected)


@pytest.mark.parametrize("rule", ["dual-ascent", "pid"])
def test_every_multiplier_rule_and_the_violation_rule_move_it(rule):
    loss = make_loss(3)
    updater = {
        "dual-ascent": lambda: DualAscent(loss, cost_limit=1.0, lr=0.5),
        "pid": lambda: PIDControl(
            loss, cost_limit=1.0, kp=0.25, ki=0.25, pessimism=0.0, normalize=False
        ),
    }[rule]()
    episode_cost = torch.tensor([[3.0, 1.0, 0.0]])
    updater.step(episode_cost)
    assert loss.lagrange_multiplier.tolist() == [1.0, 0.0, 0.0]
    ViolationUpdater(loss, cost_limit=1.0).step(episode_cost)
    assert loss.cost_violation.tolist() == [2.0, 0.0, -1.0]


def test_masked_steps_do_not_count():
    loss, data = make_loss(2), estimated(2)
    mask = torch.arange(len(data)) % 3 > 0
    data["collector", "mask"] = mask
    expected = loss.cost_surrogate_loss(data[mask])
    data["cost_advantage"][~mask] = float("nan")
    torch.testing.assert_close(loss.cost_surrogate_loss(data), expected)


@pytest.mark.parametrize("options", [{}, {"clip_value": 0.1}, {"functional": False}])
def test_the_critics_alone_have_the_losses_of_the_whole(options):
    """Bit for bit, their gradients too, and without a look at the policy."""
    loss, data = make_loss(2, **options), estimated(2)
    data["collector", "mask"] = torch.arange(len(data)) % 3 > 0
    whole = loss(data)
    expected = {key: whole[key] for key in ("loss_critic", "loss_cost_critic")}
    gradients = torch.autograd.grad(sum(expected.values()), critics(loss))
    losses = loss.critic_losses(data.exclude("action", "action_log_prob", "advantage"))
    assert set(losses.keys()) == set(expected)
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    for value, other in zip(
        gradients, torch.autograd.grad(sum(losses.values()), critics(loss)), strict=True
    ):
        assert torch.equal(value, other)
    with pytest.raises(KeyError, match="cost_value_target"):
        loss.critic_losses(data.exclude("cost_value_target"))


def test_recurrent_critics_see_whole_sequences_alone_too():
    """As they do in a call of the loss, around which TorchRL says so."""
    modes = []

    class Critic(torch.nn.Linear):
        def forward(self, observation):
            modes.append(recurrent_mode())
            return super().forward(observation)

    actor, critic, _ = make_networks()
    cost_critic = ValueOperator(Critic(OBSERVATION_SIZE, 1), out_keys=["cost_value"])
    TrustRegionLoss(actor, critic, cost_critic).critic_losses(estimated())
    assert modes == [True]


def test_without_a_reward_critic_the_cost_critic_learns_alone():
    loss, data = make_loss(critic_coeff=0.0), estimated()
    assert set(loss.critic_losses(data).keys()) == {"loss_cost_critic"}


def critics(loss):
    networks = loss.critic_network, loss.cost_critic_network
    if loss.functional:
        networks = loss.critic_network_params, loss.cost_critic_network_params
    return [parameter for network in networks for parameter in network.parameters()]


def test_keys_can_be_nested():
    loss, data = make_loss(2), estimated(2)
    names = {"cost_advantage": ("a", "b"), "cost_value_target": ("c", "d")}
    expected = loss(data.clone())
    surrogate = loss.cost_surrogate_loss(data)
    loss.set_keys(**names)
    renamed = data.clone()
    for key, name in names.items():
        renamed.rename_key_(key, name)
    for key, value in loss(renamed).items():
        assert torch.equal(value, expected[key]), key
    assert torch.equal(loss.cost_surrogate_loss(renamed), surrogate)


def test_call_with_keywords_equals_call_with_tensordict():
    loss, batch = make_loss(2), make_batch(2)
    keywords = {
        "_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys
    }
    expected = loss(batch)
    for key, value in zip(loss.out_keys, loss(**keywords), strict=True):
        assert torch.equal(value, expected[key]), key


@pytest.mark.parametrize("call", ["estimate_advantages", "cost_surrogate_loss"])
def test_a_batch_without_cost_is_refused(call):
    key = {"estimate_advantages": "'cost'", "cost_surrogate_loss": "'cost_advantage'"}[call]
    batch = make_batch().exclude(("next", "cost"))
    with pytest.raises(KeyError, match=key):
        getattr(make_loss(), call)(batch)


def test_costs_of_the_wrong_width_are_refused():
    data = estimated(2)
    with pytest.raises(ValueError, match=r"'cost_advantage'.*3 costs.*\(24, 2\)"):
        make_loss(3).cost_surrogate_loss(data)
    actor, critic, _ = make_networks()
    loss = TrustRegionLoss(actor, critic, make_critic("cost_value", 2), num_costs=3)
    with pytest.raises(ValueError, match="one column for each"):
        loss.estimate_advantages(make_batch(3))


def test_limits_of_the_wrong_length_are_refused():
    with pytest.raises(ValueError, match=r"cost_limit.*2 costs.*\(3,\)"):
        ViolationUpdater(make_loss(2), cost_limit=torch.ones(3))


def test_state_goes_to_another_loss():
    loss, other = make_loss(2, multiplier_init=0.5), make_loss(2)
    ViolationUpdater(loss, cost_limit=1.0).step(torch.tensor([[3.0, 0.0]]))
    other.load_state_dict(loss.state_dict())
    assert other.lagrange_multiplier.tolist() == [0.5, 0.5]
    assert other.cost_violation.tolist() == [2.0, -1.0]


@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
@pytest.mark.slow
def test_compiles_to_one_graph():
    loss, data = make_loss(2), estimated(2)
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    expected = loss(data)
    for key, value in compiled(data).items():
        torch.testing.assert_close(value, expected[key], msg=key)
    surrogate = torch.compile(loss.cost_surrogate_loss, fullgraph=True, backend="eager")(data)
    torch.testing.assert_close(surrogate, loss.cost_surrogate_loss(data))
