"""ArmEnv as an environment: specs, seeds, resets, time limits."""

import numpy as np
import pytest
import torch
from scripted import fly, over, straight
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs
from worlds import ARMS, Places, combinations, step

from torchrl_safe.envs import (
    ArmEnv,
    Bullet,
    CartesianDelta,
    Collision,
    Cylinder,
    InFront,
    JointDelta,
    NoObstacles,
    Reach,
    Region,
    Scene,
)

both_engines = pytest.mark.usefixtures("engine")
ROLLING = InFront(shape=Cylinder(mass=1.0))
WORLDS = {"one": 1, "three": 3}
ACTIONS = {"cartesian": CartesianDelta(), "joint": JointDelta()}
LAYOUTS = {"fixed": InFront(), "free": ROLLING, "none": NoObstacles()}
each_action = pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)


def always(value):
    """A cost that is the same everywhere."""
    return lambda state: np.full(len(state.goal), float(value))


def towards(env, point):
    """The action that moves the tool towards a point, as fast as it can."""
    delta = torch.as_tensor(point - env.arm_state.ee_position) / env.action_mode.step
    return delta.float().clamp(-1, 1)


@pytest.mark.parametrize(
    ("arm", "num_envs", "action", "obstacles"),
    combinations(ARMS, WORLDS, ACTIONS, LAYOUTS),
)
def test_specs(make_env, arm, num_envs, action, obstacles):
    num_envs = WORLDS[num_envs]
    costs = {"collision": Collision(), "one": always(1)}
    env = make_env(
        ArmEnv,
        ARMS[arm],
        num_envs=num_envs,
        action=ACTIONS[action],
        obstacles=LAYOUTS[obstacles],
        costs=costs,
        max_episode_steps=5,
    )
    check_env_specs(env)
    assert env.batch_size == (num_envs,)
    assert env.cost_names == ("collision", "one")
    assert env.full_reward_spec["cost"].shape == (num_envs, 2)
    assert env.full_reward_spec["cost"].dtype == torch.float32
    assert env.control_rate == 20


def test_observation_fields(make_env):
    env = make_env(ArmEnv, num_envs=2, seed=0)
    observation = env.reset()["observation"].numpy()
    state, fields = env.arm_state, env.observation_fields
    assert observation.shape[1] == max(field.stop for field in fields.values())
    np.testing.assert_allclose(observation[:, fields["ee_position"]], state.ee_position, atol=1e-6)
    np.testing.assert_allclose(
        observation[:, fields["to_goal"]], state.goal - state.ee_position, atol=1e-6
    )
    np.testing.assert_allclose(
        observation[:, fields["to_obstacle"]],
        state.obstacle_position[:, 0] - state.ee_position,
        atol=1e-6,
    )
    np.testing.assert_allclose(observation[:, fields["obstacle_size"]], [[0.05, 0.05, 0.1]] * 2)


def test_observation_of_two_obstacles(make_env):
    """All of the first, then all of the second, each relative to the tool."""
    places = [[0.7, 0.3, 0.1], [0.7, -0.4, 0.15]]
    layout = Places(Cylinder(), Cylinder(radius=0.06, height=0.3), at=places)
    env = make_env(ArmEnv, num_envs=2, obstacles=layout)
    observation = env.reset()["observation"].numpy()
    state, fields = env.arm_state, env.observation_fields
    relative = [np.subtract(places, tool).flatten() for tool in state.ee_position]
    np.testing.assert_allclose(observation[:, fields["to_obstacle"]], relative, atol=1e-6)
    sizes = [[0.05, 0.05, 0.1, 0.06, 0.06, 0.15]] * 2
    np.testing.assert_allclose(observation[:, fields["obstacle_size"]], sizes, atol=1e-6)


def test_observation_of_motion(make_env):
    env = make_env(ArmEnv, obstacles=NoObstacles(), seed=0)
    env.reset()
    observation = step(env, torch.tensor([[1.0, -1.0, 0.5]]))["observation"][0].numpy()
    for name in ("joint_position", "joint_velocity", "ee_velocity"):
        field = observation[env.observation_fields[name]]
        np.testing.assert_allclose(field, getattr(env.arm_state, name)[0], atol=1e-5)


@both_engines
@pytest.mark.parametrize("obstacles", [InFront(), ROLLING], ids=["fixed", "free"])
@each_action
def test_same_seed_same_rollout_bit_for_bit(make_env, action, obstacles):
    """In a fresh environment, and again in one that has run before: resets forget everything."""
    settings = {"num_envs": 3, "action": action, "obstacles": obstacles, "max_episode_steps": 9}
    first = make_env(ArmEnv, **settings, seed=7)
    actions = torch.rand(40, *first.action_spec.shape, generator=torch.manual_seed(0)) * 2 - 1

    def play(env):
        queue = iter(actions)
        return env.rollout(40, lambda td: td.set("action", next(queue)), break_when_any_done=False)

    one = play(first)
    second = make_env(ArmEnv, **settings, seed=99)
    play(second)
    second.set_seed(7)
    two = play(second)
    assert one["next", "done"].any()
    for key in one.keys(True, True):
        assert torch.equal(one[key], two[key]), key


@both_engines
def test_reset_forgets_the_obstacle_it_is_pushing(make_env):
    """Bullet keeps contact points over a restored state, unless they are taken away first."""

    def push(env, steps):
        env.reset()
        for _ in range(steps):
            result = step(env, towards(env, env.arm_state.obstacle_position[:, 0]))
            yield result["observation"], result["cost"]

    fresh, used = (make_env(ArmEnv, obstacles=ROLLING, seed=seed) for seed in (7, 99))
    *_, (_, cost) = push(used, 20)
    assert cost.all(), "it is reset while it touches"
    used.set_seed(7)
    for expected, got in zip(push(fresh, 25), push(used, 25), strict=True):
        assert all(map(torch.equal, expected, got))


@both_engines
def test_other_seed_other_goals(make_env):
    env = make_env(ArmEnv, num_envs=2, seed=0)
    goals = []
    for seed in (0, None, 1):
        if seed is not None:
            env.set_seed(seed)
        env.reset()
        goals.append(env.arm_state.goal)
    goals = np.concatenate(goals)
    assert len(np.unique(goals, axis=0)) == len(goals) == 6


@both_engines
def test_rows_are_seeded_as_workers_are(make_env):
    """Two environments of one world, seeded in TorchRL's chain, are one environment of two."""
    both = make_env(ArmEnv, num_envs=2, seed=3)
    one = make_env(ArmEnv)
    two = make_env(ArmEnv)
    following = two.set_seed(one.set_seed(3))
    assert following == both.set_seed(3)
    for env in (both, one, two):
        env.reset()
    np.testing.assert_array_equal(
        both.arm_state.goal, np.concatenate([one.arm_state.goal, two.arm_state.goal])
    )


def test_static_seed_stays(make_env):
    env = make_env(ArmEnv)
    assert env.set_seed(3, static_seed=True) == 3
    assert env.set_seed(3) != 3


def test_costs_keep_their_order(make_env):
    env = make_env(ArmEnv, num_envs=2, costs={"two": always(2), "one": always(1)})
    env.reset()
    assert step(env, torch.zeros(2, 3))["cost"].tolist() == [[2, 1]] * 2
    assert env.cost_names == ("two", "one")


@both_engines
def test_partial_reset_leaves_the_other_worlds_alone(make_env):
    """Row 1 must go on as if row 0 had never been reset: its simulator, not only its output."""
    settings = {"num_envs": 2, "obstacles": ROLLING, "seed": 5}
    alone, disturbed = make_env(ArmEnv, **settings), make_env(ArmEnv, **settings)
    for env in (alone, disturbed):
        env.reset()
    mask = torch.tensor([[True], [False]])
    for index in range(12):
        goal = alone.arm_state.goal
        action = towards(alone, goal)
        action[0] = 0
        expected, got = step(alone, action), step(disturbed, action)
        for key in ("observation", "reward", "cost"):
            assert torch.equal(expected[key][1], got[key][1]), (index, key)
        if index % 3 == 2:
            before = got["observation"][1].clone()
            state = disturbed.arm_state
            after = disturbed.reset(TensorDict({"_reset": mask, **got}, batch_size=[2]))
            assert torch.equal(after["observation"][1], before)
            for field in ("joint_velocity", "obstacle_position", "contact_distance"):
                kept = getattr(disturbed.arm_state, field)[1]
                np.testing.assert_array_equal(kept, getattr(state, field)[1])
            assert (disturbed.arm_state.contact_distance[0] == np.inf).all()
    # Row 0 did start again, with a new goal.
    assert not np.array_equal(alone.arm_state.goal[0], disturbed.arm_state.goal[0])
    assert np.array_equal(alone.arm_state.goal[1], disturbed.arm_state.goal[1])


@both_engines
def test_the_state_tells_the_time(make_env):
    """Each world counts its own episode, for tasks, costs and observations alike."""
    seen = {}
    costs = {"step": lambda s: s.step, "seconds": lambda s: s.time}

    def observation(state):
        seen["observed"] = state.step.tolist()
        return {"time": state.time[:, None]}

    env = make_env(ArmEnv, num_envs=2, costs=costs, observation=observation, frame_skip=24, seed=0)
    assert not env.reset()["observation"].any()
    assert seen["observed"] == env.arm_state.step.tolist() == [0, 0]
    for count in (1, 2, 3):
        result = step(env, torch.zeros(2, 3))
        # 24 substeps of 1/240 s.
        expected = torch.tensor([[count, count * 0.1]] * 2)
        torch.testing.assert_close(result["cost"], expected)
        assert seen["observed"] == [count, count]
    before = env.arm_state
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, batch_size=[2]))
    assert env.arm_state.step.tolist() == [0, 3]
    assert before.step.tolist() == [3, 3], "a state does not change afterwards"
    torch.testing.assert_close(
        step(env, torch.zeros(2, 3))["cost"], torch.tensor([[1, 0.1], [4, 0.4]])
    )
    other = make_env(ArmEnv, num_envs=2, costs=costs, observation=observation, frame_skip=24)
    other.load_state_dict(env.state_dict())
    assert other.arm_state.step.tolist() == [1, 4]
    np.testing.assert_allclose(other.arm_state.time, [0.1, 0.4])
    assert np.issubdtype(other.arm_state.step.dtype, np.integer)


def test_a_reward_of_a_change_always_has_a_state_before(make_env):
    """Also in first steps, and when the environment is made, which tries the reward."""

    class Nearer(Reach):
        def reward(self, state):
            before, now = (s.goal - s.ee_position for s in (state.previous, state))
            return np.linalg.norm(before, axis=1) - np.linalg.norm(now, axis=1)

    env = make_env(ArmEnv, task=Nearer(), obstacles=NoObstacles(), num_envs=2, seed=0)
    env.reset()
    for _ in range(3):
        reward = step(env, towards(env, env.arm_state.goal))["reward"]
        assert ((reward > 0) & (reward < 0.1)).all()
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, batch_size=[2]))
    reward = step(env, towards(env, env.arm_state.goal))["reward"]
    assert ((reward > 0) & (reward < 0.1)).all(), "not from where the last episode ended"


def test_time_limit_truncates(make_env):
    env = make_env(ArmEnv, num_envs=2, max_episode_steps=3, seed=0)
    rollout = env.rollout(3, lambda td: td.set("action", torch.zeros(2, 3)))
    truncated = rollout["next", "truncated"].squeeze(-1)
    assert truncated.tolist() == [[False, False, True]] * 2
    assert torch.equal(rollout["next", "done"].squeeze(-1), truncated)
    assert not rollout["next", "terminated"].any()
    assert not rollout["next", "success"].any()


def test_success_at_the_time_limit_is_no_truncation(make_env):
    """Else a critic would bootstrap from a state in which the task is done."""
    home = (0.35, 0, 0.2)
    task = Reach(Region(home, home))
    env = make_env(ArmEnv, task=task, obstacles=NoObstacles(), max_episode_steps=1)
    assert not env.reset()["success"], "not before the first step"
    result = step(env, torch.zeros(1, 3))
    for key, value in (("success", 1), ("terminated", 1), ("truncated", 0), ("done", 1)):
        assert result[key].item() == value, key


def test_success_terminates(make_env):
    env = make_env(ArmEnv, num_envs=2, obstacles=NoObstacles(), seed=0)
    env.reset()
    for _ in range(40):
        result = step(env, towards(env, env.arm_state.goal))
        distance = np.linalg.norm(env.arm_state.ee_position - env.arm_state.goal, axis=1)
        np.testing.assert_allclose(result["reward"][:, 0], -distance, rtol=1e-5)
        assert result["success"].squeeze(-1).tolist() == (distance < 0.05).tolist()
        assert torch.equal(result["terminated"], result["success"])
        assert torch.equal(result["done"], result["success"])
        if result["success"].all():
            break
    else:
        pytest.fail("the tool never arrived")


@both_engines
def test_terminal_observation_is_true(make_env):
    """After an automatic reset, "next" still holds where the episode ended."""
    env = make_env(ArmEnv, max_episode_steps=4, obstacles=NoObstacles(), seed=0)
    rollout = env.rollout(
        8, lambda td: td.set("action", torch.tensor([[1.0, 0, 0]])), break_when_any_done=False
    )
    x = env.observation_fields["ee_position"].start
    assert rollout["next", "observation"][0, 3, x] > rollout["observation"][0, 3, x] + 0.02
    assert rollout["observation"][0, 4, x] == rollout["observation"][0, 0, x]
    assert rollout["next", "truncated"].flatten().tolist() == [False, False, False, True] * 2


class Held(CartesianDelta):
    """Keeps the joint targets of an action for twelve steps."""

    def targets(self, action, state, simulator):
        if state.step[0] % 12 == 0:
            object.__setattr__(self, "kept", super().targets(action, state, simulator))
        return self.kept


def test_touch_in_the_middle_of_a_control_step_counts(make_env):
    """Each substep is read: a touch that is over at the end of the control step still costs."""
    settings = {"physics": Bullet(motor_gain=0.1), "scene": Scene(motor_limits=False), "seed": 0}
    coarse = make_env(ArmEnv, **settings)
    # The same motion, one substep at a time.
    fine = make_env(ArmEnv, action=Held(), frame_skip=1, max_episode_steps=480, **settings)
    coarse.reset()
    fine.reset()
    lost, cost = 0, 0
    for index in range(40):
        # Into the obstacle, and off it again as soon as it was touched.
        aim = np.array([[0.35, 0, 0.3]]) if cost else coarse.arm_state.obstacle_position[:, 0]
        action = towards(coarse, aim)
        cost = step(coarse, action)["cost"].item()
        costs = [step(fine, action)["cost"].item() for _ in range(12)]
        assert cost == max(costs), index
        lost += cost > costs[-1]
    assert lost > 0


@both_engines
def test_states_and_resets_do_not_remember_touches(make_env):
    env = make_env(ArmEnv, seed=0)
    env.reset()
    start = env.arm_state
    while not step(env, towards(env, env.arm_state.obstacle_position[:, 0]))["cost"]:
        assert env.arm_state.step < 40
    # A state is a record: what comes after it does not change it.
    assert start.contact_distance == np.inf
    env.reset()
    assert env.arm_state.contact_distance == np.inf


@pytest.mark.integration
@both_engines
def test_the_obstacle_stands_in_the_way_and_can_be_passed(make_env):
    """Straight at the goal, every episode collides; over the obstacle, all succeed at no cost."""
    env = make_env(ArmEnv, num_envs=32, seed=0)
    assert (fly(env, straight)[2] > 0).all()
    success, _, cost = fly(env, over)
    assert success.all()
    assert not cost.any()


def test_actions_are_clipped(make_env):
    settings = {"num_envs": 1, "seed": 0}
    one, two = make_env(ArmEnv, **settings), make_env(ArmEnv, **settings)
    one.reset(), two.reset()
    big, unit = torch.tensor([[5.0, -7.0, 0.5]]), torch.tensor([[1.0, -1.0, 0.5]])
    assert torch.equal(step(one, big)["observation"], step(two, unit)["observation"])


def test_action_may_be_of_any_precision(make_env):
    env = make_env(ArmEnv, num_envs=1)
    action = torch.full((1, 3), 0.5)
    seen = []
    for dtype in (torch.float32, torch.bfloat16):
        env.set_seed(0)
        env.reset()
        tensordict = TensorDict({"action": action.to(dtype)}, batch_size=[1])
        seen.append(env.step(tensordict)["next", "observation"])
    assert torch.equal(*seen)  # A half has no other value in any of them.


def test_numpy_integers_are_integers(make_env):
    env = make_env(ArmEnv, num_envs=np.int64(2), frame_skip=np.int32(6))
    assert env.num_envs == 2
    assert env.control_rate == 40


def test_it_shows_what_it_is_made_of(make_env):
    shown = repr(make_env(ArmEnv, num_envs=2, obstacles=NoObstacles()))
    for part in ("num_envs=2", "CartesianDelta(step=0.05", "obstacles=NoObstacles()", "collision"):
        assert part in shown


def test_default_dtype_does_not_matter(make_env):
    torch.set_default_dtype(torch.float64)
    try:
        env = make_env(ArmEnv, num_envs=2, seed=0)
        check_env_specs(env)
        assert env.rollout(2)["next", "cost"].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


def test_device_is_that_of_the_tensors(make_env):
    env = make_env(ArmEnv, num_envs=2, device="cpu", seed=0)
    rollout = env.rollout(2)
    assert rollout.device == torch.device("cpu")


@both_engines
@each_action
def test_velocities_are_derivatives(make_env, action):
    """At one substep a control step, velocity times 1/240 s is the change of position."""
    env = make_env(ArmEnv, action=action, frame_skip=1, obstacles=NoObstacles(), seed=0)
    env.reset()
    for _ in range(30):
        before = env.arm_state
        step(env, torch.full(env.action_spec.shape, 0.05))
        after = env.arm_state
        for position, velocity in (
            ("ee_position", "ee_velocity"),
            ("joint_position", "joint_velocity"),
        ):
            change = (getattr(after, position) - getattr(before, position)) * 240
            np.testing.assert_allclose(getattr(after, velocity), change, atol=0.02)
    assert np.abs(env.arm_state.ee_velocity).max() > 0.1
