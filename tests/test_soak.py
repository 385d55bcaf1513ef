"""Long runs: memory stays flat, nothing is left behind, multipliers stay finite."""

import gc
import itertools
import logging
import multiprocessing
import os
from functools import partial
from pathlib import Path

import pybullet
import pytest
import torch
from torch.distributions.transforms import ExpTransform, SoftplusTransform
from torchrl.envs import ParallelEnv
from torchrl.objectives import LossModule

from torchrl_safe.envs import ArmEnv, Collision, InFront, Moving, Proximity
from torchrl_safe.objectives import DualAscent, PIDControl

pytestmark = pytest.mark.integration

LOG = logging.getLogger(__name__)
PROC = Path("/proc/self")
needs_proc = pytest.mark.skipif(not PROC.exists(), reason="reads /proc")
slow = pytest.mark.slow
MEGABYTE = 2**20
# Moving obstacles, contacts and distances: all that can be asked of the simulator.
EVERYTHING = {
    "costs": {"collision": Collision(table=True, itself=True), "near": Proximity()},
    "obstacles": Moving(InFront()),
}


def resident():
    """Bytes of this process that are in memory."""
    return int((PROC / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def play(env, steps):
    """Random actions; worlds whose episode has ended start a new one."""
    tensordict = env.reset()
    for _ in range(steps // env.num_envs):
        _, tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))


# ---------------------------------------------------------------- memory


@needs_proc
@pytest.mark.parametrize(
    ("settings", "resets", "steps", "growth"),
    [
        pytest.param({"num_envs": 2}, 60, 400, 2, id="short"),
        pytest.param({"num_envs": 4, **EVERYTHING}, 200, 20_000, 4, id="all", marks=slow),
        pytest.param({"num_envs": 20, "frame_skip": 4}, 1_000, 1_000_000, 8, id="long", marks=slow),
    ],
)
def test_memory_stays_flat(settings, resets, steps, growth, make_env):
    """Less than 1 kB more for each reset, or 10 bytes for each step, of the long run."""
    env = make_env(ArmEnv, **settings, seed=0)
    # What is allocated once, by us, TorchRL and PyBullet, is there after this.
    play(env, max(200, steps // 100))
    gc.collect()
    start = resident()
    for tenth in range(1, 11):
        for _ in range(resets // 10):
            env.reset()
        play(env, steps // 10)
        grown = (resident() - start) / MEGABYTE
        LOG.info("%d steps: %.1f MB above %.0f MB", tenth * steps // 10, grown, start / MEGABYTE)
    assert grown < growth


# ---------------------------------------------------------------- what is left behind


def left_over():
    """PyBullet's servers, child processes and open files of this process."""
    gc.collect()
    clients = {c for c in range(1024) if pybullet.getConnectionInfo(c)["isConnected"]}
    children = {process.pid for process in multiprocessing.active_children()}
    files = sorted(os.readlink(file) for file in (PROC / "fd").iterdir() if file.is_symlink())
    return clients, children, files


def one_world():
    env = ArmEnv(seed=0)
    env.rollout(2)
    env.render(width=8, height=8)
    env.close()


def two_workers():
    env = ParallelEnv(2, ArmEnv, mp_start_method="fork")
    env.rollout(2)
    env.close()


@needs_proc
@pytest.mark.parametrize(
    ("cycle", "cycles"),
    [
        pytest.param(one_world, 3, id="one-3"),
        pytest.param(one_world, 100, id="one-100", marks=slow),
        pytest.param(two_workers, 1, id="parallel-1"),
        pytest.param(two_workers, 100, id="parallel-100", marks=slow),
    ],
)
def test_open_and_close_leaves_nothing(cycle, cycles):
    cycle()  # What Python opens once and keeps, such as its resource tracker.
    before = left_over()
    for _ in range(cycles):
        cycle()
    assert left_over() == before


# ---------------------------------------------------------------- multipliers

RULES = {
    "sgd": partial(DualAscent, lr=0.1),
    "adam": partial(DualAscent, lr=0.1, optimizer=torch.optim.Adam),
    "softplus": partial(
        DualAscent, lr=0.1, optimizer=torch.optim.Adam, parametrization=SoftplusTransform()
    ),
    "exp": partial(DualAscent, lr=0.1, parametrization=ExpTransform(), max_multiplier=10.0),
    "pid": partial(PIDControl, kp=0.5, ki=0.1, kd=0.5, smoothing=0.9),
}


def make_updater(rule, multiplier=1.0, **settings):
    module = LossModule()
    module.register_buffer("lagrange_multiplier", torch.tensor([multiplier]))
    return rule(module, **settings), module.lagrange_multiplier


def make_episodes(cost):
    return cost * (0.5 + torch.rand(8, 1, generator=torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("batches", [20, pytest.param(20_000, marks=slow)])
@pytest.mark.parametrize("limit", [0.0, 1.0])
@pytest.mark.parametrize("cost", [0.0, 1e-30, 1e-9, 1e6])
@pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
def test_multipliers_stay_finite(rule, cost, limit, batches):
    episodes = make_episodes(cost)
    for normalize, pessimism in itertools.product((False, True), (0.0, 2.0)):
        settings = {"cost_limit": limit, "normalize": normalize, "pessimism": pessimism}
        updater, multiplier = make_updater(rule, **settings)
        for _ in range(batches):
            updater.step(episodes)
            assert multiplier.isfinite()
            assert multiplier >= 0


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("rule", ["sgd", "exp", "pid"])
def test_bounded_multipliers_come_back_from_extreme_costs(rule, normalize):
    """The scale of normalized violations forgets a fifth in each batch: 1e6 in some 60."""
    settings = {"cost_limit": 1.0, "normalize": normalize, "max_multiplier": 10.0}
    updater, multiplier = make_updater(partial(RULES[rule], **settings))
    for _ in range(50):
        updater.step(make_episodes(1e6))
    reached = multiplier.item()
    for _ in range(200):
        updater.step(torch.zeros(8, 1))
    assert 0 <= multiplier.item() < min(reached, 1.0)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
def test_one_absurd_cost_does_not_stop_a_normalized_multiplier(rule):
    """Its square is beyond float32."""
    updater, multiplier = make_updater(rule, cost_limit=1.0, normalize=True)
    updater.step(torch.tensor([[3e20]]))
    assert updater.cost_scale.isfinite()
    # The scale forgets a fifth in each batch: it is back at 2 after some 210.
    for _ in range(300):
        before = multiplier.clone()
        updater.step(torch.tensor([[2.0]]))
    assert multiplier > before or multiplier == updater.max_multiplier
