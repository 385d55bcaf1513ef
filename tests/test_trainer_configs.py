"""Hydra configurations: they say what the constructors say, and they compose with TorchRL's."""

import inspect
import re
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from on_policy import make_loss
from torch.distributions.transforms import SoftplusTransform

from torchrl_safe.envs import IIWA, ArmEnv, Scattered
from torchrl_safe.objectives import (
    CRPOLoss,
    DualAscent,
    LagrangianLoss,
    PIDControl,
    ViolationUpdater,
)
from torchrl_safe.trainers import ConstrainedPPOTrainer, configs
from torchrl_safe.trainers.configs import (
    ArmEnvConfig,
    ConstrainedPPOTrainerConfig,
    CRPOLossConfig,
    DualAscentConfig,
    LagrangianLossConfig,
    PIDControlConfig,
    ViolationUpdaterConfig,
    register_configs,
)

DOCUMENT = Path(__file__).parent.parent / "docs" / "trainers.md"


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The folder of the documented configuration."""
    register_configs()
    folder = tmp_path_factory.mktemp("configs")
    (text,) = re.findall(r"```yaml\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.S)
    (folder / "config.yaml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """The logger of a configuration makes its folder where the process is."""
    monkeypatch.chdir(tmp_path)


def read(folder, *overrides):
    with initialize_config_dir(str(folder), version_base="1.3"):
        return compose("config", overrides=list(overrides))


CONFIGS = {
    ArmEnvConfig: ArmEnv,
    LagrangianLossConfig: LagrangianLoss,
    CRPOLossConfig: CRPOLoss,
    DualAscentConfig: DualAscent,
    PIDControlConfig: PIDControl,
    ViolationUpdaterConfig: ViolationUpdater,
}


@pytest.mark.parametrize(
    ("config", "made"), CONFIGS.items(), ids=[made.__name__ for made in CONFIGS.values()]
)
def test_each_argument_with_its_default(config, made):
    node = OmegaConf.structured(config)
    fields = {name for name in node if not name.startswith("_")}
    parameters = dict(inspect.signature(made.__init__).parameters)
    del parameters["self"]
    if made not in (ArmEnv, LagrangianLoss, CRPOLoss):
        del parameters["loss_module"]  # It is given by the trainer.
    assert fields == set(parameters)
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty:
            assert OmegaConf.is_missing(node, name)
        else:
            default = node[name]
            configured = instantiate(default) if OmegaConf.is_dict(default) else default
            assert same(configured, parameter.default), name


def test_one_tolerance_for_each_cost():
    assert OmegaConf.structured(CRPOLossConfig(tolerance=[0.1, 0.2])).tolerance == [0.1, 0.2]


def same(configured, default):
    """Equal; functions of functools.partial and torch's transforms compare by what they are."""
    if isinstance(default, torch.distributions.transforms.ComposeTransform):
        return default.parts == configured.parts
    return getattr(configured, "func", configured) == default


def test_the_arguments_of_the_trainer():
    fields = set(ConstrainedPPOTrainerConfig.__dataclass_fields__)
    ours = inspect.signature(ConstrainedPPOTrainer).parameters
    assert set(ours) - {"kwargs"} <= fields
    node = OmegaConf.structured(ConstrainedPPOTrainerConfig)
    for name in ("frame_skip", "optim_steps_per_batch", "gamma", "lmbda", "add_gae", "gae"):
        assert node[name] == ours[name].default
    for name in ("done_key", "episode_cost_key"):
        assert node[name] == ours[name].default
    assert OmegaConf.is_missing(node, "updater")


def test_the_documented_configuration(example):
    """Everything in it is what it names, and the collector has the very policy of the loss."""
    trainer = instantiate(read(example).trainer)
    collector, loss = trainer.collector, trainer.loss_module
    assert isinstance(trainer, ConstrainedPPOTrainer)
    assert collector.env.base_env.arm == IIWA
    assert isinstance(loss, LagrangianLoss)
    assert next(collector.policy.parameters()) is next(loss.actor_network.parameters())
    assert loss.value_estimator.gamma == loss.cost_value_estimator.gamma == pytest.approx(0.97)
    updater = trainer._modules["multiplier"].updater
    assert isinstance(updater, PIDControl)
    assert updater.loss_module is loss
    trainer.shutdown()


def test_another_rule_and_two_costs(example):
    """Lists arrive as k numbers."""
    loss = instantiate(read(example).loss, num_costs=2)
    dual = instantiate(DualAscentConfig(cost_limit=[1.0, 2.0], lr=0.3))(loss)
    assert isinstance(dual, DualAscent)
    config = PIDControlConfig(cost_limit=[1.0, 2.0], kp=0.5, ki=0.1, kd=0.5)
    updater = instantiate(config)(loss)
    assert isinstance(updater, PIDControl)
    assert dual.cost_limit.tolist() == updater.cost_limit.tolist() == [1, 2]
    updater.step(torch.tensor([[3.0, 2.0]]))
    assert loss.lagrange_multiplier.tolist() == pytest.approx([0.6, 0])  # A violation of 1 at most.


def test_another_parametrization(example):
    softplus = "torch.distributions.transforms.SoftplusTransform"
    chosen = ["updater.lr=0.1", f"updater.parametrization._target_={softplus}"]
    config = read(example, "updater=dual_ascent", *chosen)
    updater = instantiate(config.updater)(instantiate(config.loss, multiplier_init=1.0))
    assert isinstance(updater.parametrization, SoftplusTransform)


def test_a_loss_that_reads_violations(example):
    trainer = instantiate(read(example, "loss=crpo", "updater=violation").trainer)
    assert isinstance(trainer.loss_module, CRPOLoss)
    trainer._modules["multiplier"].updater.step(torch.tensor([[2.0]]))
    assert trainer.loss_module.cost_violation.tolist() == [1.5]
    trainer.shutdown()


@pytest.mark.parametrize("own", [{"policy": "mine"}, {"policy_factory": "mine"}, {"policy": None}])
def test_a_collector_keeps_a_policy_of_its_own(monkeypatch, own):
    """One that is given nothing, or None, gets the policy of the loss; here it is a mere dict."""
    monkeypatch.setattr(configs, "_make_onpolicy_trainer", lambda make, **parts: parts["collector"])
    loss = make_loss()
    collector = configs.make_constrained_ppo_trainer(
        collector=partial(dict, frames_per_batch=40, **own),
        loss_module=loss,
        updater=partial(DualAscent, cost_limit=1.0, lr=0.1),
    )
    given = own if "mine" in own.values() else {"policy": loss.actor_network}
    assert collector == {"frames_per_batch": 40, **given}


def test_an_updater_without_a_rule(example):
    """As without its line in the defaults list."""
    with pytest.raises(InstantiationException, match=r"updater must name .*collision"):
        instantiate(read(example, "~updater").trainer)
    with pytest.raises(InstantiationException, match=r"updater must name .* None"):
        instantiate(read(example, "trainer.updater=null").trainer)


def test_a_nested_key_arrives_as_one(example):
    """In YAML it is a list."""
    trainer = instantiate(read(example, "trainer.episode_cost_key=[arms,cost]").trainer)
    assert trainer._modules["multiplier"].episode_cost_key == ("next", "arms", "cost")
    trainer.shutdown()


def test_other_parts_of_an_arm():
    node = OmegaConf.structured(
        ArmEnvConfig(
            num_envs=2,
            obstacles={"_target_": "torchrl_safe.envs.Scattered", "count": 2},
            costs={
                "touch": {"_target_": "torchrl_safe.envs.Collision"},
                "close": {"_target_": "torchrl_safe.envs.Proximity", "margin": 0.1},
            },
        )
    )
    env = instantiate(node)
    assert env.batch_size == (2,)
    assert env.obstacles == Scattered(count=2)
    assert env.cost_names == ("touch", "close")
    env.close()
