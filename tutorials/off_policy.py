"""
Off-policy: SAC-Lagrangian with a replay buffer
===============================================

Where steps are expensive, you want to learn from each of them more than once. You train SAC under a
limit on collisions, from a replay buffer of TorchRL. At the end the arm has learnt to reach its
target, and you see the multiplier bring the cost down to its limit.

It takes about two minutes on one core. The settings were tried on this seed; SAC varies more from
seed to seed and from processor to processor than PPO does.
"""

# %%
# The environment
# ---------------
#
# A Panda, with an obstacle in its way and a cost for touching it. SAC needs bounded actions, which
# those of ``ArmEnv`` are by default.

import matplotlib.pyplot as plt
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate, ValueEstimators

from torchrl_safe.envs import ArmEnv, Collision, MuJoCo
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.objectives import PIDControl, SACLagrangianLoss

torch.manual_seed(0)
torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")

GAMMA, COST_LIMIT = 0.97, 0.5


def make_env():
    arm = ArmEnv(costs={"collision": Collision()}, physics=MuJoCo(), num_envs=32, seed=0)
    return TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


env = make_env()
observation = env.rollout(40, break_when_any_done=False)["observation"].flatten(0, 1)
mean, std = observation.mean(0), observation.std(0).clamp_min(0.05)
width, actions = observation.shape[-1], env.action_spec.shape[-1]

# %%
# Critics of state and action
# ---------------------------
#
# The actor chooses mean and deviation in every state. The critics read the action too: one
# predicts the reward, one the costs, with an output for each. The loss trains two copies of
# each. It uses the smaller reward prediction and the larger cost prediction.


class Network(nn.Module):
    """An MLP of standardized observations, and of actions if given."""

    def __init__(self, inputs, outputs, unit=1.0):
        super().__init__()
        self.mlp = MLP(inputs, outputs, num_cells=[64, 64], activation_class=nn.Tanh)
        self.unit = unit

    def forward(self, observation, *action):
        return self.unit * self.mlp((observation - mean) / std, *action)


policy = nn.Sequential(Network(width, 2 * actions), NormalParamExtractor())
actor = ProbabilisticActor(
    TensorDictModule(policy, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
)
state_and_action, unit = ["observation", "action"], 1 / (1 - GAMMA)
critic = ValueOperator(Network(width + actions, 1, unit), state_and_action)
cost_critic = ValueOperator(
    Network(width + actions, 1, unit), state_and_action, ["state_action_cost_value"]
)

# %%
# Loss, rule, targets, buffer
# ---------------------------
#
# ``SACLagrangianLoss`` is TorchRL's ``SACLoss`` with limits. It compares values, not standardized
# advantages, so here the multiplier has a unit: reward per cost. An episode earns about -2 if it
# succeeds and -8 if it does not (metres times steps), so a contact may cost about 1. The gains of
# the rule have the same unit. Its proportional gain and its bound are smaller than the defaults: in
# a run as short as this one, the price of a contact would soon exceed everything there is to earn.
# The entropy bonus starts small for the same reason.

loss = SACLagrangianLoss(
    actor, critic, cost_critic, action_spec=env.action_spec_unbatched, alpha_init=0.05
)
loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
loss.make_cost_value_estimator(gamma=GAMMA)
updater = PIDControl(loss, cost_limit=COST_LIMIT, kp=0.3, max_multiplier=2.0)
targets = SoftUpdate(loss, tau=0.01)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

FRAMES, FRAMES_PER_BATCH, STEPS_PER_UPDATE = 61_440, 1_280, 8
schedule = torch.optim.lr_scheduler.LinearLR(
    optimizer, 1.0, 0.1, total_iters=FRAMES // FRAMES_PER_BATCH
)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(FRAMES), batch_size=128)
collector = Collector(
    env,
    actor,
    frames_per_batch=FRAMES_PER_BATCH,
    total_frames=FRAMES,
    auto_register_policy_transforms=False,
)

# %%
# The loop
# --------
#
# The rule still moves once for each collected batch, by the costs of the episodes that ended in
# it. A minibatch from the buffer would tell it about old policies. Then there is a gradient step
# for every eight steps of the arms.

history = []
for batch in collector:
    episodes = batch["next"][batch["next", "done"].squeeze(-1)]
    updater.step(episodes["episode_cost"])
    buffer.extend(batch.reshape(-1))
    for _ in range(FRAMES_PER_BATCH // STEPS_PER_UPDATE):
        losses = loss(buffer.sample())
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        targets.step()
    schedule.step()
    success, cost = episodes["success"].float().mean(), episodes["episode_cost"].mean()
    history.append((success, cost, loss.lagrange_multiplier.item()))
    if len(history) % 3 == 0:
        print(f"success {success:4.0%}   cost {cost:.2f}   multiplier {history[-1][2]:.2f}")

# %%
# What happened
# -------------

frames = FRAMES_PER_BATCH * torch.arange(1, len(history) + 1)
titles = ("success", "cost: control steps in contact", "multiplier")
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2))
for axis, values, title in zip(axes, torch.tensor(history).T, titles, strict=True):
    axis.plot(frames, values, color="tab:green")
    axis.set(title=title, xlabel="control steps")
axes[1].axhline(COST_LIMIT, color="black", ls="--", lw=1)
axes[1].text(1.01, COST_LIMIT, "limit", va="center", transform=axes[1].get_yaxis_transform())
figure.tight_layout()

# %%
# The deterministic policy, in worlds that training has not seen:

episodes = evaluate(make_env(), actor, 128, seed=1_000)
for name, (middle, low, high) in summarize(episodes, ["collision"]).items():
    print(f"{name:16} {middle:6.2f}   [{low:.2f}, {high:.2f}]")

# %%
# Where to go from here
# ---------------------
#
# - Train longer, with ``FRAMES = 128_000``, or learn more from each step, with
#   ``STEPS_PER_UPDATE = 4``: each takes about four minutes.
# - Sum rewards and costs over n steps in the buffer: `Repeated actions and n-step sums
#   <../environments.html>`_.
# - `SAC-Lagrangian <../algorithms/sac_lagrangian.html>`_, `TD3-Lagrangian
#   <../algorithms/td3_lagrangian.html>`_: equations and arguments.
# - Reference: `off-policy losses <../reference/off_policy.html>`_.
