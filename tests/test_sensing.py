"""What costs measure, in the real simulator."""

import numpy as np
import pytest
from worlds import ARMS, each_arm, rest, step

from torchrl_safe.envs import (
    ArmEnv,
    CartesianDelta,
    Collision,
    JointDelta,
    NoObstacles,
)

EVERYTHING = {
    "table": Collision(margin=0.02, table=True),
    "itself": Collision(itself=True),
}


@each_arm
def test_at_home_the_arm_touches_neither_table_nor_itself(make_env, arm):
    """Not even closely, nor when it opens and closes its fingers; what it stands on is no touch."""
    env = make_env(
        ArmEnv,
        arm,
        action=CartesianDelta(finger_step=0.04),
        obstacles=NoObstacles(),
        costs=EVERYTHING,
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    trace = env.arm_state.trace
    for opening in (1, -1):
        for _ in range(10):
            assert not step(env, [0, 0, 0, opening])["cost"].any()
    assert trace["table_distance"].shape == trace["self_distance"].shape == (1, 12)


@each_arm
def test_pressing_on_the_table_is_a_touch(make_env, arm):
    env = make_env(
        ArmEnv,
        arm,
        obstacles=NoObstacles(),
        costs={"table": Collision(table=True), "none": Collision()},
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    costs = np.array([step(env, [0, 0, -1])["cost"][0].tolist() for _ in range(12)])
    assert not costs[:6, 0].any()
    assert costs[-1, 0]
    assert not costs[:, 1].any()
    assert env.arm_state.trace["table_distance"].min() <= 0
    # The touch is over with the episode.
    env.reset()
    assert np.isinf(env.arm_state.trace["table_distance"]).all()


# Actions that, kept up, fold the arm into itself; the Panda's hand then presses on its base.
FOLD = {
    "panda": [1, 1, -0.5, -1, 0.8, -1, -0.1],
    "iiwa": [1, -0.5, -0.3, -1, 1, 1, 1],
    "xarm6": [-0.5, 0.9, 1, 0.1, 1, 1],
    "xarm7": [-0.5, 1, -1, -1, -0.7, 1, 0.1],
    "ur5": [-1, -0.1, 1, 1, -0.9, -1],
    "ur10": [-0.3, -0.1, 1, 1, -0.5, -0.3],
}


@pytest.mark.parametrize("name", ARMS)
def test_folding_into_itself_is_a_touch(make_env, name):
    env = make_env(
        ArmEnv,
        ARMS[name],
        action=JointDelta(step=0.2),
        obstacles=NoObstacles(),
        costs={"itself": Collision(itself=True)},
        max_episode_steps=1000,
        seed=0,
    )
    env.reset()
    costs = np.array([step(env, FOLD[name])["cost"].item() for _ in range(25)])
    assert not costs[0]
    assert costs[10:].all()
    env.reset()
    assert np.isinf(env.arm_state.trace["self_distance"]).all()
    assert not rest(env)["cost"].any()
