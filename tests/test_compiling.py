"""Losses that the scripts compile: when, and that what is learnt is the same."""

import shutil
import sys

import pytest
import torch
from test_resume import SETTINGS, assert_goes_on_bit_for_bit, may_leave_a_file_open
from test_train import make_training

from experiments import compiling
from experiments.algorithms import ALGORITHMS
from experiments.config import Config
from experiments.train import train

# Of torch's, TorchRL's and tensordict's own code, when it is compiled.
pytestmark = [
    pytest.mark.filterwarnings("ignore::FutureWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


COMPILED = [name for name, made in ALGORITHMS.items() if getattr(made, "compiles", False)]


@pytest.fixture
def always(monkeypatch):
    monkeypatch.setattr(compiling, "PAYS_FROM", 0)


def is_compiled(objective):
    return hasattr(objective, "_torchdynamo_orig_callable")


def test_short_runs_are_not_compiled(monkeypatch):
    monkeypatch.setenv("CXX", sys.executable)  # Any program will do: nothing is called yet.
    ((_, short),) = make_training(frames=128_000).learner.phases
    ((_, long),) = make_training(frames=256_000).learner.phases
    assert not is_compiled(short)
    assert is_compiled(long)


def test_without_a_compiler_nothing_is_compiled_and_that_is_said(monkeypatch, capsys):
    loss = torch.nn.Linear(1, 1)
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert compiling.compiled(loss, 10**9) is loss
    assert capsys.readouterr().out == (
        "No C++ compiler no-such-compiler here: the loss is not compiled, and slower.\n"
    )


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile wants a C++ compiler")
@pytest.mark.parametrize("algorithm", COMPILED)
def test_trains_compiled(algorithm, tmp_path, always):
    """Two batches, of which the last minibatch is smaller: no graph breaks, no NaN."""
    settings = {**SETTINGS, "frames": 160, "frames_per_batch": 80}
    _, log = train(Config(**settings, out=tmp_path), algorithm, progress=False)
    assert [row["frames"] for row in log.rows] == [80, 160]


@may_leave_a_file_open
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile wants a C++ compiler")
def test_a_compiled_run_goes_on_bit_for_bit(tmp_path, always):
    assert_goes_on_bit_for_bit("ppo-lagrangian", tmp_path)
