"""
The first safe policy
=====================

A robot arm has to reach a target behind an obstacle. The shortest way leads through the obstacle,
so an agent that sees only the reward learns to hit it. You train that agent, then one with a limit
on its collisions, and film both. You will see that

- PPO reaches the target in every episode, and touches the obstacle in nearly every one.
- PPO-Lagrangian reaches it too, within a limit of 0.5 control steps in contact per episode.

Both together take about a minute and a half on one core.
"""

# %%
# The environment
# ---------------
#
# An ``ArmEnv`` is put together from an arm, actions, a task, obstacles, costs and a physics
# engine. Costs and engine are given here. The rest are defaults: a Panda that moves its tool by
# up to 5 cm in each step, a target to reach, one obstacle in front of it. ``num_envs`` worlds run
# side by side.
#
# ``cost`` is a second reward. TorchRL's ``RewardSum`` adds up both over an episode.

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

from torchrl_safe.envs import ArmEnv, Bullet, Camera, Collision, MuJoCo
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss

torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")


def make_env(num_envs=32, seed=0, engine=MuJoCo):
    costs = {"collision": Collision()}
    arm = ArmEnv(costs=costs, num_envs=num_envs, physics=engine(), seed=seed)
    return TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


env = make_env()
print(env.rollout(3)["next"].select("observation", "reward", "cost", "success", "done"))

# %%
# The networks
# ------------
#
# There are three: a policy, a critic of the reward, and a critic of the costs with one output for
# each cost. Two details make them learn faster:
#
# - Goals differ by centimetres, which a small network that is given metres hardly sees. So each
#   network first standardizes its input, by what random actions bring about.
# - Values are sums over some 30 steps. So the critics predict the mean of a step, and multiply.

GAMMA = 0.97


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
    actions = env.action_spec.shape[-1]

    def network(outputs, *after):
        mlp = MLP(seen.shape[-1], outputs, num_cells=[64, 64], activation_class=nn.Tanh)
        nn.init.orthogonal_(mlp[-1].weight, 0.01)  # Nearly the same everywhere to start with.
        return nn.Sequential(standardize, mlp, *after)

    policy = network(actions, AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    mean_of_a_step = Affine(0.0, 1 / (1 - GAMMA))
    critic = ValueOperator(network(1, mean_of_a_step), ["observation"])
    cost_critic = ValueOperator(network(1, mean_of_a_step), ["observation"], ["cost_value"])
    return actor, critic, cost_critic


# %%
# Training
# --------
#
# This is TorchRL's PPO loop. Three lines are about costs:
#
# - ``PPOLagrangianLoss`` takes the place of ``ClipPPOLoss``. Its multiplier is the price of a
#   cost.
# - ``PIDControl`` moves the multiplier once for each batch, by how far the mean cost of the
#   episodes that ended is from the limit. It needs a limit and no rate.
# - ``estimate_advantages`` estimates the advantages of reward and cost.
#
# Without a limit the multiplier stays at 0, and the loss is TorchRL's, bit for bit.

FRAMES, FRAMES_PER_BATCH = 51_200, 1_024


def train(cost_limit=None):
    torch.manual_seed(0)
    env = make_env()
    actor, critic, cost_critic = make_networks(env)
    loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
    loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
    loss.make_cost_value_estimator(gamma=GAMMA, lmbda=0.95)
    updater = None if cost_limit is None else PIDControl(loss, cost_limit=cost_limit)
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
    history = []
    for batch in collector:
        episodes = batch["next"][batch["next", "done"].squeeze(-1)]
        if updater is not None:
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
        cost, success = episodes["episode_cost"], episodes["success"].float()
        history.append((success.mean(), cost.mean(), loss.lagrange_multiplier.item()))
    return actor, torch.tensor(history)


COST_LIMIT = 0.5
runs = {"PPO": train(), "PPO-Lagrangian": train(COST_LIMIT)}

# %%
# Both learn to reach the target. Only one learns to do so without contact. Its multiplier
# rises when the limit is exceeded and settles when it is kept.

COLOURS = {"PPO": "tab:orange", "PPO-Lagrangian": "tab:blue"}
frames = torch.arange(1, FRAMES // FRAMES_PER_BATCH + 1) * FRAMES_PER_BATCH
titles = ("success", "cost: control steps in contact", "multiplier")
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2))
for column, (axis, title) in enumerate(zip(axes, titles, strict=True)):
    for name, (_, history) in runs.items():
        axis.plot(frames, history[:, column], color=COLOURS[name], label=name)
    axis.set(title=title, xlabel="control steps")
axes[1].axhline(COST_LIMIT, color="black", ls="--", lw=1)
axes[1].text(1.01, COST_LIMIT, "limit", va="center", transform=axes[1].get_yaxis_transform())
axes[0].legend()
figure.tight_layout()

# %%
# Evaluation
# ----------
#
# While it learns, a policy explores. What counts is the policy without noise. ``evaluate`` plays
# whole episodes with it, in worlds that training has not seen, and ``summarize`` adds 95 %
# intervals.

for name, (actor, _) in runs.items():
    figures = summarize(evaluate(make_env(), actor, 128, seed=1_000), ["collision"])
    print(f"{name}:")
    for figure_of, (mean, low, high) in figures.items():
        print(f"    {figure_of:14} {mean:6.2f}   [{low:.2f}, {high:.2f}]")

# %%
# Look at it
# ----------
#
# Each row is an episode of the same world, the one of eight in which PPO touches the obstacle for
# longest. The policies were trained in MuJoCo. They play in PyBullet here, whose pictures need no
# screen: actions, costs and seeds mean the same in both engines.

CAMERA = Camera(eye=(0.8, -0.8, 0.45), target=(0.5, 0.0, 0.2))


@torch.no_grad()
def play(actor):
    """Returns what is seen, (steps, worlds, height, width, 3), and the costs, (steps, worlds)."""
    stage = make_env(num_envs=8, seed=1_000, engine=Bullet)
    now, pictures, costs = stage.reset(), [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(12):
            now = stage.step(actor(now))["next"]
            pictures.append(stage.render(width=320, height=260, camera=CAMERA))
            costs.append(now["cost"].squeeze(-1))
    stage.close()
    return torch.stack(pictures), torch.stack(costs)


films = {name: play(actor) for name, (actor, _) in runs.items()}
world = films["PPO"][1].sum(0).argmax()
figure, rows = plt.subplots(2, 6, figsize=(12, 4.4))
for row, (name, (pictures, costs)) in zip(rows, films.items(), strict=True):
    for axis, step in zip(row, range(0, 12, 2), strict=True):
        contact = costs[step, world] > 0
        axis.imshow(pictures[step, world])
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set(color="red" if contact else "white", lw=3)
        axis.set_title("contact" if contact else f"step {step + 1}", size=10)
    row[0].set_ylabel(name)
figure.tight_layout()

# %%
# Where to go from here
# ---------------------
#
# - Change ``COST_LIMIT`` to 2, or to 0. Where does the multiplier settle?
# - Train longer: with ``FRAMES = 128_000`` the policy is smoother and the limit is kept more
#   surely. ``make train`` does that, and lowers the noise of the policy along the way.
# - `The same loop, step by step <own_loop.html>`_, with every tensor that goes through it.
# - `Choose a limit and a discount <../howto/limit.html>`_, `The cost sits just above the limit
#   <../howto/just_above.html>`_.
# - Reference: `environments <../reference/environments.html>`_, `losses
#   <../reference/on_policy.html>`_, `rules <../reference/rules.html>`_.
