"""The main job, made small: what it leaves behind, and what it refuses."""

import contextlib
import dataclasses
import io
import json
import math
from typing import get_args

import matplotlib.pyplot as plt
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint

import experiments.train
from experiments.agent import make_agent
from experiments.algorithms import ALGORITHMS, MULTIPLIER_RULES, OffPolicy, configured
from experiments.config import OFF_POLICY, AlgorithmName, Config, command_line
from experiments.environment import make_env
from experiments.film import save_film
from experiments.learners import NoiseSchedule
from experiments.log import summed_costs
from experiments.report import LEARNING, Line, plot_curves, plot_learning, table
from experiments.train import collecting, main, start, train
from torchrl_safe.envs import PickAndPlace, Push, Reach
from torchrl_safe.policy import load_policy

pytestmark = pytest.mark.integration

KINDS = {"cpo", "cup", "ppo-saute", "td3-lagrangian"}


def make_training(algorithm="ppo-lagrangian", **settings):
    torch.manual_seed(0)
    env = make_env(Config(), num_envs=1, seed=0, algorithm=algorithm)
    training = ALGORITHMS[algorithm].build(env, Config(**settings))
    env.close()
    return training


def tiny_film(*args, **settings):
    save_film(*args, **{**settings, "episodes": 1, "width": 32})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run, and what it has printed; each film is of one episode."""
    config = Config(
        frames=512,
        frames_per_batch=256,
        envs=4,
        workers=1,
        eval_episodes=8,
        multiplier_init=5.0,
        # Which so few episodes cannot cost on average.
        cost_limit=0.3,
        out=tmp_path_factory.mktemp("run"),
    )
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(experiments.train, "save_film", tiny_film)
        main(config)
    return config.out, printed.getvalue()


def test_what_it_leaves(finished):
    out, stdout = finished
    results = json.loads((out / "results.json").read_text())
    assert list(results["algorithms"]) == ["ppo", "ppo-lagrangian"]
    for name, run in results["algorithms"].items():
        assert [row["frames"] for row in run["history"]] == [256, 512]
        for estimate, low, high in run["evaluation"].values():
            assert low <= estimate <= high
        assert list((out / "logs").rglob(f"*{name}*"))
    with Image.open(out / "film.gif") as film:
        assert film.n_frames > 10
        assert film.width > 2 * 32, "PPO and PPO-Lagrangian, side by side"
    for picture in ("curves.png", "scene.png"):
        with Image.open(out / picture) as image:
            assert image.width >= 640
    assert table(results) in stdout
    assert (out / "table.md").read_text() == table(results)


def test_ppo_has_no_multiplier_and_its_brother_has(finished):
    out, _ = finished
    runs = json.loads((out / "results.json").read_text())["algorithms"]
    multipliers = {
        name: [row["multiplier/collision"] for row in run["history"]] for name, run in runs.items()
    }
    assert multipliers["ppo"] == [0, 0]
    first, second = multipliers["ppo-lagrangian"]
    assert 5 != first != second > 0


def test_checkpoint_holds_the_loss(finished):
    out, _ = finished
    results = json.loads((out / "results.json").read_text())
    loss = make_training().loss
    before = {key: value.clone() for key, value in loss.state_dict().items()}
    newest = max((out / "ppo-lagrangian" / "checkpoints").glob("*.torchrl"))
    Checkpoint(loss=loss).load(newest, components=["loss"])
    last = results["algorithms"]["ppo-lagrangian"]["history"][-1]
    assert loss.lagrange_multiplier.item() == pytest.approx(last["multiplier/collision"])
    assert not torch.equal(
        before["actor_network.module.0.module.0.1.0.weight"],
        loss.state_dict()["actor_network.module.0.module.0.1.0.weight"],
    )


def test_a_run_is_not_written_over(finished):
    out, _ = finished
    before = (out / "results.json").read_bytes()
    with pytest.raises(FileExistsError, match=r"out must be a new or empty .* add --resume with"):
        main(Config(out=out))
    assert (out / "results.json").read_bytes() == before


def test_resuming_where_no_run_is_says_so(tmp_path, capsys):
    config = Config(out=tmp_path / "mistyped", resume=True)
    start(config)
    said = f"There is no run in {config.out} to resume: this begins one.\n"
    assert capsys.readouterr().out == said
    start(config)
    assert capsys.readouterr().out == ""
    (tmp_path / "notes.txt").touch()
    with pytest.raises(FileExistsError, match=r"out must be .* There is no run in it to resume\."):
        start(Config(out=tmp_path, resume=True))


def test_help_is_short_and_grouped(capsys):
    """A line for each option, in one of the groups; --help-all says all."""
    for more in ([], ["--suite-task", "ur5-reach-moving"]):
        with pytest.raises(SystemExit) as end:
            command_line([*more, "--help"])
        assert not end.value.code
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= 100
        assert len(lines) < 60
        shown = [line.split()[0] for line in lines if line.startswith("  --")]
        names = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(Config)]
        assert sorted(shown) == sorted(names)
        assert all(len(line.split("  ", 2)[-1].split()) > 1 for line in lines if "--" in line)
    with pytest.raises(SystemExit, match="0"):
        command_line(["--help-all"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "ppo-shield is ppo with a shield" in said
    assert all(name in said for name in names)


def test_a_shield_is_trained_with_beside_the_others():
    algorithms = ("ppo", "ppo-lagrangian")
    assert Config().chosen == algorithms
    assert Config(shield=True).chosen == (*algorithms, "ppo-shield")
    assert Config(shield=True, algorithms=("ppo-shield",)).chosen == ("ppo-shield",)
    for algorithm in ("ppo", "ppo-shield"):
        env = make_env(Config(), num_envs=1, algorithm=algorithm)
        assert (env.base_env.shield is not None) == (algorithm == "ppo-shield")
        env.close()


def test_a_shield_and_its_cost_can_be_taken_away():
    config = Config(
        algorithms=("ppo-lagrangian-shield",), costs={"collision": 0.5, "correction": 0.2}
    )
    for shielded, names in ((True, ("collision", "correction")), (False, ("collision",))):
        env = make_env(
            config, num_envs=1, algorithm="ppo-lagrangian-shield", shielded=shielded
        ).base_env
        assert (env.shield is not None) == shielded
        assert env.cost_names == names
        env.close()
    with pytest.raises(ValueError, match="correction with algorithms without a shield"):
        Config(costs={"collision": 0.5, "correction": 0.2})
    with pytest.raises(ValueError, match="another cost beside correction"):
        Config(algorithms=("ppo-shield",), costs={"correction": 0.2})


def test_tables_show_what_is_left_without_the_shield():
    evaluation = {"cost/collision": [0.0, 0.0, 0.1], "cost/correction": [0.1, 0.0, 0.2]}
    without = {"cost/collision": [3.0, 2.0, 4.0]}
    run = {"evaluation": evaluation, "without_shield": without}
    limits = {"collision": 0.5, "correction": 0.2}
    lines = table({"algorithms": {"ppo-shield": run}, "cost_limits": limits}).splitlines()
    assert lines[3] == "| ppo-shield, without its shield | 3.00 [2.00, 4.00] | |"


def test_costs_are_summed_over_training():
    costs = torch.tensor([[[1.0, 2.0], [0.0, 1.0]]])
    batch = TensorDict({"next": {"cost": costs}}, [1, 2])
    first = summed_costs(batch, [], ("a", "b"))
    assert first == {"summed/a": 1.0, "summed/b": 3.0}
    assert summed_costs(batch, [first], ("a", "b")) == {"summed/a": 2.0, "summed/b": 6.0}


def test_curves_with_a_shield_show_the_sum(tmp_path):
    widths = []
    for name in ("ppo", "ppo-shield"):
        row = {"frames": 8, "return": -1.0, "cost/collision": 1.0, "summed/collision": 3.0}
        results = {"cost_limits": {"collision": 0.5}, "algorithms": {name: {"history": [row]}}}
        plot_curves(results, tmp_path / "curves.png")
        with Image.open(tmp_path / "curves.png") as image:
            widths.append(image.width)
    assert widths[1] == pytest.approx(1.5 * widths[0], abs=1)


def test_all_rows_of_learning_curves_are_seen(tmp_path, monkeypatch):
    """They share the scales of a column; the limit is below them all."""
    monkeypatch.setattr(plt, "close", lambda figure: None)
    rows = {
        str(size): {
            name: [Line("one", "red", [2 * [min(size, 1) if name == "success" else size]])]
            for name in LEARNING
        }
        for size in (0.5, 40.0, 3.0)
    }
    plot_learning(rows, tmp_path / "c.png", frames_per_point=8, width=1, limits=(0.25,))
    axes = plt.gcf().axes
    monkeypatch.undo()
    plt.close()
    for axis, name in zip(axes, 3 * list(LEARNING), strict=True):
        if name != "success":
            low, high = axis.get_ylim()
            assert low < 0.5 < 40 < high


def test_the_limit_is_in_the_picture_where_costs_are_far_below(tmp_path, monkeypatch):
    history = [{"frames": n, "return": 0.0, "cost/collision": 0.1} for n in (8, 16)]
    monkeypatch.setattr(plt, "close", lambda figure: None)
    runs = {"algorithms": {"ppo": {"history": history}}, "cost_limits": {"collision": 5.0}}
    plot_curves(runs, tmp_path / "curves.png")
    axis = plt.gcf().axes[1]
    monkeypatch.undo()
    plt.close()
    assert axis.get_ylim() == (0, 5.75)


def test_a_run_without_a_finished_episode_has_empty_curves(tmp_path):
    runs = {"ppo": {"history": [{"frames": 8, "summed/collision": 0.0}]}}
    plot_curves({"algorithms": runs, "cost_limits": {"collision": 0.5}}, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").exists()


def test_multiplier_rules():
    """A violation beyond a fifth of the limit counts as 1: the rate, and PID's gain on top."""
    multiplier = {}
    for name, rule in MULTIPLIER_RULES.items():
        loss = make_training().loss
        rule(loss, 0.1, cost_limit=1.0).step(torch.tensor([[3.0]]))
        multiplier[name] = loss.lagrange_multiplier.item()
    assert multiplier == pytest.approx({"dual-ascent": 0.1, "pid": 0.6})


def test_agent_knows_the_scale_of_what_it_sees_and_predicts():
    config = Config(paper=True, observation="paper")
    torch.manual_seed(0)
    env = make_env(config, num_envs=4, seed=0)
    agent = make_agent(env, gamma=0.99)
    with torch.no_grad():
        seen = env.rollout(100, break_when_any_done=False)
        standardized = agent.actor.get_submodule("0.module.0.0")(seen["observation"])
        value = agent.critic(seen.clone())["state_value"]
    env.close()
    # Of other episodes than the ones it was fitted to: the target differs, the rest does not.
    assert standardized.mean().abs() < 0.5
    assert 0.2 < standardized[..., :3].std() < 3
    # A step costs about -0.6 of reward; the untrained prediction is small in that unit.
    assert 0 < value.abs().mean() < 5
    # The paper's actions are not bounded, so the policy is a plain Gaussian.
    assert type(agent.actor.get_dist(seen)).__name__ == "IndependentNormal"


def test_agent_knows_how_far_its_own_noise_goes():
    """Without bounds, twice the noise shows twice the range; with bounds all of it is seen."""

    def ranges(paper, log_std):
        torch.manual_seed(0)
        env = make_env(Config(paper=paper, action="joint"), num_envs=4, seed=0)
        agent = make_agent(env, gamma=0.99, log_std=log_std)
        env.close()
        assert agent.log_std.tolist() == [pytest.approx(log_std)] * 7
        return 1 / agent.actor.get_submodule("0.module.0.0").scale[:7]

    assert torch.equal(ranges(False, 0.0), ranges(False, 1.0))
    wider = ranges(True, 1.0 + math.log(2)) / ranges(True, 1.0)
    assert 1.5 < wider.mean() < 2.1


def test_every_algorithm_has_a_name():
    assert set(ALGORITHMS) == set(get_args(AlgorithmName))
    replaying = {name for name, algorithm in ALGORITHMS.items() if isinstance(algorithm, OffPolicy)}
    assert replaying == set(OFF_POLICY)


def test_an_algorithm_has_its_own_settings_where_none_are_given():
    own = configured(Config(), "a2c-lagrangian")
    assert (own.frames, own.frames_per_batch, own.multiplier_rate) == (768_000, 512, 0.01)
    asked = configured(Config(frames=1024, multiplier_rate=0.3), "a2c-lagrangian")
    assert (asked.frames, asked.frames_per_batch, asked.multiplier_rate) == (1024, 512, 0.3)
    config = Config()
    assert configured(config, "ppo") == configured(config, "ppo-lagrangian") == config
    config = Config(own_settings=False)
    assert configured(config, "a2c-lagrangian") == config


# One of each kind for `make test`. That they learn is tested on a problem of known optimum.
@pytest.mark.parametrize(
    "algorithm",
    [pytest.param(name, marks=() if name in KINDS else pytest.mark.slow) for name in ALGORITHMS],
)
def test_every_algorithm_trains(algorithm, tmp_path):
    config = Config(
        frames=128,
        frames_per_batch=64,
        envs=4,
        epochs=1,
        out=tmp_path,
        gamma=0.9,
        physics="mujoco",  # The faster engine.
    )
    actor, log = train(config, algorithm, progress=False)
    assert [row["frames"] for row in log.rows] == [64, 128]
    torch.manual_seed(0)
    fresh = make_training(algorithm, gamma=0.9).actor
    moved = [
        not torch.equal(old, new)
        for old, new in zip(fresh.parameters(), actor.parameters(), strict=True)
    ]
    assert any(moved)
    assert (tmp_path / algorithm / "checkpoints" / "checkpoint-000000000128.torchrl").exists()
    saved = load_policy(tmp_path / algorithm / "policy.pt").weights
    for name, weight in actor.state_dict().items():
        torch.testing.assert_close(saved[name], weight, rtol=0, atol=0)


def test_what_ends_an_episode_early_ends_none_that_is_evaluated():
    name = "ppo-early-termination"
    for training in (True, False):
        env = make_env(Config(), num_envs=1, algorithm=name, training=training)
        assert ("accumulated_cost" in list(env.observation_spec.keys())) is training
        env.close()


def test_episodes_are_cut_off_where_they_are_learnt_from_only():
    config = Config(paper=True, episode_steps=7)
    for training, steps in ((True, 7), (False, 500)):
        env = make_env(config, num_envs=1, training=training)
        assert env.base_env.max_episode_steps == steps
        env.close()


def test_an_engine_with_threads_needs_no_workers():
    assert Config().processes == 2
    assert Config(physics="mujoco").processes == 1
    assert Config(physics="mujoco", workers=4).processes == 4
    assert Config(workers=1).processes == 1


def test_each_epoch_sees_each_step_once():
    training = make_training(epochs=3, minibatch=4)
    seen = []

    def objective(minibatch):
        assert "next" not in minibatch
        seen.append(minibatch["action"][:, 0].tolist())
        return next(training.actor.parameters()).sum()

    training.learner.phases = [(None, objective)]
    config = Config(envs=5, frames_per_batch=10, workers=1)
    with collecting(config, training.collector, "ppo") as collector:
        batch = next(iter(collector)).clone()
    training.learner.learn(batch)
    assert [len(steps) for steps in seen] == [4, 4, 2] * 3
    epochs = [[*seen[i], *seen[i + 1], *seen[i + 2]] for i in (0, 3, 6)]
    steps = batch["action"][..., 0].flatten().tolist()
    assert len(set(steps)) == 10
    assert all(sorted(epoch) == sorted(steps) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]


def test_a_trust_region_step_knows_how_long_episodes_are():
    """From those that ended, however many batches they began in."""
    training = make_training("cpo", epochs=1)
    config = Config(envs=2, frames_per_batch=10, workers=1, episode_steps=12)
    lengths = []
    with collecting(config, training.collector, "cpo") as collector:
        for batch, _ in zip(collector, range(4), strict=False):  # Five steps of each world.
            training.learner.learn(batch.clone())
            lengths.append(training.learner.actor_step.episode_length)
    assert lengths == [None, None, 12.0, 12.0]


def test_a_fixed_multiplier_stays():
    training = make_training(multiplier_rule="fixed", multiplier_init=2.0)
    assert training.updater is None
    assert training.loss.lagrange_multiplier.item() == 2.0
    assert make_training("ppo", multiplier_init=2.0).loss.lagrange_multiplier.item() == 0.0


def test_noise_falls_from_batch_to_batch():
    log_std = torch.nn.Parameter(torch.zeros(2))
    schedule = NoiseSchedule(log_std, last=-2.0, batches=4)
    seen = []
    for _ in range(2):
        schedule.step()
        seen.append(log_std.tolist())
    resumed = NoiseSchedule(log_std, last=-2.0, batches=4)
    resumed.load_state_dict(schedule.state_dict())
    for _ in range(2):
        resumed.step()
        seen.append(log_std.tolist())
    assert seen == [[-0.5, -0.5], [-1.0, -1.0], [-1.5, -1.5], [-2.0, -2.0]]
    assert not log_std.requires_grad


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frames": 0}, "frames must be a whole number of at least 1, got 0"),
        ({"workers": 0}, "workers must be a whole number of at least 1, got 0"),
        ({"episode_steps": 0}, "episode_steps must be a whole number of at least 1, got 0"),
        ({"first_log_std": float("nan")}, "first_log_std must be finite, got nan"),
        ({"last_log_std": float("-inf")}, "last_log_std must be finite, got -inf"),
        ({"envs": 5, "workers": 2}, "envs must be a multiple of workers, got 5 and 2"),
        ({"envs": 6, "workers": 2}, "frames_per_batch must be a multiple of envs"),
        ({"pessimism": -1.0}, "pessimism must be finite and not negative, got -1.0"),
        ({"limit_share": 0.0}, "limit_share must be more than 0 and at most 1, got 0.0"),
        ({"limit_share": 1.1}, "limit_share must be more than 0 and at most 1, got 1.1"),
        ({"multiplier_init": -1.0}, "multiplier_init must be finite and not negative, got -1.0"),
        ({"gamma": 1.0}, "gamma must be between 0 and 1, got 1.0"),
        ({"minibatch": 0}, "minibatch must be a whole number of at least 1, got 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be positive and finite, got nan"),
        ({"cost_limit": -1.0}, "cost_limit must be finite and not negative, got -1.0"),
        ({"demonstrations": -1}, "demonstrations must not be negative, got -1"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        (
            {"demonstrations": 1, "algorithms": ("sac-lagrangian",)},
            "demonstrations must be 0 with sac-lagrangian, which learns off policy, got 1",
        ),
        (
            {"demonstrations": 1, "action": "joint"},
            "demonstrations must be 0 with joint actions, got 1",
        ),
        ({"algorithms": ()}, r"algorithms must name at least one, each once, got \(\)"),
        ({"algorithms": ("ppo", "ppo")}, "algorithms must name at least one, each once"),
        ({"algorithms": ("cpo", "td3-lagrangian"), "paper": True}, "not contain td3-lagrangian"),
        ({"algorithms": ("ppo-saute",), "cost_limit": 0.0}, "cost_limit must be positive with ppo"),
        ({"shield": True, "paper": True}, "shield must be False with paper"),
        ({"costs": {"speed": -1.0}}, "costs must have limits of at least 0, got -1.0 for speed"),
        (
            {"costs": {"speed": 1.0}, "cost_limit": 2.0},
            "cost_limit must not be given with costs, which sets it, got 2",
        ),
        ({"costs": {"speed": 1.0}, "paper": True}, "costs must be {} with paper, got {'speed': 1"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        Config(**settings)


@pytest.mark.parametrize(
    ("task", "kind", "step", "fingers", "steps"),
    [
        ("reach", Reach, 0.05, 0, 40),
        ("push", Push, 0.03, 0, 200),
        ("pick-and-place", PickAndPlace, 0.03, 1, 100),
    ],
)
def test_a_task_gets_the_action_and_the_time_it_needs(task, kind, step, fingers, steps):
    env = make_env(Config(task=task, action="joint"), num_envs=1)
    assert env.action_spec_unbatched.shape == (7 + fingers,)
    env.close()
    env = make_env(Config(task=task), num_envs=1)
    assert isinstance(env.base_env.task, kind)
    assert env.base_env.action_mode.step == step
    assert env.action_spec_unbatched.shape == (3 + fingers,)
    assert env.base_env.max_episode_steps == steps
    env.close()


def test_what_no_random_action_shows_drowns_nothing():
    """A cube's speed is hardly ever seen before it is pushed."""
    torch.manual_seed(0)
    env = make_env(Config(task="push"), num_envs=2, seed=0)
    standardize = make_agent(env, gamma=0.97).actor.get_submodule("0.module.0.0")
    env.close()
    middle = -standardize.loc / standardize.scale
    deviations = torch.tensor([-100.0, -5.0, 3.0, 100.0])[:, None]
    seen = standardize(middle + deviations / standardize.scale)
    expected = torch.tensor([-5.0, -5.0, 3.0, 5.0])[:, None]
    torch.testing.assert_close(seen, expected.expand_as(seen), rtol=0, atol=1e-4)


def test_networks_are_as_wide_as_wanted():
    agent = make_training(hidden=48)
    widths = {parameter.shape[0] for parameter in agent.loss.parameters() if parameter.ndim == 2}
    assert widths == {48, 3, 1}
