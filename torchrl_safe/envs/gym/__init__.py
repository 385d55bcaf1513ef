"""Gymnasium, both ways: arms for Gymnasium's users, and Gymnasium's environments with a cost.

Importing this module registers the ready-made combinations of an arm, a task, obstacles and an
action as ``torchrl_safe/<Arm><Task><Obstacles><Action>-v0``; the names are the keys of ``ARMS``,
``TASKS``, ``OBSTACLES`` and ``ACTIONS``. Gymnasium's own syntax imports it on the way:
``gymnasium.make("torchrl_safe.envs.gym:torchrl_safe/PandaReachInFront-v0")``. The tasks of
:data:`~torchrl_safe.envs.SUITE` are registered as ``torchrl_safe/<name>-v0``.
"""

from itertools import product

try:
    import gymnasium
except ImportError as error:
    raise ImportError(
        'torchrl_safe.envs.gym needs Gymnasium: pip install "torchrl-safe[arms]".'
    ) from error

from torchrl_safe.envs.gym.arm import ArmGymEnv
from torchrl_safe.envs.gym.registered import ACTIONS, ARMS, OBSTACLES, TASKS, combination
from torchrl_safe.envs.gym.safe import SafeGymEnv, SafeGymWrapper
from torchrl_safe.envs.suite import SUITE

__all__ = [
    "ACTIONS",
    "ARMS",
    "OBSTACLES",
    "TASKS",
    "ArmGymEnv",
    "SafeGymEnv",
    "SafeGymWrapper",
    "combination",
]


def _register() -> None:
    combined = {
        "".join(parts): combination(*parts) for parts in product(ARMS, TASKS, OBSTACLES, ACTIONS)
    }
    suite = {name: task.arguments for name, task in SUITE.items()}
    for name, arguments in {**combined, **suite}.items():
        gymnasium.register(
            f"torchrl_safe/{name}-v0",
            entry_point=f"{__name__}:{ArmGymEnv.__name__}",
            kwargs=arguments,
        )


_register()
