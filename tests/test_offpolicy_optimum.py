"""Off-policy training ends where the mathematics of a tiny constrained problem says it must.

One step, one action a in [-1, 1]: the reward is -(a - 1)^2, a first cost is a and has the limit
d, a second is 1 - a and has the limit 1.9. Without constraints a = 1 is best. The Lagrangian

    -(a - 1)^2 - lambda (a - d)

has its maximum at a = 1 - lambda / 2, so that a = d with lambda = 2 (1 - d) = 1.4 at d = 0.3; the
second cost is 0.7 then, never binds, and has the multiplier 0.

SAC maximizes that plus alpha times its entropy. The best policy has a density proportional to
exp(-((a - 1)^2 + lambda a) / alpha): a normal one, with the mean above and the variance alpha / 2,
whatever the multiplier is, since the entropy is divided along with the reward. At alpha = 0.02 the
deviation is 0.1, and the bounds are 7 deviations away.
"""

import math
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import (
    Actor,
    AdditiveGaussianModule,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SoftUpdate

from torchrl_safe.objectives import DualAscent, SACLagrangianLoss, TD3LagrangianLoss

pytestmark = pytest.mark.integration

with warnings.catch_warnings():  # TorchRL 0.14 deprecates a base class that it still derives from.
    warnings.filterwarnings("ignore", "Creating .* WeightUpdaterBase", DeprecationWarning)
    from torchrl.collectors import Collector

LIMIT = 0.3
ALPHA = 0.02
ENVS = 64
INPUTS = ["observation", "action"]


class OneStep(EnvBase):
    """Many copies of the problem side by side."""

    def __init__(self):
        super().__init__(batch_size=[ENVS])
        self.observation_spec = Composite(observation=Unbounded((ENVS, 1)), shape=[ENVS])
        self.action_spec = Bounded(-1, 1, (ENVS, 1))
        self.reward_spec = Composite(
            reward=Unbounded((ENVS, 1)), cost=Unbounded((ENVS, 2)), shape=[ENVS]
        )

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict(observation=torch.ones(ENVS, 1), batch_size=[ENVS])

    def _step(self, tensordict):
        action = tensordict["action"]
        done = torch.ones(ENVS, 1, dtype=torch.bool)
        return TensorDict(
            observation=torch.ones(ENVS, 1),
            reward=-(action - 1).square(),
            cost=torch.cat([action, 1 - action], -1),
            done=done,
            terminated=done,
            batch_size=[ENVS],
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed)


class Quadratic(nn.Linear):
    """Critics that can be exact: a + b x + c x^2 in the action x."""

    def __init__(self, num_values):
        super().__init__(2, num_values)

    def forward(self, observation, action):
        return super().forward(torch.cat([action, action.square()], -1))


def make_sac(critics):
    policy = nn.Sequential(nn.Linear(1, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    loss = SACLagrangianLoss(
        actor, *critics, num_costs=2, fixed_alpha=True, alpha_init=ALPHA, target_entropy=0.0
    )
    return loss, actor


def make_td3(critics):
    actor = Actor(nn.Sequential(nn.Linear(1, 1), nn.Tanh()), in_keys=["observation"])
    loss = TD3LagrangianLoss(actor, *critics, num_costs=2, bounds=(-1.0, 1.0))
    noise = AdditiveGaussianModule(
        Bounded(-1, 1, (1,)), sigma_init=0.2, sigma_end=0.2, device="cpu"
    )
    return loss, TensorDictSequential(actor, noise)


MAKERS = {"sac": make_sac, "td3": make_td3}


def train(name, constrained, batches=220):
    """Actions and multipliers, batch by batch; unconstrained, the multipliers stay at 0."""
    torch.manual_seed(0)
    critic = ValueOperator(Quadratic(1), in_keys=INPUTS)
    cost_critic = ValueOperator(Quadratic(2), in_keys=INPUTS, out_keys=["state_action_cost_value"])
    loss, explorer = MAKERS[name]([critic, cost_critic])
    targets = SoftUpdate(loss, tau=0.1)
    updater = DualAscent(loss, cost_limit=torch.tensor([LIMIT, 1.9]), lr=0.1)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.03)
    collector = Collector(
        OneStep(),
        explorer,
        frames_per_batch=ENVS,
        total_frames=batches * ENVS,
        init_random_frames=10 * ENVS,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(batches * ENVS), batch_size=128)
    actions, multipliers = [], []
    for batch in collector:
        if constrained:
            # Every episode is one step long: its cost is the cost of the step.
            updater.step(batch["next", "cost"][batch["next", "done"].squeeze(-1)])
        buffer.extend(batch.reshape(-1))
        for _ in range(2):
            losses = loss(buffer.sample())
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optimizer.step()
            optimizer.zero_grad()
            targets.step()
        actions.append(batch["action"].flatten())
        multipliers.append(loss.lagrange_multiplier.clone())
    collector.shutdown()
    return torch.stack(actions), torch.stack(multipliers)


@pytest.mark.parametrize("name", MAKERS)
def test_policy_and_multipliers_reach_the_optimum(name):
    actions, multipliers = train(name, constrained=True)
    last, multiplier = actions[-60:], multipliers[-60:].mean(0)
    # Over five seeds the mean action stayed within 0.003 and the multiplier within 0.005.
    assert last.mean().item() == pytest.approx(LIMIT, abs=0.02)
    assert multiplier[0].item() == pytest.approx(2 * (1 - LIMIT), abs=0.05)
    assert multiplier[1].item() == 0.0
    if name == "sac":
        assert last.std(1).mean().item() == pytest.approx(math.sqrt(ALPHA / 2), abs=0.01)


@pytest.mark.parametrize("name", MAKERS)
def test_without_the_multiplier_the_limit_is_exceeded(name):
    actions, multipliers = train(name, constrained=False, batches=100)
    assert actions[-20:].mean() > 0.8
    assert (multipliers == 0).all()
