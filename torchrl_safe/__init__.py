"""Safe reinforcement learning components for TorchRL.

Nothing heavy is imported here: ``torchrl_safe.objectives`` needs only TorchRL,
the arms of ``torchrl_safe.envs`` also need a physics engine: the ``arms`` or the ``mujoco`` extra.
"""

__version__ = "0.1.0"
