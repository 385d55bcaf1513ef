"""The main job does what the README says of it. Takes minutes: `make test-slow`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_main_job(tmp_path):
    command = [sys.executable, "-m", "experiments.train", "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=1800)
    results = json.loads((tmp_path / "results.json").read_text())
    limit = results["config"]["cost_limit"]
    ppo, safe = (
        {key: estimate for key, (estimate, _, _) in run["evaluation"].items()}
        for run in results["algorithms"].values()
    )
    assert ppo["success"] >= 0.9
    assert ppo["cost/collision"] >= 3 * limit, "the limit binds"
    assert safe["success"] >= 0.9
    assert safe["cost/collision"] <= limit
