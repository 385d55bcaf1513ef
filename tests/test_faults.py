"""What happens when something breaks: dead workers, raising environments, NaN, empty batches."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pybullet
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector, MultiSyncCollector, _multi_sync
from torchrl.envs import ParallelEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import RandomPolicy
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from experiments.algorithms import ALGORITHMS
from experiments.config import Config
from experiments.environment import make_env
from experiments.train import train
from torchrl_safe import envs
from torchrl_safe.envs import ArmEnv, Collision, FullObservation, InFront, Placement, Reach, Shield
from torchrl_safe.objectives import DualAscent, PIDControl, PPOLagrangianLoss

ROOT = Path(__file__).parent.parent
NAN = float("nan")


class Fails:
    """A cost that is 0, and after some calls something else."""

    def __init__(self, calls, value=None):
        self.calls, self.value = calls, value

    def __call__(self, state):
        self.calls -= 1
        if self.calls >= 0:
            return np.zeros(len(state.goal))
        if self.value is None:
            raise OSError("the sensor is gone")
        return np.full(len(state.goal), self.value)


def arm(cost=None, **settings):
    costs = {"cost": Collision() if cost is None else cost}
    return ArmEnv(costs=costs, max_episode_steps=6, **settings)


# ---------------------------------------------------------------- workers


@pytest.fixture(autouse=True)
def workers_have_time_to_end(monkeypatch):
    """TorchRL closes a worker 0.1 s after it has terminated it; a busy machine takes longer.

    It then raises ValueError, "Cannot close a process while it is still running", in place of
    what these tests wait for.
    """
    close = BaseProcess.close

    def wait_and_close(process):
        if process.exitcode is None:
            process.join(60)
        close(process)

    monkeypatch.setattr(BaseProcess, "close", wait_and_close)


@pytest.fixture
def fork(monkeypatch):
    """Workers that start at once; TorchRL's default imports everything again in each."""
    before = torch.multiprocessing.get_start_method(allow_none=True)
    torch.multiprocessing.set_start_method("fork", force=True)
    yield
    torch.multiprocessing.set_start_method(before, force=True)


def collect(*envs):
    with_arm = arm()
    policy = RandomPolicy(with_arm.action_spec)
    with_arm.close()
    return MultiSyncCollector(list(envs), policy, frames_per_batch=16, total_frames=100_000)


def all_gone(processes):
    return not any(not process._closed and process.is_alive() for process in processes)


def test_collector_whose_worker_is_killed(fork):
    collector = collect(arm, arm)
    batches = iter(collector)
    next(batches)
    processes = list(collector.procs)
    os.kill(processes[1].pid, signal.SIGKILL)
    begin = time.monotonic()
    with pytest.raises(RuntimeError, match=r"process failed: worker 1 \(exit code -9\)"):
        next(batches)
    # TorchRL looks after its workers once a second.
    assert time.monotonic() - begin < 10
    collector.shutdown()
    assert all_gone(processes)


def test_collector_whose_environment_raises(fork, capfd):
    collector = collect(arm, partial(arm, Fails(calls=60)))
    processes = list(collector.procs)
    with pytest.raises(RuntimeError, match=r"process failed: worker 1 \(exit code 1\)"):
        list(collector)
    # The worker tells what it was.
    assert "OSError: the sensor is gone" in capfd.readouterr().err
    collector.shutdown()
    assert all_gone(processes)


@pytest.mark.slow  # TorchRL gives its workers ten seconds to end.
def test_collector_whose_worker_hangs(fork, monkeypatch):
    """``MAX_IDLE_COUNT=2`` in the environment, which is read once, when TorchRL is imported."""
    monkeypatch.setattr(_multi_sync, "_MAX_IDLE_COUNT", 2)
    collector = collect(arm, arm)
    batches = iter(collector)
    next(batches)
    processes = list(collector.procs)
    os.kill(processes[1].pid, signal.SIGSTOP)
    with pytest.raises(RuntimeError, match="Increase the MAX_IDLE_COUNT environment variable"):
        next(batches)
    assert all_gone(processes)


def parallel(*envs, shutdown_timeout=0.5):
    settings = {"mp_start_method": "fork", "shutdown_timeout": shutdown_timeout}
    return ParallelEnv(len(envs), list(envs), **settings)


@pytest.mark.parametrize("code", [-9, 1], ids=["killed", "raises"])
def test_parallel_environment_whose_worker_dies(code):
    # Time for the other worker to end by itself; TorchRL terminates, and names, one that does not.
    env = parallel(arm, partial(arm, Fails(calls=10)) if code == 1 else arm, shutdown_timeout=10)
    env.reset()
    workers = list(env._workers)
    if code == -9:
        os.kill(workers[1].pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="worker 1"):
        env.rollout(30, break_when_any_done=False)
    with pytest.raises(RuntimeError, match=rf"worker 1 \(exit code {code}\)"):
        env.close()
    assert all_gone(workers)


def test_parallel_environment_whose_worker_hangs():
    """As with ``BATCHED_PIPE_TIMEOUT=1`` in the environment; it is 10,000 seconds otherwise."""
    env = parallel(arm, arm)
    env.reset()
    env.BATCHED_PIPE_TIMEOUT = 1  # Workers may take longer to start.
    workers = list(env._workers)
    os.kill(workers[1].pid, signal.SIGSTOP)
    with pytest.raises(RuntimeError, match="within the 1 sec time limit"):
        env.rollout(3)
    env.close()
    assert all_gone(workers)


@pytest.mark.slow  # Two workers that import everything.
def test_training_whose_worker_is_killed(tmp_path):
    """It ends at once, says why, and leaves no process behind."""
    options = f"--algorithms ppo-lagrangian --frames 1000000 --envs 8 --workers 2 --out {tmp_path}"
    command = [sys.executable, "-m", "experiments.train", *options.split()]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as run:
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children")
        while not list(tmp_path.rglob("*.csv")):
            time.sleep(0.5)
            assert run.poll() is None
        workers = [int(pid) for pid in children.read_text().split()]
        # Python's resource tracker is the first child.
        os.kill(workers[-1], signal.SIGKILL)
        _, stderr = run.communicate(timeout=60)
    assert run.returncode == 1
    # TorchRL's message, or its error for a worker that takes long to end.
    assert "At least one process failed" in stderr or "Cannot close a process" in stderr
    deadline = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.1)


# ---------------------------------------------------------------- NaN in the environment


class Lost(Reach):
    def reward(self, state):
        return np.full(len(state.goal), NAN if np.any(state.joint_velocity) else 0.0)


def blind(state):
    fields = FullObservation()(state)
    fields["to_goal"] = fields["to_goal"] * (NAN if np.any(state.joint_velocity) else 1.0)
    return fields


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cost": Fails(calls=1, value=NAN)}, "cost 'cost' must be finite"),
        ({"cost": Fails(calls=1, value=1e39)}, "cost 'cost' must be finite"),
        ({"cost": Fails(calls=1, value=np.inf)}, "cost 'cost' must be finite"),
        ({"task": Lost()}, "reward must be finite"),
        ({"observation": blind}, "observation field 'to_goal' must be finite"),
    ],
    ids=["cost", "cost-beyond-float32", "infinite-cost", "reward", "observation"],
)
def test_the_arm_refuses_nan(settings, message, make_env):
    env = make_env(arm, **settings)
    with pytest.raises(ValueError, match=message):
        env.rollout(3)
    assert env.reset()["observation"].isfinite().all()


@pytest.mark.parametrize("before", [0, 1])
def test_a_process_that_holds_as_many_servers_as_pybullet_can(before, monkeypatch):
    """PyBullet answers -1, whether a world or what a shield measures in is one too many."""
    connect, opened = pybullet.connect, []

    def limited(mode):
        opened.append(connect(mode) if len(opened) < before else -1)
        return opened[-1]

    monkeypatch.setattr(pybullet, "connect", limited)
    with pytest.raises(RuntimeError, match="PyBullet opened no world"):
        ArmEnv(shield=Shield())
    assert len(opened) == before + 1


def test_a_nan_action_is_refused_before_anything_moves(make_env):
    env, other = (make_env(arm, num_envs=2, seed=0) for _ in range(2))
    good = TensorDict(action=torch.ones(2, 3), batch_size=[2])
    bad = TensorDict(action=torch.tensor([[0.0, 0, 0], [0, NAN, 0]]), batch_size=[2])
    for each in (env, other):
        each.reset()
    with pytest.raises(ValueError, match=r"action must be finite, got NaN or infinity in rows \[1"):
        env.step(bad)
    results = [each.step(good.clone())["next"] for each in (env, other)]
    assert torch.equal(results[0]["observation"], results[1]["observation"])


# ---------------------------------------------------------------- NaN while learning


def make_loss():
    net = torch.nn.Sequential(MLP(40, 6, num_cells=[16]), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        ["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critics = [
        ValueOperator(MLP(40, 1, num_cells=[16]), ["observation"], [key])
        for key in ("state_value", "cost_value")
    ]
    return PPOLagrangianLoss(actor, *critics, entropy_bonus=False), actor


def descend(loss, data, optimizer):
    """A step as docs/robustness.md recommends it."""
    losses = loss(data)
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    torch.nn.utils.clip_grad_norm_(loss.parameters(), torch.inf, error_if_nonfinite=True)
    optimizer.step()
    optimizer.zero_grad()


def copy_of(parameters):
    return [parameter.detach().clone() for parameter in parameters]


def all_equal(these, those):
    return all(torch.equal(one, two) for one, two in zip(these, those, strict=True))


KEYS = ["observation", "action", ("next", "reward"), ("next", "cost")]


@pytest.fixture(scope="module")
def batch():
    env = make_env(Config(), num_envs=4, seed=0).append_transform(StepCounter())  # For CPO.
    _, actor = make_loss()
    with torch.no_grad():
        batch = env.rollout(50, actor, break_when_any_done=False)
    env.close()
    return batch


def with_nan(batch, key):
    batch = batch.clone()
    batch[key][1, 7] = NAN
    return batch


@pytest.mark.parametrize("key", KEYS, ids=str)
def test_no_step_is_taken_with_nan(key, batch):
    """No mean or maximum hides a NaN on its way to the gradient."""
    loss, _ = make_loss()
    optimizer = torch.optim.Adam(loss.parameters())
    before = copy_of(loss.parameters())
    data = loss.estimate_advantages(with_nan(batch, key)).reshape(-1)
    with pytest.raises(RuntimeError, match=r"norm .* is non-finite"):
        descend(loss, data, optimizer)
    assert all_equal(loss.parameters(), before)
    # The data were bad, not the network: it learns from others.
    optimizer.zero_grad()
    descend(loss, loss.estimate_advantages(batch.clone()).reshape(-1), optimizer)
    assert not all_equal(loss.parameters(), before)
    assert all(parameter.isfinite().all() for parameter in loss.parameters())


@pytest.fixture(scope="module")
def small():
    """An environment from which networks can be made quickly."""
    env = make_env(Config(), num_envs=1, seed=0)
    yield env
    env.close()


FAST = {"cup", "cpo", "sac-lagrangian"}


@pytest.mark.parametrize(
    "key", [pytest.param(("next", "reward"), marks=pytest.mark.slow), ("next", "cost")], ids=str
)
@pytest.mark.parametrize(
    "algorithm",
    [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in ALGORITHMS],
)
def test_no_algorithm_takes_a_step_with_nan(algorithm, key, batch, small):
    if algorithm == "ppo-saute":  # It sees its budget too.
        pytest.skip("the same learner as ppo, with another observation")
    config = Config(frames=200, frames_per_batch=200, envs=4, workers=1, minibatch=200)
    training = ALGORITHMS[algorithm].build(small, config)
    before = copy_of(training.loss.parameters())
    with pytest.raises((RuntimeError, ValueError), match="finite"):
        training.learner.learn(with_nan(batch, key))
    # Of SAC's many small steps those before the one that meets the NaN are taken.
    assert all_equal(training.loss.parameters(), before) or algorithm == "sac-lagrangian"
    assert all(parameter.isfinite().all() for parameter in training.loss.parameters())


# ---------------------------------------------------------------- what is no fault


def learn(env, rule, frames_per_batch):
    """A user's loop of three batches; returns their multipliers and mean costs."""
    torch.manual_seed(0)
    env = TransformedEnv(env, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))
    loss, actor = make_loss()
    updater = rule(loss)
    optimizer = torch.optim.Adam(loss.parameters())
    settings = {"frames_per_batch": frames_per_batch, "total_frames": 3 * frames_per_batch}
    multipliers, costs = [], []
    for batch in Collector(env, actor, **settings, auto_register_policy_transforms=False):
        episode_cost = batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)]
        updater.step(episode_cost)
        descend(loss, loss.estimate_advantages(batch).reshape(-1), optimizer)
        multipliers.append(loss.lagrange_multiplier.item())
        costs.append(episode_cost.mean().item())
    assert all(parameter.isfinite().all() for parameter in loss.parameters())
    return multipliers, costs


RULES = {
    "dual-ascent": partial(DualAscent, lr=0.1),
    "pid": partial(PIDControl, kp=0.1, ki=0.1, kd=0.1),
}
each_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())


@each_rule
def test_a_batch_in_which_no_episode_ends(rule):
    rule = partial(rule, cost_limit=0.5, pessimism=2.0, normalize=True)
    env = ArmEnv(num_envs=2, seed=0)
    multipliers, costs = learn(env, lambda loss: started(rule, loss), frames_per_batch=20)
    assert multipliers == [0.5, 0.5, 0.5], "unchanged: 10 steps of 40 in each batch"
    assert np.isnan(costs).all()


def started(rule, loss):
    loss.lagrange_multiplier.fill_(0.5)
    return rule(loss)


@each_rule
def test_a_cost_limit_of_0(rule):
    """Any cost lifts the multiplier, and without any it stays."""
    settings = {"cost_limit": 0.0, "pessimism": 2.0, "normalize": True}
    env = arm(Fails(calls=20, value=1.0), num_envs=2, seed=0)
    multipliers, costs = learn(env, partial(rule, **settings), frames_per_batch=24)
    assert costs[0] == 0 == multipliers[0]
    assert 0 < costs[1] <= costs[2] == 6
    assert min(multipliers[1:]) > 0


class OutOfReach(InFront):
    def sample(self, rng, start, goal):
        return Placement([[3.0, 0.0, 0.1]])


@each_rule
def test_episodes_that_never_touch(rule):
    """No contact, no cost: the multiplier falls to 0, and learning goes on."""
    rule = partial(rule, cost_limit=0.5, pessimism=2.0, normalize=True)
    env = arm(num_envs=2, seed=0, obstacles=OutOfReach())
    multipliers, costs = learn(env, lambda loss: started(rule, loss), frames_per_batch=24)
    assert costs == [0, 0, 0]
    assert 0.5 > multipliers[0] >= multipliers[1] >= multipliers[2] >= 0


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"cost_limit": 0.0}, {"obstacles": "none"}], ids=str)
@pytest.mark.parametrize("algorithm", [name for name in ALGORITHMS if name != "ppo-saute"])
def test_every_algorithm_goes_on(algorithm, settings, tmp_path):
    settings = {"frames": 640, "frames_per_batch": 320, "envs": 8, "workers": 1, **settings}
    actor, _ = train(Config(out=tmp_path, epochs=2, **settings), algorithm, progress=False)
    assert all(parameter.isfinite().all() for parameter in actor.parameters())


@pytest.mark.parametrize("value", [None, 1, "yes", np.zeros((2, 2)), torch.zeros(3)], ids=repr)
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (envs.JointDelta, "respect_limits"),
        (envs.Collision, "table"),
        (envs.Collision, "itself"),
        (envs.Speed, "any_link"),
        (envs.Reach, "sparse"),
        (envs.Push, "sparse"),
        (envs.PickAndPlace, "sparse"),
        (envs.Scene, "motor_limits"),
        (envs.Bullet, "merged_links"),
        *((envs.Sensing, name) for name in ("table", "itself", "joints", "tool", "links")),
    ],
)
def test_a_flag_that_is_neither_true_nor_false_is_named(kind, name, value):
    with pytest.raises(TypeError, match=f"{name} must be True or False, got"):
        kind(**{name: value})
