"""PyBullet's worlds, for the tests that look behind the protocol."""

from torchrl_safe.envs import PANDA, Bullet, Scene
from torchrl_safe.envs.physics.bullet.world import World

SCENE = Scene()


def make_world(arm=PANDA, scene=SCENE, shapes=(), objects=(), **options):
    """A world of an arm, obstacles and objects; with options of Bullet."""
    return World(arm, scene, Bullet(**options), shapes, objects)


def worlds_of(env):
    """The worlds of an ArmEnv."""
    return env._simulator.worlds
