"""`make safe-gym` in the real Swimmer: train, stop, go on, evaluate, use the policy elsewhere."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

safety_gymnasium = pytest.importorskip(
    "safety_gymnasium", reason="pins gymnasium==0.28.1: `make test-safety-gymnasium` installs both"
)

from experiments import safe_gym  # noqa: E402

# Half an episode in each of two environments: episodes end in every other batch.
SMALL = safe_gym.Config(
    env="SafetySwimmerVelocity-v1",
    frames=4_000,
    frames_per_batch=1_000,
    envs=2,
    epochs=1,
    checkpoint_every=2,
    eval_episodes=2,
    compile=False,
)

# Knows neither the networks nor the environment's statistics.
USE = """
import sys, numpy as np
from torchrl_safe.policy import load_policy
policy = load_policy(sys.argv[1])
observations = np.load(sys.argv[2])
np.save(sys.argv[3], policy(observations))
assert not any(name.startswith("experiments") for name in sys.modules)
"""


def test_train_stop_go_on_and_evaluate(tmp_path, monkeypatch):
    whole, log = safe_gym.train(replace(SMALL, out=tmp_path / "whole"), progress=False)
    assert [row["frames"] for row in log.rows] == [1_000, 2_000, 3_000, 4_000]
    # At the checkpoint after the second batch episodes begin anew, as they have ended.
    assert ["cost/cost" in row for row in log.rows] == [False, True, False, True]
    assert log.rows[1]["cost/cost"] > 25
    assert log.rows[-1]["multiplier/cost"] > log.rows[1]["multiplier/cost"] > 0

    stopped = replace(SMALL, out=tmp_path / "stopped")
    add = safe_gym.Log.add

    def stop_in_the_third_batch(self, row):
        if len(self.rows) == 2:
            raise KeyboardInterrupt
        add(self, row)

    with monkeypatch.context() as patch:
        patch.setattr(safe_gym.Log, "add", stop_in_the_third_batch)
        with pytest.raises(KeyboardInterrupt):
            safe_gym.main(stopped)
    results = safe_gym.main(replace(stopped, resume=True))
    assert results["history"] == log.rows
    assert results["evaluation"]["steps"] == [1_000, 1_000, 1_000]
    assert json.loads((stopped.out / "results.json").read_text())["history"] == log.rows

    env = safety_gymnasium.make(SMALL.env)
    env.reset(seed=0)
    observations = np.stack([env.step(env.action_space.sample())[0] for _ in range(20)])
    env.close()
    files = [str(tmp_path / name) for name in ("observations.npy", "actions.npy")]
    np.save(files[0], observations)
    subprocess.run(
        [sys.executable, "-c", USE, str(stopped.out / "policy.pt"), *files],
        check=True,
        timeout=120,
    )
    loc = whole.explorer.module.policy(torch.from_numpy(observations))[0]
    expected = loc.detach().tanh().numpy()
    np.testing.assert_allclose(np.load(files[1]), expected, rtol=1e-4, atol=1e-5)


def test_an_environment_whose_seeds_have_32_bits(tmp_path):
    """Swimmer takes any. With seed 60 it is more than 32 bits for which training once asked."""
    settings = {"frames": 2_000, "frames_per_batch": 2_000, "seed": 60, "out": tmp_path}
    results = safe_gym.main(replace(SMALL, env="SafetyPointGoal1-v0", **settings))
    assert results["evaluation"]["steps"] == [1_000, 1_000, 1_000]
