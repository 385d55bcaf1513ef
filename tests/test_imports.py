"""What may import what: losses without environments, environments without losses, and so on."""

import ast
import re
from pathlib import Path

import pytest
from programs import run_code

import torchrl_safe

PACKAGE = Path(torchrl_safe.__file__).parent


def load(package):
    """Names of our modules and PyBullet's that one import loads in a new process."""
    code = (
        f"import sys, {package}\n"
        "print(*(n for n in sys.modules if n.split('.')[0] == 'pybullet'\n"
        "        or n.startswith(('pybullet', 'torchrl_safe.'))))"
    )
    done = run_code(code)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


@pytest.mark.integration
def test_the_losses_need_no_simulator():
    loaded = load("torchrl_safe.objectives")
    assert "torchrl_safe.objectives.on_policy.ppo_lagrangian" in loaded
    others = {name for name in loaded if not name.startswith("torchrl_safe.objectives")}
    assert others == {"torchrl_safe._checks"}


@pytest.mark.integration
def test_testing_needs_the_losses_only():
    """No test runner, no simulator: a user may have another one, or none."""
    code = (
        "import sys\n"
        "for name in ('pytest', 'hypothesis', 'pybullet', 'gymnasium'): sys.modules[name] = None\n"
        "import torchrl_safe.testing\n"
        "print(*(n for n in sys.modules if n.startswith('torchrl_safe.')))"
    )
    done = run_code(code)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert "torchrl_safe.testing.suite" in loaded
    packages = ("torchrl_safe.objectives", "torchrl_safe.testing")
    assert {n for n in loaded if not n.startswith(packages)} == {"torchrl_safe._checks"}


@pytest.mark.integration
def test_the_trainers_need_the_losses_only():
    """Neither environments nor simulator; Hydra for its configurations, which say so."""
    code = (
        "import sys; sys.modules['hydra'] = None\n"
        "import torchrl_safe.trainers\n"
        "print(*(n for n in sys.modules if n.startswith(('pybullet', 'torchrl_safe.'))))\n"
        "import torchrl_safe.trainers.configs"
    )
    done = run_code(code)
    loaded = set(done.stdout.split())
    assert "torchrl_safe.trainers.multiplier_hook" in loaded
    packages = ("torchrl_safe.objectives", "torchrl_safe.trainers")
    others = {name for name in loaded if not name.startswith(packages)}
    assert others == {"torchrl_safe._checks"}
    assert done.returncode != 0
    assert (
        'ImportError: torchrl_safe.trainers.configs needs Hydra: pip install "torchrl-safe[hydra]"'
        in done.stderr
    )


@pytest.mark.integration
def test_the_transforms_need_no_simulator():
    """PyBullet has no wheel for some Pythons: an error says so, but only when an arm is made."""
    code = (
        "import sys; sys.modules['pybullet'] = None\n"
        "from torchrl_safe.envs import ArmEnv, CostToReward, EarlyTermination, Saute\n"
        "print(Saute(1.0, unsafe_reward=-1.0))\n"
        "ArmEnv()"
    )
    done = run_code(code)
    assert "Saute" in done.stdout
    needed = 'ImportError: physics=Bullet() needs PyBullet: pip install "torchrl-safe[arms]"'
    assert needed in done.stderr


@pytest.mark.integration
def test_a_shield_says_what_it_needs():
    code = (
        "import sys; sys.modules['daqp'] = None\n"
        "from torchrl_safe.envs import ArmEnv, Shield\n"
        "ArmEnv().close()\n"
        "print(shield := Shield())\n"
        "ArmEnv(shield=shield)"
    )
    done = run_code(code)
    assert "Shield(" in done.stdout
    assert 'ImportError: A shield needs DAQP: pip install "torchrl-safe[arms]".' in done.stderr


@pytest.mark.integration
@pytest.mark.parametrize(
    ("module", "needed"),
    [
        ("policy", {"_checks", "_files", "_program"}),
        ("evaluation", {"_checks", "metrics"}),
        ("metrics", {"_checks"}),
        ("checkpoint", {"_checks", "_files"}),
        ("collectors", set()),
    ],
)
def test_these_need_neither_simulator_nor_environments_nor_losses(module, needed):
    names = {f"torchrl_safe.{name}" for name in (module, *needed)}
    assert load(f"torchrl_safe.{module}") == names


@pytest.mark.integration
def test_the_metrics_say_what_they_need():
    code = "import sys; sys.modules['scipy'] = None; import torchrl_safe.metrics"
    done = run_code(code)
    assert done.returncode != 0
    assert 'ImportError: torchrl_safe.metrics needs SciPy: pip install "torchrl-safe[metrics]"' in (
        done.stderr
    )


def imported_modules(path):
    """Names of all modules that a source file imports, at any depth of the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            # "from torchrl_safe import envs" names a module in the second part.
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_in(name, package):
    return name == package or name.startswith(f"{package}.")


@pytest.mark.parametrize(
    ("importer", "forbidden"),
    [
        pytest.param("envs", "torchrl_safe.objectives", id="envs-import-no-losses"),
        pytest.param("envs", "torchrl_safe.trainers", id="envs-import-no-trainers"),
        pytest.param("objectives", "torchrl_safe.envs", id="losses-import-no-envs"),
        pytest.param("objectives", "torchrl_safe.trainers", id="losses-import-no-trainers"),
        pytest.param("objectives", "pybullet", id="losses-import-no-pybullet"),
        pytest.param("objectives", "torchrl_safe.testing", id="losses-import-no-testing"),
        pytest.param("testing", "torchrl_safe.envs", id="testing-imports-no-envs"),
        pytest.param("testing", "pytest", id="testing-imports-no-pytest"),
        pytest.param("trainers", "torchrl_safe.envs", id="trainers-import-no-envs"),
    ],
)
def test_environments_and_losses_are_apart(importer, forbidden):
    sources = sorted((PACKAGE / importer).rglob("*.py"))
    assert sources
    found = {path.name: list(imported_modules(path)) for path in sources}
    # The walk sees something: every package imports torch or numpy somewhere.
    assert any(is_in(name, "torch") for names in found.values() for name in names)
    assert not {
        (source, name)
        for source, names in found.items()
        for name in names
        if is_in(name, forbidden)
    }


@pytest.mark.parametrize(("engine", "folder"), [("pybullet", "bullet"), ("mujoco", "mujoco")])
def test_an_engine_is_known_in_its_folder_only(engine, folder):
    at_home = PACKAGE / "envs" / "physics" / folder
    sources = [path for path in PACKAGE.rglob("*.py") if at_home not in path.parents]
    assert sources
    users = {
        str(path) for path in sources for name in imported_modules(path) if is_in(name, engine)
    }
    assert not users
    if engine == "pybullet":  # The other one's name is that of our own class too.
        word = re.compile(r"\bpybullet\b", re.IGNORECASE)
        # Nor is it named elsewhere, but by its rival, in comparison.
        others = [path for path in sources if "mujoco" not in path.parts]
        assert not {str(path) for path in others if word.search(path.read_text("utf-8"))}
