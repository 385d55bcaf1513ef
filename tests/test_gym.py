"""ArmGymEnv: the arm as Gymnasium, Stable-Baselines3 and loops like OmniSafe's see it."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import env_render_passive_checker
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from programs import run_code
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.monitor import Monitor
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from worlds import Places, combinations

from torchrl_safe.envs import (
    PAPER_JOINT,
    ArmEnv,
    Bullet,
    Collision,
    JointDelta,
    MuJoCo,
    NoObstacles,
    Shield,
    Sphere,
)
from torchrl_safe.envs.gym import (
    ACTIONS,
    ARMS,
    OBSTACLES,
    TASKS,
    ArmGymEnv,
    SafeGymEnv,
    SafeGymWrapper,
)

NAME = "torchrl_safe/PandaReachInFront-v0"


def actions(count, width=3, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (count, width)).astype(np.float32)


def play(env, seed, count=50):
    """Observations, rewards, infos and flags of a loop that resets at the end of episodes."""
    observation, _ = env.reset(seed=seed)
    seen = [observation]
    outcomes = []
    for action in actions(count):
        observation, *outcome = env.step(action)
        seen.append(observation)
        outcomes.append(outcome)
        if outcome[1] or outcome[2]:
            seen.append(env.reset()[0])
    return np.stack(seen), outcomes


def follow(moves):
    """A policy that takes these actions one after the other."""
    moves = iter(moves)
    return lambda td: td.set("action", next(moves))


def count_one(state):
    return np.ones(len(state.goal))


TWO_COSTS = {"collision": Collision(), "one": count_one}


@pytest.mark.parametrize(
    "parts",
    [
        pytest.param(p.values, id=p.id, marks=p.marks)
        for p in combinations(ARMS, TASKS, OBSTACLES, ACTIONS)
    ],
)
def test_checkers_of_gymnasium_and_stable_baselines(parts):
    """Neither raises nor warns; rendering, which would open a window, is tested elsewhere."""
    env = gymnasium.make(f"torchrl_safe/{''.join(parts)}-v0")
    check_env(env.unwrapped, skip_render_check=True)
    check_env_sb3(env.unwrapped, warn=True, skip_render_check=True)
    env.close()


def test_mujoco_has_no_window_to_offer():
    env = gymnasium.make("torchrl_safe/PandaReach-v0", physics=MuJoCo(threads=1))
    assert env.unwrapped.metadata["render_modes"] == ["rgb_array"]
    check_env(env.unwrapped, skip_render_check=False)
    env.close()


def test_names():
    names = {n.removeprefix("torchrl_safe/") for n in gymnasium.registry if "torchrl_safe" in n}
    assert names >= {
        f"PandaReach{obstacles}{action}-v0"
        for obstacles in ("", "InFront")
        for action in ("", "Joint")
    }
    plain = gymnasium.make("torchrl_safe/PandaReachJoint-v0")
    arm = plain.unwrapped.arm_env
    assert (arm.obstacles, arm.action_mode) == (NoObstacles(), JointDelta())
    plain.close()


@pytest.mark.integration
def test_gymnasium_imports_the_module_by_name():
    code = f"""
import gymnasium
env = gymnasium.make("torchrl_safe.envs.gym:{NAME}")
print(type(env.unwrapped).__name__, env.action_space.shape, env.spec.max_episode_steps)
"""
    done = run_code(code)
    assert done.stdout.strip().endswith("ArmGymEnv (3,) None"), done.stderr


def test_arguments_of_make_override():
    env = gymnasium.make(NAME, costs=TWO_COSTS, action=JointDelta(), frame_skip=8)
    assert env.action_space.shape == (7,)
    assert env.metadata["render_fps"] == 30
    env.reset(seed=0)
    *_, info = env.step(np.zeros(7, np.float32))
    assert info == {"cost": 1.0, "costs": {"collision": 0.0, "one": 1.0}, "is_success": False}
    env.close()


def test_costs_add_up():
    env = ArmGymEnv(costs={"one": lambda state: np.ones(1), "two": lambda state: 2 * np.ones(1)})
    env.reset()
    assert env.step(np.zeros(3, np.float32))[-1]["cost"] == 3
    env.close()


def test_physics_is_an_argument():
    """Of every name; the same goals and obstacles, in another engine."""
    seen = []
    for settings in ({}, {"physics": MuJoCo(threads=1)}):
        env = gymnasium.make(NAME, **settings)
        seen.append(env.reset(seed=0)[0])
        fields = env.unwrapped.arm_env.observation_fields
        assert type(env.unwrapped.arm_env.physics) is type(settings.get("physics", Bullet()))
        env.close()
    for name in ("to_goal", "to_obstacle"):
        np.testing.assert_allclose(*(one[fields[name]] for one in seen), atol=1e-6)


def test_same_numbers_as_the_arm(make_env):
    """Bit for bit, over several episodes and the resets between them."""
    env = make_env(ArmEnv, seed=3, costs=TWO_COSTS, max_episode_steps=20)
    view = ArmGymEnv(costs=TWO_COSTS, max_episode_steps=20)
    seen, outcomes = play(view, seed=3)
    view.close()

    expected = [env.reset()["observation"]]
    for action, (reward, terminated, truncated, info) in zip(actions(50), outcomes, strict=True):
        after = env.step(TensorDict({"action": torch.tensor(action)[None]}, [1]))["next"]
        expected.append(after["observation"])
        assert [type(value) for value in (reward, terminated, truncated)] == [float, bool, bool]
        assert reward == after["reward"].item()
        assert (terminated, truncated) == (after["terminated"].item(), after["truncated"].item())
        assert info["is_success"] is after["success"].item()
        assert list(info["costs"].values()) == after["cost"][0].tolist()
        assert info["cost"] == after["cost"].sum().item()
        if after["done"]:
            expected.append(env.reset()["observation"])
    assert np.array_equal(seen, torch.cat(expected).numpy())
    assert [i for i, (_, _, truncated, _) in enumerate(outcomes) if truncated] == [19, 39]


def test_round_trip_through_torchrl(make_env):
    """ArmEnv wrapped for Gymnasium and wrapped back for TorchRL behaves like ArmEnv."""
    settings = {"costs": TWO_COSTS, "max_episode_steps": 15}
    direct = make_env(ArmEnv, **settings)
    keys = [("costs", "collision"), ("costs", "one")]
    around = make_env(SafeGymEnv, NAME, cost_keys=keys, **settings)
    check_env_specs(around)
    direct.set_seed(5)
    # Gymnasium seeds by a reset: the first episode has been drawn.
    direct.reset()
    around.set_seed(5)
    moves = torch.tensor(actions(40))
    once = around.rollout(40, follow(moves), break_when_any_done=False)
    twice = direct.rollout(40, follow(moves[:, None]), break_when_any_done=False)[0]
    for key in ("observation", "action", "done"):
        assert torch.equal(once[key], twice[key]), key
    for key in ("observation", "reward", "cost", "done", "terminated", "truncated"):
        assert torch.equal(once["next", key], twice["next", key]), key
    assert once["next", "done"].flatten().nonzero().flatten().tolist() == [14, 29]


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_vectorized_round_trip(make_env, mode):
    """Also with the nested info of two arms at once, whose episodes end apart."""
    settings = [{"costs": TWO_COSTS, "max_episode_steps": steps} for steps in (6, 4)]
    vector = SyncVectorEnv([partial(ArmGymEnv, **s) for s in settings], autoreset_mode=mode)
    env = make_env(SafeGymWrapper, vector, cost_keys=["cost", ("costs", "one")])
    check_env_specs(env)
    env.set_seed(9)
    rollout = env.rollout(11, break_when_any_done=False)
    for row, seed, own in zip(rollout, (9, 10), settings, strict=True):
        arm = make_env(ArmEnv, **own)
        arm.set_seed(seed)
        arm.reset()
        same = arm.rollout(11, follow(row["action"][:, None]), break_when_any_done=False)[0]
        assert torch.equal(row["observation"], same["observation"])
        for key in ("observation", "reward", "done", "terminated", "truncated"):
            assert torch.equal(row["next", key], same["next", key]), key
        cost, one = row["next", "cost"].unbind(-1)
        assert torch.equal(cost, same["next", "cost"].sum(-1))
        assert (one == 1).all()


def test_seed_decides_on_everything():
    """Whatever happened before, and whatever seed the constructor had."""
    env, other = ArmGymEnv(seed=1), ArmGymEnv()
    first, _ = play(env, seed=7)
    play(env, seed=8)
    again, _ = play(env, seed=7)
    fresh, _ = play(other, seed=7)
    assert np.array_equal(first, again)
    assert np.array_equal(first, fresh)
    assert not np.array_equal(first[0], env.reset()[0]), "the next episode has another goal"
    env.close()
    other.close()


def test_actions_are_clipped_and_checked():
    env = ArmGymEnv()
    env.reset(seed=0)
    one = env.step(np.array([5.0, -7.0, 0.5]))[0]
    env.reset(seed=0)
    assert np.array_equal(one, env.step(np.array([1.0, -1.0, 0.5]))[0])
    with pytest.raises(ValueError, match="action must be finite, got NaN"):
        env.step(np.array([0, np.nan, 0], np.float32))
    with pytest.raises(ValueError, match=r"action must have shape \(3,\), got \(4,\)"):
        env.step(np.zeros(4, np.float32))
    frozen = np.zeros(3, np.float32)
    frozen.flags.writeable = False
    env.step(frozen)
    env.close()


def test_unbounded_actions():
    env = ArmGymEnv(action=PAPER_JOINT)
    assert env.action_space.shape == (7,)
    assert not env.action_space.is_bounded()
    env.action_space.seed(0)
    action = env.action_space.sample()
    assert env.action_space.contains(action)
    env.reset(seed=0)
    assert env.observation_space.contains(env.step(action)[0])
    env.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"num_envs": 2}, TypeError, "num_envs must not be given, got 2: an ArmGymEnv is one"),
        ({"gui": True}, TypeError, "gui must not be given, got True"),
        ({"render_mode": "ansi"}, ValueError, "render_mode must be None or one of .* got 'ansi'"),
        ({"frame_skip": 0}, ValueError, "frame_skip must be a whole number of at least 1, got 0"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        ArmGymEnv(**arguments)


def test_options_are_refused():
    env = ArmGymEnv()
    with pytest.raises(ValueError, match=r"options must be empty, got \{'goal': 1\}"):
        env.reset(options={"goal": 1})
    env.reset(options={})
    env.close()


def test_render():
    env = ArmGymEnv(render_mode="rgb_array")
    env.reset(seed=0)
    env_render_passive_checker(env)
    before = env.render()
    assert before.shape == (240, 320, 3)
    assert before.dtype == np.uint8
    assert before.std() > 10
    for _ in range(5):
        env.step(np.ones(3, np.float32))
    assert not np.array_equal(before, env.render())
    env.close()
    env.close()
    blind = ArmGymEnv()
    blind.reset(seed=0)
    assert blind.render() is None
    blind.close()


def straight_at_the_goal(env, seed):
    """The outcomes of an episode in a loop such as OmniSafe's."""
    outcomes, over = [], False
    env.reset(seed=seed)
    arm = env.unwrapped.arm_env
    while not over:
        delta = (arm.arm_state.goal - arm.arm_state.ee_position)[0] / arm.action_mode.step
        outcomes.append(env.step(np.clip(delta, -1, 1).astype(np.float32))[1:])
        _, terminated, truncated, _ = outcomes[-1]
        over = terminated or truncated
    return outcomes


def test_loop_that_reads_the_cost_of_info():
    """The obstacle stands in the way: every episode touches it."""
    env = gymnasium.make(NAME)
    for seed in range(3):
        assert sum(info["cost"] for *_, info in straight_at_the_goal(env, seed)) >= 1
    env.close()


def test_success_terminates():
    env = gymnasium.make("torchrl_safe/PandaReach-v0")
    *before, (_, terminated, truncated, info) = straight_at_the_goal(env, seed=0)
    env.close()
    assert (terminated, truncated, info["is_success"]) == (True, False, True)
    assert len(before) < 39
    assert not any(info["is_success"] for *_, info in before)


def test_the_info_tells_what_the_shield_has_done(turntable):
    """A ball before the bar shortens the way; one on each side stops it."""
    before, *beside = (0.45, 0.25, 0.5), (0.45, 0.16, 0.5), (0.45, -0.16, 0.5)
    infos = []
    for places in ([before], beside):
        layout = Places(*(Sphere(0.1) for _ in places), at=places)
        shield = Shield(margin=0.02, rate=5.0)
        env = ArmGymEnv(**{**turntable, "obstacles": layout, "shield": shield})
        env.reset()
        infos.append(env.step(np.ones(1, np.float32))[-1])
        env.close()
    assert [info["shield_braked"] for info in infos] == [False, True]
    assert 0.05 < infos[0]["shield_correction"] < 0.07
    assert infos[1]["shield_correction"] == pytest.approx(0.1)


@pytest.mark.integration
def test_stable_baselines_learns_on_it():
    """Policy and value change, episodes are as long as the arm's time limit allows."""
    env = Monitor(gymnasium.make(NAME), info_keywords=("is_success",))
    model = PPO("MlpPolicy", env, n_steps=256, n_epochs=2, seed=0, device="cpu")
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(1_000)
    after = [*model.policy.parameters()]
    assert all(torch.isfinite(parameter).all() for parameter in after)
    changed = [not torch.equal(*pair) for pair in zip(before, after, strict=True)]
    assert all(changed)
    assert model.num_timesteps == 1024
    lengths = env.get_episode_lengths()
    assert max(lengths) == 40
    assert sum(lengths) == pytest.approx(1024, abs=40)
    env.close()
