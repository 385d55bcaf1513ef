"""
An arm of your own, from a URDF
===============================

You write the URDF of a six-joint arm, find its home pose, choose its goals, and check that it
reaches them. At the end the arm stands on the table, with a gripper, an obstacle and a target, and
every task, cost and algorithm of the library works with it.

If you have a URDF already, skip the first section and use its path. This page runs in a quarter of
a minute.
"""

# %%
# A URDF
# ------
#
# An arm is a chain of links and joints. This one has cylinders for links. Each link begins at its
# joint and points along z. Turning joints about z, y, y, z, y, z is the layout of most six-joint
# robots.

import tempfile
from dataclasses import replace
from pathlib import Path
from textwrap import fill

import matplotlib.pyplot as plt
import torch

from torchrl_safe.envs import (
    PARALLEL_GRIPPER,
    ArmEnv,
    ArmModel,
    Bullet,
    Collision,
    MuJoCo,
    NoObstacles,
    Region,
    Speed,
    find_home,
)

torch.set_num_threads(1)

LINKS = [  # name, length (m), radius (m), mass (kg), axis of the joint where it begins
    ("shoulder", 0.20, 0.060, 4.0, "0 0 1"),
    ("upper_arm", 0.35, 0.045, 3.0, "0 1 0"),
    ("forearm", 0.30, 0.040, 2.0, "0 1 0"),
    ("wrist", 0.08, 0.035, 1.0, "0 0 1"),
    ("hand", 0.08, 0.035, 0.8, "0 1 0"),
    ("flange", 0.04, 0.030, 0.3, "0 0 1"),
]

# %%
# Joint limits (rad), speeds (rad/s) and efforts (Nm) are read from the file, so write them with
# care: the simulated motors keep to them.

LINK = """
  <link name="{name}">
    <inertial>
      <origin xyz="0 0 {middle}"/>
      <mass value="{mass}"/>
      <inertia ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual>
      <origin xyz="0 0 {middle}"/>
      <geometry><cylinder length="{length}" radius="{radius}"/></geometry>
    </visual>
    <collision>
      <origin xyz="0 0 {middle}"/>
      <geometry><cylinder length="{length}" radius="{radius}"/></geometry>
    </collision>
  </link>"""
JOINT = """
  <joint name="{name}_joint" type="revolute">
    <parent link="{parent}"/>
    <child link="{name}"/>
    <origin xyz="0 0 {start}"/>
    <axis xyz="{axis}"/>
    <limit lower="-2.8" upper="2.8" effort="150" velocity="{speed}"/>
  </joint>"""


def link(name, length, radius, mass):
    across, along = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    sizes = {"length": length, "radius": radius, "middle": length / 2}
    return LINK.format(name=name, mass=mass, across=across, along=along, **sizes)


def write_urdf(path, speed):
    parts, parent, start = [link("base", 0.02, 0.08, 5.0)], "base", 0.0
    for name, length, radius, mass, axis in LINKS:
        parts.append(link(name, length, radius, mass))
        parts.append(JOINT.format(name=name, parent=parent, start=start, axis=axis, speed=speed))
        parent, start = name, length
    path.write_text("\n".join(['<robot name="six">', *parts, "</robot>"]))
    return str(path)


folder = Path(tempfile.mkdtemp())
urdf = write_urdf(folder / "six.urdf", speed=3.0)
print(Path(urdf).read_text()[:420], "...")

# %%
# The home pose
# -------------
#
# An ``ArmModel`` is the URDF, the name of the last link, and the joint
# angles at the start of an episode. Guess angles with the elbow up and the wrist down. The
# gripper is one of ours. ``position`` puts it at the end of the flange, whose frame is 0.04 m
# further in.

guess = ArmModel(
    urdf,
    ee_link="flange",
    home=(0.0, -0.3, 1.9, 0.0, 1.5, 0.0),
    gripper=replace(PARALLEL_GRIPPER, position=(0.0, 0.0, 0.04)),
)

# %%
# ``find_home`` searches for the angles that put the tool where you want
# it. Two things can go wrong here. Both raise a ``ValueError`` that says why. The first is a pose
# out of reach:

try:
    find_home(guess, position=(1.5, 0.0, 0.2))
except ValueError as error:
    print(fill(str(error), 84))

# %%
# The second is a tool that points down in the wrong way. ``(1, 0, 0, 0)``, the default, and ``(0,
# 1, 0, 0)`` both point down, half a turn about the vertical apart. On this flange only one of
# them is within the limits of the last joint:

for orientation in ((1, 0, 0, 0), (0, 1, 0, 0)):
    try:
        home = find_home(guess, position=(0.35, 0.0, 0.2), orientation=orientation)
        print(orientation, "gives", [round(angle, 2) for angle in home])
    except ValueError as error:
        print(fill(f"{orientation} fails: {error}", 84), "\n")

# %%
# Goals
# -----
#
# ``goals`` is a box that the tool can reach while it points down. Begin at least 0.2 m beyond the
# home position, so that an obstacle fits between. ``ArmEnv`` draws goals from the box, and raises
# an error if one is out of reach however the tool is turned.

arm = replace(guess, home=home, goals=Region(low=(0.55, -0.2, 0.05), high=(0.62, 0.2, 0.15)))

try:
    ArmEnv(replace(arm, goals=Region(low=(0.55, -0.2, 0.05), high=(1.0, 0.2, 0.15))))
except ValueError as error:
    print(fill(str(error), 84))

# %%
# Look at it
# ----------
#
# ``render`` draws every world. The tool points down, the elbow is up, and the obstacle stands
# between tool and target.

env = ArmEnv(arm, num_envs=2, seed=0)
env.reset()
figure, axes = plt.subplots(1, 2, figsize=(10, 4))
for axis, picture in zip(axes, env.render(width=480, height=360), strict=True):
    axis.imshow(picture)
    axis.set_axis_off()
figure.suptitle("The same arm in two worlds")
figure.tight_layout()
env.close()

# %%
# Does it get there?
# ------------------
#
# An arm that moves too slowly cannot reach the goal within the 40 control steps of an episode.
# Nothing warns you, and no algorithm will learn the task. So fly straight to the goal first,
# without obstacles, in both physics engines:


def fly_straight(arm, steps=40, **options):
    env = ArmEnv(arm, num_envs=8, max_episode_steps=steps, seed=0, **options)

    def straight(tensordict):
        to_goal = tensordict["observation"][..., env.observation_fields["to_goal"]]
        return tensordict.set("action", (to_goal / 0.05).clamp(-1, 1))

    rollout = env.rollout(steps, straight, break_when_any_done=False)
    env.close()
    return rollout["next"]


for physics in (Bullet(), MuJoCo()):
    flight = fly_straight(arm, physics=physics, obstacles=NoObstacles())
    print(type(physics).__name__, flight["success"].any(1).float().mean().item())

# %%
# The same arm with joints of 0.2 rad/s never arrives. Give it more time, bring the goals nearer,
# or command less in each step.

slow = replace(arm, urdf=write_urdf(folder / "slow.urdf", speed=0.2))
for steps in (40, 80, 160):
    flight = fly_straight(slow, steps, physics=MuJoCo(), obstacles=NoObstacles())
    print(f"{steps} steps:", flight["success"].any(1).float().mean().item())

# %%
# Use it
# ------
#
# The arm now works wherever the library takes one. Here it flies straight into the obstacle, and
# the costs see it: contact with the obstacle, and a tool faster than 0.5 m/s.

costs = {"collision": Collision(), "speed": Speed(limit=0.5)}
flight = fly_straight(arm, physics=MuJoCo(), costs=costs)
for name, cost in zip(costs, flight["cost"].sum(1).mean(0).tolist(), strict=True):
    print(f"{name}: {cost:.1f} of 40 control steps")

# %%
# Where to go from here
# ---------------------
#
# - Train it: take `the first safe policy <first_policy.html>`_ and pass ``arm`` to ``ArmEnv``.
# - Load a file of yours. Meshes are found relative to the URDF, also through ``package://``
#   paths: `An arm of your own <../howto/arm.html>`_.
# - Nothing is learnt? `Go through this list <../howto/nothing_is_learnt.html>`_.
# - Reference: `Arms <../reference/arms.html>`_.
