"""Which actors and batches a trust-region step takes, and how precisely it computes."""

import pytest
import torch
from first_order import actor_gradient
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule, set_composite_lp_aggregate
from torch import nn
from torch.distributions import Categorical, Normal, kl_divergence
from torchrl.modules import IndependentNormal, ProbabilisticActor, recurrent_mode
from torchrl.objectives import PPOLoss, SoftUpdate
from trust_region import (
    BATCH,
    MAX_KL,
    Fixed,
    act,
    actor_state,
    discrete_actor,
    distribution,
    make_data,
    make_loss,
    normal_actor,
)

from torchrl_safe.objectives import CPO, PCPO, TRPO, TrustRegionLoss, TrustRegionStep
from torchrl_safe.objectives.trust_region.actor_copy import importance_weight
from torchrl_safe.testing import (
    ACTION_SIZE,
    OBSERVATION_SIZE,
    make_actor,
    make_batch,
    make_critic,
    make_networks,
)
from torchrl_safe.testing.networks import mlp


def test_a_composite_action():
    with set_composite_lp_aggregate(False):
        network = nn.Sequential(mlp(OBSERVATION_SIZE, 4), SplitParameters())
        actor = ProbabilisticActor(
            TensorDictModule(
                network,
                ["observation"],
                [("params", "a", "loc"), ("params", "a", "scale"), ("params", "b", "logits")],
            ),
            in_keys=["params"],
            out_keys=["a", "b"],
            distribution_class=CompositeDistribution,
            distribution_kwargs={"distribution_map": {"a": IndependentNormal, "b": Categorical}},
            return_log_prob=True,
        )
        torch.manual_seed(0)
        loss = PPOLoss(actor, make_critic(), entropy_bonus=False)
        data = TensorDict(observation=torch.randn(BATCH, OBSERVATION_SIZE), batch_size=[BATCH])
        data = act(loss, data)
        data["advantage"], data["value_target"] = torch.randn(2, BATCH, 1)
        old = distribution(loss, data)
        info = TrustRegionStep(loss, max_kl=MAX_KL).step(data)
        new = distribution(loss, data)
    parts = [kl_divergence(old.dists[name], new.dists[name]).mean() for name in ("a", "b")]
    torch.testing.assert_close(info["kl"], sum(parts))
    assert min(parts) > 0
    assert info["kl"] <= MAX_KL


class SplitParameters(nn.Module):
    def forward(self, raw):
        return raw[..., :1], raw[..., 1:2].exp(), raw[..., 2:]


def test_nested_keys():
    def stepped(nest):
        name = (lambda key: ("agent", key)) if nest else (lambda key: key)
        torch.manual_seed(0)
        loss = TrustRegionLoss(
            make_actor(name("observation"), name("action")),
            make_critic(name("state_value"), observation=name("observation")),
            make_critic(name("cost_value"), observation=name("observation")),
            entropy_bonus=False,
        )
        loss.set_keys(
            value=name("state_value"),
            cost_value=name("cost_value"),
            cost=name("cost"),
            advantage=name("advantage"),
            cost_advantage=name("cost_advantage"),
            value_target=name("value_target"),
            cost_value_target=name("cost_value_target"),
        )
        batch = make_batch()
        if nest:
            batch.rename_key_("observation", name("observation"))
            batch.rename_key_("action", name("action"))
            batch.rename_key_("action_log_prob", loss.tensor_keys.sample_log_prob)
            batch["next"].rename_key_("observation", name("observation"))
            batch["next"].rename_key_("cost", name("cost"))
        data = loss.estimate_advantages(batch).reshape(-1)
        TrustRegionStep(loss, CPO(), max_kl=MAX_KL).step(data)
        return actor_state(loss)

    assert torch.equal(stepped(nest=True), stepped(nest=False))


def test_masked_steps_count_nowhere():
    def stepped(masked):
        loss = make_loss()
        data = make_data(loss)
        mask = torch.arange(BATCH) % 3 > 0
        if not masked:
            return TrustRegionStep(loss, CPO(), max_kl=MAX_KL).step(data[mask]), actor_state(loss)
        data["collector", "mask"] = mask
        data["advantage"][~mask] = 1e6
        return TrustRegionStep(loss, CPO(), max_kl=MAX_KL).step(data), actor_state(loss)

    (info, parameters), (expected_info, expected) = stepped(True), stepped(False)
    # Sums of other lengths round differently, in double precision; one masked step that counted
    # would change it all.
    torch.testing.assert_close(parameters, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(info["kl"], expected_info["kl"], rtol=1e-6, atol=0)


def test_the_actor_that_the_user_holds_moves_in_place():
    actor, critic, cost_critic = make_networks()
    loss = TrustRegionLoss(actor, critic, cost_critic, entropy_bonus=False)
    addresses = [p.data_ptr() for p in actor.parameters()]
    before = [p.detach().clone() for p in actor.parameters()]
    TrustRegionStep(loss, max_kl=MAX_KL).step(make_data(loss))
    assert [p.data_ptr() for p in actor.parameters()] == addresses
    assert all(not torch.equal(p, old) for p, old in zip(actor.parameters(), before, strict=True))
    assert all(p.grad is None for p in loss.parameters())


def test_frozen_parameters_stay():
    loss = make_loss()
    frozen = next(iter(loss.actor_network_params.parameters()))
    frozen.requires_grad_(False)
    before = frozen.clone()
    info = TrustRegionStep(loss, max_kl=MAX_KL).step(make_data(loss))
    assert info["step_fraction"] > 0
    assert torch.equal(frozen, before)


def test_it_steps_where_gradients_are_off():
    expected = make_loss()
    TrustRegionStep(expected, max_kl=MAX_KL).step(make_data(expected))
    loss = make_loss()
    with torch.no_grad():
        TrustRegionStep(loss, max_kl=MAX_KL).step(make_data(loss))
    assert torch.equal(actor_state(loss), actor_state(expected))


def test_the_entropy_bonus_is_a_part_of_the_surrogate():
    """With no advantage at all the deviations grow."""
    loss = make_loss(entropy_bonus=True, entropy_coeff=0.1)
    data = make_data(loss)
    data["advantage"].zero_()
    before = distribution(loss, data).entropy().mean()
    TrustRegionStep(loss, max_kl=MAX_KL).step(data)
    assert distribution(loss, data).entropy().mean() > before + 0.05


def test_a_recurrent_actor_sees_whole_sequences():
    loss = make_loss()
    data, modes = make_data(loss), []
    for module in loss.actor_network.modules():
        module.register_forward_pre_hook(lambda *_: modes.append(recurrent_mode()))
    TrustRegionStep(loss, max_kl=MAX_KL).step(data)
    assert modes
    assert all(modes)


# ---------------------------------------------------------------- precision and work


def nearly_parallel(method, seed, dtype=torch.float64, shuffled=False, actor="normal"):
    """A step where cost and reward grow almost together, so that CPO's dual cancels digits."""
    loss = make_loss(actor=actor)
    loss.cost_violation.fill_(0.2)
    data = make_data(loss, seed)
    data["cost_advantage"] = data["advantage"] + 0.05 * data["cost_advantage"]
    if shuffled:
        data = data[torch.randperm(BATCH)]
    before = actor_state(loss)
    TrustRegionStep(loss, method, max_kl=MAX_KL, episode_length=10.0, dtype=dtype).step(data)
    return (actor_state(loss) - before).double()


@pytest.mark.parametrize("method", [TRPO(), CPO(), PCPO()], ids=["trpo", "cpo", "pcpo"])
def test_rounding_does_not_show_in_a_step(method):
    """The order of the steps in a batch changes the rounding of every sum, as a processor does."""
    for seed in range(4):
        step = nearly_parallel(method, seed)
        other = nearly_parallel(method, seed, shuffled=True)
        # What is left is that the parameters, of size 1, are rounded to single precision.
        assert step.norm() > 0.01
        assert (other - step).abs().max() < 2e-7


def test_the_precision_of_a_step_can_be_chosen():
    """Single precision is near, and further from double than the order of the steps."""
    exact = nearly_parallel(CPO(), 0)
    single = nearly_parallel(CPO(), 0, dtype=torch.float32)
    difference = (single - exact).norm() / exact.norm()
    assert 1e-6 < difference < 0.1
    with pytest.raises(ValueError, match=r"dtype.*torch\.int64"):
        TrustRegionStep(make_loss(), dtype=torch.int64)
    with pytest.raises(ValueError, match=r"dtype.*double"):
        TrustRegionStep(make_loss(), dtype="double")


class InSinglePrecision(nn.Module):
    def forward(self, observation):
        return observation.float()


def test_an_actor_that_fixes_its_precision_is_told_what_to_pass():
    actor = discrete_actor(Categorical)
    actor.module[0].module.insert(0, InSinglePrecision())
    loss = PPOLoss(actor, make_critic(), entropy_bonus=False)
    data, before = make_data(loss), actor_state(loss)
    with pytest.raises(RuntimeError, match=r"float64.*pass that one as dtype"):
        TrustRegionStep(loss).step(data)
    assert torch.equal(actor_state(loss), before)
    assert TrustRegionStep(loss, dtype=torch.float32).step(data)["step_fraction"] > 0


class Tied(nn.Module):
    """One weight in two places, and statistics that each call moves."""

    def __init__(self):
        super().__init__()
        self.first, self.second = (
            nn.Linear(OBSERVATION_SIZE, OBSERVATION_SIZE),
            nn.Linear(OBSERVATION_SIZE, 3),
        )
        self.again = nn.Linear(OBSERVATION_SIZE, OBSERVATION_SIZE)
        self.again.weight = self.first.weight
        self.norm = nn.BatchNorm1d(OBSERVATION_SIZE)

    def forward(self, observation):
        return self.second(self.again(self.norm(self.first(observation).tanh())).tanh())


@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
def test_tied_weights_move_together_and_buffers_stay(functional):
    def make():
        torch.manual_seed(0)
        module = Tied()
        actor = ProbabilisticActor(
            TensorDictModule(module, ["observation"], ["logits"]),
            in_keys=["logits"],
            distribution_class=Categorical,
            return_log_prob=True,
        )
        return module, PPOLoss(actor, make_critic(), entropy_bonus=False, functional=functional)

    module, loss = make()
    data = make_data(make()[1]) if functional else make_data(loss)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    assert TrustRegionStep(loss, max_kl=MAX_KL).step(data)["step_fraction"] > 0
    assert module.again.weight is module.first.weight
    for name, value in module.state_dict().items():
        still = any(part in name for part in ("running", "num_batches"))
        assert torch.equal(value, before[name]) == still, name


def test_both_uses_of_a_tied_weight_count():
    torch.manual_seed(0)
    actor = ProbabilisticActor(
        TensorDictModule(Tied().eval(), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    loss = PPOLoss(actor, make_critic(), entropy_bonus=False, functional=False)
    data = make_data(loss)
    with torch.no_grad():
        old = actor.get_dist(data.clone())
        info = TrustRegionStep(loss, max_kl=MAX_KL).step(data)
        kl = kl_divergence(old, actor.get_dist(data.clone())).mean()
    assert 0 < kl <= MAX_KL
    torch.testing.assert_close(info["kl"], kl, rtol=1e-3, atol=0)


def test_every_part_of_an_action_counts():
    """Of a distribution that is not summed over them: the step is that of one that is."""
    loss = PPOLoss(normal_actor(Normal), make_critic(), entropy_bonus=False)
    torch.manual_seed(0)
    data = act(
        loss, TensorDict(observation=torch.randn(BATCH, OBSERVATION_SIZE), batch_size=[BATCH])
    )
    data["advantage"], data["value_target"] = torch.randn(2, BATCH, 1)
    summed = PPOLoss(normal_actor(IndependentNormal), make_critic(), entropy_bonus=False)
    summed.actor_network_params.data.copy_(loss.actor_network_params.data)
    joint = data.clone()
    joint["action_log_prob"] = data["action_log_prob"].sum(-1)
    old = distribution(loss, data)
    info, expected = (
        TrustRegionStep(each, max_kl=MAX_KL).step(batch)
        for each, batch in ((loss, data), (summed, joint))
    )
    kl = kl_divergence(old, distribution(loss, data))
    assert kl.shape == (BATCH, ACTION_SIZE)
    torch.testing.assert_close(info["kl"], kl.sum(-1).mean())
    torch.testing.assert_close(info, expected)


@pytest.mark.parametrize(
    "options",
    [
        {"normalize_advantage": True},
        {"max_importance_ratio": 1.1},
        {"entropy_bonus": True, "entropy_coeff": 0.5},
        {"delay_actor": True},
    ],
    ids=lambda options: next(iter(options)),
)
def test_the_surrogate_is_that_of_the_loss(options):
    """Whose own forward gives the gain in single precision, with all its options."""
    loss = make_loss(**options)
    loss.lagrange_multiplier.fill_(0.5)
    if loss.delay_actor:
        SoftUpdate(loss, tau=0.5)
    data = make_data(loss)
    data["action_log_prob"] += 0.2 * torch.randn(BATCH)

    def surrogate():
        losses = loss(data)
        return losses["loss_objective"] + losses.get("loss_entropy", 0.0)

    before = surrogate()
    info = TrustRegionStep(loss, max_kl=MAX_KL).step(data)
    assert info["surrogate_gain"] > 1e-3
    torch.testing.assert_close(
        info["surrogate_gain"], before - surrogate(), rtol=0, atol=1e-6, check_dtype=False
    )


@pytest.mark.parametrize("kind", [IndependentNormal, Normal])
def test_a_capped_ratio_is_that_of_the_loss(kind):
    """And has its gradient. A Normal has a ratio for each part of the action."""
    torch.manual_seed(0)
    critics = make_critic(), make_critic("cost_value")
    loss = TrustRegionLoss(
        normal_actor(kind), *critics, max_importance_ratio=1.1, entropy_bonus=False
    )
    observation = torch.randn(BATCH, OBSERVATION_SIZE)
    data = act(loss, TensorDict(observation=observation, batch_size=[BATCH]))
    data["advantage"], data["cost_advantage"] = torch.randn(2, BATCH, 1)
    data["action_log_prob"] += 0.3 * torch.randn(data["action_log_prob"].shape)
    with loss.actor_network_params.to_module(loss.actor_network):
        policy = loss.actor_network.get_dist(data.clone())
    weight = importance_weight(loss, policy, data, data.shape)
    surrogate = (weight * data["cost_advantage"]).mean()
    expected = loss.cost_surrogate_loss(data)[0]
    torch.testing.assert_close(surrogate, expected)
    gradients = [actor_gradient(loss, value) for value in (surrogate, expected)]
    torch.testing.assert_close(*gradients)


def counted(module, calls, name):
    module.register_forward_pre_hook(lambda *_: calls.append(name))
    return module


def test_a_backtrack_evaluates_the_policy_once_and_no_critic():
    calls = []
    torch.manual_seed(0)
    actor = discrete_actor(Categorical)
    actor.module[0].module.append(counted(nn.Identity(), calls, "policy"))
    critics = make_critic(), make_critic("cost_value")
    for critic in critics:
        critic.module.append(counted(nn.Identity(), calls, "critic"))
    loss = TrustRegionLoss(actor, *critics, entropy_bonus=False)
    data = make_data(loss)

    def evaluations(max_backtracks):
        calls.clear()
        step = TrustRegionStep(loss, Fixed(1e4), max_backtracks=max_backtracks)
        assert step.step(data)["step_fraction"] == 0
        assert set(calls) == {"policy"}
        return len(calls)

    assert evaluations(7) - evaluations(2) == 5
    assert evaluations(0) <= 3


def test_the_divergence_of_a_very_small_step_is_kept_to():
    """In single precision a divergence of 1e-10 is rounding."""
    loss = make_loss()
    data = make_data(loss)
    double = loss.actor_network_params.data.double()
    with torch.no_grad(), double.to_module(loss.actor_network):
        old = loss.actor_network.get_dist(data.double())
    info = TrustRegionStep(loss, max_kl=1e-10).step(data)
    double = loss.actor_network_params.data.double()
    with torch.no_grad(), double.to_module(loss.actor_network):
        kl = kl_divergence(old, loss.actor_network.get_dist(data.double())).mean()
    assert 0 < kl <= 1e-10
    torch.testing.assert_close(info["kl"].double(), kl, rtol=1e-5, atol=0)


def test_a_compiled_loss_is_the_loss_itself():
    loss = make_loss()
    assert TrustRegionStep(torch.compile(loss, backend="eager"), CPO()).loss_module is loss
