"""A policy in a file of its own: saved, loaded elsewhere, played with; other files are refused."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from programs import run_code
from tensordict import TensorDict
from tensordict.nn import (
    AddStateIndependentNormalScale,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
)
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import GymEnv, ObservationNorm, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    MLP,
    AdditiveGaussianModule,
    IndependentNormal,
    LSTMModule,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    TanhDelta,
    TanhNormal,
    TruncatedNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, SACLoss
from trained import train_briefly

from experiments.agent import Affine
from torchrl_safe import testing
from torchrl_safe.envs import ArmEnv
from torchrl_safe.evaluation import evaluate as play
from torchrl_safe.policy import load_policy, save_policy

OBSERVATIONS = torch.randn(64, 40, generator=torch.Generator().manual_seed(0))
SPEC = Composite(observation=Unbounded(40))

# What a user would run, in a process that has seen neither the training nor its networks.
ACT = """
import sys
import numpy as np
from torchrl_safe.policy import load_policy

policy = load_policy(sys.argv[1])
np.save(sys.argv[3], policy(np.load(sys.argv[2])))
assert not {"experiments", "torchrl_safe.envs", "torchrl_safe.objectives"} & set(sys.modules)
"""


def act(actor, observations=OBSERVATIONS):
    """What the actor itself does."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = TensorDict(observation=observations, batch_size=observations.shape[:1])
        return actor(tensordict)["action"].numpy()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train_briefly(tmp_path_factory.mktemp("run"))


@pytest.mark.integration
def test_acts_the_same_in_a_fresh_process(trained, tmp_path):
    actor, file = trained
    np.save(tmp_path / "observations.npy", OBSERVATIONS.numpy())
    arguments = [file, tmp_path / "observations.npy", tmp_path / "actions.npy"]
    done = run_code(ACT, *arguments, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    actions = np.load(tmp_path / "actions.npy")
    np.testing.assert_array_equal(actions, act(actor))
    assert len(np.unique(actions)) > 64


# ---------------------------------------------------------------- every kind of actor


class Mine(torch.nn.Module):
    """A network of the user's own, with a buffer that is not saved and no batch size in it."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.randn(40, 3))
        self.register_buffer("shift", torch.ones(3), persistent=False)

    def forward(self, observation):
        centred = observation - observation.mean(-1, keepdim=True)
        return torch.einsum("bi,ij->bj", centred, self.weight) + self.shift


def mlp(outputs=3, *after, **settings):
    return torch.nn.Sequential(MLP(40, outputs, num_cells=[16], **settings), *after)


def gaussian(distribution_class=TanhNormal, chosen=False, **settings):
    after = NormalParamExtractor() if chosen else AddStateIndependentNormalScale(3)
    return ProbabilisticActor(
        TensorDictModule(mlp(6 if chosen else 3, after), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution_class,
        return_log_prob=True,
        **settings,
    )


def deterministic(net):
    return TensorDictModule(net, ["observation"], ["action"])


def categorical():
    logits = TensorDictModule(mlp(), ["observation"], ["logits"])
    return ProbabilisticActor(logits, in_keys=["logits"], distribution_class=OneHotCategorical)


ACTORS = {
    "same-deviation": gaussian,
    "chosen-deviation": lambda: gaussian(chosen=True, spec=Bounded(-1, 1, (3,))),
    "unbounded": lambda: gaussian(IndependentNormal),
    "own-bounds": lambda: gaussian(
        distribution_kwargs={"low": torch.tensor([-1.0, -2, -3]), "high": torch.ones(3)}
    ),
    "deterministic": lambda: deterministic(mlp(3, torch.nn.Tanh())),
    "with-noise": lambda: TensorDictSequential(
        deterministic(mlp()), AdditiveGaussianModule(Bounded(-1, 1, (3,)))
    ),
    "tanh-delta": lambda: ProbabilisticActor(
        TensorDictModule(mlp(), ["observation"], ["param"]),
        in_keys=["param"],
        distribution_class=TanhDelta,
    ),
    "normalized": lambda: TensorDictSequential(
        ObservationNorm(0.5, 2.0, in_keys=["observation"]), gaussian()
    ),
    "layers": lambda: deterministic(
        torch.nn.Sequential(
            torch.nn.BatchNorm1d(40), torch.nn.Dropout(0.5), Affine(1.0, 2.0), mlp()
        )
    ),
    "attention": lambda: deterministic(
        # Among ten tokens of one observation.
        torch.nn.Sequential(
            torch.nn.Unflatten(-1, (10, 4)),
            torch.nn.TransformerEncoderLayer(4, 2, dim_feedforward=16, batch_first=True),
            torch.nn.Flatten(),
        )
    ),
    "own-network": lambda: deterministic(Mine()),
    "discrete": categorical,
    "values": lambda: QValueActor(
        mlp(),
        spec=Composite(action=None, action_value=None, chosen_action_value=None),
        action_space="categorical",
    ),
}


@pytest.mark.parametrize("make", ACTORS.values(), ids=ACTORS.keys())
def test_every_kind_of_actor(make, tmp_path):
    torch.manual_seed(0)
    actor = make()
    before = copy.deepcopy(actor.state_dict())
    generator = torch.get_rng_state()
    save_policy(tmp_path / "policy.pt", actor, SPEC, settings={"note": ["a", 1, None]})
    assert torch.equal(torch.get_rng_state(), generator)
    assert actor.training
    policy = load_policy(tmp_path / "policy.pt")
    assert policy.settings == {"note": ["a", 1, None]}
    expected = act(actor.eval())
    actions = policy(OBSERVATIONS.numpy())
    assert actions.dtype == expected.dtype
    assert actions.shape == expected.shape == (64, *policy.action_shape)
    np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-6)
    assert len(np.unique(actions, axis=0)) > 1
    # One observation alone.
    one = policy(OBSERVATIONS[5].numpy())
    np.testing.assert_allclose(one, act(actor, OBSERVATIONS[5:6])[0], rtol=1e-5, atol=1e-6)
    # Somebody goes on training.
    torch.manual_seed(1)
    other = make().eval()
    other.load_state_dict(policy.weights)
    np.testing.assert_array_equal(act(other), expected)
    assert all(torch.equal(weight, before[name]) for name, weight in policy.weights.items())


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_the_actor_of_a_loss(name, tmp_path):
    """A loss keeps its actor's weights elsewhere. The file has those that it trains."""
    if name == "ppo":
        loss = ClipPPOLoss(gaussian(), ValueOperator(mlp(1)))
    else:
        value = ValueOperator(MLP(43, 1), in_keys=["observation", "action"])
        loss = SACLoss(gaussian(chosen=True, spec=Bounded(-1, 1, (3,))), value)
    with torch.no_grad():
        for weight in loss.actor_network_params.values(True, True):
            weight.add_(0.1)
    save_policy(tmp_path / "policy.pt", loss.actor_network, SPEC)
    with loss.actor_network_params.to_module(loss.actor_network):
        expected = act(loss.actor_network)
    actions = load_policy(tmp_path / "policy.pt")(OBSERVATIONS.numpy())
    np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-6)


def test_a_file_holds_weights_once_and_nothing_else(tmp_path):
    """Not all that a weight is a view of."""
    net = torch.nn.Linear(40, 2000)
    net.register_buffer("shift", torch.zeros(10**6)[:5])
    save_policy(tmp_path / "policy.pt", deterministic(net), SPEC)
    weights = 4 * (40 * 2000 + 2000 + 5)
    assert weights < (tmp_path / "policy.pt").stat().st_size < 1.3 * weights


def test_nested_keys_and_other_types(tmp_path):
    module = TensorDictModule(mlp().double(), [("arm", "state")], [("arm", "motor")])
    spec = Composite(arm=Composite(state=Unbounded(40, dtype=torch.float64)))
    save_policy(tmp_path / "policy.pt", module, spec, action_key=("arm", "motor"))
    policy = load_policy(tmp_path / "policy.pt")
    assert repr(policy) == "Policy(('arm', 'state') (40,) -> ('arm', 'motor') (3,))"
    assert policy.action_dtype == np.float64
    tensordict = TensorDict({("arm", "state"): OBSERVATIONS.double()}, batch_size=[64])
    expected = module(tensordict)["arm", "motor"].detach().numpy()
    np.testing.assert_allclose(policy(OBSERVATIONS.numpy()), expected)


def test_pictures(tmp_path):
    net = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.Flatten(), torch.nn.Linear(144, 2))
    scaled = TensorDictModule(lambda pixels: pixels / 255, ["pixels"], ["scaled"])
    actor = TensorDictSequential(scaled, TensorDictModule(net, ["scaled"], ["action"]))
    spec = Composite(pixels=Bounded(0, 255, (3, 8, 8), dtype=torch.uint8))
    save_policy(tmp_path / "policy.pt", actor, spec)
    policy = load_policy(tmp_path / "policy.pt")
    pixels = np.full((3, 8, 8), 200, dtype=np.uint8)
    expected = net(torch.from_numpy(pixels)[None] / 255)[0].detach().numpy()
    np.testing.assert_allclose(policy(pixels), expected, rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="observation must have dtype uint8, got float64"):
        policy(pixels / 255)
    with pytest.raises(ValueError, match=r"observation must have dtype torch.uint8, got torch.flo"):
        policy.actor.module(torch.from_numpy(pixels / 255))
    np.testing.assert_array_equal(policy(pixels.tolist()), policy(pixels))
    for wide in (pixels + np.int64(256), pixels - np.int16(201)):
        with pytest.raises(ValueError, match="observation must be in the range of uint8, got"):
            policy(wide)


def test_whole_numbers_that_would_wrap_are_refused(tmp_path):
    actor = TensorDictModule(lambda count: count.float() / 2, ["count"], ["action"])
    spec = Composite(count=Bounded(0, 10, (1,), dtype=torch.int32))
    save_policy(tmp_path / "policy.pt", actor, spec)
    policy = load_policy(tmp_path / "policy.pt")
    assert policy(np.array([7])).tolist() == [3.5]
    assert policy.actor.module(torch.tensor([7])).tolist() == [3.5]
    for act in (policy, lambda count: policy.actor.module(torch.from_numpy(count))):
        with pytest.raises(
            ValueError, match=r"observation must be in the range of (torch\.)?int32"
        ):
            act(np.array([2**32]))


# ---------------------------------------------------------------- in a control loop


@pytest.fixture(scope="module")
def policy(trained):
    return load_policy(trained[1])


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros(41), r"observation must have shape \(40,\) or \(B, 40\), got \(41,\)"),
        (np.zeros((40, 2)), r"observation must have shape .* got \(40, 2\)"),
        (np.zeros((2, 3, 40)), r"observation must have shape .* got \(2, 3, 40\)"),
        (np.float32(1.0), r"observation must have shape .* got \(\)"),
        (np.full(40, np.nan), r"observation must be finite in float32, got \[nan"),
        (np.full((2, 40), np.inf), r"observation must be finite in float32, got \[\[inf"),
        (np.full(40, 1e39), r"observation must be finite in float32, got \[1.e\+39"),
        (np.zeros(40, dtype=complex), "observation must have dtype float32, got complex128"),
        (["a"] * 40, "observation must have dtype float32, got <U1"),
    ],
)
def test_observations_that_are_refused(policy, observation, message):
    with pytest.raises(ValueError, match=message):
        policy(observation)


def test_a_tensordict_is_refused(policy):
    with pytest.raises(TypeError, match="observation must be an array, got a TensorDict"):
        policy(TensorDict(observation=OBSERVATIONS[:1]))


def test_the_actor_names_an_observation_of_another_shape(policy):
    with pytest.raises(ValueError, match=r"observation must end in shape \(40,\), got \(41,\)"):
        policy.actor(TensorDict(observation=torch.zeros(2, 41), batch_size=[2]))


def test_observations_of_all_kinds(policy):
    observation = OBSERVATIONS[0].numpy()
    expected = policy(observation)
    observation.flags.writeable = False
    for same in (observation, observation.astype(float), list(map(float, observation))):
        np.testing.assert_array_equal(policy(same), expected)
    np.testing.assert_array_equal(policy(observation[None]), expected[None])
    assert policy(np.zeros((0, 40))).shape == (0, 3)
    # The action is the caller's.
    policy(observation)[:] = 7
    np.testing.assert_array_equal(policy(observation), expected)


def test_an_action_that_is_a_constant_stays_one(tmp_path):
    class Still(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("pose", torch.ones(1, 3))

        def forward(self, observation):
            return self.pose.expand(observation.shape[0], 3)

    save_policy(tmp_path / "policy.pt", deterministic(Still()), SPEC)
    still = load_policy(tmp_path / "policy.pt")
    still(np.zeros(40))[:] = 7
    np.testing.assert_array_equal(still(np.zeros(40)), np.ones(3))


def test_the_policy_in_an_environment(policy, make_env):
    """The same actions in TorchRL as by hand, with any batch, and in another process."""
    env = make_env(ArmEnv, num_envs=2, max_episode_steps=5)
    played = env.rollout(5, policy.actor)
    by_hand = policy(played["observation"].flatten(0, 1).numpy())
    np.testing.assert_allclose(played["action"].flatten(0, 1), by_hand, rtol=1e-5, atol=1e-6)
    assert not played["action"].requires_grad
    single, double = (
        policy.actor.module(played["observation"].to(dtype))
        for dtype in (torch.float32, torch.float64)
    )
    assert torch.equal(double, single)
    sent = pickle.loads(pickle.dumps(policy.actor))
    again = env.rollout(1, sent, auto_reset=False, tensordict=played[:, 0].select("observation"))
    assert torch.equal(again["action"], played["action"][:, :1])
    assert len(play(env, policy.actor, 2, seed=0)) == 2


# ---------------------------------------------------------------- what cannot be saved


class Choosy(torch.nn.Module):
    def forward(self, observation):
        return observation[:, :3] if observation.sum() > 0 else observation[:, 3:6]


class Random(torch.nn.Module):
    def forward(self, observation):
        return torch.rand_like(observation)


class Counting(torch.nn.Module):
    calls = 0

    def forward(self, observation):
        self.calls += 1
        return observation[:, :3] * self.calls


class Centred(torch.nn.Linear):
    """One observation is centred to 0, whatever it is."""

    def forward(self, observation):
        return super().forward(observation - observation.mean(0))


def recurrent():
    lstm = LSTMModule(40, 8, in_key="observation", out_key="features")
    return TensorDictSequential(lstm, TensorDictModule(MLP(8, 3), ["features"], ["action"]))


def attached():
    """To what cannot be copied, as a normalization is to an environment that simulates."""
    net = mlp()
    net.source = (line for line in ())
    return deterministic(net)


def test_a_transform_that_an_environment_uses_is_saved_as_a_clone(tmp_path):
    with pytest.raises(ValueError, match=r"copied: .* put a clone\(\) into the actor"):
        save_policy(tmp_path / "policy.pt", attached(), SPEC)
    norm = ObservationNorm(0.5, 2.0, in_keys=["observation"])
    env = TransformedEnv(ArmEnv(num_envs=2), norm)
    actor = deterministic(mlp())
    save_policy(
        tmp_path / "policy.pt",
        TensorDictSequential(env.transform.clone(), actor),
        env.observation_spec_unbatched,
    )
    raw = env.base_env.reset()
    action = load_policy(tmp_path / "policy.pt")(raw["observation"].numpy())
    expected = actor(norm(raw))["action"].detach()
    np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
    env.close()


def broken():
    net = mlp()
    torch.nn.init.constant_(net[0][0].weight, torch.nan)
    return deterministic(net)


REFUSED = {
    "function": (lambda: mlp(), {}, TypeError, "actor must be a TensorDictModuleBase, got"),
    "recurrent": (recurrent, {}, ValueError, r"must read one key.*recurrent_state_h"),
    "several-keys": (
        lambda: TensorDictModule(torch.add, ["observation", "goal"], ["action"]),
        {},
        ValueError,
        r"actor must read one key, .* got in_keys \['observation', 'goal'\]",
    ),
    "action-key": (
        lambda: deterministic(mlp()),
        {"action_key": "motor"},
        ValueError,
        r"action_key must be one of the actor's out_keys \['action'\], got 'motor'",
    ),
    "spec": (
        lambda: deterministic(mlp()),
        {"observation_spec": Composite(state=Unbounded(40))},
        ValueError,
        r"observation_spec must have the key 'observation', .* got \['state'\]",
    ),
    "batched-spec": (
        lambda: deterministic(mlp()),
        {"observation_spec": Composite(observation=Unbounded((4, 40)), shape=(4,))},
        ValueError,
        r"observation_spec must be of one observation, .* \(4,\): pass env.observation_spec_unb",
    ),
    "nan": (broken, {}, ValueError, "actor must give finite actions, got tensor"),
    "width": (lambda: deterministic(MLP(39, 3)), {}, ValueError, "actor cannot be called: "),
    "attached": (attached, {}, ValueError, "actor cannot be copied: "),
    "choosy": (lambda: deterministic(Choosy()), {}, ValueError, "actor cannot be recorded: "),
    "truncated": (
        lambda: gaussian(TruncatedNormal, distribution_kwargs={"low": -1.0, "high": 1.0}),
        {},
        ValueError,
        "actor cannot be recorded: ",
    ),
    "random": (
        lambda: deterministic(Random()),
        {},
        ValueError,
        "actor cannot be recorded: 'aten::rand_like' is not a Core ATen operator",
    ),
    "together": (
        lambda: deterministic(Centred(40, 3)),
        {},
        ValueError,
        "actor must compute each action from its own observation alone, got tensor",
    ),
    "counting": (
        lambda: deterministic(Counting()),
        {},
        ValueError,
        "actor must compute the action in the same way from every observation",
    ),
    "settings": (
        lambda: deterministic(mlp()),
        {"settings": {"out": Path("runs")}},
        ValueError,
        "actor and settings must be such that the file can be read again",
    ),
}


@pytest.mark.parametrize(("make", "changed", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_saved(make, changed, error, message, tmp_path):
    """And a file that was there before is still there."""
    path = tmp_path / "policy.pt"
    path.write_bytes(b"before")
    with pytest.raises(error, match=message):
        save_policy(path, make(), **{"observation_spec": SPEC, **changed})
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == b"before"


def test_the_actor_of_a_file_is_not_saved_again(policy, trained, tmp_path):
    with pytest.raises(ValueError, match="actor comes from load_policy: copy its file instead"):
        save_policy(tmp_path / "again.pt", policy.actor, Unbounded(40))
    with pytest.raises(TypeError, match=r"observation_spec must be a TensorSpec, .* got Policy"):
        save_policy(tmp_path / "again.pt", testing.make_actor(), policy)
    with pytest.raises(TypeError, match=r"path must be an instance of str or Path, got \w+\("):
        save_policy(testing.make_actor(), tmp_path / "again.pt", SPEC)
    assert not (tmp_path / "again.pt").exists()


def test_an_observation_without_bounds(tmp_path):
    """CartPole's: TorchRL draws NaN where a bound is infinite."""
    spec = GymEnv("CartPole-v1").observation_spec_unbatched
    actor = TensorDictModule(torch.nn.Linear(4, 1), ["observation"], ["action"])
    save_policy(tmp_path / "policy.pt", actor, spec)
    expected = actor.module(torch.ones(4)).detach().numpy()
    action = load_policy(tmp_path / "policy.pt")(np.ones(4, np.float32))
    np.testing.assert_allclose(action, expected, rtol=1e-5)


# ---------------------------------------------------------------- what is no policy


class Exploit:
    """What pickle would call while it loads."""

    def __reduce__(self):
        return Path.touch, (Path("exploited"),)


def changed(good, step):
    """A whole policy with one operation replaced."""
    contents = torch.load(good, weights_only=True)
    contents["steps"][0] = step
    return contents


FOREIGN = {
    "empty": lambda path, good: path.write_bytes(b""),
    "text": lambda path, good: path.write_bytes(b"to whom it may concern"),
    "torn": lambda path, good: path.write_bytes(good.read_bytes()[:2000]),
    "pickle": lambda path, good: path.write_bytes(pickle.dumps(Exploit())),
    "code": lambda path, good: torch.save({"weights": Exploit()}, path),
    "other": lambda path, good: torch.save({"weights": torch.zeros(3)}, path),
    "tensor": lambda path, good: torch.save(torch.zeros(3), path),
    "nothing": lambda path, good: torch.save({"format": "torchrl-safe policy", "version": 2}, path),
}
# Operations that are none of arithmetic: the first would make a file.
for name, step in {
    "file": ("aten::from_file", ["exploited", True, 4], []),
    "python": ("python::eval", ["open('exploited', 'w')"], []),
    "module": ("builtins::eval", ["open('exploited', 'w')"], []),
    "attribute": ("aten::__class__.__init__", [], []),
    "in-place": ("aten::resize_", [{"value": "actor.module.0.module.0.loc"}, [9]], []),
    "unknown": ("aten::nothing", [], []),
}.items():
    FOREIGN[name] = lambda path, good, step=step: torch.save(changed(good, step), path)


@pytest.mark.parametrize("spoil", FOREIGN.values(), ids=FOREIGN.keys())
def test_other_files_are_refused(spoil, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spoil(tmp_path / "policy.pt", trained[1])
    with pytest.raises(ValueError, match="path must be a file that save_policy wrote, got '/"):
        load_policy(tmp_path / "policy.pt")
    assert not Path("exploited").exists(), "nothing in a file is run"


def test_the_operation_that_is_refused_is_named(trained, tmp_path):
    torch.save(changed(trained[1], ("aten::from_file", [], [])), tmp_path / "policy.pt")
    with pytest.raises(ValueError, match="'aten::from_file' is not a Core ATen operator"):
        load_policy(tmp_path / "policy.pt")


def test_version_and_missing_file(trained, tmp_path):
    torch.save({"format": "torchrl-safe policy", "version": 1}, tmp_path / "policy.pt")
    with pytest.raises(ValueError, match=r"got '.*': it is of version 1, not 2. Save it again"):
        load_policy(tmp_path / "policy.pt")
    with pytest.raises(FileNotFoundError):
        load_policy(tmp_path / "none.pt")
