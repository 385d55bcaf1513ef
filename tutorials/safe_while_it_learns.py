"""
Safe while it learns
====================

An agent learns to avoid contact by making contact. On a real arm you cannot afford that. You put a
shield between the policy and the motors, train with TorchRL's own PPO, and count collisions:

- Without the shield the arms are in contact for thousands of control steps while they learn.
- With it they hardly ever are, and they learn the task a little later.

Both together take about a minute and a half on one core.
"""

# %%
# One argument
# ------------
#
# ``Shield`` changes an action as little as needed so that the arm can stop before it touches an
# obstacle or the table. It is an argument of the environment, so any algorithm can learn with it.

# sphinx_gallery_thumbnail_number = 1

import matplotlib.pyplot as plt
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.envs import ArmEnv, MuJoCo, Shield
from torchrl_safe.evaluation import evaluate, summarize

torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")


def make_env(shield=None, seed=0):
    arm = ArmEnv(num_envs=32, physics=MuJoCo(), shield=shield, seed=seed)
    return TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


# %%
# What it changes
# ---------------
#
# ``action`` stays what was asked for. ``shield_correction`` tells by how much joint targets were
# changed, in radians. Here all arms are told to go straight ahead, where the obstacle is.

env = make_env(Shield())
ahead = torch.tensor([1.0, 0.0, -0.3]).expand(32, 3)
steps = env.rollout(8, lambda tensordict: tensordict.set("action", ahead))["next"]
for step in range(8):
    correction, cost = steps["shield_correction"][:, step], steps["cost"][:, step]
    print(f"step {step + 1}: corrected by {correction.mean():.3f} rad, in contact {cost.sum():.0f}")

# %%
# Training
# --------
#
# This is TorchRL's PPO loop. Nothing in it knows of costs, or of the shield: the batch holds the
# action that the policy sampled, and what the shield makes of it is part of the environment.

FRAMES, FRAMES_PER_BATCH, GAMMA = 51_200, 1_024, 0.97


class Affine(nn.Module):
    def __init__(self, shift, scale):
        super().__init__()
        self.register_buffer("shift", torch.as_tensor(shift))
        self.register_buffer("scale", torch.as_tensor(scale))

    def forward(self, x):
        return (x - self.shift) * self.scale


def make_networks(env):
    seen = env.rollout(40, break_when_any_done=False)["observation"].flatten(0, 1)
    standardize = Affine(seen.mean(0), 1 / seen.std(0).clamp_min(0.05))

    def network(outputs, *after):
        mlp = MLP(seen.shape[-1], outputs, num_cells=[64, 64], activation_class=nn.Tanh)
        nn.init.orthogonal_(mlp[-1].weight, 0.01)
        return nn.Sequential(standardize, mlp, *after)

    actor = ProbabilisticActor(
        TensorDictModule(
            network(3, AddStateIndependentNormalScale(3)), ["observation"], ["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return actor, ValueOperator(network(1, Affine(0.0, 1 / (1 - GAMMA))), ["observation"])


# %%
# ``summed`` counts every control step of the training in which an arm was in contact.


def train(shield=None):
    torch.manual_seed(0)
    env = make_env(shield)
    actor, critic = make_networks(env)
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False, normalize_advantage=True)
    loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    batches = FRAMES // FRAMES_PER_BATCH
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=batches)
    collector = Collector(
        env,
        actor,
        frames_per_batch=FRAMES_PER_BATCH,
        total_frames=FRAMES,
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(FRAMES_PER_BATCH),
        sampler=SamplerWithoutReplacement(),
        batch_size=256,
    )
    history, summed = [], 0.0
    for batch in collector:
        with torch.no_grad():
            loss.value_estimator(batch)
        buffer.extend(batch.reshape(-1))
        for _ in range(10):  # passes over the batch
            for minibatch in buffer:
                losses = loss(minibatch)
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
                optimizer.step()
                optimizer.zero_grad()
        schedule.step()
        ended = batch["next", "done"].squeeze(-1)
        summed += batch["next", "cost"].sum().item()
        history.append((summed, batch["next", "success"][ended].float().mean().item()))
    return actor, torch.tensor(history)


runs = {"PPO": train(), "PPO with a shield": train(Shield())}

# %%
# Both learn to reach the target. With the shield, the arms are hardly ever in contact on the
# way. `What the shield guarantees <../shield.html#what-it-guarantees>`_ says what is left.

COLOURS = {"PPO": "tab:orange", "PPO with a shield": "tab:green"}
frames = torch.arange(1, FRAMES // FRAMES_PER_BATCH + 1) * FRAMES_PER_BATCH
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
titles = ("control steps in contact, all training", "success")
for column, (axis, title) in enumerate(zip(axes, titles, strict=True)):
    for name, (_, history) in runs.items():
        axis.plot(frames, history[:, column], color=COLOURS[name], label=name)
    axis.set(title=title, xlabel="control steps")
axes[0].legend()
figure.tight_layout()
for name, (_, history) in runs.items():
    print(f"{name}: {history[-1, 0]:.0f} control steps in contact")

# %%
# Take it away
# ------------
#
# The second policy has learnt to rely on the shield. Without the shield, it collides.

actor = runs["PPO with a shield"][0]
for name, shield in {"with its shield": Shield(), "without": None}.items():
    figures = summarize(evaluate(make_env(shield), actor, 128, seed=1_000), ["collision"])
    success, cost = figures["success"][0], figures["cost/collision"][0]
    print(f"{name}: success {success:.0%}, {cost:.2f} steps in contact per episode")

# %%
# Where to go from here
# ---------------------
#
# - Keep the shield on the robot. It works in Gymnasium too: ``gymnasium.make(name, shield=...)``.
# - Or learn to do without it: add ``"correction": ShieldCorrection()`` to the costs, and limit both
#   with ``PPOLagrangianLoss``, as in `several costs, several limits <several_limits.html>`_.
#   ``make train`` does so with ``--algorithms ppo-lagrangian-shield --costs collision 0.5
#   correction 0.06 --physics mujoco``.
# - Train with ``Shield(rate=5)``. How much more slowly does the arm move, and learn?
# - `What the shield guarantees, and what it does not <../shield.html>`_.
