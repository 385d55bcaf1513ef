"""Trains PPO and PPO-Lagrangian on a robot arm and compares them.

The main job of the repository: ``make train``. Everything but the environment, the loss and
the multiplier rule is TorchRL's.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.envs import EnvBase
from tqdm import tqdm

from experiments.algorithms import ALGORITHMS, Training, configured, own_settings
from experiments.config import AlgorithmName, Config, command_line
from experiments.demonstrations import CARE, start_from_demonstrations
from experiments.environment import arm_arguments, cost_names, make_env
from experiments.files import as_json, lasting, run_to_resume, write_whole
from experiments.film import Policy, save_film
from experiments.grid import side_by_side
from experiments.log import Log, figures, progress_text, score, summed_costs, versions
from experiments.report import plot_curves, save_picture, table
from torchrl_safe.checkpoint import RunCheckpoints
from torchrl_safe.collectors import ResumableCollector
from torchrl_safe.evaluation import evaluate, summarize
from torchrl_safe.policy import load_policy, save_policy

# Algorithms that learn the same from demonstrations: they have the same networks, and see the same.
SHARING: tuple[AlgorithmName, ...] = ("ppo", "ppo-lagrangian")
# Settings that may differ when a run is resumed: they do not change what is learnt.
CHANGEABLE = ("algorithms", "shield", "jobs", "out", "logger", "resume", "checkpoint_every")


@contextmanager
def collecting(
    config: Config, policy: TensorDictModuleBase, algorithm: AlgorithmName
) -> Iterator[BaseCollector]:
    """Opens TorchRL's collector, in this process or in workers, and shuts it down."""
    settings: dict[str, Any] = {
        "frames_per_batch": config.frames_per_batch,
        # Collector closes its environment after the last frame: there would be no checkpoint then.
        "total_frames": -1,
        "auto_register_policy_transforms": False,
    }
    if config.processes == 1:
        env = make_env(config, config.envs, algorithm=algorithm, training=True)
        collector = ResumableCollector(env, policy, **settings)
    else:
        worlds = config.envs // config.processes
        factory = partial(make_env, config, worlds, algorithm=algorithm, training=True)
        collector = MultiSyncCollector(
            [factory] * config.processes, policy, **settings, collector_class=ResumableCollector
        )
    collector.set_seed(config.seed)
    if config.processes == 1:
        # The episodes that it has begun without a seed; with workers TorchRL does so itself.
        collector.reset()
    try:
        yield collector
    finally:
        collector.shutdown()


def train(
    config: Config, algorithm: AlgorithmName, *, progress: bool = True, line: int = 0
) -> tuple[TensorDictModuleBase, Log]:
    """Trains with one algorithm; returns the policy and the figures of each batch.

    ``line`` is where the progress is shown, below the first. Unless ``config.own_settings`` is
    False, the algorithm sets some of the options that are at their defaults.
    """
    config = configured(config, algorithm)
    # TorchRL's notes on each buffer would break up the progress bar.
    torchrl_logger.setLevel("WARNING")
    # The networks are small: more threads would only wait for each other.
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    env = make_env(config, num_envs=8, seed=config.seed, algorithm=algorithm)
    training = ALGORITHMS[algorithm].build(env, config)
    env.close()
    log = Log(config.logger, config.out / "logs", algorithm)
    batches = math.ceil(config.frames / config.frames_per_batch)
    costs = tuple(config.cost_limits)
    with (
        collecting(config, training.collector, algorithm) as collector,
        tqdm(
            total=config.frames,
            desc=algorithm,
            # Rates and counts would push the figures off the line.
            bar_format="{desc} {percentage:3.0f} % |{bar:20}| {remaining} left{postfix}",
            disable=not progress,
            position=line,
        ) as bar,
    ):
        checkpoints = RunCheckpoints(
            config.out / algorithm / "checkpoints",
            {
                **training.state(),
                "collector": collector,
                "log": log,
                "generators": GlobalRNGState(),
            },
            settings={"algorithm": algorithm, **lasting(dataclasses.asdict(config), CHANGEABLE)},
        )
        if not config.resume:
            checkpoints.clear()
        if checkpoints.load() is None and config.demonstrations:
            demonstrate(config, algorithm, training)
            collector.update_policy_weights_()
        log.open()
        bar.initial = bar.n = bar.last_print_n = log.frames  # Not what this process has done.
        for batch in islice(collector, batches - len(log.rows)):
            episodes = batch["next"][batch["next", "done"].squeeze(-1)]
            if training.updater is not None:
                training.updater.step(episodes["episode_cost"])
            training.learner.learn(batch)
            collector.update_policy_weights_()
            bar.update(batch.numel())
            row = figures(episodes, training.loss, costs)
            row |= summed_costs(batch, log.rows, costs)
            bar.set_postfix_str(progress_text(row, config.cost_limits))
            log.add({"frames": log.frames + batch.numel(), **row})
            if len(log.rows) % config.checkpoint_every == 0 or len(log.rows) == batches:
                recent = log.rows[-config.checkpoint_every :]
                checkpoints.save(log.frames, score=score(recent, config.cost_limits))
    keep_policy(config, algorithm, training)
    return training.actor, log


def demonstrate(config: Config, algorithm: AlgorithmName, training: Training) -> None:
    """Starts policy and critics from demonstrations, in episodes that nothing else uses.

    What one of ``SHARING`` has begun with, the others of the same run begin with too.
    """
    sharing = SHARING if algorithm in SHARING else ()
    kept = {name: begun(config, name, training) for name in sharing}
    if kept and not config.resume:
        kept[algorithm].clear()
    if any(each.load() is not None for each in kept.values()):
        return
    seed = config.seed + 2_000_000
    env = make_env(config, config.envs, seed, algorithm, training=True)
    start_from_demonstrations(training, env, config)
    env.close()
    if kept:
        kept[algorithm].save(config.demonstrations)


def begun(config: Config, algorithm: AlgorithmName, training: Training) -> RunCheckpoints:
    """The file of what an algorithm has begun with, and of the state of all generators then."""
    depends_on = {"environment": repr(arm_arguments(config)), "care": repr(CARE), **versions()}
    return RunCheckpoints(
        config.out / algorithm / "demonstrations",
        {
            "actor": training.actor,
            "critic": training.loss.critic_network,
            "cost_critic": training.loss.cost_critic_network,
            "scale": TensorDict(cost_advantage=training.loss.cost_advantage_scale),
            "generators": GlobalRNGState(),
        },
        settings={**lasting(dataclasses.asdict(config), CHANGEABLE), **depends_on},
    )


def keep_policy(config: Config, algorithm: AlgorithmName, training: Training) -> None:
    """Writes the policy to a file of its own, with what it was trained for."""
    trained = {**as_json(config), "name": algorithm}
    save_policy(
        config.out / algorithm / "policy.pt",
        training.actor,
        training.observation_spec,
        settings=trained,
    )


def train_and_evaluate(
    config: Config, algorithm: AlgorithmName, line: int = 0, *, progress: bool = True
) -> dict[str, Any]:
    """Trains with one algorithm and plays with what it has learnt; returns what JSON can keep."""
    actor, log = train(config, algorithm, progress=progress, line=line)
    seconds = log.seconds
    evaluation, episodes = play(config, algorithm, actor)
    result = {
        "versions": versions(),
        "seconds": seconds,
        "history": log.rows,
        "evaluation": evaluation,
        "episodes": {name: value.tolist() for name, value in episodes.items()},
    }
    if ALGORITHMS[algorithm].shield is not None:
        result["without_shield"] = play(config, algorithm, actor, shielded=False)[0]
    return result


def play(
    config: Config, algorithm: AlgorithmName, actor: TensorDictModuleBase, *, shielded: bool = True
) -> tuple[dict[str, list[float]], TensorDict]:
    """Plays the final evaluation; returns its figures and episodes."""
    env = make_env(config, num_envs=32, algorithm=algorithm, shielded=shielded)
    # Seeds that training does not use.
    episodes = evaluate(env, actor, config.eval_episodes, seed=config.seed + 1_000_000)
    env.close()
    return summarize(episodes, cost_names(config, shielded)), episodes


def run(config: Config, algorithm: AlgorithmName) -> dict[str, Any]:
    """One run of a grid; the grid shows the progress."""
    return train_and_evaluate(config, algorithm, progress=False)


def start(config: Config) -> dict[str, Any]:
    """Begins a run, or reads what one that is resumed has finished."""
    before = run_to_resume(config, CHANGEABLE)
    results: dict[str, Any] = {
        "config": dataclasses.asdict(config),
        "cost_limits": config.cost_limits,
        "algorithms": {} if before is None else before["algorithms"],
    }
    config.out.mkdir(parents=True, exist_ok=True)
    write_whole(config.out / "results.json", json.dumps(results, indent=1, default=str))
    return results


def film(config: Config, path: Path, *, seed: int, **options: Any) -> None:
    """Films the policies of a run side by side; ``options`` are those of :func:`save_film`."""
    actors: dict[str, tuple[EnvBase, Policy]] = {
        name: (
            make_env(config, num_envs=1, algorithm=name),
            load_policy(config.out / name / "policy.pt").actor,
        )
        for name in config.chosen
    }
    try:
        save_film(actors, path, seed=seed, limits=config.cost_limits, **options)
    finally:
        for env, _ in actors.values():
            env.close()


def finish(
    config: Config, algorithms: Sequence[AlgorithmName]
) -> Iterator[tuple[AlgorithmName, dict[str, Any]]]:
    """Trains all algorithms; yields name and results of each as soon as it has ended."""
    workers = min(config.side_by_side, len(algorithms))
    if workers < 2:
        for algorithm in algorithms:
            yield algorithm, train_and_evaluate(config, algorithm)
        return
    jobs = [(config, algorithm, line) for line, algorithm in enumerate(algorithms)]
    for index, result in side_by_side(train_and_evaluate, jobs, workers=workers):
        yield algorithms[index], result


def main(config: Config) -> None:
    """Trains and evaluates each algorithm, then writes the comparison."""
    for name in config.chosen:
        configured(config, name)  # Raises if what it sets does not fit, before anything is trained.
    results = start(config)
    todo = [name for name in config.chosen if name not in results["algorithms"]]
    for name in todo:
        if own := own_settings(config, name):
            chosen = ", ".join(f"{option} {value:g}" for option, value in own.items())
            print(f"{name} has settings of its own (--no-own-settings): {chosen}.")
    if config.limit_share < 1:
        print(f"Algorithms with limits aim at {config.limit_share:.0%} of each (--limit-share).")
    for algorithm, result in finish(config, todo):
        done = {**results["algorithms"], algorithm: result}
        # In one order, whichever ends first.
        results["algorithms"] = {n: done[n] for n in (*config.chosen, *done) if n in done}
        write_whole(config.out / "results.json", json.dumps(results, indent=1, default=str))
    stage = make_env(config, num_envs=1, seed=config.seed, algorithm=config.chosen[0])
    save_picture(stage, config.out / "scene.png")
    stage.close()
    plot_curves(results, config.out / "curves.png")
    film(config, config.out / "film.gif", seed=config.seed, width=320)
    text = table(results)
    write_whole(config.out / "table.md", text)
    print(f"\n{text}\nResults are in {config.out}.")


if __name__ == "__main__":
    main(command_line())
