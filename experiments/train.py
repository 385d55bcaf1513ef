"""Trains PPO and PPO-Lagrangian on a robot arm and compares them.

The main job of the repository: ``make train``. Everything but the environment, the loss and
the multiplier rule is TorchRL's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ValueEstimators

from torchrl_safe.envs import PANDA, ArmEnv, CartesianDelta, JointDelta
from torchrl_safe.objectives import PPOLagrangianLoss

ARMS = {"panda": PANDA}
ACTIONS = {"cartesian": CartesianDelta(), "joint": JointDelta()}


@dataclass(frozen=True)
class Config:
    """Train PPO and PPO-Lagrangian on a robot arm, side by side, and compare them."""

    arm: Literal["panda"] = "panda"
    """Robot arm."""
    action: Literal["cartesian", "joint"] = "cartesian"
    """What an action moves: the tool point, by inverse kinematics, or each joint."""
    algorithms: tuple[Literal["ppo", "ppo-lagrangian"], ...] = ("ppo", "ppo-lagrangian")
    """What to train; ppo is PPO-Lagrangian with its multiplier fixed at 0."""
    cost_limit: float = 0.5
    """Limit of the expected cost of an episode: control steps in which the arm collides."""
    frames: int = 300_000
    """Control steps to train for, for each algorithm."""
    num_envs: int = 32
    """Simulated worlds, shared among the workers."""
    workers: int = 2
    """Processes that simulate; 1 simulates in this process."""
    seed: int = 0
    """Seed of the networks, the environments and the minibatches."""
    out: Path = Path("runs/train")
    """Folder for logs, checkpoints, results.json and pictures."""
    logger: Literal["csv", "tensorboard", "wandb"] = "csv"
    """Where TorchRL logs the training to."""
    eval_episodes: int = 200
    """Episodes of the evaluation, with the deterministic policy."""
    frames_per_batch: int = 4096
    """Control steps between two updates of the policy."""
    epochs: int = 10
    """Passes over each batch."""
    minibatch_size: int = 256
    """Control steps in a minibatch."""
    learning_rate: float = 5e-4
    """Adam's learning rate, for all three networks."""
    multiplier_lr: float = 0.1
    """Multiplier added for each unit of violated cost, once a batch."""


def make_env(config: Config, num_envs: int, seed: int | None = None) -> EnvBase:
    env = ArmEnv(ARMS[config.arm], action=ACTIONS[config.action], num_envs=num_envs, seed=seed)
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    return TransformedEnv(env, sums)


def make_loss(env: EnvBase) -> PPOLagrangianLoss:
    width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    num_costs = env.full_reward_spec["cost"].shape[-1]

    def mlp(outputs: int) -> MLP:
        net = MLP(width, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)
        torch.nn.init.orthogonal_(net[-1].weight, 0.01)
        torch.nn.init.zeros_(net[-1].bias)
        return net

    policy = torch.nn.Sequential(mlp(actions), AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"tanh_loc": False},
        return_log_prob=True,
    )
    critic = ValueOperator(mlp(1), in_keys=["observation"])
    cost_critic = ValueOperator(mlp(num_costs), in_keys=["observation"], out_keys=["cost_value"])
    loss = PPOLagrangianLoss(
        actor,
        critic,
        cost_critic,
        num_costs=num_costs,
        entropy_bonus=False,
        loss_critic_type="l2",
    )
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95, vectorized=True)
    return loss
