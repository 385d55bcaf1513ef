"""ArmEnv inside TorchRL's own machinery, with two costs and with real worker processes."""

from functools import partial

import numpy as np
import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import ParallelEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.utils import RandomPolicy
from torchrl.modules import ProbabilisticActor, TanhNormal

from torchrl_safe.collectors import ResumableCollector
from torchrl_safe.envs import ArmEnv, Collision


def half(state):
    """A cost of one half in every step."""
    return np.full(len(state.goal), 0.5)


def make_env(num_envs, seed=None):
    env = ArmEnv(
        num_envs=num_envs,
        costs={"collision": Collision(), "half": half},
        max_episode_steps=6,
        seed=seed,
    )
    return TransformedEnv(env, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


def check(batch, shape):
    """Shapes of what was collected, and sums that are sums."""
    assert batch.shape == shape
    assert batch["next", "reward"].shape == (*shape, 1)
    assert batch["next", "cost"].shape == (*shape, 2)
    assert batch["next", "episode_cost"].shape == (*shape, 2)
    assert batch["next", "cost"].dtype == torch.float32
    # Nothing succeeds in six random steps, so that every episode lasts six.
    ended = batch["next", "done"].squeeze(-1)
    assert ended.any()
    assert torch.equal(batch["next", "truncated"].squeeze(-1), ended)
    assert (batch["next", "episode_cost"][ended][:, 1] == 3).all()
    rewards = batch["next", "reward"].reshape(-1, 2, 6, 1).sum(2)
    sums = batch["next", "episode_reward"].reshape(-1, 2, 6, 1)[:, :, -1]
    torch.testing.assert_close(sums, rewards)


def test_collector():
    env = make_env(2, seed=0)
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=24, total_frames=48)
    batches = list(collector)
    assert len(batches) == 2
    for batch in batches:
        check(batch, (2, 12))


@pytest.mark.parametrize(
    "batched", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")], ids=["serial", "parallel"]
)
def test_batched_environments(batched):
    env = batched(2, partial(make_env, 1))
    try:
        env.set_seed(3)
        batch = env.rollout(12, break_when_any_done=False)
        assert batch.shape == (2, 1, 12)
        check(batch.reshape(-1, 2, 12)[0], (2, 12))
    finally:
        env.close()


def test_batched_environments_draw_what_one_environment_draws():
    """The same seeds on any layout of the worlds."""
    whole = make_env(2, seed=3)
    split = SerialEnv(2, partial(make_env, 1))
    split.set_seed(3)
    try:
        actions = torch.rand(10, 2, 3, generator=torch.manual_seed(0))
        one, two = iter(actions), iter(actions)
        expected = whole.rollout(
            10, lambda td: td.set("action", next(one)), break_when_any_done=False
        )
        got = split.rollout(
            10, lambda td: td.set("action", next(two)[:, None]), break_when_any_done=False
        )
        for key in ("observation", ("next", "reward"), ("next", "cost")):
            assert torch.equal(expected[key], got[key][:, 0]), key
    finally:
        whole.close()
        split.close()


def test_multi_sync_collector_repeats_itself(forked_workers):
    """Two worker processes of two worlds each: right shapes, and twice the same."""
    runs = []
    for _ in range(2):
        policy = RandomPolicy(make_env_spec())
        collector = MultiSyncCollector(
            [partial(make_env, 2)] * 2, policy, frames_per_batch=48, total_frames=96
        )
        try:
            collector.set_seed(5)
            runs.append([batch.clone() for batch in collector])
        finally:
            collector.shutdown()
    for one, two in zip(*runs, strict=True):
        check(one.reshape(-1, 12)[:2], (2, 12))
        assert one.shape == (2, 2, 12)
        for key in ("observation", "action", ("next", "cost")):
            assert torch.equal(one[key], two[key]), key


def make_env_spec():
    env = make_env(2)
    spec = env.action_spec
    env.close()
    return spec


def resumable(device="cpu"):
    """A collector whose policy draws from the generator of its device."""
    policy = ProbabilisticActor(
        TensorDictModule(
            torch.nn.Sequential(torch.nn.Linear(40, 6), NormalParamExtractor()),
            ["observation"],
            ["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    return ResumableCollector(
        make_env(2, seed=0),
        policy.to(device),
        policy_device=device,
        env_device="cpu",
        storing_device="cpu",
        frames_per_batch=24,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_resuming_a_policy_on_cuda():
    one, other = resumable("cuda"), resumable("cuda")
    try:
        next(iter(one))
        state = one.state_dict()
        expected = next(iter(one)).clone()
        other.load_state_dict(state)
        assert torch.equal(next(iter(other))["action"], expected["action"])
    finally:
        one.shutdown()
        other.shutdown()


@pytest.mark.parametrize("devices", [0, 1, 2, 3])
def test_generators_of_every_cuda_device_are_saved(devices, monkeypatch):
    """Without a GPU here: the test checks the calls of torch.cuda for a state of two devices."""
    states = [torch.full((16,), index, dtype=torch.uint8) for index in (1, 2)]
    loaded = []
    collector = resumable()
    try:
        assert "cuda_generators" not in collector.state_dict()
        with monkeypatch.context() as patch:
            patch.setattr(torch.cuda, "is_initialized", lambda: True)
            patch.setattr(torch.cuda, "get_rng_state_all", lambda: states)
            state = collector.state_dict()
        monkeypatch.setattr(torch.cuda, "device_count", lambda: devices)
        monkeypatch.setattr(torch.cuda, "set_rng_state_all", loaded.extend)
        collector.load_state_dict(state)
    finally:
        collector.shutdown()
    assert [int(generator[0]) for generator in loaded] == [1, 2][:devices]
