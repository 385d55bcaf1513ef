"""Training ends where the mathematics of a tiny constrained problem says it must.

One step, two actions: A pays reward 1 at cost 1, B pays nothing and costs nothing. With p the
probability of A, the expected reward is p and the expected cost is p, so under the limit d the
best policy has p = d; nothing else about the problem matters.

Its multiplier is the one at which the policy gradient vanishes at p = d. The observation is
constant, so each critic is one number that drops out when an advantage is centred, and
``estimate_advantages`` leaves

    reward, standardized:   A_r = (1[A] - p) / s   with  s = sqrt(p (1 - p)),
    cost, centred:          A_c = (1[A] - p).

Hence A_r - lambda A_c = (1 / s - lambda) (1[A] - p), which vanishes at p = d for

    lambda = 1 / sqrt(d (1 - d)) = 2.182 at d = 0.3:

one in units of reward per cost, times 1 / s since the reward advantage is standardized.
A second cost, 1 for B, has the limit 0.9 and the mean 1 - d = 0.7: it never binds, so by
complementary slackness its multiplier is 0.
"""

import math
import warnings
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Composite, LazyTensorStorage, OneHot, ReplayBuffer, Unbounded
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator

from torchrl_safe.objectives import DualAscent, PIDControl, PPOLagrangianLoss

with warnings.catch_warnings():  # TorchRL 0.14 deprecates a base class that it still derives from.
    warnings.filterwarnings("ignore", "Creating .* WeightUpdaterBase", DeprecationWarning)
    from torchrl.collectors import Collector

LIMIT = 0.3
ENVS = 512


class TwoActions(EnvBase):
    """Many copies of the problem side by side."""

    def __init__(self):
        super().__init__(batch_size=[ENVS])
        self.observation_spec = Composite(observation=Unbounded((ENVS, 1)), shape=[ENVS])
        self.action_spec = OneHot(2, shape=(ENVS, 2))
        self.reward_spec = Composite(
            reward=Unbounded((ENVS, 1)), cost=Unbounded((ENVS, 2)), shape=[ENVS]
        )

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict(observation=torch.ones(ENVS, 1), batch_size=[ENVS])

    def _step(self, tensordict):
        cost = tensordict["action"].float()
        done = torch.ones(ENVS, 1, dtype=torch.bool)
        return TensorDict(
            observation=torch.ones(ENVS, 1),
            reward=cost[:, :1],
            cost=cost,
            done=done,
            terminated=done,
            batch_size=[ENVS],
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed)


def train(seed, rule, batches):
    """Share of action A and multipliers, batch by batch; without a rule they stay at 0."""
    torch.manual_seed(seed)
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(1, 2), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(nn.Linear(1, 1), in_keys=["observation"])
    cost_critic = ValueOperator(nn.Linear(1, 2), in_keys=["observation"], out_keys=["cost_value"])
    loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, entropy_bonus=False)
    updater = rule(loss, cost_limit=torch.tensor([LIMIT, 0.9])) if rule else None
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    collector = Collector(
        TwoActions(),
        actor,
        frames_per_batch=ENVS,
        total_frames=batches * ENVS,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(ENVS), sampler=SamplerWithoutReplacement(), batch_size=ENVS // 2
    )
    shares, multipliers = [], []
    for batch in collector:
        if updater is not None:
            # Every episode is one step long: its cost is the cost of the step.
            updater.step(batch["next", "cost"][batch["next", "done"].squeeze(-1)])
        buffer.extend(loss.estimate_advantages(batch).reshape(-1))
        for _ in range(2):
            for minibatch in buffer:
                losses = loss(minibatch)
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                optimizer.step()
                optimizer.zero_grad()
        shares.append(batch["action"][..., 0].float().mean())
        multipliers.append(loss.lagrange_multiplier.clone())
    collector.shutdown()
    return torch.stack(shares), torch.stack(multipliers)


RULES = {
    "dual-ascent": partial(DualAscent, lr=1.0),
    "pid": partial(PIDControl, kp=5.0, ki=1.0, kd=5.0, smoothing=0.5),
}


@pytest.fixture(scope="module")
def trained():
    return {name: train(seed=0, rule=rule, batches=240) for name, rule in RULES.items()}


@pytest.mark.parametrize("rule", RULES)
def test_policy_and_multipliers_reach_the_optimum(trained, rule):
    shares, multipliers = trained[rule]
    # Ascent on the multiplier and descent on the policy circle inwards, so the means of the last
    # third are compared; over ten seeds they stayed within half of these tolerances.
    share, multiplier = shares[-80:].mean(), multipliers[-80:].mean(0)
    assert share.item() == pytest.approx(LIMIT, abs=0.02)
    assert multiplier[0].item() == pytest.approx(1 / math.sqrt(LIMIT * (1 - LIMIT)), abs=0.1)
    assert multiplier[1].item() == pytest.approx(0.0, abs=1e-3)


def test_pid_control_damps_the_circling(trained):
    """Against dual ascent with the same integral gain, in the share of action A, here the cost.

    Means (and standard deviations) over ten seeds, dual ascent and PID control: swing below the
    limit 0.235 (0.014) and 0.093 (0.039), and above it again 0.280 (0.038) and 0.064 (0.007);
    excess summed over all batches 12.5 (2.3) and 5.0 (0.9). 512 episodes a batch make 0.02 of
    noise.
    """
    below, above, total = {}, {}, {}
    for name, (shares, _) in trained.items():
        excess = shares - LIMIT
        after = excess[(excess <= 0).int().argmax() :]
        below[name], above[name], total[name] = -after.min(), after.max(), excess.relu().sum()
    for swing in (below, above, total):
        assert swing["pid"] < 0.6 * swing["dual-ascent"]


def test_without_the_multiplier_the_limit_is_exceeded():
    shares, multipliers = train(seed=0, rule=None, batches=60)
    assert shares[-20:].mean() > 0.95
    assert (multipliers == 0).all()
