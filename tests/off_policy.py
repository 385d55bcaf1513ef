"""Off-policy losses with tiny networks, beside their parents."""

from functools import partial

import pytest
import torch
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

from torchrl_safe.objectives import SACLagrangianLoss, TD3LagrangianLoss
from torchrl_safe.testing import make_q_actor, make_q_critic, make_q_networks, make_transitions

PARENTS = {SACLagrangianLoss: SACLoss, TD3LagrangianLoss: TD3Loss}
OWN = {SACLagrangianLoss: {"target_entropy": -2.0}, TD3LagrangianLoss: {"bounds": (-1.0, 1.0)}}


def make_actor(kind):
    return make_q_actor(deterministic=kind is TD3LagrangianLoss)


def make_cost_critic(num_costs=1, key="state_action_cost_value"):
    return make_q_critic(key, num_costs)


def networks(loss):
    """Names of the networks that a loss has."""
    return ["actor", "qvalue"] + ["cost_qvalue"] * isinstance(loss, tuple(PARENTS))


def parameters(loss, network, target=False):
    prefix = "target_" if target else ""
    return list(getattr(loss, f"{prefix}{network}_network_params").values(True, True))


def finish(loss):
    """Follows the targets, and parts them from what they follow."""
    if any(name.startswith("target_") for name, _ in loss.named_children()):
        SoftUpdate(loss, tau=0.5)
    for network in networks(loss):
        generator = torch.Generator().manual_seed(len(network))
        with torch.no_grad():
            for parameter in parameters(loss, network):
                parameter.add_(0.2 * torch.randn(parameter.shape, generator=generator))
    return loss


def make_parent(kind, seed=0, **options):
    torch.manual_seed(seed)
    return finish(PARENTS[kind](make_actor(kind), make_q_critic(), **{**OWN[kind], **options}))


def make_loss(kind, num_costs=1, seed=0, num_cost_qvalue_nets=2, multiplier_init=0.0, **options):
    """A loss whose actor and reward critics are those of the parent with this seed."""
    torch.manual_seed(seed)
    actor, critic, cost_critic = make_actor(kind), make_q_critic(), make_cost_critic(num_costs)
    loss = kind(
        actor,
        critic,
        cost_critic,
        num_costs=num_costs,
        num_cost_qvalue_nets=num_cost_qvalue_nets,
        multiplier_init=multiplier_init,
        **{**OWN[kind], **options},
    )
    torch.manual_seed(seed)
    reference = PARENTS[kind](make_actor(kind), make_q_critic(), **{**OWN[kind], **options})
    with torch.no_grad():
        for network in networks(reference):
            pairs = zip(parameters(loss, network), parameters(reference, network), strict=True)
            for ours, theirs in pairs:
                ours.copy_(theirs)
    return finish(loss)


def call(loss, batch, seed=7):
    """Outputs of a loss whose random numbers begin at a seed."""
    torch.manual_seed(seed)
    return loss(batch)


each_loss = pytest.mark.parametrize(
    "kind", [SACLagrangianLoss, TD3LagrangianLoss], ids=["sac", "td3"]
)

# Only these outputs have a gradient, and this is the network each of them trains.
TRAINS = {"loss_actor": "actor", "loss_qvalue": "qvalue", "loss_cost_qvalue": "cost_qvalue"}


def networks_with_gradient(loss):
    def is_reached(p):
        return p.grad is not None and bool(p.grad.any())

    return {name for name in networks(loss) if any(map(is_reached, parameters(loss, name)))}


def assert_same_outputs(actual, expected):
    """Every output of ``expected`` is in ``actual``, bit for bit."""
    for key in list(expected.keys()):  # Items would come wrapped where they are no tensors.
        assert torch.equal(actual[key], expected[key]), key


def make_kind(kind, **options):
    """The losses as functions of their networks, with the networks and the data they need."""
    deterministic = kind is TD3LagrangianLoss
    setting = {
        "make_networks": partial(make_q_networks, deterministic=deterministic),
        # With as few as 12, a minibatch of SAC may hold final states alone, and skip them all.
        "make_data": partial(make_transitions, num_transitions=32),
    }
    makers = (partial(each, **OWN[kind], **options) for each in (kind, PARENTS[kind]))
    return *makers, setting
