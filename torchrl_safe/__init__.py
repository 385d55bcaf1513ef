"""Safe reinforcement learning components for TorchRL.

Nothing heavy is imported here. ``torchrl_safe.objectives`` needs only TorchRL. The arms of
``torchrl_safe.envs`` also need a physics engine, the extra ``arms`` or ``mujoco``, and their files,
which come with ``arms`` and ``more-arms``.
"""

__version__ = "0.1.0"
