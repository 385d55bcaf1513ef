"""A tiny constrained problem with a known optimum, and a training loop for it.

One step, two actions: A pays reward 1 at cost 1, B pays nothing and costs nothing. With p the
probability of A, the expected reward is p and the expected cost is p, so under the limit d the
best policy has p = d; nothing else about the problem matters. A second cost, 1 for B, has the
limit 0.9 and the mean 1 - d = 0.7 at the optimum: it never binds there.
"""

import warnings

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Composite, LazyTensorStorage, OneHot, ReplayBuffer, Unbounded
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator

with warnings.catch_warnings():  # TorchRL 0.14 deprecates a base class that it still derives from.
    warnings.filterwarnings("ignore", "Creating .* WeightUpdaterBase", DeprecationWarning)
    from torchrl.collectors import Collector

LIMIT = 0.3
LIMITS = torch.tensor([LIMIT, 0.9])
ENVS = 512


class TwoActions(EnvBase):
    """Many copies of the problem side by side."""

    def __init__(self, num_costs=2):
        super().__init__(batch_size=[ENVS])
        self.num_costs = num_costs
        self.observation_spec = Composite(observation=Unbounded((ENVS, 1)), shape=[ENVS])
        self.action_spec = OneHot(2, shape=(ENVS, 2))
        self.reward_spec = Composite(
            reward=Unbounded((ENVS, 1)), cost=Unbounded((ENVS, num_costs)), shape=[ENVS]
        )

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict(observation=torch.ones(ENVS, 1), batch_size=[ENVS])

    def _step(self, tensordict):
        cost = tensordict["action"].float()
        done = torch.ones(ENVS, 1, dtype=torch.bool)
        return TensorDict(
            observation=torch.ones(ENVS, 1),
            reward=cost[:, :1],
            cost=cost[:, : self.num_costs],
            done=done,
            terminated=done,
            batch_size=[ENVS],
        )

    def _set_seed(self, seed):
        torch.manual_seed(seed)


def make_networks(num_costs=2):
    """Actor, critic and cost critic, each with one number or two to learn."""
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(1, 2), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(nn.Linear(1, 1), in_keys=["observation"])
    cost_critic = ValueOperator(
        nn.Linear(1, num_costs), in_keys=["observation"], out_keys=["cost_value"]
    )
    return actor, critic, cost_critic


def epochs(call, optimizer, buffer, count=2):
    for _ in range(count):
        for minibatch in buffer:
            losses = call(minibatch)
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            optimizer.step()
            optimizer.zero_grad()


def learn(loss, optimizer, buffer):
    """What is done with a batch: two epochs of the loss."""
    epochs(loss, optimizer, buffer)


def train(seed, make_loss, rule, batches, *, learn=learn, read=None, lr=0.1, num_costs=2):
    """Share of action A batch by batch, and what ``read`` reads off the loss after each.

    ``make_loss`` is called with actor, critic and cost critic, ``rule`` with the loss and the
    limits; ``None`` for a rule that nothing moves. ``num_costs=1`` leaves the second cost out.
    """
    torch.manual_seed(seed)
    actor, critic, cost_critic = make_networks(num_costs)
    loss = make_loss(actor, critic, cost_critic)
    updater = rule(loss, cost_limit=LIMITS[:num_costs]) if rule else None
    optimizer = torch.optim.SGD(loss.parameters(), lr=lr)
    collector = Collector(
        TwoActions(num_costs),
        actor,
        frames_per_batch=ENVS,
        total_frames=batches * ENVS,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(ENVS), sampler=SamplerWithoutReplacement(), batch_size=ENVS // 2
    )
    shares, readings = [], []
    for batch in collector:
        if updater is not None:
            # Every episode is one step long: its cost is the cost of the step.
            updater.step(batch["next", "cost"][batch["next", "done"].squeeze(-1)])
        buffer.extend(loss.estimate_advantages(batch).reshape(-1))
        learn(loss, optimizer, buffer)
        shares.append(batch["action"][..., 0].float().mean())
        readings.append(read(loss).clone() if read else torch.tensor(0.0))
    collector.shutdown()
    return torch.stack(shares), torch.stack(readings)
