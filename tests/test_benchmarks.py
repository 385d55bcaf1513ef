"""The benchmarks measure what they say. The parts that are quick enough are run."""

import json
import math
from importlib.metadata import version

import numpy as np
import pytest
import torch
from bullet_worlds import worlds_of

from benchmarks.bare import Hollow, Recording
from benchmarks.floor import Tape
from benchmarks.handwritten import HandWritten, arguments
from benchmarks.networks import make_actor, make_critic, make_minibatch
from benchmarks.original import OriginalEnv
from benchmarks.parts import measure
from benchmarks.report import Figure, record
from benchmarks.timing import race, ratio, timed
from torchrl_safe.envs import PAPER_CARTESIAN, PAPER_JOINT, ArmEnv, MuJoCo, paper_env
from torchrl_safe.objectives import PPOLagrangianLoss


def test_contenders_take_turns_and_the_first_round_does_not_count():
    turns = []

    def contender(name, seconds):
        return lambda: turns.append(name) or seconds

    times = race({"a": contender("a", 2.0), "b": contender("b", 0.5)}, rounds=2)
    assert turns == ["a", "b"] * 3
    figure = ratio("a / b", times["a"], times["b"], at_most=3)
    assert (figure.low, figure.median, figure.high) == (4.0, 4.0, 4.0)
    assert figure.verdict == "missed"


def test_time_is_that_of_one_call():
    now = iter((0.0, 6.0))
    calls = []
    assert timed(lambda: calls.append(1), calls=3, clock=lambda: next(now))() == 2.0
    assert len(calls) == 3


def test_parts_are_kept_and_replaced(tmp_path):
    record("env", [Figure("old", 1.0, 1.0, 1.0, "x")], tmp_path)
    record("reset", [Figure("fast", 2.0, 1.5, 2.5, "x", at_least=1.7)], tmp_path)
    record("env", [Figure("new", 0.4, 0.3, 0.5, "x", at_least=0.5)], tmp_path)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [results[part]["figures"][0]["verdict"] for part in ("env", "reset")] == [
        "missed",
        "met",
    ]
    assert results["env"]["versions"]["torch"] == version("torch")
    table = (tmp_path / "table.md").read_text()
    assert "| fast | 2 x | 1.5 to 2.5 | at least 1.7 | met |" in table
    assert "old" not in table


def test_an_empty_environment_takes_the_same_physics_steps():
    env = ArmEnv(num_envs=2, frame_skip=3, physics=MuJoCo(threads=1))
    recording, batch = Recording(env, 4), env._simulator._batch
    after = batch.state.copy()
    hollow = Hollow(env, recording)
    rollout = hollow.rollout(4)
    assert np.array_equal(batch.state, after)
    assert hollow.seconds > 0
    assert set(rollout.keys(True, True)) == set(env.rollout(1).keys(True, True))
    env.close()


def test_floor_moves_the_worlds_as_the_environment_did():
    env = ArmEnv(num_envs=2, frame_skip=3)
    tape = Tape()

    def play():
        env.set_seed(0)
        return env.reset()

    torch.manual_seed(0)
    with tape.recording():
        env.rollout(5, auto_reset=False, tensordict=play(), break_when_any_done=False)
    moved = env._simulator.state().joint_position
    play()
    tape.play()
    np.testing.assert_array_equal([world.read()[:7] for world in worlds_of(env)], moved)
    env.close()


@pytest.mark.parametrize(
    ("name", "action"), [("cartesian", PAPER_CARTESIAN), ("joint", PAPER_JOINT)]
)
def test_original_moves_the_arm_as_the_papers_environment(name, action):
    original, env = OriginalEnv(name), paper_env(action)
    original.reset()
    tensordict = env.reset()
    for step in np.random.default_rng(0).uniform(-1, 1, (20, env.action_spec.shape[-1])):
        observation = original.step(step)[0]
        tensordict["action"] = torch.tensor(step, dtype=torch.float32)[None]
        tensordict = env.step(tensordict)["next"]
    # Both observe the tool and the fingers first; the brick lies elsewhere.
    np.testing.assert_allclose(tensordict["observation"][0, :5], observation[:5], atol=1e-4)
    original.close()
    env.close()


def test_hand_written_update_is_the_same_update():
    torch.manual_seed(0)
    actor, critics = make_actor(), [make_critic(key) for key in ("state_value", "cost_value")]
    loss = PPOLagrangianLoss(
        actor, *critics, multiplier_init=0.5, entropy_bonus=False, loss_critic_type="l2"
    )
    by_hand = HandWritten()
    by_hand.multiplier.fill_(0.5)
    pairs = zip(
        (by_hand.policy, by_hand.critic, by_hand.cost_critic),
        (actor[0].module[0], *(critic.module for critic in critics)),
        strict=True,
    )
    for mine, theirs in pairs:
        mine.load_state_dict(theirs.state_dict())
    minibatch = make_minibatch(64)
    losses = loss(minibatch)
    total = sum(value for key, value in losses.items() if key.startswith("loss_"))
    ours = by_hand(*arguments(minibatch))
    assert math.isclose(ours.item(), total.item(), rel_tol=1e-5)
    ours.backward()
    total.backward()
    torch.testing.assert_close(
        by_hand.policy[0].weight.grad,
        loss.actor_network_params["module", "0", "module", "0", "0", "weight"].grad,
    )


@pytest.mark.parametrize("part", ["reset", "update"])
def test_part_runs(part):
    figures = measure(part, quick=True)
    assert len({figure.name for figure in figures}) == len(figures)
    assert all(0 < figure.low <= figure.median <= figure.high for figure in figures)


# One part compiles a loss; PyTorch's compiler uses what PyTorch and TorchRL have deprecated.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.slow
@pytest.mark.parametrize("part", ["env", "bullet", "scaling", "training", "make_train"])
def test_long_part_runs(part):
    test_part_runs(part)
