"""TrustRegionStep on small policies: what a step keeps, and what it is in the limit."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    TensorDictModule,
)
from torch import nn
from torch.distributions import kl_divergence
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import PPOLoss
from trust_region import (
    ACTORS,
    BATCH,
    MAX_KL,
    METHODS,
    Fixed,
    act,
    actor_state,
    critic_state,
    distribution,
    make_data,
    make_loss,
)

from torchrl_safe.objectives import (
    CPO,
    TRPO,
    DualAscent,
    PIDControl,
    TrustRegionLoss,
    TrustRegionStep,
    ViolationUpdater,
)
from torchrl_safe.testing import (
    OBSERVATION_SIZE,
    make_batch,
    make_critic,
    make_networks,
)

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


def test_a_step_a_little_beyond_the_bound_is_shortened():
    """By a quarter: the first shorter one is within it."""
    data, max_kl, found = make_data(make_loss()), 1e3, []
    for _ in range(2):
        info = TrustRegionStep(make_loss(), Fixed(0.1), max_kl=max_kl).step(data)
        found.append(info["step_fraction"].item())
        max_kl = info["kl"].item() / 1.25
    assert found == pytest.approx([1.0, 0.8])


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
