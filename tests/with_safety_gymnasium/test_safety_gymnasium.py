"""SafeGymEnv and SafeGymWrapper around Safety-Gymnasium, compared with Safety-Gymnasium alone.

`make test-safety-gymnasium` runs these tests.
"""

import importlib.util
from functools import partial

import numpy as np
import pytest
import torch

safety_gymnasium = pytest.importorskip(
    "safety_gymnasium", reason="pins gymnasium==0.28.1: `make test-safety-gymnasium` installs both"
)

import gymnasium  # noqa: E402
from torchrl.collectors import Collector  # noqa: E402
from torchrl.envs import ParallelEnv, RewardSum, SerialEnv, TransformedEnv  # noqa: E402
from torchrl.envs.libs.safety_gymnasium import SafetyGymnasiumEnv  # noqa: E402
from torchrl.envs.utils import check_env_specs  # noqa: E402

from torchrl_safe.envs import CostToReward, EarlyTermination  # noqa: E402
from torchrl_safe.envs.gym import SafeGymEnv, SafeGymWrapper  # noqa: E402

SWIMMER = "SafetySwimmerVelocity-v1"
EPISODE = 12


def five(name):
    """The name by which Gymnasium knows an environment, whose steps have five values."""
    return name.replace("-v", "Gymnasium-v")


both = pytest.mark.parametrize("name", [SWIMMER, five(SWIMMER)], ids=["six", "five"])


def play(name, seed, actions, keys=("cost",), max_episode_steps=EPISODE):
    """What Safety-Gymnasium returns for actions, an episode after the other."""
    env = safety_gymnasium.make(name, max_episode_steps=max_episode_steps)
    env.reset(seed=seed)
    observation, _ = env.reset()  # As set_seed and rollout do it.
    rows = []
    for action in actions:
        after, reward, cost, terminated, truncated, info = env.step(action)
        costs = [{**info, "cost": cost}[key] for key in keys]
        rows.append((observation, after, reward, costs, terminated, truncated))
        observation = env.reset()[0] if terminated or truncated else after
    env.close()
    return [np.array(column) for column in zip(*rows, strict=True)]


def replay(env, seed, actions):
    """A rollout of the same actions, shape (*batch, steps, action)."""
    env.set_seed(seed)
    turns = iter(torch.as_tensor(actions).unbind(-2))
    steps = actions.shape[-2]
    return env.rollout(
        steps, lambda tensordict: tensordict.set("action", next(turns)), break_when_any_done=False
    )


def check_same(rollout, expected):
    observation, after, reward, costs, terminated, truncated = map(torch.as_tensor, expected)
    assert torch.equal(rollout["observation"], observation)
    assert torch.equal(rollout["next", "observation"], after)
    assert torch.equal(rollout["next", "reward"].squeeze(-1), reward.float())
    assert torch.equal(rollout["next", "cost"], costs.float())
    assert torch.equal(rollout["next", "terminated"].squeeze(-1), terminated)
    assert torch.equal(rollout["next", "truncated"].squeeze(-1), truncated)
    assert "cost" not in rollout


def swim(*batch, steps=3 * EPISODE + 2, seed=0):
    # Gymnasium's wrappers do not change the action.
    drawn = np.random.default_rng(seed).uniform(-1, 1, (*batch, steps, 2))
    return drawn.astype(np.float32)


def test_this_needs_no_robot_arms():
    assert importlib.util.find_spec("pybullet") is None
    assert gymnasium.__version__ == "0.28.1"


@both
def test_made_by_name(make_env, name):
    env = make_env(SafeGymEnv, name, max_episode_steps=EPISODE)
    check_env_specs(env)
    assert env.batch_size == ()
    actions = swim()
    expected = play(SWIMMER, 3, actions)
    assert expected[3].sum() > 0
    assert expected[5].sum() == 3
    check_same(replay(env, 3, actions), expected)


def test_a_module_may_stand_before_the_name(make_env):
    for name in (SWIMMER, five(SWIMMER)):
        env = make_env(SafeGymEnv, f"safety_gymnasium:{name}", max_episode_steps=EPISODE)
        actions = swim(steps=4)
        check_same(replay(env, 0, actions), play(SWIMMER, 0, actions))


def test_a_name_that_nobody_knows():
    with pytest.raises(gymnasium.error.NameNotFound, match="SafetyNothing"):
        SafeGymEnv("SafetyNothing-v0")


@pytest.mark.parametrize(
    "make",
    [partial(safety_gymnasium.make, SWIMMER), partial(gymnasium.make, five(SWIMMER))],
    ids=["six", "five"],
)
def test_wrapped(make_env, make):
    env = make_env(SafeGymWrapper, make(max_episode_steps=EPISODE))
    check_env_specs(env)
    actions = swim()
    check_same(replay(env, 5, actions), play(SWIMMER, 5, actions))


VECTORS = {
    "six-sync": partial(safety_gymnasium.vector.make, SWIMMER, 2, asynchronous=False),
    "five-sync": partial(gymnasium.vector.make, five(SWIMMER), 2, asynchronous=False),
    "six-async": partial(safety_gymnasium.vector.make, SWIMMER, 2),
    "five-async": partial(gymnasium.vector.make, five(SWIMMER), 2),
}


def rows(name, seed, actions):
    """The same for several environments, of which each has the next seed."""
    alone = [play(name, seed + row, each) for row, each in enumerate(actions)]
    return [np.stack(column) for column in zip(*alone, strict=True)]


@pytest.mark.parametrize("make", VECTORS.values(), ids=VECTORS.keys())
def test_vectorized(make_env, forked_workers, make):
    """These environments reset themselves; the last step of an episode is the true one."""
    env = make_env(SafeGymWrapper, make(max_episode_steps=EPISODE))
    check_env_specs(env)
    actions = swim(2)
    expected = rows(SWIMMER, 3, actions)
    assert expected[3][:, EPISODE - 1 :: EPISODE].sum() > 0, "no last step with a cost"
    check_same(replay(env, 3, actions), expected)


def test_early_termination_takes_single_ones(make_env):
    """Those of Gymnasium 0.28 reset themselves, and cannot be reset when a transform says so."""
    env = make_env(SafeGymEnv, SWIMMER, num_envs=2, asynchronous=False)
    early = env.append_transform(EarlyTermination(1))
    with pytest.raises(RuntimeError, match="put single ones in a SerialEnv or a ParallelEnv"):
        early.rollout(100, break_when_any_done=False)
    serial = SerialEnv(2, partial(SafeGymEnv, SWIMMER))
    early = make_env(TransformedEnv, serial, EarlyTermination(1))
    rollout = early.rollout(100, break_when_any_done=False)
    assert rollout["next", "terminated"].any()
    assert rollout["accumulated_cost"].max() <= 1


def test_rows_that_end_apart(make_env):
    factories = [partial(safety_gymnasium.make, SWIMMER, max_episode_steps=n) for n in (3, 5)]
    vector = safety_gymnasium.vector.SafetySyncVectorEnv(factories)
    env = make_env(SafeGymWrapper, vector)
    rollout = env.rollout(16, break_when_any_done=False)
    done = rollout["next", "done"].squeeze(-1)
    assert [row.nonzero().flatten().tolist() for row in done] == [[2, 5, 8, 11, 14], [4, 9, 14]]
    assert not rollout["next", "observation"].isnan().any()
    # After an end comes another beginning; elsewhere a step begins where the one before ended.
    goes_on = (rollout["observation"][:, 1:] == rollout["next", "observation"][:, :-1]).all(-1)
    assert torch.equal(goes_on, ~done[:, :-1])
    # A swimmer at rest has velocities of noise, of 0.1 at most; after steps they are faster.
    assert rollout["observation"][:, 1:][done[:, :-1]].abs().max() <= 0.1


@both
@pytest.mark.parametrize("asynchronous", [True, False])
def test_vectorized_by_name(make_env, forked_workers, name, asynchronous):
    env = make_env(
        SafeGymEnv, name, num_envs=2, asynchronous=asynchronous, max_episode_steps=EPISODE
    )
    assert env.batch_size == (2,)
    actions = swim(2)
    check_same(replay(env, 1, actions), rows(SWIMMER, 1, actions))


@both
def test_new_processes_know_the_name(make_env, name):
    """TorchRL spawns workers, in which nobody has imported Safety-Gymnasium."""
    env = make_env(SafeGymEnv, name, num_envs=1)
    assert env.rollout(2)["next", "cost"].shape == (1, 2, 1)


@pytest.mark.parametrize("kind", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_batched_by_torchrl(make_env, kind):
    env = make_env(kind, 2, partial(SafeGymEnv, SWIMMER, max_episode_steps=EPISODE))
    check_env_specs(env)
    rollout = env.rollout(EPISODE + 1, break_when_any_done=False)
    assert rollout["next", "truncated"].squeeze(-1).sum(-1).tolist() == [1, 1]


# Each reset of this task takes a second. With this seed, a point that drives straight on is in a
# hazard in its last steps.
BUTTON, SEED = "SafetyPointButton1-v0", 3
NAMED = ["cost_gremlins", "cost_hazards", "cost_sum", "cost"]
AHEAD = np.tile(np.array([1, 0], np.float32), (38, 1))


@pytest.fixture(scope="module")
def touching():
    outcome = play(BUTTON, SEED, AHEAD, NAMED, max_episode_steps=len(AHEAD))
    assert outcome[3][-1].tolist() == [0, 1, 1, 1]
    assert outcome[5][-1]
    return outcome


def test_named_costs(make_env, touching):
    env = make_env(SafeGymEnv, BUTTON, cost_keys=NAMED, max_episode_steps=len(AHEAD))
    check_same(replay(env, SEED, AHEAD), touching)


def test_named_costs_of_vectors(make_env, touching):
    """Those of the last step stand apart from those of the others."""
    vector = gymnasium.vector.make(
        five(BUTTON), 1, asynchronous=False, max_episode_steps=len(AHEAD)
    )
    env = make_env(SafeGymWrapper, vector, cost_keys=NAMED)
    check_same(replay(env, SEED, AHEAD[None])[0], touching)


@pytest.mark.parametrize("num_envs", [0, 2])
def test_a_cost_that_is_left_out_after_a_press(make_env, num_envs):
    """Safety-Gymnasium itself takes it for 0: it is not in the sum."""
    keys = ["cost_buttons", "cost_gremlins", "cost_hazards", "cost_sum"]
    env = make_env(SafeGymEnv, BUTTON, cost_keys=keys, num_envs=num_envs, asynchronous=False)
    env.set_seed(SEED)
    first = (env._env.envs[0] if num_envs else env._env).unwrapped
    costs, tensordict = [], env.reset()
    for step, action in enumerate(torch.as_tensor(AHEAD)):
        if step == 33:
            first.task.buttons.reset_timer()  # As the task does where the goal button is touched.
        assert ("cost_buttons" in first.task.calculate_cost()) == (step < 33)
        tensordict["action"] = action.expand(env.action_spec.shape)
        after, tensordict = env.step_and_maybe_reset(tensordict)
        costs.append(after["next", "cost"])
    costs = torch.stack(costs)
    assert torch.equal(costs[..., :3].sum(-1), costs[..., 3])
    assert costs[-1].reshape(-1, 4)[0].tolist() == [0, 0, 1, 1]


def test_a_cost_that_was_never_there_is_not_left_out(make_env):
    with pytest.raises(KeyError, match=r"info must have \('cost_button',\) in every step"):
        make_env(SafeGymEnv, BUTTON, cost_keys=["cost_button"]).rollout(1)


def test_named_costs_of_rows_that_end_apart(make_env):
    """No task with named costs has a fast reset, so the steps of this one are counted."""

    class Named(gymnasium.Wrapper):
        def reset(self, **kwargs):
            self.count = 0
            return self.env.reset(**kwargs)

        def step(self, action):
            *outcome, info = self.env.step(action)
            self.count += 1
            return *outcome, {**info, "count": self.count, "costs": {"half": self.count / 2}}

    def start(steps):
        return Named(safety_gymnasium.make(SWIMMER, max_episode_steps=steps))

    vector = safety_gymnasium.vector.SafetySyncVectorEnv([partial(start, 3), partial(start, 4)])
    env = make_env(SafeGymWrapper, vector, cost_keys=["count", ("costs", "half")])
    check_env_specs(env)
    count = torch.tensor([[1, 2, 3, 1, 2, 3, 1, 2], [1, 2, 3, 4, 1, 2, 3, 4]])
    cost = env.rollout(8, break_when_any_done=False)["next", "cost"]
    assert torch.equal(cost, torch.stack([count, count / 2], dim=-1))


def test_a_cost_that_is_not_reported(make_env):
    message = r"info must have \('cost_lava',\) in every step, got only"
    with pytest.raises(KeyError, match=message):
        make_env(SafeGymEnv, SWIMMER, cost_keys=["cost_lava"]).rollout(1)
    vector = safety_gymnasium.vector.make(SWIMMER, 2, asynchronous=False, max_episode_steps=1)
    with pytest.raises(KeyError, match=message):
        make_env(SafeGymWrapper, vector, cost_keys=["cost_lava"]).rollout(1)


def test_frames_that_are_skipped(make_env):
    env = make_env(SafeGymEnv, SWIMMER, frame_skip=2, max_episode_steps=EPISODE)
    actions = swim(steps=EPISODE // 2)
    rollout = replay(env, 2, actions)
    _, after, reward, costs, _, truncated = play(SWIMMER, 2, actions.repeat(2, axis=0))
    assert torch.equal(rollout["next", "observation"], torch.as_tensor(after[1::2]))
    twice = torch.as_tensor(reward.reshape(-1, 2).sum(1)).float()
    assert torch.equal(rollout["next", "reward"].squeeze(-1), twice)
    assert torch.equal(
        rollout["next", "cost"], torch.as_tensor(costs.reshape(-1, 2, 1).sum(1)).float()
    )
    assert rollout["next", "truncated"].squeeze(-1).tolist() == truncated[1::2].tolist()


def test_after_torchrls_own(make_env):
    theirs = make_env(
        TransformedEnv, SafetyGymnasiumEnv(SWIMMER, max_episode_steps=EPISODE), CostToReward()
    )
    check_env_specs(theirs)
    ours = make_env(SafeGymEnv, SWIMMER, max_episode_steps=EPISODE)
    assert theirs.reward_spec == ours.reward_spec
    actions = swim()
    check_same(replay(theirs, 4, actions), play(SWIMMER, 4, actions))


@pytest.mark.parametrize(
    "make",
    [
        partial(SafeGymEnv, SWIMMER, max_episode_steps=EPISODE),
        lambda: SafeGymWrapper(VECTORS["six-sync"](max_episode_steps=EPISODE)),
        lambda: TransformedEnv(
            SafetyGymnasiumEnv(SWIMMER, max_episode_steps=EPISODE), CostToReward()
        ),
    ],
    ids=["single", "vector", "torchrl"],
)
def test_sums_in_a_collector(make_env, make):
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    env = make_env(lambda: make().append_transform(sums))
    width = max(1, env.batch_size.numel())
    collector = Collector(env, frames_per_batch=10 * width, total_frames=40 * width)
    data = torch.cat(list(collector), dim=-1).reshape(width, -1)
    collector.shutdown()
    for key in ("cost", "reward"):
        sums = data["next", key][:, : 3 * EPISODE].reshape(width, 3, EPISODE).sum(-1)
        told = data["next", f"episode_{key}"][:, EPISODE - 1 :: EPISODE].squeeze(-1)
        torch.testing.assert_close(told, sums)
