"""Training with several costs, each with a limit: a task of the suite, and the suite as a whole."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from experiments import evaluate, suite, suite_merge, train
from experiments.algorithms import ALGORITHMS
from experiments.config import Config, command_line, suite_config
from experiments.environment import make_env
from experiments.grid import missing
from experiments.log import score
from experiments.report import figures_table
from experiments.suite_report import (
    plot_profiles,
    plot_training,
    profile,
    report,
    scores,
    table,
    whole,
)
from torchrl_safe.envs import SUITE, EarlyTermination, Human, Saute, SpeedAndSeparation
from torchrl_safe.policy import load_policy

pytestmark = pytest.mark.integration

NAME = "panda-reach-human"
TINY = {
    "frames": 256,
    "frames_per_batch": 128,
    "envs": 4,
    "epochs": 1,
    "eval_episodes": 4,
    "physics": "mujoco",
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Results of a short run in a task of the suite, and its policy's file."""
    out = tmp_path_factory.mktemp("suite")
    config = suite_config(NAME, **TINY, out=out)
    return train.run(config, "ppo-lagrangian"), out / "ppo-lagrangian" / "policy.pt"


def test_each_cost_has_its_name_and_its_multiplier(trained):
    result, _ = trained
    assert set(result["evaluation"]) == {
        *("success", "return", "steps"),
        *("cost/collision", "any/collision", "cost/separation", "any/separation"),
    }
    last = result["history"][-1]
    for name in ("collision", "separation"):
        assert {f"summed/{name}", f"multiplier/{name}"} <= set(last)
    assert np.shape(result["episodes"]["episode_cost"]) == (32, 2)


def test_its_policy_is_evaluated_in_its_task(trained, capsys):
    _, file = trained
    config = evaluate.Config(file, episodes=4, envs=4)
    saved = load_policy(file)
    assert evaluate.cost_limits(config, saved) == tuple(SUITE[NAME].cost_limits.values())
    env = evaluate.factory(config, saved)(num_envs=1)
    assert isinstance(env.base_env.obstacles, Human)
    assert isinstance(env.base_env.costs["separation"], SpeedAndSeparation)
    env.close()
    evaluate.main(config)
    shown = capsys.readouterr().out
    for heading in ("episode cost: separation", "episodes above the limit of collision"):
        assert heading in shown
    limits = SUITE[NAME].cost_limits
    assert f"Cost limits collision 0.5, separation {limits['separation']:g}; brackets" in shown


def test_costs_are_chosen_each_with_a_limit():
    config = Config(costs={"speed": 2.0, "collision": 0.5})
    assert config.cost_limits == {"speed": 2.0, "collision": 0.5}
    env = make_env(config, num_envs=1)
    assert env.base_env.cost_names == ("speed", "collision")
    env.close()
    assert Config(cost_limit=3.0).cost_limits == {"collision": 3.0}


def test_every_limit_reaches_the_updater():
    config = suite_config("iiwa-reach-joints", physics="mujoco", limit_share=1.0)
    env = make_env(config, num_envs=2, seed=0)
    for algorithm in ("ppo-lagrangian", "trpo-lagrangian", "p3o"):
        updater = ALGORITHMS[algorithm].build(env, config).updater
        limits = dict(zip(updater.cost_names, updater.cost_limit.tolist(), strict=True))
        assert limits == pytest.approx(SUITE["iiwa-reach-joints"].cost_limits)
    env.close()


def budget_of(env):
    (transform,) = (each for each in env.transform if isinstance(each, Saute | EarlyTermination))
    return transform.budget.tolist()


def test_a_share_of_each_limit_is_what_training_aims_at():
    """Updaters have the share, budgets and reports the limit."""
    config = suite_config("iiwa-reach-joints", physics="mujoco", limit_share=0.5)
    env = make_env(config, 2, 0, "ppo-saute", training=True)
    updater = ALGORITHMS["ppo-lagrangian"].build(env, config).updater
    assert updater.cost_limit.tolist() == [0.125, 0.25, 0.25]
    assert config.cost_limits == {"collision": 0.25, "joint-limit": 0.5, "speed": 0.5}
    assert budget_of(env) == [0.25, 0.5, 0.5]
    env.close()


def test_training_aims_at_one_share_of_all_limits_below_them():
    (share,) = {config.limit_share for config in (Config(), *map(suite_config, SUITE))}
    assert share < 1


def test_a_saved_policy_is_evaluated_with_the_budget_of_its_training():
    settings = json.loads(json.dumps(dataclasses.asdict(Config(cost_limit=3.0)), default=str))
    saved = SimpleNamespace(settings={**settings, "name": "ppo-saute"})
    env = make_env(evaluate.training_config(saved), num_envs=1, algorithm="ppo-saute")
    assert budget_of(env) == [3.0]
    env.close()


@pytest.mark.parametrize("algorithm", ["ppo-saute", "ppo-early-termination"])
def test_every_limit_is_a_budget(algorithm):
    config = suite_config(NAME, physics="mujoco")
    env = make_env(config, num_envs=1, algorithm=algorithm, training=True)
    assert budget_of(env) == [*SUITE[NAME].cost_limits.values()]
    env.close()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("arm", "ur5"),
        ("task", "push"),
        ("obstacles", "none"),
        ("action", "joint"),
        ("observation", "paper"),
        ("paper", True),
        ("cost_limit", 1.0),
        ("costs", {"speed": 1.0}),
    ],
)
def test_what_the_task_decides_on_is_refused(option, value):
    with pytest.raises(ValueError, match=f"{option} must not be given with suite_task, which"):
        suite_config(NAME, **{option: value})


def test_what_limits_one_cost_gets_one():
    with pytest.raises(ValueError, match="cpo with several costs, got collision, sep"):
        suite_config(NAME, algorithms=("ppo", "cpo"))


def test_unknown_tasks_are_refused(capsys):
    with pytest.raises(ValueError, match=r"one of panda-reach-in-front, .*'fly'"):
        suite_config("fly")
    with pytest.raises(SystemExit):
        command_line(["--suite-task", "fly"])
    assert "invalid choice: 'fly'" in capsys.readouterr().err


def test_options_are_those_of_the_task_where_none_is_given():
    plain = command_line([])
    assert (plain.suite_task, plain.frames) == (None, 128_000)
    assert dataclasses.replace(plain, out=Path()) == Config(out=Path())
    name = "xarm7-pick-scattered"
    assert dataclasses.replace(command_line(["--suite-task", name]), out=Path()) == suite_config(
        name, out=Path()
    )
    chosen = command_line(["--frames", "99", "--suite-task", name, "--seed", "3"])
    assert (chosen.suite_task, chosen.frames, chosen.seed) == (name, 99, 3)


def test_a_checkpoint_is_best_within_every_limit():
    rows = [{"return": -1.0, "cost/a": 0.4, "cost/b": 3.0}, {"multiplier/a": 1.0}]
    assert score(rows, {"a": 0.5, "b": 3.0}) == -1.0
    assert score(rows, {"a": 0.5, "b": 2.9}) is None
    assert score(rows[1:], {"a": 0.5}) is None


def test_table_of_several_limits():
    text = figures_table({"x": {"cost/a": [1, 0, 2]}}, {"a": 0.5, "b": 2.0})
    assert text.splitlines()[-1] == "Cost limits a 0.5, b 2; brackets: 95 % confidence."


# ---------------------------------------------------------------- the whole suite

LIMITS = {"one": {"hit": 0.5}, "two": {"hit": 1.0, "fast": 2.0}}


def made_up(task, algorithm, seed, success, **costs):
    row = {"frames": 1000, **{f"summed/{name}": 100 * cost for name, cost in costs.items()}}
    return {
        "task": task,
        "algorithm": algorithm,
        "seed": seed,
        "history": [dict.fromkeys(row, 0), row],
        "evaluation": {
            "success": [success, 0, 1],
            **{f"cost/{name}": [cost, 0, 9] for name, cost in costs.items()},
        },
    }


RUNS = [
    made_up("one", "ppo", 0, 1.0, hit=2.0),
    made_up("one", "ppo", 1, 0.9, hit=1.0),
    made_up("two", "ppo", 0, 1.0, hit=1.0, fast=8.0),
    made_up("two", "ppo", 1, 1.0, hit=0.0, fast=2.0),
    made_up("one", "ppo-lagrangian", 0, 0.8, hit=0.5),
    made_up("one", "ppo-lagrangian", 1, 0.6, hit=0.25),
    made_up("two", "ppo-lagrangian", 0, 1.0, hit=1.0, fast=1.0),
    made_up("two", "ppo-lagrangian", 1, 1.0, hit=0.0, fast=3.0),
]


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_scores_are_success_and_the_largest_cost_in_units_of_its_limit():
    success, excess = scores(RUNS, LIMITS, "ppo")
    assert success.tolist() == [[1.0, 0.9], [1.0, 1.0]]
    assert excess.tolist() == [[4.0, 2.0], [4.0, 1.0]]


def test_table_shows_each_cost_of_each_run_against_its_limit():
    head, _, *lines = (cells(line) for line in table(RUNS, LIMITS).splitlines())
    assert head == [
        "task", "cost", "limit", "cost, ppo", "cost, ppo-lagrangian",
        "success, ppo, %", "success, ppo-lagrangian, %",
    ]  # fmt: skip
    assert lines == [
        ["`one`", "hit", "0.5", "**2.00**, **1.00**", "0.50, 0.25", "100, 90", "80, 60"],
        ["`two`", "hit", "1", "1.00, 0.00", "1.00, 0.00", "100, 100", "100, 100"],
        ["", "fast", "2", "**8.00**, 2.00", "1.00, **3.00**", "", ""],
    ]


def test_the_whole_has_intervals_unless_there_is_one_seed():
    ppo, lagrangian = (cells(line) for line in whole(RUNS, LIMITS).splitlines()[2:4])
    assert ppo[0] == "ppo"
    # Of four runs the middle two.
    assert ppo[1].startswith("100.0% [")
    assert ppo[2].startswith("3.00 [")
    # A limit that is just kept is kept.
    assert ppo[3].startswith("75% [")
    assert lagrangian[3].startswith("25% [")
    # 1.5 of 0.5; 5 of 2 is less.
    assert (ppo[4], lagrangian[4]) == ("1/2", "0/2")
    assert (ppo[5], lagrangian[5]) == ("1.00", f"{(0.25 + 1 + 0.4) / 3:.2f}")
    single = [run for run in RUNS if run["seed"] == 0]
    first, _ = (cells(line) for line in whole(single, LIMITS).splitlines()[2:4])
    assert first[1:4] == ["100.0%", "4.00", "100%"]


def test_a_profile_is_the_share_of_runs_above_each_threshold():
    values = np.array([[1.0, 3.0], [2.0, 2.0]])
    share, band = profile(values, np.array([0.5, 1.0, 2.0, 3.0]))
    assert share.tolist() == [1, 0.75, 0.25, 0]
    assert band.shape == (2, 4)
    assert (band[0] <= share).all()
    assert (share <= band[1]).all()
    # Each task draws its own runs: the second never has one above 2, the first none to two.
    assert band[:, 2].tolist() == [0, 0.5]


def test_figures_are_drawn(tmp_path):
    for plot in (plot_profiles, plot_training):
        plot(RUNS, LIMITS, tmp_path / "figure.png")
        with Image.open(tmp_path / "figure.png") as image:
            assert image.width > 500


def test_jobs_are_what_make_train_runs(tmp_path):
    config = suite.Config(tasks=(NAME, "ur5-reach-moving"), seeds=(10, 11), out=tmp_path)
    jobs = suite.jobs(config)
    assert len(jobs) == 8
    assert {settings.physics for settings, *_ in jobs.values()} == {"mujoco"}
    # All of the first seed come first.
    assert [settings.seed for settings, *_ in jobs.values()] == [10] * 4 + [11] * 4
    settings, algorithm, definition = jobs[tmp_path / f"{NAME}-ppo-10.json"]
    same = suite_config(NAME, seed=10, physics="mujoco", workers=1, resume=True, out=settings.out)
    assert (settings, algorithm) == (same, "ppo")
    assert "SpeedAndSeparation(reaction_time=0.1" in definition


def test_a_finished_suite_runs_nothing_and_writes_all(tmp_path, monkeypatch, capsys):
    config = suite.Config(tasks=(NAME,), seeds=(0, 1), out=tmp_path)
    costs = {"collision": 0.1, "separation": 2.0}
    for path, (settings, algorithm, definition) in suite.jobs(config).items():
        plain = {k: v for k, v in dataclasses.asdict(settings).items() if k != "out"}
        kept = {
            "arguments": [plain, algorithm, definition],
            "result": made_up(NAME, algorithm, settings.seed, 1.0, **costs),
        }
        path.write_text(json.dumps(kept))
    assert not missing(suite.jobs(config))
    monkeypatch.setattr(suite, "run", None)
    suite.main(config)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [(run["algorithm"], run["seed"]) for run in results["runs"]] == [
        ("ppo", 0), ("ppo-lagrangian", 0), ("ppo", 1), ("ppo-lagrangian", 1),
    ]  # fmt: skip
    text = (tmp_path / "table.md").read_text()
    assert text == report(results["runs"], {NAME: dict(SUITE[NAME].cost_limits)})
    assert text in capsys.readouterr().out
    for name in ("profiles", "training", f"pictures/{NAME}"):
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.width >= 400


def test_suites_of_several_places_are_merged(tmp_path, capsys):
    """A run that is in both counts as it is in the last; only what is drawn is kept."""
    costs = {"collision": 0.1, "separation": 0.2}
    first = [made_up(NAME, name, 0, 1.0, **costs) for name in ("ppo", "ppo-lagrangian")]
    second = [
        *(made_up(NAME, "ppo", 0, 0.5, **costs), made_up(NAME, "ppo", 1, 0.7, **costs)),
        made_up(NAME, "ppo-lagrangian", 1, 1.0, **costs),
    ]
    second[1]["history"][1]["return"] = 3.0
    files = [tmp_path / name for name in ("one.json", "two.json")]
    for file, runs in zip(files, (first, second), strict=True):
        file.write_text(json.dumps({"runs": [{**run, "episodes": {}} for run in runs]}))
    suite_merge.main(suite_merge.Config((*files,), tmp_path / "all"))
    results = json.loads((tmp_path / "all" / "results.json").read_text())["runs"]
    del second[1]["history"][1]["return"]
    assert results == [*second[:2], first[1], second[2]]
    text = (tmp_path / "all" / "table.md").read_text()
    assert f"| `{NAME}` | collision | 0.5 | 0.10, 0.10 | 0.10, 0.10 | 50, 70 | 100, 100 |" in text
    assert text in capsys.readouterr().out
    lacking = tmp_path / "lacking.json"
    lacking.write_text(json.dumps({"runs": [*first[:1], {**first[1], "seed": 1}]}))
    with pytest.raises(ValueError, match=rf"got none of {NAME} ppo 1; {NAME} ppo-lagrangian 0\."):
        suite_merge.main(suite_merge.Config((lacking,), tmp_path / "none"))
    assert not (tmp_path / "none").exists()
    again = suite_merge.Config((tmp_path / "all" / "results.json",), tmp_path / "again")
    suite_merge.main(again)
    for name in ("results.json", "table.md"):
        assert (again.out / name).read_text() == (tmp_path / "all" / name).read_text()


def test_results_of_another_definition_are_refused(tmp_path):
    config = suite.Config(tasks=(NAME,), algorithms=("ppo",), seeds=(0,), out=tmp_path)
    ((path, (settings, algorithm, definition)),) = suite.jobs(config).items()
    plain = {k: v for k, v in dataclasses.asdict(settings).items() if k != "out"}
    arguments = [plain, algorithm, definition.replace("0.5", "0.7")]
    path.write_text(json.dumps({"arguments": arguments, "result": {}}))
    with pytest.raises(ValueError, match="the run has other settings: argument 2 was"):
        suite.main(config)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tasks": ()}, r"tasks must name at least one, each once, got \(\)"),
        ({"seeds": (1, 1)}, r"seeds must name at least one, each once, got \(1, 1\)"),
        ({"algorithms": ("ppo", "cpo")}, "algorithms must not contain cpo with several costs"),
        ({"algorithms": ("sac-lagrangian",)}, "demonstrations must be 0 with sac-lagrangian"),
        ({"jobs": 0}, "jobs must be a whole number of at least 1, got 0"),
        ({"frames": 0}, "frames must be a whole number of at least 1, got 0"),
        ({"eval_episodes": 1}, "eval_episodes must be a whole number of at least 2, got 1"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        suite.Config(**settings)
