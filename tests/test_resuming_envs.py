"""An environment or collector that loads a state continues as the saved one, bit for bit."""

import copy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import (
    Compose,
    GymEnv,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    VecNormV2,
)

from torchrl_safe.collectors import ResumableCollector
from torchrl_safe.envs import (
    PAPER_CARTESIAN,
    PAPER_JOINT,
    UR5,
    XARM7,
    ArmEnv,
    Bullet,
    CartesianDelta,
    ContactForce,
    Cylinder,
    EarlyTermination,
    Human,
    InFront,
    JointDelta,
    Moving,
    PickAndPlace,
    Proximity,
    Push,
    Scattered,
    Shield,
    paper_env,
)

pytestmark = pytest.mark.usefixtures("engine")

ROLLING = InFront(shape=Cylinder(mass=1.0))
ENVS = {
    "default": ArmEnv,
    "joints-scattered": partial(ArmEnv, action=JointDelta(), obstacles=Scattered()),
    "rolling": partial(ArmEnv, obstacles=ROLLING, costs={"force": ContactForce(limit=10.0)}),
    "moving": partial(ArmEnv, UR5, obstacles=Moving(), costs={"near": Proximity(0.1)}),
    "human": partial(ArmEnv, obstacles=Human()),
    "push": partial(ArmEnv, task=Push()),
    "pick-and-place": partial(ArmEnv, task=PickAndPlace(), action=CartesianDelta(finger_step=0.04)),
    "paper-cartesian": partial(paper_env, PAPER_CARTESIAN),
    "paper-joint": partial(paper_env, PAPER_JOINT),
}
# One with what is fixed, one with what rolls, one with what moves, one with what is carried.
QUICK = {"default", "rolling", "moving", "pick-and-place", "paper-cartesian"}


def play(env, actions, td):
    """Steps through all actions, rows that are done begin anew; returns all that was seen."""
    seen = []
    for action in actions:
        result, td = env.step_and_maybe_reset(td.set("action", action))
        seen.append(result)
    return torch.stack(seen), td


def assert_equal(one, two):
    assert set(one.keys(True, True)) == set(two.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], two[key]), key


def through_a_file(state, folder):
    torch.save(state, folder / "state.pt")
    return torch.load(folder / "state.pt", weights_only=True)


@pytest.mark.parametrize(
    "factory",
    [
        pytest.param(factory, id=name, marks=() if name in QUICK else pytest.mark.slow)
        for name, factory in ENVS.items()
    ],
)
def test_a_loaded_environment_goes_on_bit_for_bit(make_env, tmp_path, factory):
    """With rows at different steps: some were reset before the others were done."""
    env = make_env(factory, num_envs=3, seed=3, max_episode_steps=9)
    generator = torch.manual_seed(0)
    actions = torch.rand(40, *env.action_spec.shape, generator=generator) * 2 - 1
    # A second time in the same direction: towards what can be touched.
    actions[:, 1] = actions[:1, 1]
    _, td = play(env, actions[:5], env.reset())
    mask = torch.tensor([[True], [False], [False]])
    td = env.reset(td.set("_reset", mask)).exclude("_reset")
    _, td = play(env, actions[5:16], td)
    state, td = through_a_file(env.state_dict(), tmp_path), td.clone()
    expected, _ = play(env, actions[16:], td.clone())
    assert expected["next", "done"].any(0).all()

    fresh = make_env(factory, num_envs=3, seed=77, max_episode_steps=9)
    used = make_env(factory, num_envs=3, seed=78, max_episode_steps=9)
    play(used, actions[:13], used.reset())
    for other in (fresh, used, env):
        other.load_state_dict(state)
        got, _ = play(other, actions[16:], td.clone())
        assert_equal(expected, got)


def test_a_state_that_was_loaded_can_be_saved_again(make_env):
    one, two, three = (make_env(ArmEnv, num_envs=2, seed=seed) for seed in range(3))
    actions = torch.rand(60, 2, 3) * 2 - 1
    _, td = play(one, actions[:20], one.reset())
    two.load_state_dict(one.state_dict())
    _, later = play(two, actions[20:35], td.clone())
    three.load_state_dict(two.state_dict())
    got, _ = play(three, actions[35:], later.clone())
    expected, _ = play(one, actions[20:], td)
    assert_equal(expected[15:], got)


def test_a_state_does_not_change_when_the_environment_goes_on(make_env):
    env = make_env(ArmEnv, num_envs=2, seed=0)
    env.reset()
    saved = env.state_dict()
    kept = copy.deepcopy(saved)
    env.rollout(5)
    for name, value in kept["_extra_state"].items():
        assert torch.equal(value, saved["_extra_state"][name]), name


def test_a_seed_between_two_episodes_is_kept(make_env):
    one, two = (make_env(ArmEnv, num_envs=1, seed=seed) for seed in range(2))
    one.reset()
    one.set_seed(5)
    two.load_state_dict(one.state_dict())
    assert torch.equal(one.reset()["observation"], two.reset()["observation"])


def test_in_batched_environments(make_env):
    """ParallelEnv of TorchRL 0.14.1 reads its first step after a load before it is there."""
    one, two = (
        make_env(SerialEnv, 2, partial(ArmEnv, num_envs=2, max_episode_steps=9)) for _ in range(2)
    )
    one.set_seed(1)
    actions = torch.rand(30, 2, 2, 3) * 2 - 1
    _, td = play(one, actions[:13], one.reset())
    state = copy.deepcopy(one.state_dict())
    two.reset()
    two.load_state_dict(state)
    expected, _ = play(one, actions[13:], td.clone())
    got, _ = play(two, actions[13:], td.clone())
    assert_equal(expected, got)


def test_a_state_of_other_worlds_is_refused(make_env):
    env = make_env(ArmEnv, num_envs=2)
    for other in (make_env(ArmEnv), make_env(ArmEnv, UR5, num_envs=2)):
        with pytest.raises(ValueError, match="state must be of an environment like this one"):
            env.load_state_dict(other.state_dict())


def test_a_refused_state_leaves_the_running_episodes(make_env):
    env, twin = (make_env(ArmEnv, num_envs=2, seed=0) for _ in range(2))
    actions = torch.rand(10, 2, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    _, td = play(env, actions[:5], env.reset())
    play(twin, actions[:5], twin.reset())
    other = make_env(ArmEnv, UR5, num_envs=2)
    other.reset()
    with pytest.raises(ValueError, match=r"of an environment like this one|whose"):
        env.load_state_dict(other.state_dict())
    assert_equal(play(twin, actions[5:], td.clone())[0], play(env, actions[5:], td.clone())[0])


def test_a_state_without_a_shield_is_refused_behind_one(make_env):
    env = make_env(ArmEnv, num_envs=1, shield=Shield())
    with pytest.raises(ValueError, match=r"got no \['shield_braked', 'shield_correction'\]"):
        env.load_state_dict(make_env(ArmEnv, num_envs=1).state_dict())


def test_a_state_from_before_the_first_reset_has_no_episode_to_go_on_with(make_env):
    env, other = make_env(ArmEnv, num_envs=1, seed=3), make_env(ArmEnv, num_envs=1)
    other.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match="reset"):
        other.step(TensorDict({"action": torch.zeros(1, 3)}, [1]))
    assert torch.equal(other.reset()["observation"], env.reset()["observation"])


def test_a_state_that_does_not_come_back_is_told_of(make_env):
    """By PyBullet, which plays the episodes again; MuJoCo takes the state as it was."""
    env = make_env(ArmEnv, num_envs=1, seed=0, physics=Bullet())
    env.rollout(3)
    other = make_env(ArmEnv, num_envs=1, physics=Bullet(urdf_inertia=True))
    with pytest.warns(UserWarning, match="did not come back bit for bit"):
        other.load_state_dict(env.state_dict())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame_skip": 6}, "whose frame_skip is 6, got 12"),
        ({"arm": XARM7}, r"whose home is \[.*\], got \[.*\]"),
    ],
    ids=["frame-skip", "arm"],
)
def test_a_state_of_another_build_is_refused(make_env, changes, message):
    env = make_env(ArmEnv, num_envs=1, seed=0)
    env.rollout(3)
    other = make_env(ArmEnv, num_envs=1, **changes)
    with pytest.raises(ValueError, match=message):
        other.load_state_dict(env.state_dict())


def test_a_closed_environment_has_no_state(make_env):
    env = make_env(ArmEnv)
    env.close()
    with pytest.raises(RuntimeError, match="This ArmEnv is closed"):
        env.state_dict()


class Noisy(torch.nn.Module):
    """Draws from torch's global generator, as policies do."""

    def __init__(self, width):
        super().__init__()
        self.net = torch.nn.Linear(width, 3)

    def forward(self, observation):
        return self.net(observation) + torch.randn(*observation.shape[:-1], 3)


def make_noisy(env):
    torch.manual_seed(0)
    return TensorDictModule(
        Noisy(env.observation_spec["observation"].shape[-1]), ["observation"], ["action"]
    )


def make_training_env(num_envs):
    transforms = Compose(RewardSum(["reward"]), EarlyTermination(2.0))
    return TransformedEnv(ArmEnv(num_envs=num_envs, max_episode_steps=9), transforms)


def collect(make, batches):
    """Batches of one collector; then of another that is loaded after the first batches."""
    one, two = make(), make()
    try:
        one.set_seed(0)
        iterator = iter(one)
        for _ in range(batches):
            next(iterator)
        state = copy.deepcopy(one.state_dict())
        expected = [next(iterator).clone() for _ in range(2)]
        two.load_state_dict(state)
        iterator = iter(two)
        return expected, [next(iterator).clone() for _ in range(2)]
    finally:
        one.shutdown()
        two.shutdown()


SETTINGS = {
    "frames_per_batch": 28,
    "total_frames": 28 * 5,
    "auto_register_policy_transforms": False,
}


def test_a_loaded_collector_goes_on_bit_for_bit():
    def make(kind=ResumableCollector):
        env = make_training_env(4)
        return kind(env, make_noisy(env), **SETTINGS)

    expected, got = collect(make, 3)
    for one, two in zip(expected, got, strict=True):
        assert_equal(one, two)
    # That is more than TorchRL's own does.
    expected, got = collect(partial(make, Collector), 3)
    assert not torch.equal(expected[0]["observation"], got[0]["observation"])


def test_a_collector_of_several_arms_goes_on_bit_for_bit():
    """Their states are parts of that of their SerialEnv."""

    def make():
        env = SerialEnv(2, partial(ArmEnv, max_episode_steps=9))
        return ResumableCollector(env, make_noisy(env), **SETTINGS)

    for one, two in zip(*collect(make, 3), strict=True):
        assert_equal(one, two)


def test_a_loaded_collector_ends_where_the_saved_one_would():
    def make():
        env = make_training_env(4)
        return ResumableCollector(env, make_noisy(env), **SETTINGS)

    one, two = make(), make()
    iterator = iter(one)
    for _ in range(4):
        next(iterator)
    two.load_state_dict(one.state_dict())
    assert len(list(two)) == len(list(iterator)) == 1
    one.shutdown()
    two.shutdown()


def test_without_transforms_and_as_torchrls_own(make_env):
    kinds = [(Collector, Collector), (ResumableCollector,) * 2, (Collector, ResumableCollector)]
    for pair in kinds:
        one, two = (
            kind(make_env(ArmEnv, num_envs=2), make_noisy(make_env(ArmEnv)), **SETTINGS)
            for kind in pair
        )
        next(iter(one))
        two.load_state_dict(one.state_dict())
        assert len(list(two)) == 4
        one.shutdown()
        two.shutdown()


def pendulum():
    return TransformedEnv(GymEnv("Pendulum-v1"), RewardSum(["reward"]))


def two_with_transforms():
    return SerialEnv(2, [partial(make_training_env, 1)] * 2)


def two_processes():
    two = ParallelEnv(2, partial(ArmEnv, num_envs=1), mp_start_method="fork")
    return TransformedEnv(two, RewardSum(["reward"]))


@pytest.mark.parametrize("make", [pendulum, two_with_transforms, two_processes])
def test_environments_without_a_state_begin_anew(make):
    """Sums and observations too, which would otherwise be those of another episode."""
    settings = {**SETTINGS, "frames_per_batch": 10}

    def collector():
        env = make()
        actions = env.action_spec.shape[-1]
        policy = TensorDictModule(torch.nn.LazyLinear(actions), ["observation"], ["action"])
        return ResumableCollector(env, policy, **settings)

    one, two = collector(), collector()
    try:
        next(iter(one))
        with pytest.warns(UserWarning, match="Episodes begin anew, so the run differs"):
            two.load_state_dict(one.state_dict())
        batch = next(iter(two)).reshape(-1, 10 // (1 if make is pendulum else 2))
        sums, rewards = batch["next", "episode_reward"], batch["next", "reward"]
        torch.testing.assert_close(sums[:, 0], rewards[:, 0])
        assert rewards.all()  # None is of a step that was not there yet.
    finally:
        one.shutdown()
        two.shutdown()


def test_whole_trajectories_begin_anew():
    """What a batch left unfinished is not in the state: without its beginning it would be wrong."""

    def collector():
        env = TransformedEnv(ArmEnv(num_envs=2, max_episode_steps=7), StepCounter())
        trajectories = {"trajs_per_batch": 3, "traj_format": "padded"}
        return ResumableCollector(env, make_noisy(env), **SETTINGS, **trajectories)

    one, two = collector(), collector()
    next(iter(one))
    with pytest.warns(UserWarning, match="Episodes begin anew, so the run differs"):
        two.load_state_dict(one.state_dict())
    batch = next(iter(two))
    assert not batch["step_count"][:, 0].any()
    assert (batch["collector", "mask"].sum(-1) == 7).all()
    one.shutdown()
    two.shutdown()


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size")
def test_nested_transforms_go_on_bit_for_bit():
    """TorchRL's own state has those of the outermost environment only."""

    def make():
        norm = VecNormV2(["observation"], reduce_batch_dims=True)
        inner = TransformedEnv(ArmEnv(num_envs=2, seed=0), norm)
        env = TransformedEnv(inner, RewardSum(["reward", "cost"]), auto_unwrap=False)
        return ResumableCollector(env, make_noisy(env), **SETTINGS)

    expected, got = collect(make, 3)
    for one, two in zip(expected, got, strict=True):
        assert_equal(one, two)


def test_the_state_can_be_sent_by_a_worker():
    """As a TensorDict, which takes tensors only."""
    env = make_training_env(2)
    collector = ResumableCollector(env, make_noisy(env), **SETTINGS)
    next(iter(collector))
    sent = TensorDict(collector.state_dict())
    assert torch.equal(sent["torch_generator"], torch.get_rng_state())
    collector.shutdown()


@pytest.mark.slow
def test_with_workers():
    """Each worker has its own generator; only the numbers of trajectories may differ."""

    def make():
        env = make_training_env(2)
        policy = make_noisy(env)
        env.close()
        return MultiSyncCollector(
            [partial(make_training_env, 2)] * 2,
            policy,
            **SETTINGS,
            collector_class=ResumableCollector,
        )

    expected, got = collect(make, 3)
    for one, two in zip(expected, got, strict=True):
        assert_equal(one.exclude("collector"), two.exclude("collector"))
