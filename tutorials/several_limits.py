"""
Several costs, several limits
=============================

An arm that may not touch the obstacle learns to lift its tool over it. Now there is also a ceiling
that the tool may not pass. You give each cost a name and each name a limit. At the end you see two
paths: over the obstacle with one limit, and around it with two.

Both together take about a minute and a half on one core.
"""

# %%
# Costs by name
# -------------
#
# ``costs`` is a dict. ``cost`` then has a column for each entry, in this order. ``Workspace``
# costs 1 for a control step in which the tool leaves a box. The ceiling is the top of the box.

# sphinx_gallery_thumbnail_number = -1

import matplotlib.pyplot as plt
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe.envs import ArmEnv, Collision, MuJoCo, Region, Workspace
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss

torch.set_num_threads(1)
torch.manual_seed(0)
torchrl_logger.setLevel("WARNING")

CEILING = 0.23  # m
COSTS = {
    "collision": Collision(),
    "ceiling": Workspace(Region(low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, CEILING))),
}


def make_env(num_envs=32, seed=0):
    arm = ArmEnv(costs=COSTS, physics=MuJoCo(), num_envs=num_envs, seed=seed)
    return TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


env = make_env()
rollout = env.rollout(40, break_when_any_done=False)
observations = rollout["observation"].flatten(0, 1)
print("cost", tuple(rollout["next", "cost"].shape))
for name, cost in zip(env.cost_names, rollout["next", "cost"].sum(1).mean(0), strict=True):
    print(f"random actions cost {cost:.1f} of {name} in 40 steps")

# %%
# Networks and loop
# -----------------
#
# Compared with one cost, three lines change. The cost critic has two outputs, the loss has
# ``num_costs=2``, and the rule gets a limit for each name. A name that is missing or misspelt
# raises a ``ValueError``.

GAMMA, FRAMES, FRAMES_PER_BATCH = 0.97, 51_200, 1_024


class Affine(nn.Module):
    def __init__(self, shift, scale):
        super().__init__()
        self.register_buffer("shift", torch.as_tensor(shift))
        self.register_buffer("scale", torch.as_tensor(scale))

    def forward(self, x):
        return (x - self.shift) * self.scale


standardize = Affine(observations.mean(0), 1 / observations.std(0).clamp_min(0.05))


def network(outputs, *after):
    mlp = MLP(observations.shape[-1], outputs, num_cells=[64, 64], activation_class=nn.Tanh)
    nn.init.orthogonal_(mlp[-1].weight, 0.01)
    return nn.Sequential(standardize, mlp, *after)


def train(limits):
    torch.manual_seed(0)
    env = make_env()
    policy = network(3, AddStateIndependentNormalScale(3, init_value=-0.5))
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    mean_of_a_step = Affine(0.0, 1 / (1 - GAMMA))
    critic = ValueOperator(network(1, mean_of_a_step), ["observation"])
    cost_critic = ValueOperator(
        network(len(COSTS), mean_of_a_step), ["observation"], ["cost_value"]
    )
    loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=len(COSTS), entropy_bonus=False)
    loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
    loss.make_cost_value_estimator(gamma=GAMMA, lmbda=0.95)
    updater = PIDControl(loss, cost_limit=limits, cost_names=env.cost_names)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, 1.0, 0.0, total_iters=FRAMES // FRAMES_PER_BATCH
    )
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
    history = []
    for batch in collector:
        episodes = batch["next"][batch["next", "done"].squeeze(-1)]
        updater.step(episodes["episode_cost"])
        buffer.extend(loss.estimate_advantages(batch).reshape(-1))
        for _ in range(10):  # passes over the batch
            for minibatch in buffer:
                losses = loss(minibatch)
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
                optimizer.step()
                optimizer.zero_grad()
        schedule.step()
        history.append(torch.cat([episodes["episode_cost"].mean(0), loss.lagrange_multiplier]))
    return actor, torch.stack(history)


# %%
# An episode has 40 steps, so a limit of 40 never binds. The first run limits collisions only.

LIMITS = {
    "one limit": {"collision": 0.5, "ceiling": 40.0},
    "two limits": {"collision": 0.5, "ceiling": 0.5},
}
runs = {name: train(limits) for name, limits in LIMITS.items()}

# %%
# A multiplier for each
# ---------------------
#
# Each cost has a multiplier of its own. It rises when its limit is exceeded. One that ends at 0
# belongs to a limit that does not bind.

COLOURS = {"one limit": "tab:orange", "two limits": "tab:blue"}
frames = FRAMES_PER_BATCH * torch.arange(1, FRAMES // FRAMES_PER_BATCH + 1)
titles = [f"cost: {name}" for name in COSTS] + [f"multiplier: {name}" for name in COSTS]
figure, axes = plt.subplots(1, 4, figsize=(13, 3))
for column, (axis, title) in enumerate(zip(axes, titles, strict=True)):
    for name, (_, history) in runs.items():
        axis.plot(frames, history[:, column], color=COLOURS[name], label=name)
    axis.set(title=title, xlabel="control steps")
for axis in axes[:2]:
    axis.axhline(0.5, color="black", ls="--", lw=1)
axes[0].legend()
figure.tight_layout()

# %%
# Without exploration, in worlds that training has not seen:

for name, (actor, _) in runs.items():
    print(name)
    figures = summarize(evaluate(make_env(), actor, 128, seed=1_000), list(COSTS))
    for key, (mean, low, high) in figures.items():
        print(f"    {key:16}{mean:6.2f}   [{low:.2f}, {high:.2f}]")

# %%
# Look at it
# ----------
#
# The paths of the tool in sixteen worlds, from the side and from above. With one limit it goes
# over the obstacle. With two it stays below the ceiling and goes round.


@torch.no_grad()
def paths_of(actor):
    stage = make_env(num_envs=16, seed=1_000)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        episodes = stage.rollout(40, actor, break_when_any_done=False)
    place = episodes["observation"][..., stage.base_env.observation_fields["ee_position"]]
    stage.close()
    steps = episodes["next", "done"].squeeze(-1).int().argmax(1)
    return [path[: last + 1] for path, last in zip(place, steps, strict=True)]


figure, (side, above) = plt.subplots(1, 2, figsize=(11, 3.6))
for name, (actor, _) in runs.items():
    for path in paths_of(actor):
        x, y, z = path.T
        side.plot(x, z, color=COLOURS[name], lw=1, alpha=0.7)
        above.plot(x, y, color=COLOURS[name], lw=1, alpha=0.7)
    above.plot([], [], color=COLOURS[name], label=name)
side.axhline(CEILING, color="tab:red", lw=1)
side.text(0.36, CEILING, "ceiling", color="tab:red", va="bottom")
side.set(xlabel="x, m", ylabel="height, m", title="from the side")
above.set(xlabel="x, m", ylabel="y, m", title="from above")
above.legend()
figure.tight_layout()

# %%
# Where to go from here
# ---------------------
#
# - Lower the ceiling to 0.21 m, or add ``"speed": Speed(limit=1.0)``. Two limits that exclude
#   each other cannot both be kept: both multipliers then stay at their bound of 20.
# - Train longer: ``FRAMES = 128_000``.
# - Logs by name in TensorBoard: `Keep several limits at once <../howto/several_limits.html>`_.
# - `The multiplier explodes <../howto/multiplier_explodes.html>`_.
# - Reference: `costs <../reference/costs.html>`_, `rules <../reference/rules.html>`_.
