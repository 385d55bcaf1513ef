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
    short = code.replace("total_frames=400_000", "total_frames=8_192")
    assert short != code
    script = tmp_path / "readme.py"
    script.write_text(short, encoding="utf-8")
    lines = re.findall(r"return (\S+) cost (\S+) multiplier (\S+)", run(script))
    assert len(lines) == 2
    returns, costs, multipliers = zip(*[map(float, line) for line in lines], strict=True)
    assert max(returns) < 0
    assert min(costs) > 0.5, "random actions collide more often than the limit allows"
    assert 0 < multipliers[0] < multipliers[1], "so that the multiplier rises"


@pytest.mark.parametrize("path", sorted((ROOT / "tutorials").glob("*.py")), ids=lambda p: p.stem)
def test_tutorial(path):
    assert run(path)
