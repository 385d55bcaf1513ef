"""
A loop of your own, step by step
================================

You build a constrained training loop piece by piece, and look at every tensor that goes through it:
what the environment reports, what the loss reads, what moves the multiplier. At the end the loop
trains an arm within its limit, and you see cost and multiplier answer each other.

Come here when you want to put limits into a loop that you already have. It takes about a minute.
"""

# %%
# 1. An environment with a cost
# -----------------------------
#
# ``ArmEnv`` simulates 32 arms side by side. An action moves the tool by up to 5 cm along x, y, z.

import matplotlib.pyplot as plt
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe.envs import ArmEnv, Collision, MuJoCo
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss

torch.manual_seed(0)
torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")


def make_arm():
    costs = {"collision": Collision()}
    return ArmEnv(costs=costs, physics=MuJoCo(), num_envs=32, seed=0)


arm = make_arm()
print({key: tuple(spec.shape) for key, spec in arm.reward_spec.items()})

# %%
# The cost is a second reward, with one column for each cost. You find both under ``"next"``:

rollout = arm.rollout(40, break_when_any_done=False)
print("reward", tuple(rollout["next", "reward"].shape))
print("cost  ", tuple(rollout["next", "cost"].shape), "of", arm.cost_names)
print("steps in contact:", int(rollout["next", "cost"].sum()), "of", 32 * 40)

# %%
# 2. Costs of whole episodes
# --------------------------
#
# A limit is about the cost of an episode, so you have to add up. ``RewardSum`` does that for
# rewards, and a cost is one. Where ``done`` is true, the sum is that of the whole episode:

env = TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))
rollout = env.rollout(80, break_when_any_done=False)
ended = rollout["next", "done"].squeeze(-1)
episode_cost = rollout["next", "episode_cost"][ended]
print(int(ended.sum()), "episodes ended, mean cost", round(episode_cost.mean().item(), 2))

# %%
# 3. Actor and critics
# --------------------
#
# The actor is that of any PPO. Beside the critic of the reward there is one of the costs, with an
# output for each. Two details make them learn faster. All networks standardize observations with
# the statistics of the random rollout above, because goals differ by centimetres and velocities by
# metres a second. And the critics predict the mean of a step; a value is about ``1 / (1 - GAMMA)``
# times as much.

observations = rollout["observation"].flatten(0, 1)
GAMMA = 0.97


class Affine(nn.Module):
    def __init__(self, shift, scale):
        super().__init__()
        self.register_buffer("shift", torch.as_tensor(shift))
        self.register_buffer("scale", torch.as_tensor(scale))

    def forward(self, x):
        return (x - self.shift) * self.scale


standardize = Affine(observations.mean(0), 1 / observations.std(0).clamp_min(0.05))
mean_of_a_step = Affine(0.0, 1 / (1 - GAMMA))


def network(outputs, *after):
    mlp = MLP(observations.shape[-1], outputs, num_cells=[64, 64], activation_class=nn.Tanh)
    nn.init.orthogonal_(mlp[-1].weight, 0.01)  # Nearly the same everywhere to start with.
    return nn.Sequential(standardize, mlp, *after)


# %%
# ``return_log_prob`` makes the actor note how probable an action was. PPO needs that later.

actions = env.action_spec.shape[-1]
policy = network(actions, AddStateIndependentNormalScale(actions))
actor = ProbabilisticActor(
    TensorDictModule(policy, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
num_costs = len(arm.cost_names)
critic = ValueOperator(network(1, mean_of_a_step), ["observation"])
cost_critic = ValueOperator(network(num_costs, mean_of_a_step), ["observation"], ["cost_value"])
with torch.no_grad():
    print(cost_critic(critic(actor(env.reset()))).select("action", "state_value", "cost_value"))

# %%
# 4. Loss and rule
# ----------------
#
# The loss is ``ClipPPOLoss`` with limits. The multiplier is a buffer of the loss: it is saved
# with it, and no optimizer touches it. The rule writes into it.
#
# A discount of 0.97 suits episodes of about 40 steps. Reward and cost may have different ones.
# The limit itself is never discounted.

loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
loss.make_cost_value_estimator(gamma=GAMMA, lmbda=0.95)
updater = PIDControl(loss, cost_limit=0.5)
print("multiplier", loss.lagrange_multiplier)

# %%
# 5. One batch, slowly
# --------------------
#
# A collector plays the policy. In a batch of 1,280 steps some episodes end:

FRAMES, FRAMES_PER_BATCH = 46_080, 1_280
collector = Collector(
    env,
    actor,
    frames_per_batch=FRAMES_PER_BATCH,
    total_frames=FRAMES,
    auto_register_policy_transforms=False,
)
batches = iter(collector)
batch = next(batches)
ended = batch["next", "done"].squeeze(-1)
episode_cost = batch["next", "episode_cost"][ended]
print("batch", tuple(batch.shape), "costs of", tuple(episode_cost.shape), "episodes and costs")

# %%
# **The rule first.** It gets the costs of the episodes that ended, not those of all steps. It
# adds two standard errors to their mean, and compares that with the limit:

updater.step(episode_cost)
print(
    f"mean cost {episode_cost.mean():.2f}, limit 0.5, multiplier {loss.lagrange_multiplier[0]:.2f}"
)

# %%
# **Then the advantages**, of reward and cost, over the whole batch and before it is cut into
# minibatches. Both have the same size at first, and a multiplier of 1 then weighs both alike:

batch = loss.estimate_advantages(batch)
for key in ("advantage", "cost_advantage", "value_target", "cost_value_target"):
    values = batch[key]
    print(f"{key:18} mean {values.mean():6.2f}, deviation {values.std():5.2f}")

# %%
# **Then the loss**, on a minibatch. Each ``loss_`` output trains one network; the others are for
# your logger:

for key, value in loss(batch.reshape(-1)[:256]).items():
    print(f"{key:28} {value.item():8.4f}")

# %%
# 6. The loop
# -----------
#
# The same for every batch, some passes over each. Two lines make it robust. A learning rate that
# falls to 0 lets the policy settle. The gradient of the policy is clipped, and
# ``error_if_nonfinite`` stops the run before a NaN is in its weights. Clip the policy alone: the
# gradients of the critics are larger, and would take up the whole norm.

optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
schedule = torch.optim.lr_scheduler.LinearLR(
    optimizer, 1.0, 0.0, total_iters=FRAMES // FRAMES_PER_BATCH
)
buffer = TensorDictReplayBuffer(
    storage=LazyTensorStorage(FRAMES_PER_BATCH),
    sampler=SamplerWithoutReplacement(),
    batch_size=256,
)
history = []
for batch in batches:
    episodes = batch["next"][batch["next", "done"].squeeze(-1)]
    updater.step(episodes["episode_cost"])
    buffer.extend(loss.estimate_advantages(batch).reshape(-1))
    for _ in range(10):  # passes over the batch
        for minibatch in buffer:
            losses = loss(minibatch)
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            nn.utils.clip_grad_norm_(actor.parameters(), 0.5, error_if_nonfinite=True)
            optimizer.step()
            optimizer.zero_grad()
    schedule.step()
    success = episodes["success"].float().mean().item()
    cost, multiplier = episodes["episode_cost"].mean().item(), loss.lagrange_multiplier.item()
    history.append((success, cost, multiplier))
    if len(history) % 5 == 0:
        print(f"success {success:4.0%}   cost {cost:.2f}   multiplier {multiplier:.2f}")

# %%
# 7. What happened
# ----------------
#
# The multiplier goes up at first, when the cost is above the limit, and comes down with the cost.
# What is left of it is the price at which the policy keeps the limit.

success, cost, multiplier = torch.tensor(history).T
frames = FRAMES_PER_BATCH * torch.arange(2, len(history) + 2)
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2))
for axis, values, title in zip(
    axes,
    (success, cost, multiplier),
    ("success", "cost: control steps in contact", "multiplier"),
    strict=True,
):
    axis.plot(frames, values, color="tab:blue")
    axis.set(title=title, xlabel="control steps")
axes[1].axhline(0.5, color="black", ls="--", lw=1)
axes[1].text(1.01, 0.5, "limit", va="center", transform=axes[1].get_yaxis_transform())
figure.tight_layout()

# %%
# And without the noise of exploration, in worlds that training has not seen. (The collector has
# closed its environment after the last frame, so this is another one.)

episodes = evaluate(make_arm(), actor, 128, seed=1_000)
for name, (mean, low, high) in summarize(episodes, arm.cost_names).items():
    print(f"{name:16} {mean:6.2f}   [{low:.2f}, {high:.2f}]")

# %%
# Where to go from here
# ---------------------
#
# - Turn joints instead: ``action=JointDelta()``. That takes about 64,000 steps.
# - Put the loss into your loop: ``LagrangianLoss`` wraps A2C, REINFORCE, PPO and its variants:
#   `all algorithms <../algorithms.html>`_.
# - Stop and resume such a run, bit for bit: `when something breaks <../robustness.html>`_.
# - TorchRL's trainers write the loop for you: `with TorchRL's trainers <../trainers.html>`_.
# - The multiplier does something strange? `What it tells you <../background/multiplier.html>`_,
#   `the multiplier explodes <../howto/multiplier_explodes.html>`_.
# - Reference: `losses <../reference/on_policy.html>`_, `rules <../reference/rules.html>`_,
#   `transforms <../reference/transforms.html>`_.
