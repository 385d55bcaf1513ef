"""Every loss and rule of ours passes the checks of ``torchrl_safe.testing``; its factories work.

test_testing_losses.py and test_testing_rules.py have the faults that the checks find.
"""

import math
import re
from functools import partial

import pytest
import torch
from off_policy import TRAINS as Q_TRAINS
from on_policy import BY_MULTIPLIER, BY_VIOLATION, TRAINS
from torchrl.objectives import ClipPPOLoss, PPOLoss, SACLoss

from torchrl_safe import testing
from torchrl_safe.objectives import (
    CUPLoss,
    DualAscent,
    FOCOPSLoss,
    IPOLoss,
    P3OLoss,
    PIDControl,
    PPOLagrangianLoss,
    SACLagrangianLoss,
    TD3LagrangianLoss,
    TrustRegionLoss,
)

# ---------------------------------------------------------------- ours pass


OFF_POLICY = {
    "sac": partial(SACLagrangianLoss, target_entropy=-2.0),
    "td3": partial(TD3LagrangianLoss, bounds=(-1.0, 1.0)),
}


# Which network each output trains. Those of ReinforceLoss have names of their own.
EVERY_OUTPUT = {
    **TRAINS,
    **Q_TRAINS,
    "loss_kl": "actor",
    "loss_penalty": "actor",
    "loss_value": "critic",
}


ON_POLICY_CHECKS = (
    partial(testing.check_gradients, trains=EVERY_OUTPUT),
    testing.check_multiplier_direction,
    testing.check_num_costs,
    testing.check_masked_steps,
    testing.check_keys,
    partial(testing.check_keys, nested=False, make_data=testing.make_batch),
    partial(testing.check_keys, names=("reward", "cost"), make_data=testing.make_batch),
    testing.check_dispatch,
    testing.check_input_unchanged,
    partial(testing.check_input_unchanged, make_data=testing.make_batch),
    testing.check_state_dict,
    partial(testing.check_state_dict, make_data=testing.make_batch),
    testing.check_cast,
    partial(testing.check_cast, make_data=testing.make_batch),
)


OFF_POLICY_CHECKS = (
    partial(testing.check_gradients, trains=EVERY_OUTPUT),
    testing.check_q_multiplier_direction,
    testing.check_masked_steps,
    partial(testing.check_keys, names=testing.OFF_POLICY_KEYS),
    testing.check_dispatch,
    partial(testing.check_input_unchanged, writes=["td_error"]),
    testing.check_state_dict,
    testing.check_cast,
)


def named(checks):
    return [pytest.param(each, id=getattr(each, "func", each).__name__) for each in checks]


@pytest.mark.parametrize("check", named(ON_POLICY_CHECKS))
@pytest.mark.parametrize("name", [*BY_MULTIPLIER, *BY_VIOLATION])
def test_our_on_policy_losses_pass(name, check):
    if name in BY_MULTIPLIER:
        check(BY_MULTIPLIER[name])
    else:
        check(BY_VIOLATION[name], constrain=testing.set_violation)


@pytest.mark.parametrize("check", named(OFF_POLICY_CHECKS))
@pytest.mark.parametrize("name", OFF_POLICY)
def test_our_off_policy_losses_pass(name, check):
    check(OFF_POLICY[name], **off_policy(name))


def off_policy(name):
    networks = partial(testing.make_q_networks, deterministic=name == "td3")
    return {"make_networks": networks, "make_data": testing.make_transitions}


MULTIPLIER_CHECKS = (testing.check_multiplier_direction, testing.check_num_costs)


@pytest.mark.parametrize(
    "check", named(each for each in ON_POLICY_CHECKS if each not in MULTIPLIER_CHECKS)
)
def test_cup_passes_what_is_about_its_first_phase(check):
    """Its multipliers act in the second."""
    check(CUPLoss)


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize(
    ("make", "parent"), [(PPOLagrangianLoss, ClipPPOLoss), (TrustRegionLoss, PPOLoss)]
)
def test_losses_with_multipliers_equal_their_parents(make, parent, num_costs):
    """test_lagrangian.py has those around a parent."""
    testing.check_equals_at_zero(make, parent, num_costs=num_costs)


@pytest.mark.parametrize(
    ("make", "parent", "options"),
    [
        (CUPLoss, ClipPPOLoss, {}),
        (P3OLoss, ClipPPOLoss, {"constrain": testing.set_violation}),
        (BY_VIOLATION["crpo"], ClipPPOLoss, {"constrain": testing.set_violation}),
        # Their own terms have no effect at first.
        (partial(FOCOPSLoss, temperature=1.0, kl_bound=math.inf), PPOLoss, {"num_updates": 0}),
        (IPOLoss, ClipPPOLoss, {"constrain": testing.set_violation, "num_updates": 0}),
    ],
    ids=["cup", "p3o", "crpo", "focops", "ipo"],
)
def test_the_others_equal_their_parents(make, parent, options):
    testing.check_equals_at_zero(make, parent, **options)


RULES = {
    "dual-ascent": partial(DualAscent, lr=0.1),
    "adam": partial(DualAscent, lr=0.1, optimizer=torch.optim.Adam),
    "softplus": partial(
        DualAscent, lr=0.1, parametrization=torch.distributions.transforms.SoftplusTransform()
    ),
    "bounded": partial(DualAscent, lr=0.1, max_multiplier=2.0),
    "normalized": partial(DualAscent, lr=0.1, normalize=True),
    "pid": PIDControl,
    "pid-as-published": partial(PIDControl, kp=0.1, ki=0.1, kd=0.1, normalize=False),
}


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
def test_our_rules_pass(rule):
    testing.check_multiplier_updater(rule)


# ---------------------------------------------------------------- factories


def test_the_bandits_know_their_optimum():
    bandit = testing.ConstrainedBandit()
    assert bandit.cost_limit.tolist() == pytest.approx([0.3, 0.9])
    assert bandit.optimal_multiplier.tolist() == [1, 0]
    continuous = testing.ContinuousConstrainedBandit(num_costs=1)
    assert continuous.cost_limit.tolist() == pytest.approx([0.3])
    assert continuous.optimal_multiplier.tolist() == pytest.approx([1.4])
    for kind in (testing.ConstrainedBandit, testing.ContinuousConstrainedBandit):
        with pytest.raises(ValueError, match="num_costs must be 1 or 2, got 3"):
            kind(num_costs=3)


def test_global_random_numbers_are_left_alone():
    state = torch.get_rng_state()
    testing.make_batch(2)
    testing.make_minibatch(2)
    testing.make_transitions(2)
    testing.make_networks(2)
    testing.make_q_networks(2)
    testing.check_equals_at_zero(PPOLagrangianLoss, ClipPPOLoss, num_updates=1)
    sac = partial(SACLoss, target_entropy=-2.0)
    testing.check_equals_at_zero(OFF_POLICY["sac"], sac, num_updates=1, **off_policy("sac"))
    testing.check_state_dict(OFF_POLICY["td3"], **off_policy("td3"))
    testing.train_on_bandit(partial(PPOLagrangianLoss, entropy_bonus=False), num_batches=1)
    assert torch.equal(torch.get_rng_state(), state)


def test_factories_repeat_themselves_and_have_seeds():
    for make in (testing.make_batch, testing.make_minibatch, testing.make_transitions):
        assert (make(2) == make(2)).all()
        assert (make(2)["observation"] != make(2, seed=2)["observation"]).all()
    for make in (testing.make_networks, testing.make_q_networks):
        one, same, other = make(2), make(2), make(2, seed=5)
        for ours, theirs, differing in zip(one, same, other, strict=True):
            weights = (next(module.parameters()) for module in (ours, theirs, differing))
            first, second, third = weights
            assert torch.equal(first, second)
            assert not torch.equal(first, third)


def test_a_batch_is_made_of_trajectories():
    batch = testing.make_batch(3)
    assert batch.names == [None, "time"]
    following, done = batch["next"], batch["next", "done"].squeeze(-1)
    carried = (batch["observation"][:, 1:] == following["observation"][:, :-1]).all(-1)
    assert torch.equal(carried, ~done[:, :-1])
    assert done.sum(1).tolist() == [0, 1, 1, 3]
    assert torch.equal(following["terminated"] | following["truncated"], following["done"])
    highest = following["cost"].flatten(0, 1).amax(0)
    assert (highest <= torch.tensor([1.0, 2.0, 3.0])).all()
    assert highest[2] > 1
    # The policy of the batch is another one than that of the networks.
    actor, _, _ = testing.make_networks()
    ratio = actor.get_dist(batch.clone()).log_prob(batch["action"]) - batch["action_log_prob"]
    assert ratio.abs().max() > 0.5


def test_a_minibatch_is_standardized():
    data = testing.make_minibatch(3)
    assert data.batch_size == (24,)
    advantage = data["advantage"]
    torch.testing.assert_close(advantage.mean(), torch.tensor(0.0), atol=1e-6, rtol=0)
    torch.testing.assert_close(advantage.std(), torch.tensor(1.0))
    torch.testing.assert_close(data["cost_advantage"].mean(0), torch.zeros(3), atol=1e-6, rtol=0)


def test_everything_is_listed():
    listed = set(testing.__all__)
    assert {name for name in dir(testing) if re.match("check_|make_|set_|train_", name)} <= listed
