"""Safe reinforcement learning components for TorchRL.

Nothing heavy is imported here: ``torchrl_safe.objectives`` needs only TorchRL,
``torchrl_safe.envs`` also needs the ``arms`` extra (PyBullet).
"""

__version__ = "0.1.0"
