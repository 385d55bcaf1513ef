"""What tests losses finds their faults."""

from functools import partial

import pytest
import torch
from torchrl.objectives import A2CLoss, ClipPPOLoss

from torchrl_safe import testing
from torchrl_safe.objectives import PPOLagrangianLoss, SACLagrangianLoss, reduced


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


class LearnsTheNext(PPOLagrangianLoss):
    """The critic's value of each cost learns the targets of another."""

    def forward(self, data):
        target = data["cost_value_target"].roll(1, -1)
        return super().forward(data.replace({"cost_value_target": target}))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (LearnsTheNext, "the critic's value of cost 0 learns other targets"),
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


class DividesByPadding(PPOLagrangianLoss):
    """A masked step divides by a stored deviation of 0, and is left out too late."""

    def forward(self, data):
        losses, critic = super().forward(data), self.critic_network
        with self.critic_network_params.to_module(critic):
            ratio = critic(data.select("observation"))["state_value"] / data["scale"]
        losses["loss_critic"] = losses["loss_critic"] + reduced(self, ratio, data)
        return losses


def test_padding_that_makes_a_gradient_nan():
    with pytest.raises(AssertionError, match=r"make the gradient of critic_network_params.*NaN"):
        testing.check_masked_steps(DividesByPadding)


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


class Moves(PPOLagrangianLoss):
    """Its own multiplier."""

    def forward(self, data):
        losses = super().forward(data)
        self.lagrange_multiplier.mul_(0.9)
        return losses


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Writes, r"written \{'left'\}"),
        (Changes, "entry 'advantage' of the"),
        (Moves, "a call changed lagrange_multiplier"),
    ],
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
