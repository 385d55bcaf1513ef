"""TorchRL's sums over n steps, and repeated actions, with a cost beside the reward."""

from functools import partial

import pytest
import torch
from counting import CountingBatch, flagged
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, MultiStep, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    FrameSkipTransform,
    GymEnv,
    MultiStepTransform,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import ArmEnv, CostToReward, EarlyTermination, FrameSkip
from torchrl_safe.envs.gym import SafeGymEnv
from torchrl_safe.objectives import CostTD0

GAMMA = 0.5
# Of an episode of six steps, the sums of three: 4 + 5 / 2 + 6 / 4 and so on.
THREE = [2.75, 4.5, 6.25, 8.0, 8.0, 6.0]
ONE = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def make_batch():
    """Two episodes of six steps in a row; rewards and the first cost count, the second x 10."""
    count = torch.tensor(ONE * 2).reshape(1, 12, 1)
    done = count == 6
    return TensorDict(
        observation=count - 1,
        next=TensorDict(
            observation=count,
            reward=count,
            cost=torch.cat([count, 10 * count], -1),
            episode_cost=torch.cat([count, 10 * count], -1).cumsum(1),
            done=done,
            terminated=done,
            truncated=torch.zeros_like(done),
            batch_size=[1, 12],
        ),
        batch_size=[1, 12],
    )


def through_postproc(*reward_keys, done_keys=None):
    postproc = MultiStep(gamma=GAMMA, n_steps=3)
    if reward_keys:
        postproc.reward_keys = reward_keys
    if done_keys is not None:
        postproc.done_keys = done_keys
    return postproc(make_batch())


def summed_over_steps():
    return through_postproc("reward", "cost", done_keys=("done", "truncated"))


def through_buffer(**kwargs):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100, ndim=2),
        transform=MultiStepTransform(n_steps=3, gamma=GAMMA, **kwargs),
        batch_size=4,
    )
    buffer.extend(make_batch())
    return buffer[:]


def test_costs_are_summed_if_they_are_named():
    """By an attribute of MultiStep or an argument of MultiStepTransform; else the last is kept."""
    both = ("reward", "cost")
    for summed in (through_postproc(*both), through_buffer(reward_keys=[*both])):
        assert summed["next", "reward"][0, :6, 0].tolist() == THREE
        assert summed["next", "cost"][0, :6, 0].tolist() == THREE
        assert summed["next", "cost"][0, :6, 1].tolist() == [10 * number for number in THREE]
    for unsummed in (through_postproc(), through_buffer()):
        assert unsummed["next", "reward"][0, :6, 0].tolist() == THREE
        assert unsummed["next", "cost"][0, :6, 0].tolist() == [3, 4, 5, 6, 6, 6]


def test_original_reward_is_that_of_the_key_named_last():
    batch = make_batch()
    first = through_postproc("cost", "reward")["next", "original_reward"]
    last = through_postproc("reward", "cost")["next", "original_reward"]
    assert torch.equal(first, batch["next", "reward"])
    assert torch.equal(last, batch["next", "cost"])


def test_costs_of_whole_episodes_stay():
    """What an updater is stepped with: a step that ends an episode has nothing ahead of it."""
    batch, after = make_batch()["next"], summed_over_steps()["next"]
    assert torch.equal(after["done"], batch["done"])
    done = batch["done"].squeeze(-1)
    assert torch.equal(after["episode_cost"][done], batch["episode_cost"][done])


@pytest.mark.parametrize(
    ("make", "lost"),
    [
        (lambda: through_buffer(reward_keys=["cost", "reward"], done_keys=[]), 0),
        (lambda: through_buffer(reward_keys=["cost", "reward"]), 2),
        (summed_over_steps, 0),
        (lambda: through_postproc("reward", "cost"), 2),
    ],
    ids=["buffer", "buffer-default", "postproc", "postproc-default"],
)
def test_target_of_the_cost_critic(make, lost):
    """With TorchRL's own ``done_keys`` the last steps bootstrap from the end of the episode."""
    data = make()
    # A critic that says 100 and 1000 everywhere.
    data["next", "state_action_cost_value"] = torch.tensor([100.0, 1000.0]).expand(*data.shape, 2)
    target = CostTD0(gamma=GAMMA).value_estimate(data)[0, :6]
    ahead = [3, 3, 3, 3, 2, 1]
    bootstrapped = [100 * GAMMA**n for n in ahead]
    wanted = [
        sum_ + (value if step < 3 + lost else 0)
        for step, (sum_, value) in enumerate(zip(THREE, bootstrapped, strict=True))
    ]
    torch.testing.assert_close(target, torch.tensor([[w, 10 * w] for w in wanted]))


def test_in_a_collector(make_env):
    postproc = MultiStep(gamma=1.0, n_steps=3)
    postproc.reward_keys = ("reward", "cost")
    env = make_env(lambda: TransformedEnv(CountingBatch(2), CostToReward()))
    collector = Collector(env, frames_per_batch=12, total_frames=12, postproc=postproc)
    (batch,) = list(collector)
    # Row 0 has episodes of two steps, row 1 of three: costs 1/4, 2/4, 3/4.
    assert batch["next", "cost"][0, :, 0].tolist() == [0.75, 0.5] * 3
    assert batch["next", "cost"][1, :, 0].tolist() == [1.5, 1.25, 0.75] * 2
    assert torch.equal(batch["next", "reward"], 40 * batch["next", "cost"])


# ---------------------------------------------------------------- repeated actions


def counting(num_envs=None):
    return TransformedEnv(CountingBatch(num_envs), CostToReward())


class Half(Transform):
    def __init__(self):
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, state):
        return state * 0.5


def test_other_transforms_change_each_frames_action_once(make_env):
    """Wherever they stand: before, after, or around an environment inside."""

    def run(*transforms):
        env = GymEnv("Pendulum-v1")
        for transform in transforms:
            env = TransformedEnv(env, transform, auto_unwrap=False)
        env = make_env(lambda: env)
        env.set_seed(0)
        act = lambda td: td.set("action", torch.ones(1))  # noqa: E731
        return env.rollout(4, act)["next", "observation"]

    after = run(Compose(FrameSkip(3), Half()))
    assert torch.equal(run(Compose(Half(), FrameSkip(3))), after)
    assert torch.equal(run(Half(), FrameSkip(3)), after)
    assert not torch.equal(run(FrameSkip(3)), after)


def test_torchrls_own_takes_one_reward_only(make_env):
    env = make_env(lambda: counting().append_transform(FrameSkipTransform(2)))
    with pytest.raises(KeyError, match="more than one key"):
        env.rollout(2)


@pytest.mark.parametrize("wrap", [None, SerialEnv, ParallelEnv])
@pytest.mark.parametrize("num_envs", [None, 3], ids=["single", "batched"])
def test_repeats_and_sums(make_env, num_envs, wrap):
    """Rows of 2, 3 and 4 steps; what comes after the end of an episode counts nowhere."""
    settings = {"mp_start_method": "fork"} if wrap is ParallelEnv else {}
    make = partial(counting, num_envs)
    env = make_env(make if wrap is None else lambda: TransformedEnv(wrap(2, make, **settings)))
    env.append_transform(FrameSkip(2)).append_transform(
        RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    )
    check_env_specs(env)
    rollout = env.rollout(4, break_when_any_done=False)["next"]
    rows = {
        key: rollout[key].reshape(-1, num_envs or 1, 4)[0].tolist()
        for key in ("cost", "observation", "done", "episode_cost")
    }
    count = num_envs or 1
    expected = {
        "cost": [[0.75] * 4, [0.75, 0.75] * 2, [0.75, 1.75] * 2],
        "observation": [[2.0] * 4, [2.0, 3.0] * 2, [2.0, 4.0] * 2],
        "done": [[True] * 4, [False, True] * 2, [False, True] * 2],
        "episode_cost": [[0.75] * 4, [0.75, 1.5] * 2, [0.75, 2.5] * 2],
    }
    assert rows == {key: value[:count] for key, value in expected.items()}
    assert torch.equal(rollout["reward"], 40 * rollout["cost"])


def test_an_arm_repeats_as_by_hand(make_env):
    settings = {"num_envs": 2, "max_episode_steps": 7, "seed": 0}
    skipped = make_env(lambda: TransformedEnv(ArmEnv(**settings), FrameSkip(3)))
    plain = make_env(ArmEnv, **settings)
    start, td = skipped.reset(), plain.reset()
    assert torch.equal(start["observation"], td["observation"])
    for repeats in (3, 3, 1):
        action = torch.rand(2, 3) * 2 - 1
        got = skipped.step(TensorDict({"action": action}, batch_size=[2]))["next"]
        steps = [
            plain.step(TensorDict({"action": action}, batch_size=[2]))["next"]
            for _ in range(repeats)
        ]
        assert torch.equal(got["observation"], steps[-1]["observation"])
        for key in ("reward", "cost"):
            torch.testing.assert_close(got[key], sum(step[key] for step in steps))
    assert got["truncated"].all()


def test_of_a_gymnasium_environment(make_env):
    """Whose own frame_skip sums too."""
    envs = [
        make_env(lambda: TransformedEnv(SafeGymEnv("Counting-v0", steps=6), FrameSkip(2))),
        make_env(partial(SafeGymEnv, "Counting-v0", steps=6, frame_skip=2)),
    ]
    for env in envs:
        cost = env.rollout(5)["next", "cost"]
        assert cost.flatten().tolist() == [0.75, 1.75, 2.75]


def test_sums_and_budgets_may_come_before_it(make_env):
    """They see every step: costs of 0.25, 0.5, 0.75 and 1 in the row of four steps."""
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    env = make_env(lambda: counting(3).append_transform(sums).append_transform(FrameSkip(2)))
    check_env_specs(env)
    rollout = env.rollout(2, break_when_any_done=False)["next"][2]
    assert rollout["cost"].flatten().tolist() == [0.75, 1.75]
    assert rollout["episode_cost"].flatten().tolist() == [0.75, 2.5]

    early = EarlyTermination(2.0)
    env = make_env(lambda: counting(3).append_transform(early).append_transform(FrameSkip(2)))
    rollout = env.rollout(2, break_when_any_done=False)["next"][2]
    assert rollout["accumulated_cost"].flatten().tolist() == [0.75, 2.5]
    assert rollout["terminated"].flatten().tolist() == [False, True]


@pytest.mark.parametrize("frame_skip", [0, -1, 1.5, None])
def test_frame_skip_is_a_number(frame_skip):
    with pytest.raises(ValueError, match=f"frame_skip must be a whole number .* got {frame_skip}"):
        FrameSkip(frame_skip)


def test_frame_skip_sums_no_flags():
    with pytest.raises(ValueError, match=r"cost must be a number to be summed, got torch.bool"):
        flagged(FrameSkip(2)).rollout(1)


def test_frame_skip_is_for_environments():
    with pytest.raises(RuntimeError, match="FrameSkip repeats the steps of an environment"):
        FrameSkip(2)._step(TensorDict(), TensorDict())
