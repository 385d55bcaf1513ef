"""Physics engines behind one protocol: see :mod:`torchrl_safe.envs.physics.simulator`."""
