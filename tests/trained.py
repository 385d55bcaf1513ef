"""For the tests that need a policy that ``make train`` has saved."""

from experiments.config import Config
from experiments.train import train


def train_briefly(out):
    """Trains for two batches, and returns the actor and the file of its policy."""
    config = Config(frames=128, frames_per_batch=64, envs=8, workers=1, epochs=1, out=out)
    actor, _ = train(config, "ppo-lagrangian", progress=False)
    return actor, out / "ppo-lagrangian" / "policy.pt"
