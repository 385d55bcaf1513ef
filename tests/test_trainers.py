"""The multiplier inside TorchRL's trainers: registered, learnt with, and saved."""

import csv
from functools import partial

import pytest
import torch
from on_policy import make_loss
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss, KLPENPPOLoss, SoftUpdate
from torchrl.record import CSVLogger
from torchrl.trainers.algorithms import PPOTrainer, SACTrainer

from torchrl_safe.envs import ArmEnv, Collision
from torchrl_safe.objectives import (
    CRPOLoss,
    CUPLoss,
    DualAscent,
    FOCOPSLoss,
    IPOLoss,
    LagrangianLoss,
    P3OLoss,
    PIDControl,
    PPOLagrangianLoss,
    SACLagrangianLoss,
    TrustRegionLoss,
    ViolationUpdater,
)
from torchrl_safe.testing import ConstrainedBandit, make_networks
from torchrl_safe.trainers import ConstrainedPPOTrainer, MultiplierHook

WORLDS, STEPS, FRAMES = 4, 5, 40


def always(state):
    """Costs 1 in each step: 5 in an episode of ours, and nothing can be done about it."""
    return torch.ones(len(state.goal)).numpy()


class Arm:
    """What a training on a real arm is made of, the same for the same seed."""

    def __init__(self, seed=0, rule=DualAscent, **settings):
        torch.manual_seed(seed)
        self.costs = {"collision": Collision(), "always": always}
        arm = ArmEnv(num_envs=WORLDS, costs=self.costs, max_episode_steps=STEPS, seed=seed)
        env = TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))
        observations = env.observation_spec["observation"].shape[-1]
        actor = make_actor(observations)
        self.env, self.actor = env, actor
        critic = ValueOperator(MLP(observations, 1, num_cells=[8]), ["observation"])
        cost_critic = ValueOperator(
            MLP(observations, 2, num_cells=[8]), ["observation"], ["cost_value"]
        )
        self.loss = PPOLagrangianLoss(actor, critic, cost_critic, num_costs=2, entropy_bonus=False)
        settings = settings or {"cost_limit": 2.0, "lr": 0.1}
        self.updater = rule(self.loss, cost_names=list(self.costs), **settings)
        self.optimizer = torch.optim.Adam(self.loss.parameters(), lr=1e-3)
        self.buffer = make_buffer(FRAMES, FRAMES // 2)
        self.collector = make_collector(env, actor, FRAMES)

    def trainer(self, kind=ConstrainedPPOTrainer, batches=2, **settings):
        """A trainer of these parts."""
        return kind(
            collector=self.collector,
            total_frames=batches * FRAMES,
            frame_skip=1,
            optim_steps_per_batch=None,
            loss_module=self.loss,
            optimizer=self.optimizer,
            replay_buffer=self.buffer,
            progress_bar=False,
            log_interval=0,
            seed=1,
            **settings,
        )

    def safe_trainer(self, **settings):
        return self.trainer(updater=self.updater, **settings)


def make_actor(observations):
    policy = nn.Sequential(MLP(observations, 6, num_cells=[8]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(policy, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_collector(env, actor, frames):
    return Collector(env, actor, frames_per_batch=frames, auto_register_policy_transforms=False)


def make_buffer(frames, minibatch):
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=minibatch
    )


@pytest.fixture
def make_arm():
    """Closes every collector that a test has made with it."""
    made = []

    def make(*args, **kwargs):
        made.append(Arm(*args, **kwargs))
        return made[-1]

    yield make
    for arm in made:
        arm.collector.shutdown()


def read_log(folder, name):
    """Steps and values of a scalar that TorchRL's CSV logger has written."""
    (file,) = folder.rglob(f"{name}.csv")
    with file.open() as rows:
        return [(int(step), float(value)) for step, value in csv.reader(rows)]


@pytest.mark.parametrize("traj_format", ["cat", "padded"])
def test_whole_trajectories(make_arm, traj_format):
    arm = make_arm()
    arm.collector.shutdown(close_env=False)
    arm.collector = Collector(
        arm.env,
        arm.actor,
        frames_per_batch=FRAMES,
        trajs_per_batch=WORLDS,
        traj_format=traj_format,
        auto_register_policy_transforms=False,
    )
    arm.safe_trainer().train()
    assert (arm.loss.lagrange_multiplier > 0).any()
    assert all(parameter.isfinite().all() for parameter in arm.loss.parameters())


def test_a_missing_collector_is_named(make_arm):
    arm = make_arm()
    with pytest.raises(TypeError, match=r"missing .* 'collector'"):
        ConstrainedPPOTrainer(loss_module=arm.loss, updater=arm.updater)


def test_steps_in_an_unknown_order(make_arm):
    """They may be of several worlds, or shuffled."""
    arm = make_arm()
    arm.collector.postproc = lambda batch: batch.reshape(-1)
    with pytest.raises(ValueError, match="must have a dimension of time"):
        arm.safe_trainer().train()


def test_an_updater_of_another_loss(make_arm):
    arm = make_arm()
    other = DualAscent(make_loss(num_costs=2), cost_limit=1.0, lr=0.5)
    with pytest.raises(ValueError, match="updater must be of the trainer's loss_module"):
        arm.trainer(updater=other)
    trainer = arm.trainer(PPOTrainer, gae=arm.loss.estimate_advantages)
    trainer.loss_module = len
    with pytest.raises(ValueError, match="loss_module, a builtin_function_or_method: it moves"):
        MultiplierHook(arm.updater).register(trainer)


def test_two_hooks_have_names_of_their_own(make_arm):
    """The states of both are saved."""
    arm = make_arm()
    trainer = arm.safe_trainer()
    MultiplierHook(arm.updater).register(trainer, "other")
    assert {"multiplier", "other"} <= set(trainer.state_dict())


def test_the_hook_in_a_ppo_trainer(make_arm, tmp_path):
    """Costs of 5 in each episode, a limit of 2, a rate of 0.1: 0.3 more with each batch."""
    arm = make_arm()
    logger = CSVLogger("run", log_dir=str(tmp_path))
    trainer = arm.trainer(PPOTrainer, 3, gae=arm.loss.estimate_advantages, logger=logger)
    MultiplierHook(arm.updater).register(trainer)
    trainer.train()
    multipliers = read_log(tmp_path, "lagrange_multiplier/always")
    assert [step for step, _ in multipliers] == [40, 80, 120]
    assert [value for _, value in multipliers] == pytest.approx([0.3, 0.6, 0.9])
    assert read_log(tmp_path, "episode_cost/always") == [(40, 5), (80, 5), (120, 5)]
    assert len(read_log(tmp_path, "lagrange_multiplier/collision")) == 3
    # The loss has seen what the hook has written, and its cost critic learns.
    assert read_log(tmp_path, "lagrange_multiplier_1") == multipliers
    assert read_log(tmp_path, "loss_cost_critic")[0][1] > 0


def test_the_hook_in_a_sac_trainer(tmp_path):
    """Off policy it is the same hook: costs of 5 in each episode again, one cost this time."""
    torch.manual_seed(0)
    arm = ArmEnv(num_envs=WORLDS, costs={"always": always}, max_episode_steps=STEPS, seed=0)
    env = TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))
    observations = env.observation_spec["observation"].shape[-1]
    actor = make_actor(observations)
    inputs = {"in_keys": ["observation", "action"]}
    loss = SACLagrangianLoss(
        actor,
        ValueOperator(MLP(observations + 3, 1, num_cells=[8]), **inputs),
        ValueOperator(
            MLP(observations + 3, 1, num_cells=[8]), out_keys=["state_action_cost_value"], **inputs
        ),
        target_entropy=-3.0,
    )
    logger = CSVLogger("run", log_dir=str(tmp_path))
    collector = make_collector(env, actor, FRAMES)
    trainer = SACTrainer(
        collector=collector,
        total_frames=2 * FRAMES,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        target_net_updater=SoftUpdate(loss, eps=0.99),
        replay_buffer=TensorDictReplayBuffer(storage=LazyTensorStorage(200), batch_size=20),
        logger=logger,
        log_interval=0,
        progress_bar=False,
        episode_reward_key="episode_reward",
    )
    updater = DualAscent(loss, cost_limit=2.0, lr=0.1, cost_names=["always"])
    MultiplierHook(updater).register(trainer)
    trainer.train()
    values = [value for _, value in read_log(tmp_path, "lagrange_multiplier/always")]
    assert values == pytest.approx([0.3, 0.6])


def plain_loop(arm, batches):
    """What ConstrainedPPOTrainer does, written out."""
    torch.manual_seed(arm.collector.set_seed(1, static_seed=False))
    for _, batch in zip(range(batches), arm.collector, strict=False):
        arm.updater.step(batch["next", "episode_cost"][batch["next", "done"].squeeze(-1)])
        for _ in range(4):
            arm.buffer.extend(arm.loss.estimate_advantages(batch).reshape(-1))
            for minibatch in arm.buffer:
                losses = arm.loss(minibatch)
                sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
                arm.optimizer.step()
                arm.optimizer.zero_grad()


def with_the_hook(arm, batches):
    trainer = arm.trainer(PPOTrainer, batches, gae=arm.loss.estimate_advantages)
    MultiplierHook(arm.updater).register(trainer)
    return trainer


@pytest.mark.parametrize("make", [Arm.safe_trainer, with_the_hook], ids=["trainer", "hook"])
def test_a_trainer_is_the_plain_loop(make_arm, make):
    """All parameters, the multipliers and Adam's state, bit for bit."""
    ours, plain = make_arm(), make_arm()
    before = [parameter.clone() for parameter in ours.loss.parameters()]
    make(ours, batches=3).train()
    plain_loop(plain, 3)
    assert_same_state(ours.loss, plain.loss)
    assert ours.loss.lagrange_multiplier[1] == pytest.approx(0.9)
    assert not any(map(torch.equal, before, ours.loss.parameters()))
    moments = [arm.optimizer.state_dict()["state"] for arm in (ours, plain)]
    for mine, its in zip(moments[0].values(), moments[1].values(), strict=True):
        assert torch.equal(mine["exp_avg_sq"], its["exp_avg_sq"])


def assert_same_state(loss, expected):
    state, expected = loss.state_dict(), expected.state_dict()
    assert state.keys() == expected.keys()
    for key, value in expected.items():
        assert torch.equal(torch.as_tensor(state[key]), torch.as_tensor(value)), key


def make_world(seed):
    arm = ArmEnv(num_envs=2, costs={"always": always}, max_episode_steps=STEPS, seed=seed)
    return TransformedEnv(arm, RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))


@pytest.mark.slow
def test_worker_processes():
    """Their episodes move the multiplier, and each batch is of the policy as it has become."""
    torch.manual_seed(0)
    actor = make_actor(40)
    critic = ValueOperator(MLP(40, 1, num_cells=[8]), ["observation"])
    cost_critic = ValueOperator(MLP(40, 1, num_cells=[8]), ["observation"], ["cost_value"])
    loss = PPOLagrangianLoss(actor, critic, cost_critic, entropy_bonus=False)
    collector = MultiSyncCollector(
        [partial(make_world, seed) for seed in range(2)],
        actor,
        frames_per_batch=FRAMES,
        total_frames=3 * FRAMES,
        auto_register_policy_transforms=False,
    )
    trainer = ConstrainedPPOTrainer(
        collector=collector,
        total_frames=3 * FRAMES,
        loss_module=loss,
        updater=DualAscent(loss, cost_limit=2.0, lr=0.1),
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-2),
        replay_buffer=make_buffer(FRAMES, FRAMES // 2),
        weight_update_map={"policy": "loss_module.actor_network"},
        progress_bar=False,
    )
    lags, policies = [], []

    def compare(batch):
        """The workers' log-probabilities against those of the loss's policy."""
        policies.append(loss.actor_network_params.data.clone())
        with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
            log_prob = loss.actor_network.get_dist(batch).log_prob(batch["action"])
        lags.append((log_prob - batch["action_log_prob"]).abs().max())
        return batch

    trainer.register_op("batch_process", compare)
    try:
        trainer.train()
    finally:
        collector.shutdown()
    assert loss.lagrange_multiplier.item() == pytest.approx(0.9)
    assert max(lags) < 1e-4
    assert not (policies[0] == policies[2]).all()


def test_discounts(make_arm):
    arm = make_arm()
    arm.safe_trainer(gamma=0.9, lmbda=0.8)
    for estimator in (arm.loss.value_estimator, arm.loss.cost_value_estimator):
        assert estimator.gamma.item() == pytest.approx(0.9)
        assert estimator.lmbda.item() == pytest.approx(0.8)
    with pytest.raises(ValueError, match=r"gamma and lmbda must be given together, got 0\.9"):
        arm.safe_trainer(gamma=0.9)
    with pytest.raises(ValueError, match=r"got None and 0\.8"):
        arm.safe_trainer(lmbda=0.8)


def test_advantages_by_a_function_of_ones_own(make_arm):
    """It takes the place of the loss's: with each batch it is asked once in each epoch."""
    arm, shapes = make_arm(), []

    def estimate(batch):
        shapes.append(batch.shape)
        return arm.loss.estimate_advantages(batch)

    arm.safe_trainer(gae=estimate, num_epochs=3).train()
    assert shapes == [(WORLDS, FRAMES // WORLDS)] * 6


def test_advantages_that_come_with_the_batch(make_arm):
    """Without ``add_gae`` nobody writes others over them."""
    arm = make_arm()

    def estimate(batch):
        return arm.loss.estimate_advantages(batch).set("advantage", torch.full((4, 10, 1), 7.0))

    trainer = arm.safe_trainer(add_gae=False)
    trainer.register_op("batch_process", estimate)
    trainer.train()
    assert (arm.buffer[:]["advantage"] == 7).all()


def test_the_loss_reads_ends_where_the_done_key_says(make_arm):
    arm = make_arm()
    arm.safe_trainer(done_key="truncated")
    assert arm.loss.tensor_keys.done == "truncated"


PID = {"cost_limit": 2.0, "kp": 0.5, "ki": 0.1, "kd": 0.5}


def test_saved_and_loaded(make_arm, tmp_path):
    """The trainer that has loaded takes the same next step of the multiplier; a fresh one not."""
    file = tmp_path / "checkpoint"
    first, second, fresh = (make_arm(rule=PIDControl, **PID) for _ in range(3))
    first.safe_trainer(checkpoint=Checkpoint(), save_trainer_file=file).train()
    trainer = second.safe_trainer().load_from_file(file)
    assert trainer.collected_frames == 2 * FRAMES
    assert torch.equal(second.updater.integral, first.updater.integral)
    assert_same_state(second.loss, first.loss)
    # Only the multiplier is handed over here: integral and smoothed cost are missing then.
    fresh.loss.lagrange_multiplier.copy_(first.loss.lagrange_multiplier)
    for arm in (first, second, fresh):
        arm.updater.step(torch.tensor([[1.0, 4.0]]))
    assert torch.equal(second.loss.lagrange_multiplier, first.loss.lagrange_multiplier)
    assert not torch.equal(fresh.loss.lagrange_multiplier, first.loss.lagrange_multiplier)


@pytest.mark.filterwarnings("ignore:The (default|legacy).*heckpoint:Warning")
def test_saved_and_loaded_as_one_file(make_arm, tmp_path):
    """TorchRL's older format, which it still writes unless it is given a Checkpoint."""
    file = tmp_path / "checkpoint.pt"
    first, second = (make_arm(rule=PIDControl, **PID) for _ in range(2))
    first.safe_trainer(save_trainer_file=str(file)).train()
    second.safe_trainer().load_from_file(str(file))
    assert torch.equal(second.updater.integral, first.updater.integral)
    assert torch.equal(second.loss.lagrange_multiplier, first.loss.lagrange_multiplier)


LOSSES = {
    "ppo-lagrangian": (PPOLagrangianLoss, DualAscent),
    "a2c-lagrangian": (lambda a, c, cc, **k: LagrangianLoss(A2CLoss(a, c), cc, **k), DualAscent),
    "kl-ppo": (lambda a, c, cc, **k: LagrangianLoss(KLPENPPOLoss(a, c), cc, **k), DualAscent),
    "focops": (FOCOPSLoss, DualAscent),
    "p3o": (P3OLoss, ViolationUpdater),
    "ipo": (IPOLoss, ViolationUpdater),
    "crpo": (lambda a, c, cc, **k: CRPOLoss(ClipPPOLoss(a, c), cc, **k), ViolationUpdater),
}


@pytest.mark.parametrize(("make", "rule"), LOSSES.values(), ids=LOSSES.keys())
def test_every_loss_that_one_optimizer_minimizes(make, rule):
    """Two actions, each with a cost of its own: whatever is done, the mean costs sum to 1."""
    torch.manual_seed(0)
    env = ConstrainedBandit()
    actor, critic, cost_critic = env.make_networks()
    loss = make(actor, critic, cost_critic, num_costs=2)
    rate = {"lr": 1.0} if rule is DualAscent else {}
    updater = rule(loss, cost_limit=0.0, **rate)
    before = [parameter.clone() for parameter in loss.parameters()]
    ConstrainedPPOTrainer(
        collector=make_collector(env, actor, env.batch_size.numel()),
        total_frames=env.batch_size.numel(),
        loss_module=loss,
        updater=updater,
        optimizer=torch.optim.SGD(loss.parameters(), lr=0.1),
        replay_buffer=make_buffer(env.batch_size.numel(), env.batch_size.numel() // 2),
        progress_bar=False,
        episode_cost_key="cost",  # Each episode is one step long.
    ).train()
    moved = getattr(loss, updater.buffer_name)
    assert moved.sum() == pytest.approx(1)
    assert moved.min() > 0.1
    assert not any(map(torch.equal, before, loss.parameters()))


def test_a_compiled_loss(make_arm):
    """TorchRL's trainers take one too."""
    arm = make_arm()
    loss, arm.loss = arm.loss, torch.compile(arm.loss, backend="eager")
    assert arm.safe_trainer().loss_module is arm.loss
    plain = ClipPPOLoss(loss.actor_network, loss.critic_network)
    arm.loss = torch.compile(plain, backend="eager")
    with pytest.raises(TypeError, match=r"loss_module must be .* cost critic, .* got ClipPPOLoss"):
        arm.safe_trainer()


@pytest.mark.parametrize("make", [CUPLoss, TrustRegionLoss])
def test_losses_with_a_loop_of_their_own(make):
    loss = make(*make_networks())
    with pytest.raises(ValueError, match="loss_module must be minimized as it stands, got"):
        ConstrainedPPOTrainer(loss_module=loss, updater=None, collector=None, total_frames=1)


def test_a_loss_without_costs():
    loss = ClipPPOLoss(*make_networks()[:2])
    with pytest.raises(TypeError, match=r"loss_module must be .* cost critic, .* got ClipPPOLoss"):
        ConstrainedPPOTrainer(loss_module=loss, updater=None, collector=None, total_frames=1)


def test_a_trainer_that_sees_no_batches(make_arm):
    with pytest.raises(ValueError, match="async_collection must be False"):
        make_arm().safe_trainer(async_collection=True)
    arm = make_arm()
    for option in ("set_truncated", "reset_at_each_iter"):
        setattr(arm.collector, option, True)
        with pytest.raises(ValueError, match=f"{option} of the collector must be False"):
            arm.safe_trainer()
        setattr(arm.collector, option, False)
    hook = MultiplierHook(DualAscent(make_loss(), cost_limit=1.0, lr=0.5))
    with pytest.raises(ValueError, match="collector must yield its batches"):
        hook.log(None)


def test_a_trainer_that_learns_in_another_process(make_arm):
    arm = make_arm()
    trainer = arm.trainer(PPOTrainer, gae=arm.loss.estimate_advantages)
    trainer.learner_backend = "ray"
    with pytest.raises(ValueError, match="learner_backend must be 'local', got 'ray'"):
        MultiplierHook(arm.updater).register(trainer)


def test_ends_are_where_the_done_key_says(make_arm):
    """No episode of ours is terminated; all are truncated, and cost more than their limit."""
    moved = []
    for key in ("terminated", "truncated"):
        arm = make_arm()
        arm.safe_trainer(done_key=key).train()
        moved.append(arm.loss.lagrange_multiplier[1].item() > 0)
    assert moved == [False, True]


def test_frames_and_steps_are_those_asked_for(make_arm):
    arm = make_arm()
    trainer = ConstrainedPPOTrainer(
        collector=arm.collector,
        total_frames=FRAMES,
        frame_skip=3,
        optim_steps_per_batch=1,
        num_epochs=1,
        loss_module=arm.loss,
        updater=arm.updater,
        optimizer=arm.optimizer,
        replay_buffer=arm.buffer,
        progress_bar=False,
    )
    trainer.train()
    assert trainer.collected_frames == 3 * FRAMES
    (steps,) = {state["step"].item() for state in arm.optimizer.state.values()}
    assert steps == 1
