"""The private names of TorchRL that the package uses. To use a new one, add it here.

A private name may move with any release of TorchRL. Those below are each explained where they
are used; beside them stand two that TorchRL documents for subclasses.
"""

import ast
from pathlib import Path

import pytest
import torchrl
from torchrl.objectives import LossModule

PACKAGE = Path(__file__).parents[1] / "torchrl_safe"
OBJECTIVES = PACKAGE / "objectives"
TORCHRL = Path(torchrl.__file__).parent
# Where the classes that ours are made of are written.
SOURCES = [
    *(
        f"objectives/{name}.py"
        for name in ("a2c", "common", "ppo", "reinforce", "sac", "td3", "utils")
    ),
    *("objectives/multiagent/mappo.py", "objectives/value/advantages.py", "_utils.py"),
]

DOCUMENTED = {"_AcceptedKeys", "_schedulable_buffers"}
ON_POLICY = {
    "_get_entropy",
    "_has_update_associated",
    "_log_weight",
    "_maybe_normalize_advantage",
    "_weighted_loss_entropy",
}
# Hooks that TorchRL's own GAE of several agents overrides too.
ESTIMATORS = {"_broadcast_optional", "_prepare_signals"}
OFF_POLICY = {"_alpha", "_compute_target_v2", "_next_value", "_reduce_loss"}
OFF_POLICY_FILES = {
    *("critics/cost_td0.py", "off_policy/constrained.py"),
    *("off_policy/sac_lagrangian.py", "off_policy/td3_lagrangian.py"),
}
# Beside the losses: the sources of TorchRL that a file is made of, and what it uses of them. What
# TorchRL's guide and Hydra tell a subclass to write is left out.
HOOKS = {"_reset", "_step", "_set_seed", "_make_specs", "_target_"}
ELSEWHERE = {
    "collectors.py": (["collectors/_single.py"], {"_carrier", "_traj_pool"}),
    "envs/arm_env.py": (["envs/common.py"], {"_has_frame_skip"}),
    "envs/gym/safe.py": (
        ["envs/common.py", "envs/gym_like.py", "envs/libs/gym.py"],
        {"_async_env", "_build_env", "_convert_actions_to_numpy", "_env", "_is_batched"}
        | {"_output_transform", "_replace_reset"},
    ),
    "trainers/configs.py": (
        ["trainers/algorithms/configs/common.py", "trainers/algorithms/configs/trainers.py"],
        {"_make_onpolicy_trainer", "_normalize_hydra_key"},
    ),
}


def is_private(name):
    return name.startswith("_") and not name.startswith("__") and len(name) > 1


def defined_in(tree):
    """Functions, classes and attributes that a module of TorchRL defines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def used_in(tree):
    """Names that a module of ours reads, sets, overrides, imports or spells out."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def private_names(sources):
    """The private names that some files of TorchRL define."""
    trees = [ast.parse((TORCHRL / path).read_text()) for path in sources]
    # What comes from nn.Module is not TorchRL's to move.
    inherited = set(dir(LossModule.__mro__[-2])) | {"_buffers", "_modules", "_parameters"}
    names = {name for tree in trees for name in defined_in(tree) if is_private(name)}
    return names - inherited


@pytest.fixture(scope="module")
def theirs():
    return private_names(SOURCES)


def used(theirs, *, off_policy):
    """TorchRL's private names by the files of ours that use them."""
    found = {}
    for path in OBJECTIVES.rglob("*.py"):
        if (str(path.relative_to(OBJECTIVES)) in OFF_POLICY_FILES) == off_policy:
            for name in theirs & set(used_in(ast.parse(path.read_text()))):
                found.setdefault(name, set()).add(path.name)
    return found


def test_a_new_private_name_is_noticed(theirs):
    assert {"_log_weight", "_reduce_loss", "_in_keys", "_tensor_keys"} <= theirs
    source = "class Mine(PPOLoss):\n    def _log_weight(self):\n        return self._in_keys"
    assert {"_log_weight", "_in_keys"} <= set(used_in(ast.parse(source)))


def test_on_policy_losses_and_trust_regions_use_no_other_private_names(theirs):
    found = used(theirs, off_policy=False)
    allowed = DOCUMENTED | ON_POLICY | ESTIMATORS
    assert found.keys() <= allowed, {name: found[name] for name in found.keys() - allowed}
    assert allowed <= found.keys(), f"no longer used: {allowed - found.keys()}"
    assert len(ON_POLICY) <= 6


def test_off_policy_losses_use_no_other_private_names(theirs):
    found = used(theirs, off_policy=True)
    allowed = DOCUMENTED | OFF_POLICY
    assert found.keys() <= allowed, {name: found[name] for name in found.keys() - allowed}
    assert allowed <= found.keys(), f"no longer used: {allowed - found.keys()}"
    assert len(ON_POLICY | ESTIMATORS | OFF_POLICY) <= 14


@pytest.mark.parametrize("path", ELSEWHERE)
def test_environments_collectors_and_trainers_use_no_other_private_names(path):
    sources, allowed = ELSEWHERE[path]
    found = private_names(sources) & set(used_in(ast.parse((PACKAGE / path).read_text())))
    assert found - HOOKS == allowed
