"""FOCOPS, CUP, P3O, IPO and CRPO: the parent where no limit acts, and all kinds of policies."""

import math
from functools import partial

import pytest
import torch
from first_order import FAR, actor_gradient, build, crpo, parent_of, step
from on_policy import estimated, total
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch.distributions import Categorical, Independent, Normal, kl_divergence
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    MLP,
    IndependentNormal,
    MaskedCategorical,
    ProbabilisticActor,
    TruncatedNormal,
)
from torchrl.objectives import SoftUpdate

from torchrl_safe.objectives import CUPLoss, FOCOPSLoss, IPOLoss, P3OLoss, TrustRegionLoss
from torchrl_safe.objectives.on_policy.policies import divergence
from torchrl_safe.testing import make_batch, make_critic


def term(loss, data):
    """What a method adds to the objective of the reward, or puts in its place."""
    if isinstance(loss, CUPLoss):
        loss.start_projection()
        return loss.projection_loss(data)["loss_projection"]
    if isinstance(loss, TrustRegionLoss):
        return loss.cost_surrogate_loss(data).sum()
    losses = loss(data)
    return losses["loss_objective" if isinstance(loss, FOCOPSLoss) else "loss_penalty"]


def gradient_of(make, distribution, num_actions, off=0.0, **options):
    """Of what costs add to a loss; log-probabilities were recorded too high by ``off``."""
    torch.manual_seed(0)
    net = torch.nn.Sequential(MLP(4, 2 * num_actions), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        return_log_prob=True,
    )
    critics = make_critic(), make_critic("cost_value")
    loss = make(actor, *critics, entropy_bonus=False, **options)
    if loss.delay_actor:
        SoftUpdate(loss, eps=0.5)
    for name in loss.cost_buffers:
        getattr(loss, name).fill_(2.0)
    data = make_batch(1).exclude("action", "action_log_prob", "loc", "scale")
    with torch.no_grad():
        data = loss.estimate_advantages(actor(data)).reshape(-1)
    data["action_log_prob"] += off
    return actor_gradient(loss, term(loss, data))


@pytest.mark.parametrize("num_actions", [1, 3])
@pytest.mark.parametrize(
    "make", [FOCOPSLoss, CUPLoss, P3OLoss, IPOLoss, TrustRegionLoss], ids=lambda make: make.__name__
)
def test_a_log_probability_of_each_part_is_added_up(make, num_actions):
    """Of the same policy, summed or not: the same gradient. Costs meet their own states."""
    gradients = [gradient_of(make, each, num_actions) for each in (IndependentNormal, Normal)]
    assert gradients[0].norm() > 0.1
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("make", [P3OLoss, CUPLoss])
def test_the_parts_of_a_delayed_policy_are_added_up(make):
    """Three parts of a log-probability that are 0.1 off are one that is 0.3 off."""
    gradients = [
        gradient_of(make, distribution, 3, off, delay_actor=True)
        for distribution, off in ((IndependentNormal, 0.3), (Normal, 0.1))
    ]
    assert gradients[0].norm() > 0.1
    torch.testing.assert_close(*gradients)


def test_a_coefficient_that_is_a_whole_number_is_still_a_number():
    """A buffer of whole numbers would cut off what comes later."""
    loss = build(IPOLoss, sharpness=20)
    assert loss.sharpness.is_floating_point()
    losses = loss(estimated(loss))
    assert total(losses).isfinite()


@pytest.mark.parametrize("make", [CUPLoss, FOCOPSLoss, P3OLoss])
def test_targets_of_another_number_of_costs_are_refused(make):
    loss = build(make, 2)
    data = estimated(loss, 2)
    data["cost_value_target"] = data["cost_value_target"][..., :1]
    with pytest.raises(ValueError, match=r"'cost_value_target' must have one column .* 2 costs"):
        loss(data)


UNBOUND = {
    "focops": partial(FOCOPSLoss, temperature=1.0, kl_bound=math.inf),
    "cup": CUPLoss,
    "p3o": P3OLoss,
    "crpo": crpo,
}

OPTIONS = {
    "default": {},
    "clip_value": {"clip_value": 0.1},
    "separate_losses": {"separate_losses": True},
    "not_functional": {"functional": False},
    "max_importance_ratio": {"max_importance_ratio": 1.1},
    "delay_actor": {"delay_actor": True},
}


@pytest.mark.parametrize("num_costs", [1, 3])
@pytest.mark.parametrize("precomputed", [True, False], ids=["advantages-given", "no-advantages"])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
@pytest.mark.parametrize("name", UNBOUND)
def test_without_a_limit_that_binds_it_is_its_parent_bit_for_bit(
    name, options, precomputed, num_costs
):
    loss, parent = build(UNBOUND[name], num_costs, **options), parent_of(name, **options)
    if options.get("delay_actor"):
        for delayed in (loss.loss_module if name == "crpo" else loss, parent):
            SoftUpdate(delayed, eps=0.5)
    step(loss, [FAR] * num_costs)
    batch = make_batch(num_costs)
    if precomputed:
        batch = loss.estimate_advantages(batch).reshape(-1)
    losses = loss(batch.clone())
    if not precomputed:  # Where there are no advantages, the loss does this itself.
        batch = loss.estimate_advantages(batch)
    expected = parent(batch)
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    extra = set(losses.keys()) - set(expected.keys())
    assert {"loss_cost_critic", "cost_explained_variance"} < extra
    if name == "p3o":
        assert losses["loss_penalty"] == 0


def test_far_from_its_limits_ipo_has_no_force():
    loss, parent = build(IPOLoss, 2), parent_of("ipo")
    step(loss, [FAR, FAR])
    data = estimated(loss, 2)
    losses, expected = loss(data), parent(data)
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key
    assert actor_gradient(loss, losses["loss_penalty"]).abs().max() < 1e-20


def two_masked(logits, mask):
    """Two choices among three actions each."""
    each = MaskedCategorical(logits=logits.unflatten(-1, (2, 3)), mask=mask.unflatten(-1, (2, 3)))
    return Independent(each, 1)


@pytest.mark.parametrize(("distribution", "width"), [(MaskedCategorical, 3), (two_masked, 6)])
@pytest.mark.parametrize("make", [FOCOPSLoss, CUPLoss])
def test_a_masked_action_leaves_the_gradients_finite(make, distribution, width):
    """PyTorch's divergence of two policies that exclude the same action has a gradient of NaN."""
    net = TensorDictModule(torch.nn.Linear(4, width), ["observation"], ["logits"])
    actor = ProbabilisticActor(
        net, ["logits", "mask"], distribution_class=distribution, return_log_prob=True
    )
    loss = make(actor, make_critic(), make_critic("cost_value"), multiplier_init=1.0)
    batch = TensorDict(
        observation=torch.randn(8, 4),
        mask=torch.tensor([True, True, False]).repeat(8, width // 3),
        advantage=torch.randn(8, 1),
        cost_advantage=torch.randn(8, 1),
        value_target=torch.zeros(8, 1),
        cost_value_target=torch.zeros(8, 1),
        batch_size=8,
    )
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        actor(batch)
    phases = [loss]
    if make is CUPLoss:
        loss.start_projection()
        phases.append(loss.projection_loss)
    for phase in phases:
        losses = phase(batch)
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    assert all(parameter.grad.isfinite().all() for parameter in loss.parameters())


def test_the_divergence_of_independent_categories_is_pytorchs():
    logits = torch.randn(2, 5, 2, 3, generator=torch.Generator().manual_seed(0))
    for summed, shape in ((0, (5, 2)), (1, (5,)), (2, ())):
        old, new = (Independent(Categorical(logits=each), summed) for each in logits)
        expected = kl_divergence(old, new).unsqueeze(-1)
        torch.testing.assert_close(divergence(old, new, torch.Size(shape)), expected)


def test_the_divergence_of_categories_is_pytorchs():
    old, new = (torch.distributions.Categorical(logits=torch.randn(5, 3)) for _ in range(2))
    shape = torch.Size([5])
    assert torch.equal(divergence(old, new, shape), kl_divergence(old, new).unsqueeze(-1))
    # What the new policy excludes and the old one does not is infinitely far away.
    excluding = torch.distributions.Categorical(probs=torch.tensor([0.5, 0.5, 0.0]))
    everything = torch.distributions.Categorical(probs=torch.ones(3))
    assert divergence(everything, excluding, torch.Size([])) == math.inf
    assert kl_divergence(everything, excluding) == math.inf


def test_a_distribution_without_a_divergence_is_named():
    one = TruncatedNormal(torch.zeros(2), torch.ones(2), low=-1.0, high=1.0)
    with pytest.raises(NotImplementedError, match="no KL divergence of TruncatedNormal"):
        divergence(one, one, torch.Size([]))
