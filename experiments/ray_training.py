"""PPO-Lagrangian with two costs, its worlds spread over a Ray cluster: ``make ray``.

The actors collect, this process learns: loss, optimizer and multipliers are here, so that an actor
that dies takes nothing with it but the batch it was collecting. Without ``--address`` a cluster of
two nodes, a head and a worker, is started on this machine. On a bigger one::

    ray start --head   # on the others: ray start --address=...
    python -m experiments.ray_training --address auto --actors 64
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from pathlib import Path
from time import strftime
from typing import Any

import ray
import torch
import tyro
from ray.cluster_utils import Cluster
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from tqdm import tqdm

from experiments.algorithms import ALGORITHMS
from experiments.config import Config as TrainConfig
from experiments.files import require_new
from experiments.log import Log, figures
from torchrl_safe.envs import ArmEnv, Collision, Speed
from torchrl_safe.policy import save_policy

COSTS: dict[str, Any] = {"collision": Collision(), "speed": Speed(limit=1.0)}

# An error that an environment raises is not among them, and ends the run.
_DIED = (ray.exceptions.RayActorError, ray.exceptions.NodeDiedError)
# More frames than any run takes; -1 means none at all here.
_ENDLESS = 10**12


@dataclasses.dataclass(frozen=True)
class Config:
    """Train with a limit on collisions and one on speed, on a Ray cluster."""

    address: str | None = None
    """Address of a Ray cluster, or "auto"; by default one of two nodes is started here."""
    actors: int = 2
    """Actors that collect."""
    envs: int = 16
    """Simulated worlds of each actor."""
    cost_limits: tuple[float, float] = (0.5, 2.0)
    """Limits of the expected cost of an episode: control steps in which the arm collides, and in
    which the tool is faster than 1 m/s."""
    frames: int = TrainConfig.frames
    """Control steps to train for."""
    frames_per_batch: int = TrainConfig.frames_per_batch
    """Control steps between two updates of the policy."""
    seed: int = 0
    """Seed of networks and minibatches."""
    out: Path = dataclasses.field(
        default_factory=lambda: Path("runs", "ray", strftime("%Y-%m-%d_%H-%M-%S"))
    )
    """Folder for logs and the policy."""


def make_env(num_envs: int) -> EnvBase:
    """Makes an arm with two costs, and sums of reward and costs over each episode."""
    env = ArmEnv(num_envs=num_envs, costs=COSTS)
    return TransformedEnv(env, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


@contextmanager
def cluster(address: str | None) -> Iterator[str]:
    """The address of a cluster: that which is given, or a head and a worker on this machine."""
    if address is not None:
        yield address
        return
    # Ray runs actors at a niceness of 15. Beside other work on this machine they would get a few
    # percent of a core, and take minutes to import what they need.
    os.environ.setdefault("RAY_worker_niceness", "0")
    local = Cluster()
    try:
        for num_cpus in (1, 2):  # Ray itself would wait for half a minute.
            local.add_node(num_cpus=num_cpus, wait=False)
            local.wait_for_nodes(timeout=300)
        yield local.address
    finally:
        ray.shutdown()
        local.shutdown()


def make_collector(config: Config, policy: TensorDictModuleBase, address: str) -> RayCollector:
    """Opens a collector whose actors are spread over the cluster."""
    return RayCollector(
        [partial(make_env, config.envs)] * config.actors,
        policy,
        frames_per_batch=config.frames_per_batch,
        total_frames=_ENDLESS,
        sync=True,
        collector_kwargs={"auto_register_policy_transforms": False},
        ray_init_config={"address": address, "log_to_driver": False},
        # TorchRL's own numbers reserve a GPU and 2 GiB for each.
        remote_configs={"num_cpus": 1, "num_gpus": 0, "memory": 512 * 2**20},
    )


class Collection:
    """Batches without end, each with the policy as it is; new actors take the place of dead ones.

    Args:
        config: the settings.
        policy: the policy; its weights here are those that new actors begin with.
        address: address of the cluster.
    """

    def __init__(self, config: Config, policy: TensorDictModuleBase, address: str) -> None:
        self._make = partial(make_collector, config, policy, address)
        self.collector = self._make()
        #: How often actors had to be replaced.
        self.replaced = 0

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches, fresh = iter(self.collector), True
        while True:
            try:
                self._send_weights()
                batch = next(batches)
            except _DIED as error:
                if fresh:  # They would die again and again.
                    raise
                torchrl_logger.warning(f"An actor died, new ones are started: {error}")
                self.close()
                self.collector, self.replaced = self._make(), self.replaced + 1
                batches, fresh = iter(self.collector), True
                continue
            fresh = False
            yield batch

    def _send_weights(self) -> None:
        """Raises one of ``_DIED`` if an actor is dead."""
        try:
            self.collector.update_policy_weights_()
        except ray.exceptions.RayError:
            raise
        except RuntimeError:
            # The weights go through a connection of their own, which may break before Ray says
            # that the actor at its other end is dead.
            for actor in self.collector.remote_collectors:
                with suppress(ray.exceptions.GetTimeoutError):  # Busy, so not dead.
                    ray.get(actor.__ray_ready__.remote(), timeout=10)
            raise

    def close(self) -> None:
        """Ends the actors; the cluster goes on."""
        self.collector.shutdown(shutdown_ray=False)


def main(config: Config) -> dict[str, Any]:
    """Trains; returns the last figures and how often actors were replaced."""
    require_new(config.out)
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    collision, speed = config.cost_limits
    settings = TrainConfig(
        costs={"collision": collision, "speed": speed},
        frames=config.frames,
        frames_per_batch=config.frames_per_batch,
        seed=config.seed,
    )
    env = make_env(num_envs=8)
    training = ALGORITHMS["ppo-lagrangian"].build(env, settings)
    env.close()
    updater = training.updater
    assert updater is not None  # The rule that moves the multipliers.
    log = Log("csv", config.out / "logs", "ppo-lagrangian")
    log.open()
    batches = math.ceil(config.frames / config.frames_per_batch)
    with cluster(config.address) as address, tqdm(total=batches, unit="batch") as bar:
        collection = Collection(config, training.collector, address)
        try:
            for batch in islice(collection, batches):
                episodes = batch["next"][batch["next", "done"].squeeze(-1)]
                updater.step(episodes["episode_cost"])
                training.learner.learn(batch)
                row = figures(episodes, training.loss, tuple(COSTS))
                log.add({"frames": log.frames + batch.numel(), **row})
                bar.set_postfix({name: f"{value:.2f}" for name, value in row.items()})
                bar.update()
        finally:
            collection.close()
    save_policy(
        config.out / "ppo-lagrangian" / "policy.pt",
        training.actor,
        training.observation_spec,
        settings={
            "env": f"{make_env.__module__}:{make_env.__name__}",
            "cost_limits": list(config.cost_limits),
            "frames": config.frames,
            "seed": config.seed,
        },
    )
    return {**log.rows[-1], "replaced": collection.replaced}


if __name__ == "__main__":
    main(tyro.cli(Config))
