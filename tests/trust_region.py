"""Small policies and batches for trust-region steps."""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
)
from torch import nn
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
)

from torchrl_safe.objectives import (
    CPO,
    PCPO,
    TRPO,
    TrustRegionLoss,
    TrustRegionMethod,
    TrustRegionSolution,
)
from torchrl_safe.testing import (
    ACTION_SIZE,
    OBSERVATION_SIZE,
    make_critic,
)
from torchrl_safe.testing.networks import mlp

MAX_KL = 0.01
BATCH = 128
METHODS = {
    "trpo": TRPO(),
    "cpo": CPO(),
    "pcpo": PCPO(),
    "pcpo-euclid": PCPO(kl_projection=False),
}


def normal_actor(distribution):
    policy = nn.Sequential(mlp(OBSERVATION_SIZE, 2 * ACTION_SIZE), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        return_log_prob=True,
    )


def discrete_actor(distribution):
    return ProbabilisticActor(
        TensorDictModule(mlp(OBSERVATION_SIZE, 3), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=distribution,
        return_log_prob=True,
    )


ACTORS = {
    "normal": lambda: normal_actor(IndependentNormal),
    "tanh-normal": lambda: normal_actor(TanhNormal),
    "categorical": lambda: discrete_actor(Categorical),
    "one-hot": lambda: discrete_actor(OneHotCategorical),
}


def make_loss(num_costs=1, actor="normal", seed=0, **kwargs):
    torch.manual_seed(seed)
    networks = ACTORS[actor](), make_critic(), make_critic("cost_value", num_costs)
    return TrustRegionLoss(*networks, num_costs=num_costs, **{"entropy_bonus": False, **kwargs})


def act(loss, data):
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return loss.actor_network(data)


def make_data(loss, seed=1):
    """A batch by the present actor; what pays, costs too."""
    torch.manual_seed(seed)
    observation = torch.randn(BATCH, OBSERVATION_SIZE)
    data = act(loss, TensorDict(observation=observation, batch_size=[BATCH]))
    action = data["action"].float().reshape(BATCH, -1)
    slope = torch.randn(action.shape[-1], 1)
    advantage = action @ slope + 0.3 * torch.randn(BATCH, 1)
    data["advantage"] = (advantage - advantage.mean()) / advantage.std()
    cost = action @ (slope + 0.5 * torch.randn(action.shape[-1], 3)) + 0.3 * torch.randn(BATCH, 3)
    data["cost_advantage"] = (cost - cost.mean(0))[:, : getattr(loss, "num_costs", 1)]
    data["value_target"] = torch.randn(BATCH, 1)
    data["cost_value_target"] = torch.randn_like(data["cost_advantage"])
    return data


def actor_state(loss):
    return torch.cat([p.detach().flatten() for p in loss.actor_network_params.parameters()])


def critic_state(loss):
    params = loss.critic_network_params, loss.cost_critic_network_params
    return torch.cat([p.detach().flatten() for group in params for p in group.parameters()])


def distribution(loss, data):
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        return loss.actor_network.get_dist(data.clone())


@dataclass(frozen=True)
class Fixed(TrustRegionMethod):
    """A step against, or far beyond, all that is asked of one."""

    scale: float
    constrained = False

    def __call__(self, problem):
        return TrustRegionSolution(self.scale * problem.gradient)
