"""The arm that an algorithm trains on, from the options of a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl.envs import Compose, EnvBase, RewardSum, TransformedEnv

from experiments.algorithms import ALGORITHMS
from experiments.config import TASKS, AlgorithmName, Config
from torchrl_safe.envs import (
    PAPER_CARTESIAN,
    PAPER_JOINT,
    SUITE,
    ActionMode,
    ArmEnv,
    Bullet,
    CartesianDelta,
    Collision,
    ContactForce,
    FullObservation,
    Human,
    JointDelta,
    JointLimit,
    MuJoCo,
    Physics,
    Proximity,
    ShieldCorrection,
    Speed,
    SpeedAndSeparation,
    gym,
    paper_env,
    paper_observation,
)
from torchrl_safe.envs.arm_env import Cost

# What options are called in the names that Gymnasium knows.
ARMS = {name.lower(): name for name in gym.ARMS}
OBSTACLES = {
    "none": "",
    "in-front": "InFront",
    "scattered": "Scattered",
    "moving": "Moving",
    "human": "Human",
}
PHYSICS: dict[str, Physics] = {"bullet": Bullet(), "mujoco": MuJoCo()}
PAPER_ACTIONS: dict[str, ActionMode] = {"cartesian": PAPER_CARTESIAN, "joint": PAPER_JOINT}
OBSERVATIONS = {"full": FullObservation(), "paper": paper_observation}
COSTS: dict[str, Cost] = {
    "collision": Collision(),
    "contact-force": ContactForce(),
    "correction": ShieldCorrection(),
    "joint-limit": JointLimit(),
    "proximity": Proximity(),
    "separation": SpeedAndSeparation(),
    # Actions ask for up to 1 m/s along each axis.
    "speed": Speed(limit=1.0),
}
# For a hand that reaches as far and as fast as Human's, 0.6 m in 0.7 s, with minimum jerk.
_BESIDE_A_PERSON: dict[str, Any] = {"obstacle_acceleration": 7.0, "margin": 0.015}


def make_env(
    config: Config,
    num_envs: int,
    seed: int | None = None,
    algorithm: AlgorithmName = "ppo",
    *,
    training: bool = False,
    shielded: bool = True,
    gui: bool = False,
) -> EnvBase:
    """Makes the environment that an algorithm trains in, with sums of reward and cost.

    The sums are over each episode, of the arm's own reward and costs, which an algorithm's
    transforms do not change. ``shielded=False`` leaves out the shield that an algorithm may have,
    and its cost.
    """
    settings: dict[str, Any] = {
        "observation": OBSERVATIONS[config.observation],
        "num_envs": num_envs,
        "seed": seed,
        "gui": gui,
    }
    if training and config.episode_steps is not None:
        settings["max_episode_steps"] = config.episode_steps
    if config.paper:
        env = paper_env(PAPER_ACTIONS[config.action], **settings)
    else:
        arguments = arm_arguments(config, shielded)
        shield = ALGORITHMS[algorithm].shield if shielded else None
        if shield is not None and isinstance(arguments["obstacles"], Human):
            shield = replace(shield, **_BESIDE_A_PERSON)
        env = ArmEnv(physics=PHYSICS[config.physics], shield=shield, **{**arguments, **settings})
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    transforms = ALGORITHMS[algorithm].transforms(config)
    if training:
        transforms += ALGORITHMS[algorithm].training_transforms(config)
    return TransformedEnv(env, Compose(sums, *transforms))


def arm_arguments(config: Config, shielded: bool = True) -> dict[str, Any]:
    """What the arm, its task and its costs are, as arguments of ArmEnv."""
    if config.suite_task is not None:
        return SUITE[config.suite_task].arguments
    task = TASKS[config.task].__name__
    return {
        **gym.combination(ARMS[config.arm], task, OBSTACLES[config.obstacles], action=""),
        "action": make_action(config),
        "costs": {name: COSTS[name] for name in cost_names(config, shielded)},
    }


def cost_names(config: Config, shielded: bool = True) -> tuple[str, ...]:
    """Names of the costs, in their order."""
    return tuple(name for name in config.cost_limits if shielded or name != "correction")


def make_action(config: Config) -> ActionMode:
    """Makes what an action does, as the task needs it."""
    if config.task == "reach":
        return JointDelta() if config.action == "joint" else CartesianDelta()
    fingers = 0.04 if config.task == "pick-and-place" else None
    if config.action == "joint":
        return JointDelta(finger_step=fingers)
    # At the speed of reaching, 1 m/s, a cube that is hit slides on for 0.2 m.
    held = gym.ARMS[ARMS[config.arm]].handling_orientation
    return CartesianDelta(step=0.03, orientation=held, finger_step=fingers)
