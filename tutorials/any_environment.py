"""
Any Gymnasium environment with a cost
=====================================

You write a Gymnasium environment with a cost in its ``info``: a walk to a goal, with a puddle in
the way. You train it without a limit and with one. At the end you see both paths, one through the
puddle and one around it.

The same lines work for any Gymnasium environment that reports a cost, Safety-Gymnasium included. It
takes about a minute on one core.
"""

# %%
# An environment with a cost
# --------------------------
#
# It is an ordinary Gymnasium environment: a vector is observed, actions are continuous. The only
# thing to add is ``info["cost"]`` in every step. Keep the cost out of the reward.

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe.envs.gym import SafeGymEnv
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss

torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")

GOAL, PUDDLE, RADIUS = np.array([1.0, 0.0]), np.array([0.0, 0.2]), 0.4


class Puddle(gymnasium.Env):
    """Walk to the goal; a step that ends in the puddle costs 1."""

    observation_space = gymnasium.spaces.Box(-2, 2, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = np.array([-1.0, self.np_random.uniform(-0.4, 0.4)], np.float32)
        return self.place, {}

    def step(self, action):
        self.place = np.clip(self.place + 0.2 * action, -2, 2).astype(np.float32)
        distance = float(np.linalg.norm(self.place - GOAL))
        wet = float(np.linalg.norm(self.place - PUDDLE) < RADIUS)
        return self.place, -distance, distance < 0.15, False, {"cost": wet}


gymnasium.register("Puddle-v0", Puddle, max_episode_steps=25)

# %%
# In TorchRL
# ----------
#
# ``SafeGymEnv`` is TorchRL's ``GymEnv`` with the cost beside the
# reward. With ``num_envs`` it makes several. ``asynchronous=False`` steps them in this process,
# which is faster where a step takes less than about a millisecond.


def make_env(num_envs=16, seed=0):
    env = SafeGymEnv("Puddle-v0", num_envs=num_envs, asynchronous=False)
    env.set_seed(seed)
    return TransformedEnv(env, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


print(make_env().rollout(3)["next"].select("observation", "reward", "cost"))

# %%
# Several costs have names, ``cost_keys=["heat", "wear"]`` for ``info["heat"]`` and
# ``info["wear"]``. ``("costs", "heat")`` is the entry ``heat`` of the entry ``costs``.

# %%
# Training
# --------
#
# From here on nothing is about Gymnasium. It is PPO with two additions, a critic of the cost and
# a rule for its price.

FRAMES, FRAMES_PER_BATCH = 32_000, 800


def train(cost_limit=None):
    torch.manual_seed(0)
    env = make_env()

    def network(outputs):
        return MLP(2, outputs, num_cells=[32, 32], activation_class=nn.Tanh)

    policy = nn.Sequential(network(2), AddStateIndependentNormalScale(2))
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(network(1), ["observation"])
    cost_critic = ValueOperator(network(1), ["observation"], ["cost_value"])
    loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
    loss.make_value_estimator(gamma=0.97, lmbda=0.95)
    loss.make_cost_value_estimator(gamma=0.97, lmbda=0.95)
    updater = None if cost_limit is None else PIDControl(loss, cost_limit=cost_limit)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-3)
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
        batch_size=200,
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
                optimizer.step()
                optimizer.zero_grad()
        history.append((episodes["episode_reward"].mean(), episodes["episode_cost"].mean()))
    return actor, torch.tensor(history)


COST_LIMIT = 0.5
runs = {"no limit": train(), f"limit {COST_LIMIT}": train(COST_LIMIT)}

# %%
# What happened
# -------------
#
# The map shows the deterministic policies, from sixteen starts. The curves show how the cost of
# an episode developed.


@torch.no_grad()
def paths(actor):
    stage = make_env(seed=1_000)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        episodes = stage.rollout(25, actor, break_when_any_done=False)
    ended = episodes["next", "done"].squeeze(-1)
    first = torch.arange(25) <= ended.int().argmax(1, keepdim=True)  # The first episode of each.
    return [
        torch.cat([place[:1], after[keep]])
        for place, after, keep in zip(
            episodes["observation"], episodes["next", "observation"], first, strict=True
        )
    ]


figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4))
left.add_patch(plt.Circle(PUDDLE, RADIUS, color="tab:cyan", alpha=0.4, lw=0))
left.plot(*GOAL, marker="*", ms=14, color="gold", mec="black")
for (name, (actor, history)), colour in zip(runs.items(), ("tab:orange", "tab:blue"), strict=True):
    for path in paths(actor):
        left.plot(*path.T, color=colour, lw=1, alpha=0.7)
    right.plot(FRAMES_PER_BATCH * torch.arange(1, len(history) + 1), history[:, 1], color=colour)
    right.plot([], [], color=colour, label=name)
left.set(aspect="equal", xlim=(-1.2, 1.2), ylim=(-0.8, 0.8), title="The paths of both policies")
right.axhline(COST_LIMIT, color="black", ls="--", lw=1)
right.set(xlabel="steps", title="cost of an episode: steps in the puddle")
right.legend()
figure.tight_layout()

# %%
# Safety-Gymnasium
# ----------------
#
# Its names work too. It pins older versions of Gymnasium and MuJoCo, so ``make safe-gym`` gives
# it a virtual environment of its own and trains there:
#
# .. code-block:: bash
#
#     make safe-gym ARGS="--env SafetySwimmerVelocity-v1 --cost-limit 25"
#
# In code it is one line:
#
# .. code-block:: python
#
#     env = SafeGymEnv("SafetySwimmerVelocity-v1", num_envs=8)

# %%
# Your environment
# ----------------
#
# Most environments differ from this one in three ways:
#
# - Actions have other bounds than -1 and 1. Give them to the policy, as
#   ``distribution_kwargs={"low": ..., "high": ...}``.
# - Rewards are larger. Scale them, so that returns are about 1 to 100.
# - Observations are larger. Standardize them.
#
# `Train in any environment with a cost <../safe_gym.html>`_ has a loop with the first two, and a
# script that does all three.

# %%
# Where to go from here
# ---------------------
#
# - Move the puddle to (0, 0), so that both ways round are equally long. Which one is found?
# - A recipe for longer runs, with checkpoints: `Train in any environment with a cost
#   <../safe_gym.html>`_.
# - An environment of TorchRL that has its cost in the observation: ``CostToReward``, in
#   `transforms <../reference/transforms.html>`_.
# - Reference: `Gymnasium <../reference/gym.html>`_.
