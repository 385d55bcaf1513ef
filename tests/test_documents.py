"""What README and the pages of the site show runs. `make docs` runs the tutorials."""

import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from programs import run_program
from tensordict import TensorDict

from torchrl_safe.envs import ArmEnv, MuJoCo, NoObstacles

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parent.parent


def run(path, folder=None, **settings):
    done = run_program(path, folder=folder, **settings)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def code_of(document, language="python"):
    text = (ROOT / document).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


# Drives the arm with what the loop has saved; the next process knows nothing else of it.
DRIVE = """
from torchrl_safe.envs import PANDA, ArmEnv

env = ArmEnv(PANDA, seed=1)
tensordict = env.reset()
for _ in range(5):
    action = policy(tensordict["observation"][0].numpy())
    tensordict["action"] = torch.from_numpy(action)[None]
    tensordict = env.step(tensordict)["next"]
    print("moved by", abs(action).max())
print(action.shape)
"""


# Networks, a collector and costs for the loop that README shows.
LOOP = """
import torch
from torchrl.collectors import Collector
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

width = env.observation_spec["observation"].shape[-1]
net = torch.nn.Sequential(MLP(width, 6, num_cells=[8]), NormalParamExtractor())
net = TensorDictModule(net, ["observation"], ["loc", "scale"])
actor = ProbabilisticActor(net, net.out_keys, distribution_class=TanhNormal, return_log_prob=True)
critic = ValueOperator(MLP(width, 1, num_cells=[8]), ["observation"])
cost_critic = ValueOperator(MLP(width, 2, num_cells=[8]), ["observation"], ["cost_value"])
"""
COLLECT = """
collector = Collector(
    sums, actor, frames_per_batch=160, total_frames=160, auto_register_policy_transforms=False
)
"""


def test_readme(tmp_path):
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 120
    env, loop = code_of("README.md")
    check = """
print(batch["advantage"].shape, batch["cost_advantage"].shape)
print(updater.cost_names, loss.lagrange_multiplier.shape)
"""
    script = tmp_path / "readme.py"
    loop = loop.replace("for batch in", COLLECT + "for batch in")
    script.write_text(env + LOOP + loop + check, encoding="utf-8")
    assert run(script).splitlines()[-3:] == [
        "torch.Size([4, 20, 2])",
        "torch.Size([4, 40, 1]) torch.Size([4, 40, 2])",
        "('collision', 'speed') torch.Size([2])",
    ]


def test_quickstart(tmp_path):
    env, loop, use, measure = code_of("docs/start/quickstart.md")
    assert env == code_of("README.md")[0]
    assert len(loop.splitlines()) <= 44
    # The same program on fewer frames, with fewer passes over them.
    short = loop.replace("2048, total_frames=153_600", "1280, total_frames=2560")
    short = short.replace("range(10)", "range(2)")
    assert short.count("2560") == short.count("range(2)") == 1
    script = tmp_path / "quickstart.py"
    script.write_text(short, encoding="utf-8")
    lines = re.findall(
        r"return \S+ cost (\S+) multiplier (\S+)",
        run(script, tmp_path, strict=FutureWarning),
    )
    assert len(lines) == 2
    for batch, (cost, shown) in enumerate(lines, start=1):
        # What is printed is the rule at work: a cost above the limit of 0.5 raises the multiplier.
        assert float(shown) > 0 or float(cost) < 0.5
        assert float(shown) < 0.51 + 0.1 * batch  # Up to 1; above, by factors.
    assert max(float(shown) for _, shown in lines) > 0
    short = measure.replace("256", "32")
    assert short != measure
    script.write_text(f"import torch\n{use}{short}print(action.shape)\n{DRIVE}", encoding="utf-8")
    *moved, shape = run(script, tmp_path).splitlines()[-6:]
    assert shape == "(3,)"
    assert len({line for line in moved if line.startswith("moved by 0.")}) == 5


def test_several_limits(tmp_path):
    (code,) = code_of("docs/howto/several_limits.md")
    short = code.replace("total_frames=153_600", "total_frames=2_048")
    short = short.replace("range(10)", "range(1)")
    assert short.count("2_048") == short.count("range(1)") == 1
    script = tmp_path / "limits.py"
    check = "print(episode_cost.shape[-1], *(m > 0 for m in loss.lagrange_multiplier.tolist()))\n"
    script.write_text(short + check, encoding="utf-8")
    # Random actions are too fast, and that alone is certain.
    assert re.fullmatch("2 (True|False) True", run(script, tmp_path).splitlines()[-1])
    assert list(tmp_path.glob("runs/two-limits/events*"))


def test_an_arm_of_ones_own(tmp_path):
    script = tmp_path / "arm.py"
    script.write_text("\n".join(code_of("docs/howto/arm.md")), encoding="utf-8")
    home, success = run(script, tmp_path).splitlines()[-2:]
    assert home.replace("-0.0,", "0.0,").replace("-0.0]", "0.0]") == (
        "[0.0, -0.77, -0.26, 0.0, 1.02, 0.0]"
    )
    assert success == "1.0"


def test_a_cost_of_ones_own(tmp_path):
    blocks = code_of("docs/howto/cost.md")
    assert len(blocks) == 2
    check = "print(env.rollout(3)['next', 'cost'].shape[-1])\nenv.close()\n"
    script = tmp_path / "costs.py"
    script.write_text("\n".join(block + check for block in blocks), encoding="utf-8")
    assert run(script).splitlines()[-2:] == ["2", "1"]


def test_a_rule_of_ones_own(tmp_path):
    rule, use = code_of("docs/howto/rule.md")
    script = tmp_path / "rule.py"
    script.write_text(f"{rule}\n{use}", encoding="utf-8")
    multipliers = [float(line) for line in run(script).split()]
    # From 0 to effect within some batches, never by leaps, and down again when the limit is kept.
    assert multipliers[0] == pytest.approx(0.01, rel=0.25)
    assert all(0.8 < last / first < 1.25 for first, last in pairwise(multipliers))
    assert max(multipliers) == multipliers[39] > 5 * multipliers[0]
    assert multipliers[-1] < multipliers[39] / 2


def test_deploying_a_policy(tmp_path):
    """What docs/howto/deploy.md does, on few episodes."""
    trained = """
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP
from torchrl_safe.envs import ArmEnv
env, actor = ArmEnv(), TensorDictModule(MLP(40, 3), ["observation"], ["action"])
"""
    save, load, drive, simulated, batched, measure = code_of("docs/howto/deploy.md")
    short = measure.replace("num_envs=32", "num_envs=2").replace("256", "2")
    assert short != measure
    show = "print(action.shape, step['action'].shape, len(figures))\n"
    arm = """
sent, began = [], __import__("time").perf_counter()
def read_observation(): return np.zeros(40)
def send_action(action): sent.append(action)
def is_running(): return len(sent) < 4
"""
    pace = "print(len(sent), 0.15 <= time.perf_counter() - began)\n"
    code = trained + save + load + arm + drive + pace + simulated + batched + short + show
    (tmp_path / "deploy.py").write_text(code, encoding="utf-8")
    assert run(tmp_path / "deploy.py", tmp_path).splitlines()[-3:] == [
        "4 True",
        "reached: True, control steps in collision: 0.0",
        "(3,) torch.Size([4, 3]) 7",
    ]


def test_any_environment(tmp_path):
    """The wrapped environment, then its loop on one batch."""
    pendulum, transform, loop = code_of("docs/safe_gym.md")[:3]
    short = loop.replace("total_frames=122_880", "total_frames=4_096").replace(
        "actor, 64", "actor, 16"
    )
    short = short.replace("range(10)", "range(1)")
    assert short.count("4_096") == short.count("actor, 16") == short.count("range(1)") == 1
    (tmp_path / "pendulum.py").write_text(pendulum + transform + short, encoding="utf-8")
    shape, *lines = (
        line for line in run(tmp_path / "pendulum.py").splitlines() if "torchrl" not in line
    )
    assert shape == "torch.Size([3, 1])"
    # Random torques, of which half are too large: the policy has the whole range of the motor.
    assert 60 < float(re.fullmatch(r"cost (\S+) of 10", lines[0])[1]) < 160
    assert "cost/cost" in lines[1]


def test_short_blocks(tmp_path):
    """Lines for a loop, on the networks and the batch of docs/algorithms.md."""
    setting = code_of("docs/algorithms.md")[0] + (
        "from torchrl_safe.objectives import DualAscent, PIDControl, PPOLagrangianLoss\n"
        "loss = PPOLagrangianLoss(actor, critic, cost_critic)\n"
        "both = ValueOperator(torch.nn.Linear(4, 2), ['observation'], ['cost_value'])\n"
        "two = PPOLagrangianLoss(actor, critic, both, num_costs=2)\n"
        "updater = PIDControl(loss, cost_limit=0.5)\n"
        "optimizer = torch.optim.Adam(loss.parameters())\n"
    )
    limits, discount = code_of("docs/howto/limit.md")
    blocks = [
        limits.replace("PIDControl(\n    loss", "PIDControl(\n    two"),
        discount,
        *code_of("docs/howto/multiplier_explodes.md"),
        *code_of("docs/robustness.md"),
        *code_of("docs/limits.md"),
        *code_of("docs/speed.md"),
        *code_of("docs/howto/demonstrations.md"),
    ]
    script = tmp_path / "blocks.py"
    script.write_text("\n".join([setting, *blocks]), encoding="utf-8")
    run(script, tmp_path)  # The loop of docs/robustness.md writes checkpoints.


def test_no_block_is_left_out():
    """A page with code is named in this file, or in one of the folders that it goes through."""
    named = set(re.findall(r'"((?:docs/[\w/]+|README)\.md)"', Path(__file__).read_text("utf-8")))
    pages = {page.relative_to(ROOT).as_posix() for page in (ROOT / "docs").rglob("*.md")}
    folders = ("docs/tasks/", "docs/algorithms/", "docs/_build/", "docs/tutorials/")
    assert {page for page in pages if not page.startswith(folders) and code_of(page)} <= named


def test_environments(tmp_path):
    """Each block runs by itself and makes real environments."""
    blocks = code_of("docs/environments.md") + code_of("docs/engines.md")
    assert len(blocks) == 6
    script = tmp_path / "environments.py"
    check = "env.reset()\nenv.close()\n"
    script.write_text("\n".join(block + check for block in blocks), encoding="utf-8")
    run(script)


def test_pages_of_tasks():
    """Their environments have observations of the widths that they name."""
    pages = sorted((ROOT / "docs" / "tasks").glob("*.md"))
    for page in pages:
        (block,) = code_of(page)
        names = {}
        exec(block, names)
        width = names["env"].observation_spec["observation"].shape[-1]
        assert f"{width} numbers" in page.read_text(encoding="utf-8")
        names["env"].rollout(2)
        names["env"].close()
    assert len(pages) == 3


def test_an_observation_of_ones_own(tmp_path):
    (block,) = code_of("docs/howto/observation.md")
    (script := tmp_path / "observation.py").write_text(f"{block}env.close()\n", encoding="utf-8")
    assert run(script).endswith("14 slice(13, 14, None)\n")


def test_suite(tmp_path):
    script = tmp_path / "suite.py"
    script.write_text("\n".join(code_of("docs/suite.md")), encoding="utf-8")
    run(script)


def test_shield(tmp_path):
    (script := tmp_path / "shield.py").write_text(*code_of("docs/shield.md"), encoding="utf-8")
    assert run(script).startswith("torch.Size([2, 5, 1])")


def test_the_circle_is_followed():
    """What howto/task.md shows as a task: going where the target is keeps the tool at it."""
    names = {"__name__": __name__}
    exec(code_of("docs/howto/task.md")[0], names)
    names["env"].close()
    env = ArmEnv(
        task=names["task"], observation=names["observation"], obstacles=NoObstacles(), seed=0
    )
    env.reset()
    field = env.observation_fields["to_target"]
    angles, misses = [], []
    for step in range(80):
        state = env.arm_state
        assert state.step.tolist() == [step]
        action = torch.tensor(names["task"].to_target(state) / 0.05, dtype=torch.float32)
        after = env.step(TensorDict({"action": action}, batch_size=[1]))["next"]
        seen = after["observation"][0, field]
        assert -seen.norm() == pytest.approx(after["reward"].item(), abs=1e-6)
        x, y, _ = (env.arm_state.ee_position - env.arm_state.goal)[0]
        angles.append(math.atan2(y, x))
        misses.append(seen.norm().item())
    env.close()
    # In 4 s once round; behind by what the target does in a control step, 4 mm.
    assert max(misses[20:]) < 0.012
    assert np.unwrap(angles[20:])[-1] - angles[20] == pytest.approx(2 * math.pi * 59 / 80, abs=0.1)


def test_two_points_are_touched_in_turn():
    """The task with a memory in howto/task.md, in worlds that begin anew at different times."""
    names = {"__name__": __name__}
    task_alone, with_memory = code_of("docs/howto/task.md")
    exec(task_alone + "env.close()\n" + with_memory + "env.close()\n", names)
    task = names["TouchTwo"]()
    env = ArmEnv(
        task=task,
        observation=task.observation,
        obstacles=NoObstacles(),
        physics=MuJoCo(),
        max_episode_steps=60,
        num_envs=4,
        seed=0,
    )

    def straight(tensordict):
        to_target = tensordict["observation"][..., env.observation_fields["to_target"]]
        return tensordict.set("action", (to_target / 0.05).clamp(-1, 1))

    played = env.rollout(100, straight, break_when_any_done=False)
    env.close()
    done = played["next", "done"].squeeze(-1)
    assert (played["next", "success"].squeeze(-1) == done).all()  # None runs out of time.
    assert done.sum(1).min() >= 4
    touched = played["observation"][..., env.observation_fields["touched"]].squeeze(-1) > 0
    goal = played["observation"][..., env.observation_fields["to_goal"]].norm(dim=-1)
    first = torch.nn.functional.pad(done[:, :-1], (1, 0), value=True)
    assert not touched[first].any()
    # From where it touches the goal to the end of the episode, and not before.
    assert ((goal < 0.03) <= touched).all()
    begins = touched[:, 1:] & ~touched[:, :-1]
    assert (goal[:, 1:][begins] < 0.03).all()
    assert (~touched[:, 1:] & touched[:, :-1]).equal(done[:, :-1] & touched[:, :-1])


def test_algorithms(tmp_path):
    """Each kind of loop runs on the networks and the batch of the first block."""
    setting, *loops = code_of("docs/algorithms.md")
    assert len(loops) == 2
    script = tmp_path / "algorithms.py"
    script.write_text("\n".join(setting + loop for loop in loops), encoding="utf-8")
    # TorchRL tells of the replay buffer.
    assert all("[torchrl]" in line for line in run(script).splitlines())


def test_every_algorithm(tmp_path):
    """The page of each algorithm runs on the same networks and the same batch."""
    pages = sorted((ROOT / "docs" / "algorithms").glob("*.md"))
    assert len(pages) == 14
    setting = code_of("docs/algorithms.md")[0]
    blocks = [code_of(page.relative_to(ROOT)) for page in pages]
    assert all(len(block) == 1 for block in blocks)
    uses = [
        f"{block}{'losses' if 'losses' in block else 'env.rollout(2)'}\nprint({page.stem!r})\n"
        for page, (block,) in zip(pages, blocks, strict=True)
    ]
    script = tmp_path / "algorithms.py"
    script.write_text("\n".join([setting, *uses]), encoding="utf-8")
    shown = [line for line in run(script).splitlines() if line in {page.stem for page in pages}]
    assert shown == [page.stem for page in pages]


def test_trainers(tmp_path):
    """The trainer, then the one that Hydra makes, on one small batch each."""
    (config,) = code_of("docs/trainers.md", "yaml")
    code = "\n".join(code_of("docs/trainers.md"))
    for text, name in ((config, "config.yaml"), (code, "trainers.py")):
        short = re.sub(r"(frames_per_batch|total_frames)(=|: )[0-9_]+", r"\g<1>\g<2>320", text)
        short = re.sub(r"num_epochs(=|: )10", r"num_epochs\g<1>1", short)
        short = re.sub(r"num_envs(=|: )32", r"num_envs\g<1>8", short)
        short = short.replace("batches, steps = 2, 1_280", "batches, steps = 2, 320")
        assert short.count("320") == (2 if name == "config.yaml" else 3)
        (tmp_path / name).write_text(short, encoding="utf-8")
    (shown,) = re.findall(r"multiplier (\S+)", run(tmp_path / "trainers.py", tmp_path))
    (log,) = tmp_path.joinpath("runs").rglob("episode_cost/collision.csv")
    step, cost = log.read_text().split(",")
    assert int(step) == 320
    # What is shown is the rule at work: a cost above the limit of 0.5 lifts the multiplier.
    assert 0 <= float(shown) < 1.21
    assert float(shown) > 0 or float(cost) <= 0.5
    assert (tmp_path / "runs" / "checkpoint").exists()


def test_testing(tmp_path):
    """A loss that a user wrote passes all checks but the one that it is said to fail."""
    own, failing, every, rule = code_of("docs/testing.md")
    assert len(own.splitlines()) < 30
    script = tmp_path / "own.py"
    caught = (
        f"try:\n    {failing.splitlines()[0]}\nexcept AssertionError as error:\n    print(error)\n"
    )
    # The doctest of check_loss runs the call.
    *imports, _ = every.splitlines()
    script.write_text("\n".join([own, caught, *imports, rule]), encoding="utf-8")
    shown = run(script)
    expected = failing.splitlines()[1].removeprefix("# AssertionError: ").removesuffix(" ...")
    assert shown.startswith(expected)
