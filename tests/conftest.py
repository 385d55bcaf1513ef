"""Fixtures shared by the tests."""

import gc
import multiprocessing
import signal

import pytest

# What takes seconds to import is imported where it is used: the process that only hands out the
# tests to others loads this file too.

# A shell that runs us in the background has us ignore Ctrl+C, and so all that we start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    """Examples in docstrings cannot be marked where they are: these compile whole losses."""
    compiling = (
        "torchrl_safe/testing/suite.py",
        "torchrl_safe/testing/interface.py::torchrl_safe.testing.interface.check_compile",
    )
    for item in items:
        if item.nodeid.startswith(compiling):
            item.add_marker(pytest.mark.integration)


def pytest_collection_finish():
    """Collects garbage less often: looking through all imports took an eighth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


@pytest.fixture
def make_env():
    """Closes every environment that a test has made with it."""
    made = []

    def make(factory, *args, **kwargs):
        env = factory(*args, **kwargs)
        made.append(env)
        return env

    yield make
    for env in made:
        if not env.is_closed:
            env.close()


@pytest.fixture(params=["bullet", "mujoco"])  # Those of worlds.ENGINES.
def engine(request, monkeypatch):
    """Its name: the engine of every ArmEnv that does not say otherwise."""
    from worlds import ENGINES

    from torchrl_safe.envs import ArmEnv

    monkeypatch.setitem(ArmEnv.__init__.__kwdefaults__, "physics", ENGINES[request.param])
    return request.param


@pytest.fixture
def turntable(tmp_path):
    """Settings of an ArmEnv with a bar that turns about a vertical axis."""
    from worlds import turntable_settings

    return turntable_settings(tmp_path)


@pytest.fixture
def threads():
    """Scripts set the number of PyTorch's threads; puts it back."""
    import torch

    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def forked_workers():
    """TorchRL makes spawning the default, which takes seconds for each worker."""
    before = multiprocessing.get_start_method()
    multiprocessing.set_start_method("fork", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture(autouse=True)
def seed():
    """Numbers that a test draws do not depend on the tests before it."""
    import torch

    # Of the CPU alone: torch.manual_seed formats the stack for each kind of device not in use.
    torch.default_generator.manual_seed(0)
