"""How often a batch is gone through, and how far its policy may move meanwhile."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torchrl.modules import IndependentNormal, ProbabilisticActor

from experiments.learners import NoiseSchedule, OnPolicyLearner, moved_from_here, summed
from torchrl_safe.objectives import CUPLoss
from torchrl_safe.testing import make_batch, make_networks


def steps(max_kl: float, learning_rate: float = 1e-3) -> list[int]:
    """How many gradient steps each phase of CUP takes, of three passes with two each at most."""
    torch.manual_seed(0)
    actor, *critics = make_networks()
    batch = make_batch()
    loss = CUPLoss(actor, *critics, multiplier_init=1.0)
    calls = []

    def start_projection() -> None:
        calls.append(0)
        loss.start_projection()

    def counted(objective):
        def count(minibatch):
            calls[-1] += 1
            return objective(minibatch)

        return count

    learner = OnPolicyLearner(
        loss,
        actor,
        NoiseSchedule(torch.nn.Parameter(torch.zeros(())), last=0.0, batches=1),
        learning_rate=learning_rate,
        batches=1,
        epochs=3,
        minibatch=batch.numel() // 2,
        phases=[
            (lambda: calls.append(0), counted(summed(loss))),
            (start_projection, counted(summed(loss.projection_loss))),
        ],
        max_kl=max_kl,
    )
    learner.learn(batch)
    return calls


@pytest.mark.parametrize(
    ("max_kl", "expected"), [(math.inf, [6, 6]), (100.0, [6, 6]), (1e-9, [1, 1])]
)
def test_a_phase_ends_once_the_policy_has_moved_too_far(max_kl, expected):
    assert steps(max_kl) == expected


def test_each_phase_measures_from_where_it_began():
    """The first one ends too far away. The second does not end for that after one step."""
    first, second = steps(max_kl=0.02, learning_rate=0.03)
    assert first < 6
    assert second > 1


def test_how_far_a_policy_has_moved():
    """With a deviation of 1, half the square of how far the mean has."""
    shift = torch.nn.Linear(1, 1)
    policy = torch.nn.Sequential(shift, AddStateIndependentNormalScale(1))
    module = TensorDictModule(policy, ["observation"], ["loc", "scale"])
    actor = ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal
    )
    data = TensorDict(observation=torch.randn(5, 1), batch_size=[5])
    moved = moved_from_here(actor, data)
    assert moved() == 0.0
    with torch.no_grad():
        shift.bias.add_(0.6)
    assert moved() == pytest.approx(0.18)
    assert list(data.keys()) == ["observation"]
