"""``torchrl_safe.testing``: every loss and rule of ours passes its checks, and each check finds the
fault that it is for."""

import math
import re
from functools import partial

import pytest
import torch
from off_policy import TRAINS as Q_TRAINS
from on_policy import BY_MULTIPLIER, BY_VIOLATION, TRAINS
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    PPOLoss,
    SACLoss,
)

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


# ---------------------------------------------------------------- faults are found


class Scaled(PPOLagrangianLoss):
    """Not quite its parent."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_objective"] = losses["loss_objective"] * (1 + 1e-6)
        return losses


class Draws(PPOLagrangianLoss):
    """Uses up random numbers."""

    def forward(self, data):
        torch.rand(1)
        return super().forward(data)


class OtherGradient(PPOLagrangianLoss):
    """The right value with twice the gradient."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_critic"] = 2 * losses["loss_critic"] - losses["loss_critic"].detach()
        return losses


class Drifts(PPOLagrangianLoss):
    """Like its parent for five calls."""

    calls = 0

    def forward(self, data):
        self.calls += 1
        losses = super().forward(data)
        if self.calls > 5:
            losses["loss_objective"] = 2 * losses["loss_objective"]
        return losses


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Scaled, "Scaled without constraint and ClipPPOLoss differ, output 'loss_objective'"),
        (Draws, "random numbers drawn"),
        (OtherGradient, "gradient of 'loss_critic' by critic_network_params"),
        (Drifts, "actor_network_params.* after 20 updates"),
        (lambda a, c, cc, **k: A2CLoss(a, c), "no output .*'loss_objective'|has no"),
    ],
    ids=["value", "random", "gradient", "later", "another-loss"],
)
def test_what_is_not_its_parent(make, message):
    constrain = testing.set_multiplier if isinstance(make, type) else lambda *_: None
    with pytest.raises(AssertionError, match=message):
        testing.check_equals_at_zero(make, ClipPPOLoss, constrain=constrain)


class ThroughThePolicy(PPOLagrangianLoss):
    """The loss of the critic reaches the policy too."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_critic"] = losses["loss_critic"] + losses["loss_objective"]
        return losses


class Detached(PPOLagrangianLoss):
    """The cost critic learns nothing."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_cost_critic"] = losses["loss_cost_critic"].detach()
        return losses


class Silent(PPOLagrangianLoss):
    """The cost critic has no loss."""

    def forward(self, data):
        return super().forward(data).exclude("loss_cost_critic")


@pytest.mark.parametrize(
    ("make", "trains", "message"),
    [
        (ThroughThePolicy, None, r"'loss_critic' must train one network, trains \['actor', 'cri"),
        (Detached, None, "'loss_cost_critic' has no gradient"),
        (Silent, None, r"no output trains \['cost_critic'\]"),
        (PPOLagrangianLoss, {"loss_critic": "actor"}, r"'loss_critic' must train \{'actor'\}"),
    ],
    ids=["two-networks", "detached", "untrained", "swapped"],
)
def test_a_wrong_gradient(make, trains, message):
    with pytest.raises(AssertionError, match=message):
        testing.check_gradients(make, trains)


class WrongWay(PPOLagrangianLoss):
    """Rewards costs."""

    def forward(self, data):
        return super().forward(data.replace({"cost_advantage": -data["cost_advantage"]}))


class Deaf(PPOLagrangianLoss):
    """Multipliers have no effect."""

    def forward(self, data):
        return super().forward(data.replace({"cost_advantage": 0 * data["cost_advantage"]}))


@pytest.mark.parametrize("make", [WrongWay, Deaf])
def test_a_multiplier_that_does_not_push_costs_down(make):
    with pytest.raises(AssertionError, match="with multiplier 100 for cost 0 a step must lower"):
        testing.check_multiplier_direction(make)


class FirstOnly(PPOLagrangianLoss):
    """All multipliers act on the first cost."""

    def forward(self, data):
        cost = data["cost_advantage"][..., :1].expand_as(data["cost_advantage"])
        return super().forward(data.replace({"cost_advantage": cost}))


class LearnsOne(PPOLagrangianLoss):
    """The critic of all costs but the first has no targets."""

    def forward(self, data):
        target = data["cost_value_target"].clone()
        target[..., 1:] = 0
        return super().forward(data.replace({"cost_value_target": target}))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (FirstOnly, "cost 1 of 3 does not act on the policy as it does alone"),
        (LearnsOne, "the target of cost 1 has no effect"),
    ],
)
def test_costs_that_are_mixed_up(make, message):
    with pytest.raises(AssertionError, match=message):
        testing.check_num_costs(make)


class CountsAll(PPOLagrangianLoss):
    """The mask is ignored by one loss."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_critic"] = super().forward(data.exclude(("collector", "mask")))["loss_critic"]
        return losses


class Halves(PPOLagrangianLoss):
    """Masked steps count as zeros."""

    def forward(self, data):
        losses = super().forward(data)
        if ("collector", "mask") in data.keys(True):
            losses["loss_critic"] = losses["loss_critic"] * data["collector", "mask"].float().mean()
        return losses


@pytest.mark.parametrize(
    ("make", "message"),
    [(CountsAll, "what the masked steps hold has an effect"), (Halves, "masked steps count")],
)
def test_a_mask_that_is_ignored(make, message):
    with pytest.raises(AssertionError, match=f"{message}, output 'loss_critic'"):
        testing.check_masked_steps(make)


class FixedKey(PPOLagrangianLoss):
    """Reads a key by its default name."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_objective"] = (
            losses["loss_objective"] + data.get("value_target", torch.zeros(1)).mean()
        )
        return losses


def test_a_key_that_cannot_be_renamed():
    with pytest.raises(AssertionError, match=r"set_keys\(value_target='renamed'\), output"):
        testing.check_keys(FixedKey)
    with pytest.raises(ValueError, match="not an accepted"):
        testing.check_keys(PPOLagrangianLoss, ["no_such_key"])


class FixedCost(PPOLagrangianLoss):
    """Estimates from ``cost``, whatever it is called."""

    def _cost_estimator_keys(self):
        return {**super()._cost_estimator_keys(), "reward": "cost"}


def test_a_key_of_the_estimator_that_cannot_be_renamed():
    """A loss that gets advantages never reads it."""
    testing.check_keys(FixedCost)
    with pytest.raises(AssertionError, match=r"set_keys.*\('next', 'cost'\) was not found"):
        testing.check_loss(FixedCost)


class Unannounced(PPOLagrangianLoss):
    """Has a loss that a call with keywords does not return."""

    def policy_losses(self, *arguments):
        losses = super().policy_losses(*arguments)
        return losses.set("loss_hidden", losses["loss_objective"])


def test_a_loss_that_is_not_announced():
    with pytest.raises(AssertionError, match=r"out_keys lacks the output \['loss_hidden'\]"):
        testing.check_dispatch(Unannounced)


class WrongCritic(SACLagrangianLoss):
    """Rewards costs, or lets each multiplier act on another one."""

    def __init__(self, *networks, change, **options):
        super().__init__(*networks, **options)
        self.change = change

    def _cost_qvalue(self, tensordict, params):
        return self.change(super()._cost_qvalue(tensordict, params))


@pytest.mark.parametrize("change", [torch.neg, lambda cost: cost.flip(-1)], ids=["sign", "column"])
def test_a_multiplier_that_does_not_push_the_costs_of_actions_down(change):
    make = partial(WrongCritic, target_entropy=-2.0, change=change)
    with pytest.raises(AssertionError, match="with multiplier 100 for cost 0 a step must lower"):
        testing.check_q_multiplier_direction(make)


class Announces(PPOLagrangianLoss):
    """Promises an output that it does not have."""

    @property
    def out_keys(self):
        return [*super().out_keys, "loss_nothing"]


def test_an_output_that_is_not_there():
    with pytest.raises(AssertionError, match=r"out_keys has \['loss_nothing'\]"):
        testing.check_dispatch(Announces)


class Writes(PPOLagrangianLoss):
    """Leaves something in the data."""

    def forward(self, data):
        data["left"] = data["advantage"]
        return super().forward(data)


class Changes(PPOLagrangianLoss):
    """Changes an entry in place."""

    def forward(self, data):
        data["advantage"].mul_(2)
        return super().forward(data)


@pytest.mark.parametrize(
    ("make", "message"), [(Writes, r"written \{'left'\}"), (Changes, "entry 'advantage' of the")]
)
def test_an_input_that_is_written_into(make, message):
    with pytest.raises(AssertionError, match=message):
        testing.check_input_unchanged(make)


class Forgets(PPOLagrangianLoss):
    """Keeps a weight outside its state."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.weight = next(iter(self.parameters())).detach().flatten()[0].clone()

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_objective"] = losses["loss_objective"] * self.weight
        return losses


class Shares(PPOLagrangianLoss):
    """A copy has the original's parameters."""

    def __deepcopy__(self, memo):
        return self


@pytest.mark.parametrize(
    ("make", "message"),
    [(Forgets, "state of one loss in another"), (Shares, "after its deepcopy has changed")],
)
def test_a_state_that_is_not_all(make, message):
    with pytest.raises(AssertionError, match=f"{message}.* output"):
        testing.check_state_dict(make)


class Single(PPOLagrangianLoss):
    """Computes in single precision whatever comes."""

    def forward(self, data):
        losses = super().forward(data)
        losses["loss_critic"] = losses["loss_critic"].float()
        return losses


def test_a_precision_that_is_lost():
    with pytest.raises(AssertionError, match=r"'loss_critic' .* is torch\.float32"):
        testing.check_cast(Single)


class Counts(PPOLagrangianLoss):
    """Has to be traced again for each call."""

    calls = 0

    def forward(self, data):
        self.calls += 1
        losses = super().forward(data)
        losses["calls"] = torch.full((), self.calls)
        return losses.exclude("calls")


@pytest.mark.slow
def test_a_graph_that_is_not_one():
    with pytest.raises(AssertionError, match="took 2 graphs"):
        testing.check_compile(Counts)


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
