"""The sweep of limits and the multiplier profile, made small: what they run and what they draw."""

import dataclasses
import json

import pytest
from PIL import Image

from experiments import compare, multiplier_profile, sweep
from experiments.grid import missing

SMALL = {"seeds": (0,), "frames": 4096, "eval_episodes": 32, "jobs": 2}


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    out = tmp_path_factory.mktemp("sweep")
    config = sweep.Config(**SMALL, limits=(0.5,), actions=("cartesian",), out=out)
    sweep.main(config)
    return config


@pytest.mark.slow
def test_sweep_leaves_table_figure_and_results(swept):
    results = json.loads((swept.out / "results.json").read_text())
    assert [run["limit"] for run in results["runs"]] == [0.5, None]
    safe, ppo = results["runs"]
    assert safe["history"][-1]["multiplier/collision"] > 0
    assert ppo["history"][-1]["multiplier/collision"] == 0
    costs = sweep.episode_costs(results["runs"])
    assert costs.shape == (2, 32)
    assert costs[0].mean().item() == pytest.approx(safe["evaluation"]["cost/collision"][0])
    assert (swept.out / "table.md").read_text() == sweep.table(results["runs"], swept)
    for name in ("sweep", "curves"):
        with Image.open(swept.out / f"{name}.png") as image:
            assert image.width > 500
    assert not missing(sweep.jobs(swept))
    assert len(missing(sweep.jobs(dataclasses.replace(swept, seeds=(0, 1, 2))))) == 4


@pytest.mark.parametrize("script", [compare, sweep, multiplier_profile])
def test_engine_is_an_option(script, tmp_path):
    for physics in ("bullet", "mujoco"):
        jobs = script.jobs(script.Config(physics=physics, out=tmp_path))
        assert {settings.physics for settings, _ in jobs.values()} == {physics}


def test_training_may_aim_below_the_limits():
    config = sweep.Config(limits=(2.0,), limit_share=0.75)
    aims = {settings.aims["collision"] for settings, _ in sweep.jobs(config).values()}
    assert aims == {1.5, 0.0}  # PPO has no limit.


def test_the_paper_has_one_engine(tmp_path):
    with pytest.raises(ValueError, match="physics must be bullet with paper, got mujoco"):
        sweep.jobs(sweep.Config(paper=True, physics="mujoco", out=tmp_path))


def made_up(limit, seed, costs, success):
    return {
        "action": "joint",
        "limit": limit,
        "seed": seed,
        "history": [{"multiplier/collision": 2.0 * seed}],
        "evaluation": {"success": [success, 0, 1], "return": [-3.0, -4, -2]},
        "episodes": {"episode_cost": [[float(cost)] for cost in costs]},
    }


def test_sweep_counts_the_seeds_that_keep_the_limit():
    config = sweep.Config(limits=(2.0,), actions=("joint",), seeds=(0, 1))
    runs = [
        made_up(2.0, 0, [0, 4], 1.0),  # exactly the limit
        made_up(2.0, 1, [1, 4], 0.5),
        made_up(None, 0, [9, 9], 1.0),
        made_up(None, 1, [9, 9], 1.0),
    ]
    row = sweep.table(runs, config).splitlines()[2]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:4] == ["joint", "2", "1/2", "2.50"]
    assert cells[5:] == ["75.0%", "50.0%", "-3.00", "0.00 to 2.00"]


@pytest.mark.slow
def test_profile_runs_fixed_multipliers_and_rules(tmp_path):
    config = multiplier_profile.Config(**SMALL, multipliers=(4.0,), limits=(0.5,), out=tmp_path)
    multiplier_profile.main(config)
    fixed, *others = json.loads((tmp_path / "results.json").read_text())["runs"]
    assert (fixed["rule"], fixed["value"]) == ("fixed", 4.0)
    assert {row["multiplier/collision"] for row in fixed["history"]} == {4.0}
    assert [(run["rule"], run["value"]) for run in others] == [("dual-ascent", 0.5), ("pid", 0.5)]
    config = dataclasses.replace(config, limits=(0.5, 2.0), seeds=(0, 1))
    assert [path.name for path in missing(multiplier_profile.jobs(config))] == [
        "dual-ascent-2-0.json", "pid-2-0.json",
        "fixed-4-1.json", "dual-ascent-0.5-1.json", "dual-ascent-2-1.json",
        "pid-0.5-1.json", "pid-2-1.json",
    ]  # fmt: skip


def test_profile_shows_fixed_multipliers_and_rules(tmp_path):
    def end(rule, value, cost, multiplier):
        evaluation = {"return": [-3.0], "cost/collision": [cost], "success": [1.0]}
        history = [{"multiplier/collision": multiplier}]
        return {"rule": rule, "value": value, "evaluation": evaluation, "history": history}

    runs = [
        end("fixed", 0.0, 5.0, 0.0), end("fixed", 3.0, 0.25, 3.0), end("fixed", 3.0, 0.75, 3.0),
        end("dual-ascent", 0.5, 0.4, 2.0), end("pid", 0.5, 0.3, 2.5),
    ]  # fmt: skip
    assert multiplier_profile.table(runs).splitlines()[2:] == [
        "| fixed at 0 | -3.00 ± 0.00 | 5.00 ± 0.00 | 1.00 ± 0.00 | 0.00 ± 0.00 |",
        "| fixed at 3 | -3.00 ± 0.00 | 0.50 ± 0.25 | 1.00 ± 0.00 | 3.00 ± 0.00 |",
        "| dual-ascent, limit 0.5 | -3.00 ± 0.00 | 0.40 ± 0.00 | 1.00 ± 0.00 | 2.00 ± 0.00 |",
        "| pid, limit 0.5 | -3.00 ± 0.00 | 0.30 ± 0.00 | 1.00 ± 0.00 | 2.50 ± 0.00 |",
    ]
    multiplier_profile.plot(runs, tmp_path / "profile.png")
    with Image.open(tmp_path / "profile.png") as image:
        assert image.width > 500


def test_comparison_has_a_row_for_each_algorithm(tmp_path):
    def end(algorithm, seed, costs, success, limit=0.5):
        return {
            "algorithm": algorithm,
            "seed": seed,
            "cost_limit": limit,
            "seconds": 60.0 * (1 + seed),
            "evaluation": {
                "success": [success, 0, 1], "return": [-2.0 - seed], "cost/collision": [costs[0]],
            },
            "episodes": {"episode_cost": [[float(cost)] for cost in costs]},
        }  # fmt: skip

    runs = [
        end("ppo", 0, [4, 4], 1.0), end("cpo", 0, [0, 1], 1.0),
        end("ppo", 1, [6, 6], 1.0), end("cpo", 1, [1, 1], 0.5),
        end("ppo-saute", 0, [1, 2], 1.0, limit=2.0), end("ppo-saute", 1, [2, 2], 1.0, limit=2.0),
    ]  # fmt: skip
    rows = compare.table(runs).splitlines()[2:]
    assert rows == [
        "| ppo | 0.5 | 5.00 [4.00, 6.00] | 6.00 | 0/2 | 100.0% | 100.0% | -2.50 | 1.5 |",
        "| cpo | 0.5 | 0.75 [0.50, 1.00] | 1.00 | 1/2 | 75.0% | 50.0% | -2.50 | 1.5 |",
        "| ppo-saute | 2 | 1.75 [1.50, 2.00] | 2.00 | 2/2 | 100.0% | 100.0% | -2.50 | 1.5 |",
    ]
    compare.plot(runs, tmp_path / "compare.png")
    with Image.open(tmp_path / "compare.png") as image:
        assert image.width > 500


def test_comparison_has_settings_and_limits_of_their_own_for_some(tmp_path):
    jobs = compare.jobs(compare.Config(seeds=(0,), out=tmp_path))
    settings = {algorithm: config for config, algorithm in jobs.values()}
    assert len(settings) == 17
    assert settings["ppo"].frames == settings["ppo-lagrangian"].frames == 128_000
    assert settings["a2c-lagrangian"].frames_per_batch == 512
    assert {n for n, c in settings.items() if c.cost_limit == 2} == {*compare.BUDGETS}
    higher = compare.jobs(compare.Config(seeds=(0,), cost_limit=5.0, out=tmp_path))
    assert {config.cost_limit for config, _ in higher.values()} == {5.0}


@pytest.mark.slow
def test_comparison_trains_what_it_is_told(tmp_path):
    config = compare.Config(**SMALL, algorithms=("ppo", "cpo"), out=tmp_path)
    compare.main(config)
    runs = json.loads((tmp_path / "results.json").read_text())["runs"]
    assert [run["algorithm"] for run in runs] == ["ppo", "cpo"]
    assert not missing(compare.jobs(config))
    more = dataclasses.replace(config, seeds=(0, 1))
    assert [path.name for path in missing(compare.jobs(more))] == [
        "ppo-1.json", "cpo-1.json",
    ]  # fmt: skip


@pytest.mark.parametrize("config", [compare.Config, sweep.Config, multiplier_profile.Config])
def test_a_grid_of_no_seed_or_no_process_is_refused(config):
    with pytest.raises(ValueError, match=r"seeds must name at least one, each once, got \(\)"):
        config(seeds=())
    with pytest.raises(ValueError, match="jobs must be a whole number of at least 1, got 0"):
        config(jobs=0)
