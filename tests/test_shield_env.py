"""An environment with a shield: specs, state, resets, and settings that are refused."""

import gymnasium
import numpy as np
import pytest
import torch
from states import make_state
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs
from worlds import step

from torchrl_safe.envs import (
    ArmEnv,
    Collision,
    Human,
    JointDelta,
    Moving,
    NoObstacles,
    Scattered,
    Shield,
    ShieldCorrection,
)

# A Cartesian action towards the table.
DOWN = torch.tensor([0.0, 0.0, -1.0])


@pytest.mark.parametrize("obstacles", [NoObstacles(), Scattered(fewest=0), Human()], ids=str)
def test_specs(make_env, engine, obstacles):
    costs = {"collision": Collision(), "shield": ShieldCorrection()}
    env = make_env(ArmEnv, num_envs=2, obstacles=obstacles, shield=Shield(), costs=costs, seed=0)
    check_env_specs(env)
    first = env.reset()
    assert not first["shield_correction"].any()
    assert not first["shield_braked"].any()
    rollout = env.rollout(4)["next"]
    torch.testing.assert_close(rollout["cost"][..., 1:], rollout["shield_correction"])
    assert rollout["shield_correction"].shape == (2, 4, 1)


def test_two_flags_of_a_step_do_not_share_their_memory(make_env, engine):
    env = make_env(ArmEnv, num_envs=2, shield=Shield(), max_episode_steps=1, seed=0)
    env.reset()
    last = step(env, torch.zeros(2, 3))
    kept = last["success"].clone()
    last["terminated"].logical_not_()
    assert torch.equal(last["success"], kept)


def test_the_batch_holds_the_sampled_action(make_env, engine):
    """And its log-probability. What is executed instead is up to the environment."""
    env = make_env(ArmEnv, num_envs=2, shield=Shield(), seed=0)
    sampled = []

    def policy(tensordict):
        action = DOWN.repeat(2, 1)
        sampled.append(action)
        return tensordict.set("action", action)

    collector = Collector(env, policy, frames_per_batch=20, total_frames=20)
    (batch,) = list(collector)
    torch.testing.assert_close(batch["action"], torch.stack(sampled[-10:], dim=1))
    assert batch["next", "shield_correction"].any()


def test_checkpoints_bring_the_correction_back(make_env, engine):
    env, other = (make_env(ArmEnv, num_envs=2, shield=Shield(), seed=0) for _ in range(2))
    env.reset()
    for _ in range(5):
        step(env, DOWN)
    assert env.arm_state.shield_correction.any()
    other.load_state_dict(env.state_dict())
    for name in ("shield_correction", "shield_braked", "joint_position"):
        np.testing.assert_array_equal(getattr(env.arm_state, name), getattr(other.arm_state, name))
    after = [step(each, DOWN)["shield_correction"] for each in (env, other)]
    torch.testing.assert_close(*after, rtol=0, atol=0)


def test_a_partial_reset_forgets_one_correction(make_env, engine):
    env = make_env(ArmEnv, num_envs=2, shield=Shield(), seed=0)
    env.reset()
    before = [step(env, DOWN) for _ in range(5)][-1]["shield_correction"]
    assert before.all()
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    after = env.arm_state.shield_correction
    assert after[0] == 0
    assert after[1] == pytest.approx(before[1].item())


def test_a_world_is_the_same_alone_and_among_others(make_env, engine):
    """Bit for bit, also where its neighbours make the shield measure twice."""
    settings = {"action": JointDelta(), "shield": Shield(), "obstacles": Moving()}
    actions = torch.rand(12, 3, 7) * 2 - 1
    together = make_env(ArmEnv, num_envs=3, seed=0, **settings)
    seed, found = 0, []
    together.reset()
    many = [step(together, action)["observation"] for action in actions]
    for row in range(3):
        alone = make_env(ArmEnv, seed=seed, **settings)
        seed = alone.set_seed(seed)
        alone.reset()
        found.append([step(alone, action[row])["observation"][0] for action in actions])
    for row in range(3):
        expected = torch.stack([observation[row] for observation in many])
        torch.testing.assert_close(torch.stack(found[row]), expected, rtol=0, atol=0)


def test_gymnasium_tells_what_the_shield_did():
    env = gymnasium.make("torchrl_safe/PandaReachInFront-v0", shield=Shield())
    env.reset(seed=0)
    *_, info = env.step(env.action_space.sample())
    assert info["shield_braked"] is False
    assert info["shield_correction"] >= 0
    env.close()


def test_corrections_cost_what_exceeds_a_margin():
    state = make_state(shield_correction=[0.3, 0.05])
    np.testing.assert_allclose(ShieldCorrection()(state), [0.3, 0.05])
    np.testing.assert_allclose(ShieldCorrection(margin=0.1)(state), [0.2, 0.0])


def test_a_correction_needs_a_shield():
    with pytest.raises(ValueError, match="shield must be given to ArmEnv"):
        ArmEnv(costs={"shield": ShieldCorrection()})
    with pytest.raises(TypeError, match="shield must be an instance of Shield"):
        ArmEnv(shield=0.02)


@pytest.mark.parametrize(
    "settings",
    [
        {"margin": -0.1},
        {"table": float("nan")},
        {"rate": 0.0},
        {"reach": 0.01},
        {"acceleration": -1.0},
        {"tool_weight": -1.0},
        {"obstacle_acceleration": -1.0},
        {"obstacle_speed": -1.0},
    ],
    ids=lambda settings: next(iter(settings)),
)
def test_bad_shields_are_refused(settings):
    (name,) = settings
    with pytest.raises(ValueError, match=name):
        Shield(**settings)
