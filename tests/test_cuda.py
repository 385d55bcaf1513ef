"""On a GPU, losses, multiplier rules and environments do what they do on the CPU."""

from copy import deepcopy
from functools import partial

import off_policy
import pytest
import torch
import trust_region
from on_policy import BY_MULTIPLIER, BY_VIOLATION, total
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    NormalParamExtractor,
    TensorDictModule,
    set_interaction_type,
)
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe.checkpoint import RunCheckpoints
from torchrl_safe.envs import ArmEnv, Moving, Shield
from torchrl_safe.evaluation import evaluate
from torchrl_safe.objectives import (
    CUPLoss,
    DualAscent,
    MultiplierUpdater,
    PIDControl,
    PPOLagrangianLoss,
    SACLagrangianLoss,
    TD3LagrangianLoss,
    TrustRegionStep,
)
from torchrl_safe.policy import load_policy, save_policy
from torchrl_safe.testing import (
    make_batch,
    make_networks,
    make_transitions,
    set_multiplier,
    set_violation,
)
from torchrl_safe.testing.networks import mlp

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

COSTS = 2
ON_POLICY = {
    **{name: (make, set_multiplier) for name, make in BY_MULTIPLIER.items()},
    **{name: (make, set_violation) for name, make in BY_VIOLATION.items()},
    "cup": (CUPLoss, set_multiplier),
}
each_on_policy = pytest.mark.parametrize(
    ("make", "constrain"), ON_POLICY.values(), ids=ON_POLICY.keys()
)


def on_both(loss):
    return loss, deepcopy(loss).to("cuda")


def assert_on_gpu_as_on_cpu(actual, expected):
    """Float32 rounds to about 1e-7; sums in another order, to a little more."""
    assert actual.keys() == expected.keys()
    for name, value in expected.items():
        assert actual[name].device.type == "cuda", name
        torch.testing.assert_close(
            actual[name].cpu(),
            value,
            rtol=1e-4,
            atol=1e-5,
            msg=lambda text, name=name: f"{name}: {text}",
        )


def gradients(loss, data):
    """Outputs of a loss, and the gradients of all parameters."""
    outputs = loss(data)
    total(outputs).backward()
    return dict(outputs.detach().items()), {
        name: p.grad for name, p in loss.named_parameters() if p.grad is not None
    }


@each_on_policy
def test_on_policy_losses(make, constrain):
    """From a batch as the collector returns it: advantages, losses, gradients."""
    both = on_both(make(*make_networks(COSTS), num_costs=COSTS))
    results = []
    for loss, device in zip(both, ("cpu", "cuda"), strict=True):
        constrain(loss, torch.tensor([0.7, 2.0]))
        batch = loss.estimate_advantages(make_batch(COSTS).to(device))
        results.append((dict(batch.reshape(-1).items(True, True)), *gradients(loss, batch)))
    for cpu, gpu in zip(*results, strict=True):
        assert_on_gpu_as_on_cpu(gpu, cpu)


@pytest.mark.parametrize("kind", [SACLagrangianLoss, TD3LagrangianLoss], ids=["sac", "td3"])
def test_off_policy_losses(kind, monkeypatch):
    """With the same random numbers, which otherwise differ from device to device."""

    def drawn_on_the_cpu(shape, dtype, device):
        return torch.randn(shape, dtype=dtype).to(device)

    monkeypatch.setattr("torch.distributions.normal._standard_normal", drawn_on_the_cpu)
    own = {"policy_noise": 0.0} if kind is TD3LagrangianLoss else {}
    both = on_both(off_policy.make_loss(kind, COSTS, multiplier_init=0.7, **own))
    data = make_transitions(COSTS, num_transitions=32)
    results = []
    for loss, device in zip(both, ("cpu", "cuda"), strict=True):
        torch.manual_seed(7)
        results.append(gradients(loss, data.to(device)))
    for cpu, gpu in zip(*results, strict=True):
        assert_on_gpu_as_on_cpu(gpu, cpu)


class Exponentiated(MultiplierUpdater):
    """As a user writes it, without a word about devices."""

    def next_multiplier(self, multiplier, violation):
        return multiplier.clamp_min(0.01) * (violation / self.cost_limit).exp()


@pytest.mark.parametrize("costs_on", ["cpu", "cuda"])
@pytest.mark.parametrize(
    "rule",
    [
        partial(DualAscent, lr=0.1),
        partial(DualAscent, lr=0.1, optimizer=torch.optim.Adam),
        PIDControl,
        Exponentiated,
    ],
    ids=["sgd", "adam", "pid", "own"],
)
def test_multiplier_rules(rule, costs_on):
    both = on_both(PPOLagrangianLoss(*make_networks(COSTS), num_costs=COSTS))
    updaters = [rule(loss, cost_limit=torch.tensor([0.5, 1.0])) for loss in both]
    for seed in range(5):
        torch.manual_seed(seed)
        costs = 3 * torch.rand(8, COSTS)
        updaters[0].step(costs)
        updaters[1].step(costs.to(costs_on))
    expected, actual = (loss.lagrange_multiplier for loss in both)
    assert expected.all()
    assert_on_gpu_as_on_cpu({"multiplier": actual}, {"multiplier": expected})


@pytest.mark.parametrize("method", trust_region.METHODS.values(), ids=trust_region.METHODS.keys())
def test_trust_region_steps(method):
    both = on_both(trust_region.make_loss())
    data = trust_region.make_data(both[0])
    results = []
    for loss, device in zip(both, ("cpu", "cuda"), strict=True):
        loss.cost_violation.fill_(0.2)
        step = TrustRegionStep(loss, method, max_kl=0.01, episode_length=10.0)
        info = step.step(data.to(device))
        assert step.rejected_steps == 0
        results.append((info["kl"], {"actor": trust_region.actor_state(loss)}))
    (kl, expected), (kl_on_gpu, actual) = results
    assert_on_gpu_as_on_cpu(actual, expected)
    # What is to be logged is on the CPU.
    torch.testing.assert_close(kl_on_gpu, kl, rtol=1e-4, atol=1e-6)


# PyTorch's compiler uses what PyTorch and TorchRL have deprecated, and advises less precision.
@pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:TensorFloat32:UserWarning"
)
def test_compiled_and_autocast():
    loss = PPOLagrangianLoss(*make_networks(COSTS), num_costs=COSTS).to("cuda")
    set_multiplier(loss, torch.tensor([0.7, 2.0]))
    data = loss.estimate_advantages(make_batch(COSTS).to("cuda")).reshape(-1)
    expected = total(loss(data))
    torch.testing.assert_close(
        torch.compile(lambda data: total(loss(data)))(data), expected, rtol=1e-4, atol=1e-5
    )
    with torch.autocast("cuda", dtype=torch.bfloat16):
        torch.testing.assert_close(total(loss(data)).float(), expected, rtol=0.05, atol=0.05)


def test_checkpoints_move_between_devices(tmp_path):
    torch.manual_seed(0)
    losses = on_both(PPOLagrangianLoss(*make_networks(), num_costs=1))
    set_multiplier(losses[1], torch.tensor([3.0]))
    updaters = [PIDControl(loss, cost_limit=1.0) for loss in losses]
    updaters[1].step(torch.tensor([[2.0]], device="cuda"))
    runs = [
        RunCheckpoints(tmp_path, {"loss": loss, "updater": updater}, settings={})
        for loss, updater in zip(losses, updaters, strict=True)
    ]
    runs[1].save(1)
    assert runs[0].load(map_location="cpu") == 1
    for updater, device in zip(updaters, ("cpu", "cuda"), strict=True):
        updater.step(torch.tensor([[2.0]], device=device))
    expected, actual = (loss.lagrange_multiplier for loss in losses)
    assert_on_gpu_as_on_cpu({"multiplier": actual}, {"multiplier": expected})


@pytest.mark.parametrize("shield", [None, Shield()], ids=["bare", "shielded"])
def test_environments(engine, make_env, shield):
    """The engine works on the CPU, so the tensors are the same to the bit."""
    settings = {"num_envs": 3, "obstacles": Moving(), "max_episode_steps": 8, "seed": 3}
    cpu = make_env(ArmEnv, shield=shield, **settings)
    gpu = make_env(ArmEnv, shield=shield, device="cuda", **settings)
    torch.manual_seed(0)
    actions = 2 * torch.rand(20, 3, 3) - 1

    def play(env):
        steps = []
        tensordict = env.reset()
        for action in actions.to(env.device or "cpu"):
            taken, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            steps.append(taken)
        return torch.stack(steps)

    played, expected = play(gpu), play(cpu)
    assert played["next", "done"].any()
    assert (played.cpu() == expected).all()
    check_env_specs(gpu)


def test_a_policy_trains_and_is_saved(engine, make_env, tmp_path):
    """Environment, collector, loss, evaluation and file, all with tensors on the GPU."""
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    arm = partial(ArmEnv, num_envs=4, device="cuda", max_episode_steps=10, seed=0)
    env, another = (make_env(lambda: TransformedEnv(arm(), sums.clone())) for _ in range(2))
    width = env.observation_spec["observation"].shape[-1]
    policy = TensorDictModule(
        torch.nn.Sequential(mlp(width, 6), NormalParamExtractor()),
        ["observation"],
        ["loc", "scale"],
    )
    actor = ProbabilisticActor(
        policy, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    ).to("cuda")
    critics = (
        ValueOperator(mlp(width, 1), in_keys=["observation"], out_keys=[key])
        for key in ("state_value", "cost_value")
    )
    loss = PPOLagrangianLoss(actor, *critics).to("cuda")
    updater = PIDControl(loss, cost_limit=1.0)
    optimizer = torch.optim.Adam(loss.parameters())
    before = [parameter.detach().clone() for parameter in loss.parameters()]
    collector = Collector(
        env,
        actor,
        frames_per_batch=80,
        total_frames=160,
        device="cuda",
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        assert batch["next", "cost"].device.type == "cuda"
        updater.step(batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)])
        total(loss(loss.estimate_advantages(batch).reshape(-1))).backward()
        optimizer.step()
        optimizer.zero_grad()
    for parameter, earlier in zip(loss.parameters(), before, strict=True):
        assert parameter.isfinite().all()
        assert not torch.equal(parameter, earlier)
    assert evaluate(another, actor, 8, seed=5)["episode_cost"].shape == (8, 1)
    save_policy(tmp_path / "policy.pt", actor, another.observation_spec_unbatched)
    observation = another.reset()["observation"]
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        expected = actor(TensorDict(observation=observation, batch_size=[4]))["action"]
    actions = load_policy(tmp_path / "policy.pt")(observation.cpu().numpy())
    torch.testing.assert_close(torch.from_numpy(actions), expected.cpu(), rtol=1e-4, atol=1e-5)
