"""Every arm with every action, task and layout of obstacles: all choices fit all others."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from worlds import ARMS, ENGINES, combinations

from torchrl_safe.envs import (
    ArmEnv,
    CartesianDelta,
    Collision,
    Cylinder,
    Human,
    InFront,
    JointDelta,
    JointLimit,
    Moving,
    NoObstacles,
    PickAndPlace,
    Proximity,
    Push,
    Reach,
    Region,
    Scattered,
    Speed,
    SpeedAndSeparation,
    Swing,
    Workspace,
)

pytestmark = pytest.mark.integration

ACTIONS = {"cartesian": CartesianDelta, "joint": JointDelta}
TASKS = {"reach": Reach(), "push": Push(), "pick": PickAndPlace()}
OBSTACLES = {
    "none": NoObstacles(),
    "front": InFront(shape=Cylinder(mass=0.5)),
    "scattered": Scattered(count=3, fewest=0),
    "moving": Moving(InFront(), Swing(period=0.5)),
    "human": Human(duration=(0.2, 0.4), pause=(0.01, 0.02)),
}
# Each layout with other costs; one is measured, one not.
COSTS = {
    "none": {"limit": JointLimit(), "fast": Speed(any_link=True)},
    "front": {"collision": Collision()},
    "scattered": {"near": Proximity(), "table": Collision(table=True), "out": Speed(limit=1.0)},
    "moving": {"apart": SpeedAndSeparation(), "touch": Collision(), "limit": JointLimit()},
    "human": {
        "touch": Collision(),
        "near": Proximity(margin=0.1),
        "in": Workspace(Region((0, -0.5, 0), (1, 0.5, 1))),
    },
}
LONG, SHORT, DISTURBED = 120, 60, 25


def play(env, actions, disturb=()):
    """What each step returns, with worlds reset when they are done, and the first on request."""
    env.set_seed(5)
    env.reset()
    history = []
    for index, action in enumerate(actions):
        result = env.step(TensorDict({"action": action}, batch_size=[2]))["next"]
        history.append(
            torch.cat([result[key] for key in ("observation", "reward", "cost", "done")], dim=1)
        )
        rows = result["done"].clone()
        if index in disturb:
            rows[0] = True
        if rows.any():
            reset = TensorDict({**result, "_reset": rows}, batch_size=[2])
            observation = env.reset(reset)["observation"]
            unchanged = torch.eq(observation, result["observation"]).all(1, keepdim=True)
            assert torch.equal(unchanged, ~rows), "only what is reset begins anew"
    return torch.stack(history)


@pytest.mark.parametrize(
    ("arm", "action", "task", "obstacles", "physics"),
    combinations(ARMS, ACTIONS, TASKS, OBSTACLES, ENGINES),
)
def test_combination(make_env, arm, action, task, obstacles, physics):
    """Specs; finite values; a seed gives one rollout, bit for bit; resets touch no other world."""
    env = make_env(
        ArmEnv,
        ARMS[arm],
        num_envs=2,
        action=ACTIONS[action](finger_step=0.04 if task == "pick" else None),
        task=TASKS[task],
        obstacles=OBSTACLES[obstacles],
        costs=COSTS[obstacles],
        physics=ENGINES[physics],
        frame_skip=2,
        max_episode_steps=70,
        seed=0,
    )
    check_env_specs(env)
    generator = torch.manual_seed(0)
    shape = env.action_spec.shape
    # Noise about a drift, or the arm would not get anywhere.
    drift = torch.rand(LONG // 20, 1, *shape, generator=generator) * 2 - 1
    noise = torch.rand(LONG // 20, 20, *shape, generator=generator) * 2 - 1
    actions = (drift + noise).clamp(-1, 1).flatten(0, 1)
    history = play(env, actions)
    assert torch.isfinite(history).all()
    assert history[:, :, -1].any(), "some worlds are reset"
    again = play(env, actions[:SHORT], disturb={DISTURBED, DISTURBED + 8})
    assert torch.equal(history[: DISTURBED + 1], again[: DISTURBED + 1])
    assert torch.equal(history[:SHORT, 1], again[:, 1])
    assert not torch.equal(history[:SHORT, 0], again[:, 0])
