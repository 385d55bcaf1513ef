"""What the documents show runs: the README's training loop, and every tutorial."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(path):
    done = subprocess.run(
        [sys.executable, str(path)], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_readme_loop(tmp_path):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (code,) = [c for c in re.findall(r"```python\n(.*?)```", readme, re.S) if "Collector(" in c]
    assert len(code.splitlines()) <= 40
    # The same program on fewer frames.
    short = code.replace("total_frames=256_000", "total_frames=6_144")
    assert short != code
    script = tmp_path / "readme.py"
    script.write_text(short, encoding="utf-8")
    lines = re.findall(r"cost (\S+) multiplier (\S+)", run(script))
    costs, multipliers = zip(*[map(float, line) for line in lines], strict=True)
    assert len(costs) == 3
    # Random actions collide more often than the limit of 0.5 allows: the multiplier rises.
    assert min(costs) > 0.5
    assert 0 < multipliers[0] < multipliers[1] < multipliers[2]


def test_recipes_of_contributing(tmp_path):
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    recipes = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(recipes) == 3
    script = tmp_path / "recipes.py"
    check = "print(env.rollout(3)['next', 'cost'].shape[-1])\n"
    script.write_text("\n".join([*(recipes[0], check, recipes[1], check, recipes[2])]))
    assert run(script).split() == ["1", "2"]


@pytest.mark.parametrize("path", sorted((ROOT / "tutorials").glob("*.py")), ids=lambda p: p.stem)
def test_tutorial(path):
    assert run(path)
