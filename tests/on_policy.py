"""PPO-Lagrangian losses on the networks of ``torchrl_safe.testing``, and what tests ask of them."""

from functools import partial

import pytest
import torch
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss, PPOLoss, ReinforceLoss

from torchrl_safe.objectives import (
    CRPOLoss,
    CUPLoss,
    FOCOPSLoss,
    IPOLoss,
    LagrangianLoss,
    P3OLoss,
    PPOLagrangianLoss,
    TrustRegionLoss,
)
from torchrl_safe.testing import OBSERVATION_SIZE, make_batch, make_critic, make_networks
from torchrl_safe.testing.networks import mlp

NETWORKS = ("actor", "critic", "cost_critic")
# Only these outputs have a gradient, and this is the network each of them trains.
TRAINS = {
    "loss_objective": "actor",
    "loss_entropy": "actor",
    "loss_critic": "critic",
    "loss_cost_critic": "cost_critic",
}


def make_loss(num_costs=1, seed=0, **kwargs):
    networks = make_networks(num_costs, seed=seed)
    return PPOLagrangianLoss(*networks, num_costs=num_costs, **kwargs)


class Heads(nn.Module):
    """A normal head and a categorical one."""

    def __init__(self):
        super().__init__()
        self.body = mlp(OBSERVATION_SIZE, 5)

    def forward(self, observation):
        out = self.body(observation)
        return out[..., :1], out[..., 1:2].exp(), out[..., 2:]


def make_composite(num_costs):
    """Actor with a continuous and a discrete head, the critics, and a batch."""
    torch.manual_seed(0)
    params = [("params", "move", "loc"), ("params", "move", "scale"), ("params", "grip", "logits")]
    actor = ProbabilisticActor(
        TensorDictModule(Heads(), ["observation"], params),
        in_keys=["params"],
        out_keys=["move", "grip"],
        distribution_class=partial(
            CompositeDistribution,
            distribution_map={
                "move": IndependentNormal,
                "grip": torch.distributions.Categorical,
            },
        ),
        return_log_prob=True,
    )
    batch = make_batch(num_costs).exclude("action", "action_log_prob", "loc", "scale")
    with torch.no_grad():
        actor(batch)
        for key in ("move_log_prob", "grip_log_prob"):  # As of an older policy.
            batch[key] = batch[key] + 0.2 * torch.randn_like(batch[key])
    return actor, make_critic(), make_critic("cost_value", num_costs), batch


def make_trunk(num_costs):
    """Three networks that share their first layer, and that layer."""
    torch.manual_seed(0)
    trunk = TensorDictModule(nn.Linear(OBSERVATION_SIZE, 8), ["observation"], ["hidden"])
    policy = nn.Sequential(nn.Linear(8, 4), NormalParamExtractor())
    head = ProbabilisticActor(
        TensorDictModule(policy, ["hidden"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = TensorDictSequential(trunk, ValueOperator(nn.Linear(8, 1), in_keys=["hidden"]))
    cost_critic = TensorDictSequential(
        trunk, ValueOperator(nn.Linear(8, num_costs), in_keys=["hidden"], out_keys=["cost_value"])
    )
    return (ProbabilisticTensorDictSequential(trunk, *head), critic, cost_critic), trunk.module


def around(kind, parent):
    """A loss around another one, as a function of the networks; most options are the parent's."""

    def make(actor, critic, cost_critic, **options):
        own = {name: options.pop(name) for name in ("num_costs", "tolerance") if name in options}
        return kind(parent(actor, critic, **options), cost_critic, **own)

    return make


# What constrains each loss: its multipliers.
BY_MULTIPLIER = {
    "ppo-lagrangian": PPOLagrangianLoss,
    "a2c": around(LagrangianLoss, A2CLoss),
    "reinforce": around(LagrangianLoss, ReinforceLoss),
    "ppo": around(LagrangianLoss, PPOLoss),
    "kl-ppo": around(LagrangianLoss, KLPENPPOLoss),
    # The batch is of another policy, far outside the trust region of FOCOPS.
    "focops": partial(FOCOPSLoss, kl_bound=1.0),
    "trust-region": TrustRegionLoss,
}
# These have no multipliers.
BY_VIOLATION = {
    "p3o": P3OLoss,
    "ipo": IPOLoss,
    "crpo": around(CRPOLoss, ClipPPOLoss),
}


def parameters(loss, network):
    if loss.functional:
        return list(getattr(loss, f"{network}_network_params").values(True, True))
    return list(getattr(loss, f"{network}_network").parameters())


def networks_with_gradient(loss):
    def is_reached(p):
        return p.grad is not None and bool(p.grad.any())

    return {name for name in NETWORKS if any(map(is_reached, parameters(loss, name)))}


def assert_same_outputs(actual, expected):
    """Every output of ``expected`` is in ``actual``, bit for bit."""
    for key, value in expected.items():
        assert torch.equal(actual[key], value), key


def assert_close_outputs(actual, expected):
    assert set(actual.keys()) == set(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(actual[key], value, msg=lambda text, key=key: f"{key}: {text}")


def total(losses):
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def train(loss, data, updates=20):
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    order = torch.Generator().manual_seed(3)
    for _ in range(updates):
        minibatch = data[torch.randperm(len(data), generator=order)[:8]]
        total(loss(minibatch)).backward()
        optimizer.step()
        optimizer.zero_grad()


def estimated(loss, num_costs=1, seed=1):
    """A flat batch with both advantages."""
    return loss.estimate_advantages(make_batch(num_costs, seed=seed)).reshape(-1)


SUBCLASSES = {
    "ppo-lagrangian": (PPOLagrangianLoss, ClipPPOLoss),
    "focops": (partial(FOCOPSLoss, kl_bound=float("inf"), temperature=1.0), PPOLoss),
    "cup": (CUPLoss, ClipPPOLoss),
    "p3o": (P3OLoss, ClipPPOLoss),
    "ipo": (IPOLoss, ClipPPOLoss),
    "trust-region": (TrustRegionLoss, PPOLoss),
    "lagrangian-clip-ppo": (around(LagrangianLoss, ClipPPOLoss), ClipPPOLoss),
    "lagrangian-kl-ppo": (around(LagrangianLoss, KLPENPPOLoss), KLPENPPOLoss),
    "crpo-clip-ppo": (around(CRPOLoss, ClipPPOLoss), ClipPPOLoss),
}

# These evaluate their policy on a copy of their own: the trunk is evaluated once more.
OTHERS = {
    "lagrangian-a2c": (around(LagrangianLoss, A2CLoss), A2CLoss),
    "lagrangian-reinforce": (around(LagrangianLoss, ReinforceLoss), ReinforceLoss),
    "crpo-a2c": (around(CRPOLoss, A2CLoss), A2CLoss),
}

every_loss = pytest.mark.parametrize(
    "make", [make for make, _ in SUBCLASSES.values()], ids=SUBCLASSES
)

all_losses = pytest.mark.parametrize(
    "make", [make for make, _ in {**SUBCLASSES, **OTHERS}.values()], ids=[*SUBCLASSES, *OTHERS]
)


def free(loss):
    """Moves a loss as far from its limits as a number can be."""
    if "cost_violation" in dict(loss.named_buffers()):
        loss.cost_violation.fill_(-1e30)
