"""
Deploy, film and evaluate a policy
==================================

You train a policy, save it to one file, and load it as a function of a NumPy array. Whoever loads
it needs none of your code. It then drives an arm at 20 Hz. At the end you see a film of it, and a
table of how good and how safe it is.

It takes about a minute.
"""

# %%
# A policy
# --------
#
# This is the loop of `the first safe policy <first_policy.html>`_ with fewer steps. If you have
# trained a policy already, go on to the next section.

import base64
import io
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe.envs import ArmEnv, Bullet, Collision, MuJoCo, Speed
from torchrl_safe.envs.gym import ArmGymEnv
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.metrics import conditional_value_at_risk
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss
from torchrl_safe.policy import load_policy, save_policy

torch.manual_seed(0)
torch.set_num_threads(1)
torchrl_logger.setLevel("WARNING")

FRAMES, FRAMES_PER_BATCH, GAMMA = 30_720, 1_024, 0.97
arm = ArmEnv(costs={"collision": Collision()}, physics=MuJoCo(), num_envs=32, seed=0)
env = TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


class Affine(nn.Module):
    def __init__(self, shift, scale):
        super().__init__()
        self.register_buffer("shift", torch.as_tensor(shift))
        self.register_buffer("scale", torch.as_tensor(scale))

    def forward(self, x):
        return (x - self.shift) * self.scale


seen = env.rollout(40, break_when_any_done=False)["observation"].flatten(0, 1)
standardize = Affine(seen.mean(0), 1 / seen.std(0).clamp_min(0.05))


def network(outputs, *after):
    mlp = MLP(seen.shape[-1], outputs, num_cells=[64, 64], activation_class=nn.Tanh)
    nn.init.orthogonal_(mlp[-1].weight, 0.01)
    return nn.Sequential(standardize, mlp, *after)


mean_of_a_step = Affine(0.0, 1 / (1 - GAMMA))
actor = ProbabilisticActor(
    TensorDictModule(
        network(3, AddStateIndependentNormalScale(3)), ["observation"], ["loc", "scale"]
    ),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
critic = ValueOperator(network(1, mean_of_a_step), ["observation"])
cost_critic = ValueOperator(network(1, mean_of_a_step), ["observation"], ["cost_value"])
loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
loss.make_cost_value_estimator(gamma=GAMMA, lmbda=0.95)
updater = PIDControl(loss, cost_limit=0.5)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
buffer = TensorDictReplayBuffer(
    storage=LazyTensorStorage(FRAMES_PER_BATCH),
    sampler=SamplerWithoutReplacement(),
    batch_size=256,
)
for batch in Collector(
    env,
    actor,
    frames_per_batch=FRAMES_PER_BATCH,
    total_frames=FRAMES,
    auto_register_policy_transforms=False,
):
    updater.step(batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)])
    buffer.extend(loss.estimate_advantages(batch).reshape(-1))
    for _ in range(10):  # passes over the batch
        for minibatch in buffer:
            losses = loss(minibatch)
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
            optimizer.step()
            optimizer.zero_grad()

# %%
# One file
# --------
#
# ``save_policy`` records the computation of the mean action, not your Python classes. Here the
# standardization of the observation is the first layer of the actor, so it is in the file as
# well. If yours is a transform of the environment, save
# ``TensorDictSequential(transform.clone(), actor)``.

path = Path(tempfile.mkdtemp(), "policy.pt")
save_policy(path, actor, arm.observation_spec_unbatched, settings={"cost_limits": [0.5]})
print(path.name, f"{path.stat().st_size / 1000:.0f} kB")

# %%
# ``load_policy`` needs none of the code above. What it returns takes and returns NumPy arrays:

policy = load_policy(path)
print(policy, policy.settings)
print(policy(np.zeros(policy.observation_shape)))

# %%
# An observation that is not usable raises an error, instead of moving the arm:

try:
    policy(np.zeros(39))
except ValueError as error:
    print(error)

# %%
# 20 times a second
# -----------------
#
# On a robot you write ``read_observation`` and ``send_action``. Here a simulated arm takes its
# place: the Gymnasium view of the same world. An action is a displacement, which the arm does
# within the next 1/20 s. So the loop keeps to a clock.

robot = ArmGymEnv()
PERIOD = 1 / 20  # s, as in training

seconds, late, reached, touches = [], 0, 0, 0
observation, _ = robot.reset(seed=0)
deadline = time.perf_counter()
for _ in range(60):
    start = time.perf_counter()
    action = policy(observation)
    seconds.append(time.perf_counter() - start)
    observation, _, terminated, truncated, info = robot.step(action)
    touches += info["costs"]["collision"] > 0
    if terminated or truncated:
        reached += info["is_success"]
        observation, _ = robot.reset()
    deadline += PERIOD
    late += time.perf_counter() > deadline
    time.sleep(max(0.0, deadline - time.perf_counter()))
robot.close()

print(f"the policy takes {1e3 * np.median(seconds):.1f} ms of the {1e3 * PERIOD:.0f} ms there are")
print(f"{late} of 60 steps were late")
print(f"{reached} targets reached, {touches} steps in contact")

# %%
# The policy was trained in simulation, and in another physics engine. Keep the limits and the
# emergency stop of a real arm.

# %%
# A film
# ------
#
# The same arm draws itself. These are six steps of the first of three episodes:

robot = ArmGymEnv(render_mode="rgb_array")
frames, ends = [], []
for seed in range(3):
    observation, _ = robot.reset(seed=seed)
    done = False
    while not done:
        observation, _, terminated, truncated, _ = robot.step(policy(observation))
        frames.append(Image.fromarray(robot.render()))
        done = terminated or truncated
    ends.append(len(frames))
robot.close()

figure, axes = plt.subplots(1, 6, figsize=(12, 2))
chosen = np.linspace(0, ends[0] - 1, 6).round().astype(int)
for axis, index in zip(axes, chosen, strict=True):
    axis.imshow(frames[index])
    axis.set_axis_off()
figure.tight_layout()

# %%
# All three episodes as a film, at half speed:


class Film:
    """A GIF that notebooks and this page show."""

    def __init__(self, frames, milliseconds):
        file = io.BytesIO()
        options = {"append_images": frames[1:], "duration": milliseconds, "loop": 0}
        frames[0].save(file, format="GIF", save_all=True, **options)
        self.data = file.getvalue()

    def _repr_html_(self):
        data = base64.b64encode(self.data).decode()
        return f'<img alt="The arm reaches its target" src="data:image/gif;base64,{data}">'


Film(frames, milliseconds=100)

# %%
# To write it to a file, use ``frames[0].save("film.gif", ...)`` in the same way. Gymnasium's
# ``RecordVideo`` and TorchRL's ``VideoRecorder`` film too.

# %%
# How good, and how safe?
# -----------------------
#
# ``evaluate`` plays whole episodes, and the same seed gives every policy the same episodes. Ask
# for more than the training did: a second cost, and the other engine. ``policy.actor`` is the
# policy for TorchRL.

costs = {"collision": Collision(), "speed": Speed(limit=1.0)}
played = {}
for engine in (MuJoCo(), Bullet()):
    stage = ArmEnv(costs=costs, physics=engine, num_envs=32)
    played[type(engine).__name__] = evaluate(stage, policy.actor, 64, seed=1_000)
    stage.close()

for name, episodes in played.items():
    print(name)
    for figure, (mean, low, high) in summarize(episodes, list(costs)).items():
        print(f"    {figure:16}{mean:6.2f}   [{low:.2f}, {high:.2f}]")

# %%
# Brackets are 95 % intervals. ``cost/`` is the mean cost of an episode, ``any/`` the share of
# episodes with any of it. A mean hides rare bad episodes, so look at the worst tenth too:

for name, episodes in played.items():
    worst = conditional_value_at_risk(episodes["episode_cost"][:, :1], alpha=0.1)
    print(f"{name}: {worst.item():.2f} control steps in contact in the worst tenth of the episodes")

# %%
# Where to go from here
# ---------------------
#
# - Put limits on what the second cost shows: `several costs, several limits
#   <several_limits.html>`_.
# - ``python -m experiments.evaluate --policy policy.pt --env mine:make_env --video film.gif``
#   evaluates and films a file. ``mine.py`` has a function ``make_env(num_envs)`` that returns your
#   environment. For a policy of ``make train``, ``--policy`` is enough.
# - What can be saved, what a file guarantees: `Deploy a policy <../howto/deploy.html>`_.
# - Reference: `policies <../reference/policy.html>`_, `metrics <../reference/metrics.html>`_,
#   `Gymnasium <../reference/gym.html>`_.
