"""Off-policy losses with tiny networks, beside their parents, and a batch for them."""

import torch
from networks import ACTION, OBSERVATION, mlp
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.modules import Actor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

from torchrl_safe.objectives import SACLagrangianLoss, TD3LagrangianLoss

PARENTS = {SACLagrangianLoss: SACLoss, TD3LagrangianLoss: TD3Loss}
OWN = {SACLagrangianLoss: {"target_entropy": -2.0}, TD3LagrangianLoss: {"bounds": (-1.0, 1.0)}}


class QValue(nn.Module):
    """Values of an observation and an action."""

    def __init__(self, num_values=1):
        super().__init__()
        self.body = mlp(OBSERVATION + ACTION, num_values)

    def forward(self, observation, action):
        return self.body(torch.cat([observation, action], -1))


def make_critic(num_values=1, key="state_action_value", action="action"):
    return ValueOperator(QValue(num_values), in_keys=["observation", action], out_keys=[key])


def make_cost_critic(num_costs=1, key="state_action_cost_value", action="action"):
    return make_critic(num_costs, key, action)


def make_actor(kind, action="action"):
    if kind is TD3LagrangianLoss:
        policy = nn.Sequential(mlp(OBSERVATION, ACTION), nn.Tanh())
        return Actor(policy, in_keys=["observation"], out_keys=[action])
    policy = nn.Sequential(mlp(OBSERVATION, 2 * ACTION), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


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
    return finish(PARENTS[kind](make_actor(kind), make_critic(), **{**OWN[kind], **options}))


def make_loss(kind, num_costs=1, seed=0, num_cost_qvalue_nets=2, multiplier_init=0.0, **options):
    """A loss whose actor and reward critics are those of the parent with this seed."""
    torch.manual_seed(seed)
    actor, critic, cost_critic = make_actor(kind), make_critic(), make_cost_critic(num_costs)
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
    reference = PARENTS[kind](make_actor(kind), make_critic(), **{**OWN[kind], **options})
    with torch.no_grad():
        for network in networks(reference):
            pairs = zip(parameters(loss, network), parameters(reference, network), strict=True)
            for ours, theirs in pairs:
                ours.copy_(theirs)
    return finish(loss)


def make_batch(num_costs=1, rows=12, seed=1):
    """Transitions: every fourth terminates, every fourth is truncated, the others go on."""
    torch.manual_seed(seed)
    index = torch.arange(rows).unsqueeze(-1)
    terminated, truncated = index % 4 == 1, index % 4 == 2
    return TensorDict(
        observation=torch.randn(rows, OBSERVATION),
        action=torch.rand(rows, ACTION) * 2 - 1,
        next=TensorDict(
            observation=torch.randn(rows, OBSERVATION),
            reward=torch.randn(rows, 1),
            cost=torch.rand(rows, num_costs) * torch.arange(1, num_costs + 1),
            done=terminated | truncated,
            terminated=terminated,
            truncated=truncated,
            batch_size=[rows],
        ),
        batch_size=[rows],
    )


def call(loss, batch, seed=7):
    """Outputs of a loss whose random numbers begin at a seed."""
    torch.manual_seed(seed)
    return loss(batch)
