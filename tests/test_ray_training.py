"""Training on a real Ray cluster, a head and a worker on this machine, with an actor killed."""

import csv
import time

import pytest
import ray
import torch

from experiments import evaluate
from experiments.algorithms import ALGORITHMS
from experiments.config import Config as TrainConfig
from experiments.ray_training import COSTS, Collection, Config, cluster, main, make_env
from torchrl_safe.policy import load_policy

# Ray leaves sockets and files to the garbage collector when a cluster is shut down.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]

SMALL = Config(envs=2, frames=480, frames_per_batch=160)


def is_dead(actor):
    try:
        ray.get(actor.__ray_ready__.remote())
    except ray.exceptions.RayActorError:
        return True
    return False


def test_two_costs_and_their_multipliers(tmp_path, capsys):
    # On its way to the target an arm soon touches the obstacle.
    last = main(
        Config(envs=8, frames=4096, frames_per_batch=1024, cost_limits=(0.0, 40.0), out=tmp_path)
    )
    assert last["frames"] == 4096
    assert last["replaced"] == 0
    # No step of 40 is as fast as that; any contact exceeds the other limit.
    assert last["multiplier/speed"] == 0
    (file,) = tmp_path.rglob("multiplier/collision.csv")
    with file.open() as rows:
        multipliers = [float(row[1]) for row in csv.reader(rows)]
    assert len(multipliers) == 4
    assert max(multipliers) > 0
    assert multipliers[-1] == pytest.approx(last["multiplier/collision"])
    file = tmp_path / "ppo-lagrangian" / "policy.pt"
    assert load_policy(file).settings["cost_limits"] == [0.0, 40.0]
    with pytest.raises(ValueError, match=r"trained in experiments\.ray_training:make_env"):
        evaluate.main(evaluate.Config(file))
    settings = {"env": "experiments.ray_training:make_env", "episodes": 2, "envs": 2}
    evaluate.main(evaluate.Config(file, **settings))
    assert "Cost limits collision 0, speed 40;" in capsys.readouterr().out


def test_an_actor_is_killed_on_the_way():
    env = make_env(2)
    settings = TrainConfig(frames=480, costs=dict.fromkeys(COSTS, 0.5))
    training = ALGORITHMS["ppo-lagrangian"].build(env, settings)
    env.close()
    with cluster(None) as address:
        collection = Collection(SMALL, training.collector, address)
        try:
            batches = iter(collection)
            first = next(batches)
            nodes = {node["NodeID"] for node in ray.nodes() if node["Alive"]}
            assert len(nodes) == 2
            assert first["next", "cost"].shape == (2, 2, 40, len(COSTS))
            with torch.no_grad():
                for parameter in training.actor.parameters():
                    parameter.fill_(0.125)
            # While the learner learns: the next thing it does is to send its weights, through a
            # connection that is broken by then.
            victim = collection.collector.remote_collectors[0]
            ray.kill(victim)
            while not is_dead(victim):
                time.sleep(0.1)
            time.sleep(2)
            second = next(batches)
            assert collection.replaced == 1
            assert second.shape == first.shape
            # The new actors have what was learnt. Large weights make rounding large as well; with
            # others the means would be near 0.
            expected = training.actor(second.exclude("loc", "scale").clone())["loc"]
            assert expected.abs().min() > 0.1
            torch.testing.assert_close(second["loc"], expected, rtol=1e-3, atol=0)
            assert len(next(batches)) == 2
            assert collection.replaced == 1
            # And before anybody knows that it is dead.
            ray.kill(collection.collector.remote_collectors[1])
            assert len(next(batches)) == 2
            assert collection.replaced == 2
        finally:
            collection.close()
