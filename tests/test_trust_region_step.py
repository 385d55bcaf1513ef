"""TrustRegionStep on small policies: bounds, reductions, kinds of actors, precision and work."""

import pytest
import torch
from first_order import actor_gradient
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    TensorDictModule,
    set_composite_lp_aggregate,
)
from torch import nn
from torch.distributions import Categorical, Normal, kl_divergence
from torchrl.modules import IndependentNormal, ProbabilisticActor, recurrent_mode
from torchrl.objectives import PPOLoss, SoftUpdate
from trust_region import (
    ACTORS,
    BATCH,
    MAX_KL,
    METHODS,
    Fixed,
    act,
    actor_state,
    critic_state,
    discrete_actor,
    distribution,
    make_data,
    make_loss,
    normal_actor,
)

from torchrl_safe.objectives import (
    CPO,
    PCPO,
    TRPO,
    DualAscent,
    PIDControl,
    TrustRegionLoss,
    TrustRegionStep,
    ViolationUpdater,
)
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

# ---------------------------------------------------------------- what a step keeps


@pytest.mark.parametrize("violation", [-100.0, -0.2, 0.2, 100.0])
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
@pytest.mark.parametrize("actor", ACTORS)
def test_a_step_keeps_divergence_and_cost_within_bounds(actor, method, violation):
    loss = make_loss(actor=actor)
    loss.cost_violation.fill_(violation)
    data = make_data(loss)
    old, before, critics = distribution(loss, data), actor_state(loss), critic_state(loss)
    old_cost, old_loss = loss.cost_surrogate_loss(data), loss(data)["loss_objective"]
    step = TrustRegionStep(loss, method, max_kl=MAX_KL, episode_length=10.0)
    info = step.step(data)
    assert not torch.equal(actor_state(loss), before)
    assert torch.equal(critic_state(loss), critics)
    kl = kl_divergence(old, distribution(loss, data)).mean()
    assert 0 < kl <= MAX_KL
    torch.testing.assert_close(info["kl"], kl)
    assert 0 < info["step_fraction"] <= 1
    rise = (loss.cost_surrogate_loss(data) - old_cost).item()
    gain = (old_loss - loss(data)["loss_objective"]).item()
    assert info["surrogate_gain"].item() == pytest.approx(gain, abs=1e-6)
    assert step.rejected_steps == step.indefinite_steps == 0
    if method.constrained:
        assert info["cost_surrogate_change"].item() == pytest.approx(rise, abs=1e-6)
        assert rise <= max(-violation / 10, 0) + 1e-6
        assert rise < 0 or violation <= 0
    else:
        assert gain > 0
        assert info["cost_surrogate_change"] == 0


def test_the_step_is_the_natural_gradient():
    """A linear mean, fixed unit deviations: H is the mean of x x^T for each action dimension."""
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(nn.Linear(OBSERVATION_SIZE, 1, bias=False), ConstantDeviation()),
            ["observation"],
            ["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    torch.manual_seed(0)
    loss = PPOLoss(actor.double(), make_critic().double(), entropy_bonus=False)
    data = TensorDict(observation=torch.randn(BATCH, OBSERVATION_SIZE).double(), batch_size=[BATCH])
    data = act(loss, data)
    data["advantage"], data["value_target"] = torch.randn(2, BATCH, 1).double()
    before = actor_state(loss)
    info = TrustRegionStep(loss, max_kl=1e-6, damping=0.0, cg_iterations=20).step(data)
    # The score of a unit normal is (action - mean) x.
    observation = data["observation"]
    score = (data["action"] - data["loc"]) * observation
    gradient = (score * data["advantage"]).mean(0)
    natural = torch.linalg.solve(observation.T @ observation / BATCH, gradient)
    expected = (2e-6 / (gradient @ natural)).sqrt() * natural * info["step_fraction"]
    # This divergence is quadratic, so that the full step lies on the bound, to rounding.
    assert info["step_fraction"] in (1.0, 0.8)
    torch.testing.assert_close(actor_state(loss) - before, expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("shrink", [0.8, 0.5, 0.3])
def test_a_step_that_is_too_long_is_shortened_by_the_factor_asked_for(shrink):
    """Far from the policy the divergence is more than its quadratic approximation."""
    loss = TrustRegionLoss(*make_networks(), entropy_bonus=False)
    data = loss.estimate_advantages(make_batch()).reshape(-1)
    info = TrustRegionStep(loss, max_kl=5.0, shrink=shrink).step(data)
    assert info["step_fraction"] == pytest.approx(shrink)
    assert info["kl"] <= 5.0


class ConstantDeviation(nn.Module):
    def forward(self, loc):
        return loc, torch.ones_like(loc)


# ---------------------------------------------------------------- reductions


def train(method, loss, steps=3, violation=None):
    step = TrustRegionStep(loss, method, max_kl=MAX_KL)
    if violation is not None:
        loss.cost_violation.fill_(violation)
    return [step.step(make_data(loss, seed))["kl"] for seed in range(steps)], actor_state(loss)


@pytest.mark.parametrize("actor", ACTORS)
@pytest.mark.parametrize("method", ["cpo", "pcpo", "pcpo-euclid"])
def test_with_a_limit_that_never_binds_it_is_trpo_bit_for_bit(method, actor):
    kls, parameters = train(METHODS[method], make_loss(actor=actor), violation=-1e6)
    expected_kls, expected = train(TRPO(), make_loss(actor=actor))
    assert kls == expected_kls
    assert torch.equal(parameters, expected)


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize("functional", [True, False], ids=["functional", "not-functional"])
def test_trpo_lagrangian_with_multiplier_zero_is_trpo_bit_for_bit(functional, num_costs):
    loss = make_loss(num_costs, functional=functional)
    torch.manual_seed(0)
    ppo = PPOLoss(ACTORS["normal"](), make_critic(), entropy_bonus=False)
    for seed in range(5):
        data = make_data(ppo, seed)
        data["cost_advantage"] = torch.randn(BATCH, num_costs)
        data["cost_value_target"] = torch.randn(BATCH, num_costs)
        infos = [TrustRegionStep(each, max_kl=MAX_KL).step(data) for each in (loss, ppo)]
        assert (infos[0] == infos[1]).all()
    parameters = torch.cat([p.detach().flatten() for p in loss.actor_network.parameters()])
    if functional:
        parameters = actor_state(loss)
    assert torch.equal(parameters, actor_state(ppo))


def test_a_very_large_multiplier_lowers_its_cost_only():
    """With three costs and a multiplier of one of them that drowns all else."""
    loss = make_loss(3)
    DualAscent(loss, cost_limit=0.0, lr=1e6).step(torch.tensor([[0.0, 1.0, 0.0]]))
    data = make_data(loss)
    before = loss.cost_surrogate_loss(data)
    TrustRegionStep(loss, max_kl=MAX_KL).step(data)
    assert (loss.cost_surrogate_loss(data) - before)[1] < -0.01

    alone = make_loss(3)
    data["advantage"] = -data["cost_advantage"][:, 1:2]
    TrustRegionStep(alone, max_kl=MAX_KL).step(data)
    torch.testing.assert_close(actor_state(loss), actor_state(alone), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("num_costs", [1, 3])
def test_every_multiplier_rule_changes_the_step(num_costs):
    def stepped(rule):
        loss = make_loss(num_costs)
        if rule:
            rule(loss).step(torch.full((2, num_costs), 3.0))
        TrustRegionStep(loss, max_kl=MAX_KL).step(make_data(loss))
        return actor_state(loss)

    plain = stepped(None)
    dual = stepped(lambda loss: DualAscent(loss, cost_limit=1.0, lr=0.5))
    # Both rules give the multiplier 1: 0.5 * 2 and 0.25 * 2 + 0.25 * 2.
    settings = {"kp": 0.25, "ki": 0.25, "pessimism": 0.0, "normalize": False}
    pid = stepped(lambda loss: PIDControl(loss, cost_limit=1.0, **settings))
    assert torch.equal(dual, pid)
    assert not torch.equal(dual, plain)


def test_the_violation_is_divided_by_the_length_of_an_episode():
    """100 above the limit in 1000 steps is 0.1 in one; by default in 1 / (1 - gamma) of them."""

    def stepped(violation, gamma=0.99, **kwargs):
        loss = make_loss()
        loss.make_cost_value_estimator(gamma=gamma)
        loss.cost_violation.fill_(violation)
        TrustRegionStep(loss, CPO(), max_kl=MAX_KL, **kwargs).step(make_data(loss))
        return actor_state(loss)

    expected = stepped(0.01, episode_length=1)
    assert not torch.equal(stepped(0.02, episode_length=1), expected)
    torch.testing.assert_close(stepped(10.0, episode_length=1000), expected)
    torch.testing.assert_close(stepped(0.5, gamma=0.98), expected)
    with pytest.raises(ValueError, match=r"episode_length must be given if gamma .* is 1 or more"):
        stepped(0.5, gamma=1.0)


def test_recovery_lowers_the_cost_whatever_the_reward():
    loss = make_loss()
    ViolationUpdater(loss, cost_limit=1.0).step(torch.tensor([[1000.0]]))
    step = TrustRegionStep(loss, CPO(), max_kl=MAX_KL)
    data = make_data(loss)
    data["advantage"] = data["cost_advantage"] / data["cost_advantage"].std()
    info = step.step(data)
    assert step.recovery_steps == info["recovery_steps"] == 1
    assert info["constraint_active"]
    assert info["cost_surrogate_change"] < 0
    assert info["surrogate_gain"] < 0


# ---------------------------------------------------------------- kinds of actors and batches


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


def test_a_recurrent_actor_sees_whole_sequences():
    loss = make_loss()
    data, modes = make_data(loss), []
    for module in loss.actor_network.modules():
        module.register_forward_pre_hook(lambda *_: modes.append(recurrent_mode()))
    TrustRegionStep(loss, max_kl=MAX_KL).step(data)
    assert modes
    assert all(modes)


def test_the_violation_has_the_unit_of_scaled_advantages():
    def stepped(scale=None, violation=0.2):
        loss = make_loss()
        loss.cost_violation.fill_(violation)
        data = make_data(loss)
        if scale is not None:
            loss.cost_advantage_scale.fill_(scale)
            data["cost_advantage"] /= scale
        info = TrustRegionStep(loss, CPO(), max_kl=MAX_KL, episode_length=10.0).step(data)
        assert info["constraint_active"]
        assert not info["recovery_steps"]
        return actor_state(loss)

    expected = stepped()
    assert not torch.allclose(stepped(violation=0.05), expected, atol=1e-4)
    torch.testing.assert_close(stepped(scale=4.0), expected)


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


def test_a_step_a_little_beyond_the_bound_is_shortened():
    """By a quarter: the first shorter one is within it."""
    data, max_kl, found = make_data(make_loss()), 1e3, []
    for _ in range(2):
        info = TrustRegionStep(make_loss(), Fixed(0.1), max_kl=max_kl).step(data)
        found.append(info["step_fraction"].item())
        max_kl = info["kl"].item() / 1.25
    assert found == pytest.approx([1.0, 0.8])
