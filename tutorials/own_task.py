"""
A task, a cost and an observation of your own
=============================================

You write a task that no library has: follow a point that runs round a circle. You write a cost: do
not cross an invisible wall that cuts the circle. And you write what the policy sees. At the end you
see the paths of two policies. One follows the whole circle, the other stops at the wall.

It takes about a minute.
"""

# %%
# The task
# --------
#
# A task has four members: the objects that it moves (none here), a ``sample`` that draws goals,
# the ``reward`` and the ``success`` of each world. The last two read an
# ``ArmState``: arrays of all N worlds, in metres and seconds.
#
# The target runs round the goal once in two seconds. ``state.time`` counts from the start of the
# episode.

from dataclasses import dataclass, replace

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

from torchrl_safe.envs import PANDA, ArmEnv, MuJoCo, NoObstacles, Region, Sensing
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss

torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")

RADIUS, PERIOD = 0.1, 2.0


@dataclass(frozen=True)
class FollowCircle:
    objects = ()

    def sample(self, rng, goals):
        return goals.sample(rng), np.zeros((0, 3))  # The goal is the centre of the circle.

    def to_target(self, state, later=0.0):
        angle = 2 * np.pi * (state.time + later) / PERIOD
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        return state.goal + RADIUS * circle - state.ee_position

    def reward(self, state):
        return -np.linalg.norm(self.to_target(state), axis=1) / RADIUS

    def success(self, state):
        return np.zeros(len(state.time), dtype=bool)  # The episode ends when its time is up.


task = FollowCircle()

# %%
# The cost
# --------
#
# A cost returns one number for each world. This one costs 1 for a control step in which the tool
# is beyond the wall, 3 cm to the left of the centre.
#
# A control step has 12 substeps of physics. To see all of them, ask by a property ``sensing`` and
# read ``state.trace``. A step in which the tool crosses the wall and returns is then not missed.

WALL = 0.03


class BeyondWall:
    sensing = Sensing(tool=True)

    def __call__(self, state):
        y = state.trace["ee_position"][:, :, 1]  # (N, substeps)
        return (y > state.goal[:, None, 1] + WALL).any(axis=1).astype(float)


# %%
# The observation
# ---------------
#
# It maps the state to named fields of shape ``(N, width)``. The policy has to see where the
# target is and where it will be, or the task is not Markov. Fields of about size 1 are learnt
# fastest, so lengths are in units of the radius here.


def observation(state):
    return {
        "to_target": task.to_target(state) / RADIUS,
        "to_next_target": task.to_target(state, later=0.05) / RADIUS,
        "from_centre": (state.ee_position - state.goal) / RADIUS,
        "velocity": state.ee_velocity,
    }


# %%
# The environment
# ---------------
#
# You pass them as you pass the library's own. ``goals`` of the arm is where centres are drawn.

arm = replace(PANDA, goals=Region((0.45, -0.05, 0.2), (0.55, 0.05, 0.3)))


def make_env(num_envs=32, seed=0):
    env = ArmEnv(
        arm,
        task=task,
        costs={"beyond": BeyondWall()},
        observation=observation,
        obstacles=NoObstacles(),
        max_episode_steps=80,
        physics=MuJoCo(),
        num_envs=num_envs,
        seed=seed,
    )
    return TransformedEnv(env, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


env = make_env()
print(env.base_env.observation_fields)

# %%
# Before you train, test them. A policy written by hand that goes where the target is must do
# well, and it must pay for the wall: the circle is beyond it for about two fifths of the time.


def follow(tensordict):
    to_target = tensordict["observation"][..., env.base_env.observation_fields["to_next_target"]]
    return tensordict.set("action", (to_target * RADIUS / 0.05).clamp(-1, 1))


end = env.rollout(80, follow)["next"][:, -1]
distance = -end["episode_reward"].mean() / 80 * RADIUS
print(f"mean distance to the target {distance:.3f} m, cost {end['episode_cost'].mean():.1f} of 80")

# %%
# Training
# --------
#
# PPO-Lagrangian, as in `the first safe policy <first_policy.html>`_. A limit of 2 allows two
# control steps of the 80 beyond the wall.

FRAMES, FRAMES_PER_BATCH = 51_200, 2_560
GAMMA = 0.95


def train(cost_limit=None):
    torch.manual_seed(0)
    env = make_env()
    width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]

    def network(outputs):
        return MLP(width, outputs, num_cells=[64, 64], activation_class=nn.Tanh)

    policy = nn.Sequential(
        network(actions), AddStateIndependentNormalScale(actions, init_value=-0.5)
    )
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(network(1), ["observation"])
    cost_critic = ValueOperator(network(1), ["observation"], ["cost_value"])
    loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
    loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
    loss.make_cost_value_estimator(gamma=GAMMA, lmbda=0.95)
    updater = None if cost_limit is None else PIDControl(loss, cost_limit=cost_limit)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
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
    return actor


COST_LIMIT = 2.0
actors = {"no limit": train(), "limit": train(COST_LIMIT)}

# %%
# Look at it
# ----------
#
# The paths of the tool, seen from above, in the second half of an episode.


@torch.no_grad()
def path_of(actor):
    stage = make_env(num_envs=16, seed=1_000)
    now, path = stage.reset(), []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(80):
            now = stage.step(actor(now))["next"]
            state = stage.base_env.arm_state
            path.append((state.ee_position - state.goal)[0, :2])
    stage.close()
    return np.array(path), now["episode_cost"].mean().item()


figure, axis = plt.subplots(figsize=(5, 5))
angle = np.linspace(0, 2 * np.pi, 200)
axis.plot(RADIUS * np.cos(angle), RADIUS * np.sin(angle), "k:", lw=1, label="target")
axis.axhspan(WALL, 0.15, color="tab:red", alpha=0.15, lw=0)
axis.text(0, 0.135, "costs", ha="center", color="tab:red")
for (name, actor), colour in zip(actors.items(), ("tab:orange", "tab:blue"), strict=True):
    path, cost = path_of(actor)
    axis.plot(*path[40:].T, color=colour, label=f"{name}: cost {cost:.1f}")
axis.set(xlabel="x from the centre, m", ylabel="y from the centre, m", xlim=(-0.15, 0.15))
axis.set(ylim=(-0.2, 0.15), aspect="equal", title="The limit keeps the tool out of the red area")
axis.legend(loc="lower center", ncols=3, columnspacing=1, handlelength=1, fontsize=9)
figure.tight_layout()

# %%
# Where to go from here
# ---------------------
#
# - Draw a figure of eight: change ``to_target``. Move the wall: change ``WALL`` to 0.
# - Test costs and tasks on states made by hand: `A cost of your own <../howto/cost.html>`_.
# - Tasks that move objects, obstacles of your own: `Environments <../environments.html>`_.
# - Reference: `tasks <../reference/tasks.html>`_, `costs <../reference/costs.html>`_,
#   `observations <../reference/observations.html>`_.
