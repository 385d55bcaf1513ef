"""FOCOPS, CUP, P3O, IPO and CRPO on the networks of ``torchrl_safe.testing``."""

from functools import partial

import pytest
import torch
from on_policy import around
from torchrl.objectives import ClipPPOLoss, PPOLoss

from torchrl_safe.objectives import (
    CRPOLoss,
    CUPLoss,
    DualAscent,
    FOCOPSLoss,
    IPOLoss,
    P3OLoss,
    ViolationUpdater,
)
from torchrl_safe.testing import make_actor, make_networks

crpo = around(CRPOLoss, ClipPPOLoss)
# The batch is of another policy, far outside the trust region of FOCOPS.
near = partial(FOCOPSLoss, kl_bound=1.0)
LOSSES = {"focops": near, "cup": CUPLoss, "p3o": P3OLoss, "ipo": IPOLoss, "crpo": crpo}
# As far below their limits as a number can be, so that no method acts.
FAR = -1e30
every_loss = pytest.mark.parametrize("make", LOSSES.values(), ids=LOSSES.keys())


def build(make, num_costs=1, seed=0, **kwargs):
    return make(*make_networks(num_costs, seed=seed), num_costs=num_costs, **kwargs)


def step(loss, violation):
    """Violations or multipliers, whichever the loss reads, by the front door."""
    violation = torch.tensor(violation)
    if "cost_violation" in dict(loss.named_buffers()):
        ViolationUpdater(loss, cost_limit=0.0).step(violation.unsqueeze(0))
    else:
        DualAscent(loss, cost_limit=0.0, lr=1.0).step(violation.unsqueeze(0))


def shift(loss):
    """Moves the policy, as the gradient steps of a phase do."""
    noise = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for name, parameter in loss.named_parameters():
            if name.startswith("actor_network"):
                parameter.add_(0.1 * torch.randn(parameter.shape, generator=noise))


def policy(loss, data):
    """The distribution that the loss's actor gives, with gradients to its parameters."""
    with loss.actor_network_params.to_module(loss.actor_network):
        return loss.actor_network.get_dist(data.select("observation"))


def old_policy(data):
    actor = make_actor()
    return actor.build_dist_from_params(data)


def actor_gradient(loss, value):
    parameters = list(loss.actor_network_params.values(True, True))
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, parameters)])


def parent_of(name, **kwargs):
    actor, critic, _ = make_networks()
    return (PPOLoss if name == "focops" else ClipPPOLoss)(actor, critic, **kwargs)
