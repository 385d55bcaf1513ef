"""How much room the shield leaves, beside one wall, by hand."""

import numpy as np
import pytest
from states import make_state

from torchrl_safe.envs import Nearest, Shield
from torchrl_safe.envs.shield.motion import safe_motion
from torchrl_safe.envs.shield.shield import _needed, _Pairs

# Share of the room above the margin, 20 / s over 1/20 s.
SHARE = 1 - np.exp(-1)


class Wall:
    """A joint, and fingers, that take as much off one distance as they move.

    The joint lifts the tool by ``lift``, m/rad.
    """

    def __init__(self, distance, *, other=0, fingers=0, lift=0.0):
        self.distance, self.other, self.fingers = distance, np.array([other]), fingers
        self.lift = lift

    def nearest(self, rows, angles, fingers):
        ones = np.ones((len(rows), 1, 3))
        moved = angles + fingers.sum(axis=1, keepdims=True)
        jacobian = -np.ones((len(rows), 1, 1 + self.fingers))
        point = ones * (0.3, 0, 0)
        return Nearest(self.distance - moved, ones * (0, 1, 0), point, jacobian, self.other)

    def jacobian(self, angles):
        return np.tile([[0.0], [0.0], [self.lift], [0.0], [0.0], [0.0]], (len(angles), 1, 1))


def shielded(world, asked=0.2, fingers=0.0, state=None, **settings):
    one, held = np.zeros((2, 1)), np.zeros((2, world.fingers))
    fields = {
        "joint_position": one,
        "joint_velocity": one,
        "finger_position": held,
        "joint_lower": np.array([-9.0]),
        "joint_upper": np.array([9.0]),
        **(state or {}),
    }
    shield = Shield(**{"acceleration": 1e4, **settings})
    return shield(
        one + asked,
        held + fingers,
        make_state(**fields),
        world,
        longest=np.array([0.2]),
        duration=0.05,
    )


def test_the_table_has_a_margin_of_its_own():
    done = shielded(Wall(0.15, other=1), margin=0.02, table=0.1)
    np.testing.assert_allclose(done.joints, SHARE * 0.05)
    assert not shielded(Wall(0.07, other=1), margin=0.02, table=0.1).braked.any()


def test_what_goes_away_may_stop():
    done = shielded(Wall(0.15), state={"obstacle_velocity": np.tile([0, -0.4, 0], (2, 1, 1))})
    np.testing.assert_allclose(done.joints, SHARE * 0.13)


@pytest.mark.parametrize(("speed", "comes"), [(0.4, 0.02 + 0.01), (0.0, 0.0), (-0.4, 0.0)])
def test_what_moves_may_become_faster(speed, comes):
    """By 8 m/s^2, half of it on average over the 50 ms of the step; what rests does not."""
    state = {"obstacle_velocity": np.tile([0, speed, 0], (2, 1, 1))}
    done = shielded(Wall(0.15), state=state, obstacle_acceleration=8.0)
    np.testing.assert_allclose(done.joints, SHARE * 0.13 - comes)


def test_it_can_stop_before_what_comes_is_there():
    """At 0.4 m/s: the joint turns by x in this step, x - brake in the next and so on."""
    state = {"obstacle_velocity": np.tile([0, 0.4, 0], (2, 1, 1))}
    x = shielded(Wall(0.15), state=state, rate=1e3, acceleration=20).joints
    brake = 20 * 0.05**2 / 3
    np.testing.assert_allclose((x / 2 + 0.02) * (x / brake + 1), 0.13)


def test_what_turns_comes_nearer():
    """2 rad/s, 0.2 m off the axis."""
    spin = {
        "obstacle_position": np.tile([0.1, 0, 0], (2, 1, 1)),
        "obstacle_angular_velocity": np.tile([0, 0, 2.0], (2, 1, 1)),
    }
    done = shielded(Wall(0.15), state=spin)
    np.testing.assert_allclose(done.joints, SHARE * 0.13 - 2 * 0.2 * 0.05)


def test_it_can_stop_before_what_may_come_is_there():
    """At 2 m/s, as above."""
    x = shielded(Wall(0.15), obstacle_speed=2.0, rate=1e3, acceleration=20).joints
    brake = 20 * 0.05**2 / 3
    np.testing.assert_allclose((x / 2 + 0.1) * (x / brake + 1), 0.13)


def test_what_may_come_is_not_fled_from():
    """At 2 m/s it could be there within the step."""
    done = shielded(Wall(0.05), asked=0.0, obstacle_speed=2.0)
    np.testing.assert_array_equal(done.joints, 0)
    assert not done.braked.any()


def test_the_table_does_not_come():
    done = shielded(Wall(0.15, other=1), obstacle_speed=2.0)
    np.testing.assert_allclose(done.joints, SHARE * 0.13)


@pytest.mark.parametrize("sign", [1, -1])
def test_targets_keep_to_joint_limits(sign):
    limits = {"joint_lower": np.array([-0.1]), "joint_upper": np.array([0.1])}
    done = shielded(Wall(5.0), asked=sign * 0.2, reach=9.0, state=limits)
    np.testing.assert_allclose(done.joints, sign * 0.1)


def test_fingers_stay_while_it_brakes():
    done = shielded(Wall(0.005, fingers=1), fingers=0.03)
    assert done.braked.all()
    np.testing.assert_array_equal(done.fingers, 0)


def test_fingers_use_up_room_too():
    done = shielded(Wall(0.15, fingers=1), fingers=0.01)
    np.testing.assert_allclose(done.joints, SHARE * 0.13 - 0.01)


def test_the_reach_is_more_than_the_margin_of_the_table():
    with pytest.raises(ValueError, match=r"reach must be larger than .* and table = 0.6"):
        Shield(table=0.6)


def test_each_shape_may_use_up_what_its_nearest_pair_may():
    zero, room = np.zeros((1, 2)), np.full((1, 2), 0.02)
    fingers, other = np.zeros((1, 2, 0)), np.array([0, 0])
    then = _Pairs(room, zero, zero[..., None], fingers, other)
    np.testing.assert_allclose(_needed(np.array([[0.01, 0.05]]), then), [[-0.01, -0.01]])


class Corner:
    """Two joints take as much off a distance; the first moves the tool along x, 1 m/rad."""

    fingers = 0

    def __init__(self, distance):
        self.distance = distance

    def nearest(self, rows, angles, fingers):
        ones = np.ones((len(rows), 1, 3))
        distance = self.distance - angles.sum(axis=1, keepdims=True)
        return Nearest(distance, ones * (0, 1, 0), ones, -ones[..., :2], np.array([0]))

    def jacobian(self, angles):
        return np.eye(6, 2) * (1, 0) + np.zeros((len(angles), 1, 1))


def cornered(distance, asked, velocity=None, **settings):
    zero, limits = np.zeros((2, 2)), np.full(2, 9.0)
    state = make_state(
        joint_position=zero,
        joint_velocity=zero if velocity is None else velocity,
        joint_lower=-limits,
        joint_upper=limits,
    )
    shield = Shield(**{"acceleration": 1e4, **settings})
    longest = np.full(2, 0.2)
    world = Corner(distance)
    return shield(zero + asked, zero[:, :0], state, world, longest=longest, duration=0.05)


def test_joints_that_move_the_tool_where_it_is_to_go_give_way_less():
    """With the weight k the first gives way 1 / (1 + k^2) times as much as the second."""
    done = cornered(0.05, (0.1, 0.15), margin=0, table=0, rate=1e3, tool_weight=3.0)
    np.testing.assert_allclose(done.joints, [[0.1 - 0.2 / 11, 0.15 - 0.2 * 10 / 11]] * 2)


@pytest.mark.parametrize(
    ("asked", "velocity", "change"),
    [
        # Of the first, 0.0125 rad are sure and 0.0875 are not; of the second, a quarter of what is
        # sure counts, 0.003125. With the share x both miss 0.090625 x, half of 0.05 m.
        ((-0.1, 0.0), (0.0, 0.0), (-0.0125 - 0.0875 * 0.025 / 0.090625, 0.0)),
        # Equal wishes have equal parts.
        ((-0.1, 0.1), (0.0, 0.0), (-0.0125 - 0.0125, 0.0125 + 0.0125)),
        # There is room for these.
        ((-0.03, 0.0), (0.0, 0.0), (-0.03, 0.0)),
        ((-0.1, 0.0), (-2.0, 0.0), (-0.1, 0.0)),
        # Joints can turn by 0.2 rad: more is not asked for.
        ((-0.5, 0.2), (0.0, 0.0), (-0.0125 - 0.0125, 0.0125 + 0.0125)),
    ],
)
def test_what_joints_may_miss_uses_up_no_more_than_half_of_the_room(asked, velocity, change):
    """Motors change velocities by 5 rad/s^2 for sure, 0.0125 rad, and by more perhaps."""
    settings = {"margin": 0, "table": 0, "rate": 1e3, "acceleration": 5.0, "tool_weight": 0.0}
    done = cornered(0.05, asked, np.array([velocity, velocity]), **settings)
    np.testing.assert_allclose(done.joints, [change] * 2)


def test_a_pressed_arm_takes_the_shortest_way_out():
    """Whatever its tool weighs."""
    done = cornered(0.005, 0.0, tool_weight=10.0)
    assert done.braked.all()
    np.testing.assert_allclose(done.joints, -SHARE * 0.015 / 2)


def test_a_pressed_arm_goes_down_where_nothing_else_is_left():
    """Its one joint turns down or into the obstacle."""
    done = shielded(Wall(0.005, lift=1.0))
    assert done.braked.all()
    np.testing.assert_allclose(done.joints, -SHARE * 0.015)


@pytest.mark.parametrize(
    ("last", "share"), [((-1.0, -1.0), 0.03 / 2.03), ((-0.2, 0.0), 0.03 / 0.23)]
)
def test_distances_give_way_by_the_same_share_while_an_arm_brakes(last, share):
    """One asks for at least 0.02 rad, the other for at most -0.01, and the third is far away."""
    rows, least = np.array([[[1.0], [-1.0], [0.0]]]), np.array([[0.02, 0.01, 0.0]])
    bounds, comes = np.array([[1.0]]), np.zeros((1, 3), dtype=bool)
    change, solved, braked = safe_motion(
        np.array([[0.5]]), rows, least, np.array([[*last, -np.inf]]), comes, -bounds, bounds, None
    )
    assert solved.all()
    assert braked.all()
    np.testing.assert_allclose(change, [[0.02 - share * (0.02 - last[0])]], atol=1e-6)


@pytest.mark.parametrize(
    ("least", "last", "found"),
    [
        # The first may not be missed, the second by no more than 0.01.
        ((0.02, 0.01), (0.02, 0.0), False),
        # They may be missed by fractions of a millimetre.
        ((0.0001, 0.0001), (-0.0003, -0.0003), True),
    ],
)
def test_an_arm_stands_still_only_where_the_last_would_be_missed(least, last, found):
    rows, bounds = np.array([[[1.0], [-1.0]]]), np.array([[1.0]])
    comes = np.zeros((1, 2), dtype=bool)
    change, solved, braked = safe_motion(
        np.zeros((1, 1)), rows, np.array([least]), np.array([last]), comes, -bounds, bounds, None
    )
    assert solved.all() == found
    assert braked.all()
    if found:
        assert ((rows @ change[:, :, None])[:, :, 0] >= last).all()


class Bend:
    """A joint whose distances are others, with other gradients, once it has turned."""

    fingers = 0

    def __init__(self, here, there, gradient, before=0.0):
        self.here, self.there = np.array(here), np.array(there)
        self.gradient, self.before = np.array(gradient), np.array(before)

    def nearest(self, rows, angles, fingers):
        turned = angles != 0
        distance = np.where(turned, self.there, self.here)
        point = np.zeros((*distance.shape, 3))
        jacobian = np.where(turned, self.gradient, self.before)[..., None]
        other = np.zeros(len(self.there), int)
        normal = point + np.array([0, 1, 0])
        return Nearest(distance, normal, point, jacobian, other)

    def jacobian(self, angles):
        return np.zeros((len(angles), 6, 1))


@pytest.mark.parametrize(
    ("world", "brake"),
    [
        # One distance is new at the end of the step.
        (Bend([0.01, np.inf], [9.0, 0.05], [0.0, -1.0]), 1.0),
        # It shrinks only at the end of the step, so that a quarter is left.
        (Bend([0.01], [0.05], [-1.0]), 0.25),
    ],
)
def test_another_step_like_this_has_to_be_safe(world, brake):
    """Slower by a third of 10 rad/s^2; where it ends there are 5 cm to stop in."""
    done = shielded(world, margin=0, table=0, rate=1e3, acceleration=10)
    brake *= 10 * 0.05**2 / 3
    stops = np.sqrt(brake**2 / 4 + 2 * brake * 0.05) - brake / 2
    np.testing.assert_allclose(done.joints, stops + brake)


@pytest.mark.parametrize(
    "comes",
    [{"state": {"obstacle_velocity": np.tile([0, 0.4, 0], (2, 1, 1))}}, {"obstacle_speed": 0.4}],
)
def test_the_end_of_a_step_counts_what_comes_twice(comes):
    """In this step, at 0.4 m/s, and in the next: a quarter of the braking is left, as above."""
    world = Bend([0.015], [0.06], [-1.0])
    done = shielded(world, margin=0, table=0, rate=1e3, acceleration=10, **comes)
    brake = 10 * 0.05**2 / 3 / 4
    stops = np.sqrt((brake / 2 + 0.02) ** 2 + 2 * brake * (0.06 - 2 * 0.02)) - brake / 2
    np.testing.assert_allclose(done.joints, stops + brake - 0.02)


def test_what_shrinks_faster_at_the_end_of_a_step_uses_up_braking():
    """By 2 %; the shield looks at the end because something else is near."""
    brake = 10 * 0.05**2 / 3
    asked = np.sqrt(brake**2 / 4 + 2 * brake * 0.15) - brake / 2
    world = Bend([0.001, 0.15], [0.001, 0.15 - asked], [0.0, -1.02], before=[0.0, -1.0])
    done = shielded(world, margin=0, table=0, rate=1e3, acceleration=10)
    left = 1.02 * brake - 0.02 * asked
    stops = np.sqrt(left**2 / 4 + 2 * left * (0.15 - asked)) - left / 2
    assert stops + left < 1.02 * asked
    np.testing.assert_allclose(done.joints, (stops + left) / 1.02)


def test_it_brakes_for_what_only_the_end_of_the_step_shows():
    done = shielded(Bend(0.01, [-0.3, -0.3], [1.0, -1.0]), margin=0, table=0)
    assert done.braked.all()
    np.testing.assert_array_equal(done.joints, 0)
