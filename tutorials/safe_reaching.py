"""
A safe policy for a robot arm, in plain TorchRL
===============================================

A robot arm has to reach a target behind an obstacle. The shortest way leads through the obstacle,
so an agent that only sees the reward learns to hit it. You train an agent that keeps a limit on
collisions, with :class:`~torchrl_safe.objectives.PPOLagrangianLoss` and
:class:`~torchrl_safe.objectives.PIDControl`, in your own training loop. Everything else is plain
TorchRL.

The problem is a constrained Markov decision process: maximize the expected return while the
expected cost of an episode stays below a limit,

.. math::
    \\max_\\pi J_r(\\pi) \\quad \\text{subject to} \\quad J_c(\\pi) \\le d .

Its Lagrangian :math:`J_r - \\lambda (J_c - d)` turns the limit into a price
:math:`\\lambda \\ge 0` for cost: the policy maximizes it, and the price rises as long as the cost
is above the limit.
"""

# %%
# Settings
# --------
#
# These are small, so that the tutorial runs in seconds and shows how the parts fit. To see the arm
# learn, set ``TOTAL_FRAMES = 256_000``, ``FRAMES_PER_BATCH = 2_048`` and ``NUM_ENVS = 32``, which
# takes some minutes. ``make train`` is a longer recipe, which keeps the limit more reliably:
# :doc:`Cost limits </limits>` says what it adds and why.

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe.envs import PANDA, ArmEnv, CartesianDelta, Collision, InFront, Reach
from torchrl_safe.objectives import PIDControl, PPOLagrangianLoss

TOTAL_FRAMES = 4_096
FRAMES_PER_BATCH = 1_024
NUM_ENVS = 8
COST_LIMIT = 0.5

torch.manual_seed(0)
torch.set_num_threads(1)

# %%
# The environment
# ---------------
#
# An :class:`~torchrl_safe.envs.ArmEnv` is put together from an arm, an action representation, a
# task, obstacles and named costs. It is batched: it simulates ``num_envs`` independent worlds.
# ``cost`` is part of the reward spec, so TorchRL's ``RewardSum`` adds it up over an episode.


def make_env(seed):
    arm_env = ArmEnv(
        PANDA,
        num_envs=NUM_ENVS,
        action=CartesianDelta(step=0.05),
        task=Reach(radius=0.05),
        obstacles=InFront(gap=0.15),
        costs={"collision": Collision()},
        seed=seed,
    )
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    return TransformedEnv(arm_env, sums)


env = make_env(seed=0)
print("observed:", list(env.observation_fields))
print("costs:", env.cost_names)
print(env.rollout(3))

# %%
# Three networks
# --------------
#
# A policy, a critic for the reward, and a critic for the costs with one output for each cost.

width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]


def mlp(outputs):
    return MLP(width, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)


policy = torch.nn.Sequential(mlp(actions), AddStateIndependentNormalScale(actions))
actor = ProbabilisticActor(
    TensorDictModule(policy, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
critic = ValueOperator(mlp(1), in_keys=["observation"])
cost_critic = ValueOperator(mlp(1), in_keys=["observation"], out_keys=["cost_value"])

# %%
# Loss and multiplier
# -------------------
#
# The loss is PPO's clipped loss on the mixed advantage
# :math:`(A_r - \lambda A_c) / (1 + \lambda)`. The multiplier :math:`\lambda` is a buffer of the
# loss, which no optimizer touches. ``PIDControl`` moves it once for each batch, by how far the
# cost of the episodes that ended is from the limit.

loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
loss.make_value_estimator(gamma=0.97, lmbda=0.95)
loss.make_cost_value_estimator(gamma=0.97, lmbda=0.95)
updater = PIDControl(loss, cost_limit=COST_LIMIT)
optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)

# %%
# The loop
# --------
#
# A collector, a replay buffer, and four steps for each batch: move the multiplier, estimate the
# advantages of reward and cost over the whole batch, store, and train on minibatches.

collector = Collector(
    env,
    actor,
    frames_per_batch=FRAMES_PER_BATCH,
    total_frames=TOTAL_FRAMES,
    auto_register_policy_transforms=False,
)
buffer = TensorDictReplayBuffer(
    storage=LazyTensorStorage(FRAMES_PER_BATCH),
    sampler=SamplerWithoutReplacement(),
    batch_size=256,
)
history = []
for batch in collector:
    ended = batch["next", "done"].squeeze(-1)
    updater.step(batch["next", "episode_cost"][ended])
    buffer.extend(loss.estimate_advantages(batch).reshape(-1))
    for _ in range(10):
        for minibatch in buffer:
            losses = loss(minibatch)
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
            optimizer.zero_grad()
    history.append(
        {
            "return": batch["next", "episode_reward"][ended].mean().item(),
            "cost": batch["next", "episode_cost"][ended].mean(0).tolist(),
            "multiplier": loss.lagrange_multiplier.tolist(),
        }
    )
    print(history[-1])

# %%
# Play the policy
# ---------------
#
# The deterministic policy, one whole episode in each world. ``render`` draws the worlds.

test_env = make_env(seed=1)
with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
    play = test_env.rollout(test_env.max_episode_steps, actor, break_when_any_done=False)
first_end = play["next", "done"].squeeze(-1).int().argmax(1)
end = play["next"][torch.arange(NUM_ENVS), first_end]
print("success:", end["success"].float().mean().item())
print("cost of an episode:", end["episode_cost"].mean(0).tolist(), "limit:", COST_LIMIT)

picture = test_env.render(width=320, height=240)[0]
print("picture:", tuple(picture.shape))
test_env.close()

# %%
# Where to go from here
# ---------------------
#
# - Add a second cost, ``costs={"collision": Collision(), "fast": my_cost}``, with
#   ``num_costs=2`` in the loss, two outputs in the cost critic and a limit for each:
#   ``cost_limit=torch.tensor([0.5, 3.0])``.
# - Turn joints instead of moving the tool point: ``action=JointDelta()``.
# - Write your own rule for the multiplier: subclass
#   :class:`~torchrl_safe.objectives.MultiplierUpdater`.
