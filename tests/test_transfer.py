"""Changed worlds are changed in what they say, and in nothing else."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pybullet
import pytest
import torch
from bullet_worlds import worlds_of
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Composite, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MLP
from worlds import rest, step

from experiments import transfer
from experiments.algorithms import ALGORITHMS
from experiments.config import suite_config
from experiments.film import base_env
from experiments.pilots import act, make_pilot
from torchrl_safe.envs import (
    PANDA,
    SUITE,
    ArmEnv,
    Box,
    Bullet,
    Capsule,
    CartesianDelta,
    Cylinder,
    FullObservation,
    Human,
    MuJoCo,
    NoObstacles,
    PickAndPlace,
    Push,
    Scene,
    Sphere,
)
from torchrl_safe.policy import save_policy

pytestmark = pytest.mark.integration

NAME = "panda-reach-human"
LIMIT = SUITE[NAME].cost_limits["separation"]
FAST = MuJoCo(threads=1)


def moved(make_env, **scene):
    """How far the tool gets from rest in a control step at full action, m."""
    env = make_env(ArmEnv, obstacles=NoObstacles(), scene=Scene(**scene), seed=0)
    start = env.reset()["observation"].clone()
    after = step(env, [[1.0, 0.0, 0.0]])["observation"]
    return (after - start)[0, env.observation_fields["ee_position"]].norm().item()


@pytest.mark.usefixtures("engine")
def test_weak_motors_are_slower_and_never_stronger_than_their_share(make_env):
    """What a motor of a hundredth does is far less."""
    way = {strength: moved(make_env, motor_strength=strength) for strength in (0.01, 0.8, 1.0)}
    assert way[0.01] < 0.5 * way[1.0]
    assert way[0.01] < way[0.8] <= way[1.0] + 1e-4


@pytest.mark.usefixtures("engine")
def test_the_same_motors_move_heavy_links_less(make_env):
    """Without gravity, with motors that are too weak for a full action."""
    weak = {"gravity": 0.0, "motor_strength": 0.02}
    way = {mass: moved(make_env, link_mass=mass, **weak) for mass in (0.5, 1.0, 4.0)}
    assert way[4.0] < 0.5 * way[1.0]
    assert way[1.0] < way[0.5]


def test_friction_is_a_factor_of_that_between_two(make_env, engine):
    """A cube that is let go at a speed goes on for v^2 / (2 mu g); mu is 0.25 by default."""
    scene = Scene(friction=0.5)
    env = make_env(ArmEnv, task=Push(), obstacles=NoObstacles(), scene=scene, seed=0)
    env.reset()
    before, simulator = env.arm_state.object_position, env._simulator
    if engine == "bullet":
        (world,) = worlds_of(env)
        client = world._client
        pybullet.resetBaseVelocity(world._objects[0], (0.5, 0, 0), physicsClientId=client)
    else:
        simulator._qvel[0, simulator._objects._velocity[0, 0]] = 0.5
    rest(env, 15)
    way = env.arm_state.object_position - before
    np.testing.assert_allclose(way, [[[0.5**2 / (2 * 0.125 * 9.81), 0, 0]]], atol=8e-3)


@pytest.mark.usefixtures("engine")
def test_what_is_smooth_slips_out_of_the_gripper(make_env):
    """The same pilot lifts the cube or leaves it on the table."""
    height = {}
    for friction in (0.02, 1.0):
        env = make_env(
            ArmEnv,
            PANDA,
            task=PickAndPlace(),
            obstacles=NoObstacles(),
            action=CartesianDelta(finger_step=0.04),
            scene=Scene(friction=friction, free_fingers=True),
            max_episode_steps=60,
            num_envs=2,
            seed=0,
        )
        pilot, heights = make_pilot(env), []
        env.reset()
        for _ in range(40):
            action = torch.as_tensor(act(env, pilot), dtype=torch.float32)
            step(env, action.tolist())
            heights.append(env.arm_state.object_position[:, 0, 2].max())
        height[friction] = max(heights)
    assert height[0.02] < 0.04 < height[1.0] - 0.03


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"motor_strength": 0.0}, "motor_strength must be positive and finite, got 0.0"),
        ({"link_mass": -1.0}, "link_mass must be positive and finite, got -1.0"),
        ({"friction": math.nan}, "friction must be positive and finite, got nan"),
        ({"motor_strength": 0.5, "motor_limits": False}, "must be 1 without motor_limits, got 0.5"),
    ],
)
def test_bad_factors(settings, message):
    with pytest.raises(ValueError, match=message):
        Scene(**settings)


def test_shapes_are_wider_and_as_high():
    for shape, expected in (
        (Box((0.1, 0.2, 0.3)), (0.12, 0.24, 0.3)),
        (Cylinder(0.1, 0.4), (0.12, 0.12, 0.2)),
        (Capsule(0.1, 0.4), (0.12, 0.12, 0.32)),
        (Sphere(0.1), (0.12, 0.12, 0.12)),
    ):
        assert transfer.widen(shape, 1.2).half_extents == pytest.approx(expected)
    wide, human = transfer.Wider(Human(), 1.2), Human()
    assert [s.radius for s in wide.shapes] == pytest.approx([1.2 * s.radius for s in human.shapes])
    places = [
        layout.sample(np.random.default_rng(0), np.zeros(3), np.ones(3)).at(np.array([0.7]))[0]
        for layout in (wide, human)
    ]
    np.testing.assert_array_equal(*places)


def test_actions_come_a_step_late(make_env):
    env = make_env(TransformedEnv, ArmEnv(num_envs=2, physics=FAST, seed=0), transfer.Delay())
    plain = make_env(ArmEnv, num_envs=2, physics=FAST, seed=0)
    check_env_specs(env, seed=1)
    env.set_seed(0)
    plain.set_seed(0)
    env.reset()
    plain.reset()
    moves = [[0.5, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.3]]
    late = [step(env, move) for move in moves]
    expected = [step(plain, move) for move in ([0.0, 0.0, 0.0], *moves[:2])]
    for one, other in zip(late, expected, strict=True):
        assert torch.equal(one["observation"], other["observation"])
    # The world that begins anew begins at rest; the other goes on.
    mask = torch.tensor([[True], [False]])
    for each in (env, plain):
        each.reset(TensorDict({"_reset": mask}, batch_size=[2]))
    one = step(env, [0.0, 0.0, 0.0])["observation"]
    other = step(plain, [[0.0, 0.0, 0.0], moves[2]])["observation"]
    assert torch.equal(one, other)


def test_noise_is_what_it_says_and_repeats(make_env):
    env = make_env(ArmEnv, num_envs=8, physics=FAST, seed=0)
    state = env.arm_state
    clean, noisy = FullObservation(), transfer.Noisy(FullObservation(), 0.01, seed=3)
    again = transfer.Noisy(FullObservation(), 0.01, seed=3)
    first, second, third = noisy(state), again(state), noisy(state)
    errors = np.concatenate([first[name] - clean(state)[name] for name in first], axis=1)
    assert errors.std() == pytest.approx(0.01, rel=0.15)
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not np.array_equal(first["to_goal"], third["to_goal"])


@pytest.mark.parametrize("condition", transfer.Config.__dataclass_fields__["conditions"].default)
def test_each_condition_makes_an_environment(make_env, condition):
    task = SUITE["panda-pick-in-front"]
    assert transfer.applies(task, condition)
    env = make_env(transfer.make_env, task, condition, physics="mujoco", num_envs=1, seed=0)
    arm = base_env(env)
    rows = {
        "other engine": arm.physics == Bullet(),
        "wider obstacles": arm.obstacles.shapes[0].radius == pytest.approx(0.06),
        "weak motors": arm.scene.motor_strength == 0.8,
        "strong motors": arm.scene.motor_strength == 1.2,
        "heavy links": arm.scene.link_mass == 1.2,
        "light links": arm.scene.link_mass == 0.8,
        "rough": arm.scene.friction == 1.2,
        "smooth": arm.scene.friction == 0.8,
        "heavy object": arm.task.shape.mass == pytest.approx(0.12),
        "light object": arm.task.shape.mass == pytest.approx(0.08),
        "noise": isinstance(arm.observation, transfer.Noisy),
        "delay": arm is not env,
    }
    assert {name for name, changed in rows.items() if changed} == {condition} - {"as trained"}
    assert not transfer.applies(SUITE[NAME], "heavy object")


def test_table_and_folder(tmp_path, capsys):
    env = SUITE[NAME].make_env(num_envs=1, physics=FAST)
    width = env.observation_spec["observation"].shape[-1]
    env.close()
    actor = TensorDictModule(MLP(width, 3, num_cells=[4]), ["observation"], ["action"])
    settings = dataclasses.asdict(suite_config(NAME, physics="mujoco"))
    settings = json.loads(json.dumps({**settings, "name": "ppo"}, default=str))
    spec = Composite(observation=Unbounded(width))
    save_policy(tmp_path / "mine.pt", actor, spec, settings=settings)
    config = transfer.Config(
        policies=(str(tmp_path / "mine.pt"),),
        conditions=("as trained", "heavy object"),
        episodes=8,
        jobs=1,
        out=tmp_path / "out",
    )
    transfer.main(config)
    lines = capsys.readouterr().out.splitlines()
    head = lines.index("| | mine | within every limit |")
    _, limits, as_trained, heavy = lines[head + 1 : head + 5]
    assert limits == f"| limits | collision 0.5, separation {LIMIT:g} | |"
    assert as_trained.startswith("| as trained | ")
    assert heavy == "| heavy object | | 0/0 |"


def test_a_shield_that_was_trained_with_is_there(tmp_path, monkeypatch):
    saved = SimpleNamespace(
        actor=None, settings={"name": "ppo-shield", "suite_task": NAME, "physics": "mujoco"}
    )
    monkeypatch.setattr(transfer, "load_policy", lambda path: saved)
    monkeypatch.setattr(transfer, "evaluate", lambda env, *args, **kwargs: env.shield)
    monkeypatch.setattr(transfer, "summarize", lambda shield, names: shield)
    assert transfer.run("p", "as trained", 2, 0)["evaluation"] == ALGORITHMS["ppo-shield"].shield
    saved.settings["name"] = "ppo-saute"
    with pytest.raises(
        ValueError, match="policies must observe what the task has, got 'p' of ppo-"
    ):
        transfer.run("p", "as trained", 2, 0)
    del saved.settings["suite_task"]
    with pytest.raises(ValueError, match="policies must be of tasks of the suite, got 'p'"):
        transfer.run("p", "as trained", 2, 0)


def test_policies_that_training_has_written_have_the_names_of_their_folders():
    assert transfer.name_of("runs/suite/runs/a/3/ppo/policy.pt") == "a-3-ppo"
    assert transfer.name_of("mine.pt") == transfer.name_of("mine") == "mine"


def test_costs_above_their_limits_are_bold():
    figures = {"success": [0.5], "cost/collision": [0.5], "cost/separation": [LIMIT + 0.01]}
    run = {"policy": "p", "task": NAME, "condition": "delay", "evaluation": figures}
    row = transfer.table([run]).splitlines()[3]
    assert row == f"| delay | 50%; 0.50, **{LIMIT + 0.01:.2f}** | 0/1 |"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"conditions": ()}, r"conditions must name at least one, each once, got \(\)"),
        ({"episodes": 1}, "episodes must be a whole number of at least 2, got 1"),
        ({"jobs": 0}, "jobs must be a whole number of at least 1, got 0"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        transfer.Config(**{"policies": ("p",), **settings})
