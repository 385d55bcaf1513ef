"""A run that is stopped at any point and resumed equals an uninterrupted run, bit for bit."""

import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from experiments.algorithms import ALGORITHMS
from experiments.config import Config
from experiments.train import main, train

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parent.parent
SETTINGS = {
    "frames": 640,
    "frames_per_batch": 64,
    "envs": 4,
    "workers": 1,
    "epochs": 1,
    "minibatch": 32,
    "eval_episodes": 8,
    "checkpoint_every": 1,
    "gamma": 0.9,
    "multiplier_init": 1.0,
}


@pytest.fixture
def start():
    """Starts processes, and ends those that are left."""
    started = []

    def start_one(*args, **kwargs):
        started.append(make_train(*args, **kwargs))
        return started[-1]

    yield start_one
    for process in started:
        if process.returncode is None:
            process.kill()
            process.communicate()


def make_train(out, *algorithms, **settings):
    """Starts ``make train`` in a process of its own, at the head of its own process group."""
    options = {**SETTINGS, "resume": True, **settings, "out": out}
    arguments = ["--algorithms", *algorithms]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        arguments += [option] if value is True else [option, str(value)]
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.train", *arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for(process, happens, every=0.001):
    deadline = time.monotonic() + 600
    while not happens():
        if process.poll() is not None:
            pytest.fail(f"ended with {process.returncode}: {process.stderr.read()[-3000:]}")
        assert time.monotonic() < deadline
        time.sleep(every)


def kill_in_the_middle_of_a_write(process, folder):
    unfinished = folder / ".unfinished"
    # Not at the first: there is nothing to go on from.
    wait_for(process, lambda: any(folder.glob("*.torchrl")), every=0.02)
    while True:
        wait_for(process, unfinished.exists)
        process.send_signal(signal.SIGSTOP)
        # It does not stop at once.
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        left = list(unfinished.rglob("*.pt")) if unfinished.exists() else []
        if left:
            process.kill()
            process.communicate()
            return left
        process.send_signal(signal.SIGCONT)


def written(out):
    """The text of all logs by their names."""
    return {
        path.relative_to(out).as_posix(): path.read_text() for path in (out / "logs").rglob("*.csv")
    }


def assert_same_run(one, two, out_one, out_two):
    for (name, first), second in zip(
        one[0].state_dict().items(), two[0].state_dict().values(), strict=True
    ):
        assert torch.equal(first, second), name
    assert one[1].rows == two[1].rows
    assert written(out_one) == written(out_two) != {}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("uninterrupted")
    return train(Config(**SETTINGS, out=out), "ppo-lagrangian", progress=False), out


def test_killed_in_the_middle_of_a_write(tmp_path, uninterrupted, start):
    """Also, two processes with one seed do the same, from the first episodes on."""
    expected, reference = uninterrupted
    folder = tmp_path / "ppo-lagrangian" / "checkpoints"
    process = start(tmp_path, "ppo-lagrangian")
    assert kill_in_the_middle_of_a_write(process, folder)
    assert process.returncode == -signal.SIGKILL
    assert 1 <= len(list(folder.glob("*.torchrl"))) <= 3
    resumed = train(Config(**SETTINGS, out=tmp_path, resume=True), "ppo-lagrangian", progress=False)
    assert_same_run(expected, resumed, reference, tmp_path)
    assert not (folder / ".unfinished").exists()
    # A run that is over is not trained again.
    again = train(Config(**SETTINGS, out=tmp_path, resume=True), "ppo-lagrangian", progress=False)
    assert_same_run(expected, again, reference, tmp_path)


def interrupt_when(happens):
    """Sends this process what Ctrl+C sends, as soon as something has happened."""

    def watch():
        while not happens():
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


# An interrupt may come between open() and the "with" that closes the file: then Python closes it,
# and warns.
may_leave_a_file_open = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")


def assert_goes_on_bit_for_bit(algorithm, tmp_path):
    """Stopped after its second checkpoint, a run ends as one that was never stopped."""
    settings = {**SETTINGS, "frames": 320}
    one, two = tmp_path / "one", tmp_path / "two"
    expected = train(Config(**settings, out=one), algorithm, progress=False)
    folder = two / algorithm / "checkpoints"
    thread = interrupt_when(lambda: len(list(folder.glob("*.torchrl"))) > 1)
    with pytest.raises(KeyboardInterrupt):
        train(Config(**settings, out=two), algorithm, progress=False)
    thread.join()
    gc.collect()  # What was left open is closed now, while that may be.
    resumed = train(Config(**settings, out=two, resume=True), algorithm, progress=False)
    assert_same_run(expected, resumed, one, two)


@may_leave_a_file_open
@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_goes_on_bit_for_bit(algorithm, tmp_path):
    assert_goes_on_bit_for_bit(algorithm, tmp_path)


def results(out):
    """All results but those that are about this run of the program."""
    read = json.loads((out / "results.json").read_text())
    for run in read["algorithms"].values():
        del run["seconds"]
    return read["algorithms"]


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "jobs"), [(1, 1), (2, 1), (1, 2)])
def test_stopped_again_and_again(tmp_path, workers, jobs, start):
    """By all signals, in training and after it. Finished parts are kept, the rest is the same."""
    one, two = tmp_path / "one", tmp_path / "two"
    names = ("ppo", "sac-lagrangian")
    process = start(one, *names, workers=workers, jobs=1)
    _, problem = process.communicate()
    assert process.returncode == 0, problem

    def reaches(algorithm, frames):
        last = f"checkpoint-{frames:012d}.torchrl"
        folder = two / algorithm / "checkpoints"
        return lambda: any(path.name >= last for path in folder.glob("*.torchrl"))

    stops = (
        (signal.SIGTERM, reaches("ppo", 128)),
        (signal.SIGKILL, reaches("ppo", 384)),
        (signal.SIGKILL, (two / "ppo" / "policy.pt").exists),
        (signal.SIGINT, reaches("sac-lagrangian", 256)),
    )
    for number, happens in stops:
        process = start(two, *names, workers=workers, jobs=jobs)
        wait_for(process, happens)
        children = children_of(process.pid)
        process.send_signal(number)
        process.communicate()
        assert process.returncode != 0
        wait_until_gone(children)
    process = start(two, *names, workers=workers, jobs=jobs)
    _, problem = process.communicate()
    assert process.returncode == 0, problem
    assert results(one) == results(two)
    assert written(one) == written(two) != {}


def children_of(pid):
    listed = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(child) for child in listed.read_text().split()] if listed.exists() else []


def wait_until_gone(pids):
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < deadline, f"still there: {pids}"
        time.sleep(0.1)


def test_other_settings_are_refused(tmp_path, uninterrupted):
    _, reference = uninterrupted
    other = Config(**{**SETTINGS, "epochs": 2}, out=reference, resume=True)
    with pytest.raises(RuntimeError, match="epochs was 1 and is now 2"):
        train(other, "ppo-lagrangian", progress=False)
    config = Config(**SETTINGS, algorithms=("ppo",), out=tmp_path)
    (tmp_path / "results.json").write_text(
        json.dumps({"config": {**vars(config), "out": "", "seed": 1}, "algorithms": {}})
    )
    with pytest.raises(ValueError, match="seed was 1 and is now 0"):
        main(Config(**SETTINGS, algorithms=("ppo",), out=tmp_path, resume=True))


def test_a_folder_without_a_run_is_refused(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(FileExistsError, match="There is no run in it to resume"):
        main(Config(out=tmp_path, resume=True))


def test_a_run_that_is_not_resumed_begins_anew(tmp_path, uninterrupted):
    _, reference = uninterrupted
    shutil.copytree(reference, tmp_path / "run")
    config = Config(**{**SETTINGS, "frames": 64}, out=tmp_path / "run")
    _, log = train(config, "ppo-lagrangian", progress=False)
    assert [row["frames"] for row in log.rows] == [64]
    assert all(len(text.splitlines()) == 1 for text in written(config.out).values())
    assert len(list((config.out / "ppo-lagrangian" / "checkpoints").iterdir())) == 1
