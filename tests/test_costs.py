import numpy as np
import pytest
from states import make_state, make_trace

from torchrl_safe.envs import (
    Collision,
    ContactForce,
    JointLimit,
    Proximity,
    Region,
    Sensing,
    Sensor,
    Speed,
    SpeedAndSeparation,
    Workspace,
)

SENSORS = {
    "table": Collision(table=True),
    "itself": Collision(itself=True),
    "proximity": Proximity(),
    "joint-limit": JointLimit(),
    "speed": Speed(),
    "link-speed": Speed(any_link=True),
    "separation": SpeedAndSeparation(),
    "workspace": Workspace(Region((0, 0, 0), (1, 1, 1))),
}


@pytest.mark.parametrize(
    ("cost", "distances", "expected"),
    [
        (Collision(), [[np.inf], [-0.001]], [0, 1]),
        (Collision(), [[0.0], [1e-9]], [1, 0]),
        (Collision(), [[np.inf, -0.01], [np.inf, np.inf]], [1, 0]),
        (Collision(), [[-0.01, -0.01], [0.5, -0.01]], [1, 1]),
    ],
    ids=["overlap", "boundary", "second-obstacle", "never-more-than-one"],
)
def test_collision(cost, distances, expected):
    np.testing.assert_array_equal(cost(make_state(contact_distance=distances)), expected)


def test_what_is_pushed_is_touched():
    """Bullet pushes where bodies are still a hair apart."""
    state = make_state(contact_distance=[[1e-4], [1e-4]], contact_force=[[0.0], [288.0]])
    np.testing.assert_array_equal(Collision()(state), [0, 1])


def test_collision_without_obstacles_is_free():
    nothing = np.zeros((2, 0))
    state = make_state(contact_distance=nothing, contact_force=nothing)
    np.testing.assert_array_equal(Collision()(state), [0, 0])


def test_collision_within_a_margin():
    """What is nearer in any substep counts, and so does a touch between two measurements."""
    apart = [[np.inf], [np.inf]]
    clearance = np.array([[[0.03], [0.02]], [[0.03], [0.021]], [[0.02], [0.03]], apart])
    state = make_state(
        contact_distance=[*apart, [np.inf], [-0.001]],
        contact_force=np.zeros((4, 1)),
        trace={"clearance": clearance},
    )
    np.testing.assert_array_equal(Collision(margin=0.02)(state), [1, 0, 1, 1])


@pytest.mark.parametrize("margin", [-0.01, float("inf"), float("nan")])
def test_collision_rejects_margin(margin):
    with pytest.raises(ValueError, match=f"margin must be finite and not negative, got {margin}"):
        Collision(margin=margin)


@pytest.mark.parametrize(
    ("distances", "expected"),
    [
        ([[np.inf, np.inf, np.inf], [np.inf, 0.0, np.inf]], [0, 1]),
        ([[1e-9, 1e-9, 1e-9], [-0.01, -0.01, -0.01]], [0, 1]),
    ],
    ids=["middle-substep", "boundary"],
)
@pytest.mark.parametrize("what", ["table", "itself"])
def test_collision_with_table_and_itself(what, distances, expected):
    name = {"table": "table_distance", "itself": "self_distance"}[what]
    state = make_state(trace=make_trace(**{name: distances}))
    np.testing.assert_array_equal(Collision(**{what: True})(state), expected)
    # Nothing that is not asked for costs.
    np.testing.assert_array_equal(Collision()(state), [0, 0])


def test_collision_with_anything():
    """One is enough, whichever it is; and several cost no more than one."""
    far, near = [[np.inf], [np.inf]], [[np.inf], [-0.001]]
    cost = Collision(table=True, itself=True)
    for obstacle in (far, near):
        for table in (far, near):
            for itself in (far, near):
                state = make_state(
                    contact_distance=obstacle,
                    trace=make_trace(table_distance=table, self_distance=itself),
                )
                touches = near in (obstacle, table, itself)
                np.testing.assert_array_equal(cost(state), [0, touches])


@pytest.mark.parametrize(
    ("forces", "expected"),
    [
        ([[140.0], [140.1]], [0, 1]),
        ([[0.0, 141.0], [139.0, 139.0]], [1, 0]),
        (np.zeros((2, 0)), [0, 0]),
    ],
    ids=["boundary", "each-obstacle-for-itself", "no-obstacles"],
)
def test_contact_force(forces, expected):
    np.testing.assert_array_equal(ContactForce()(make_state(contact_force=forces)), expected)


def test_contact_force_of_nothing():
    """At a limit of 0 any force costs, but none does not."""
    state = make_state(contact_force=[[0.0], [1e-9]])
    np.testing.assert_array_equal(ContactForce(limit=0.0)(state), [0, 1])


@pytest.mark.parametrize(
    ("clearance", "expected"),
    [
        ([[[0.05], [0.05]], [[0.04], [np.inf]]], [0, 0.01]),
        ([[[np.inf], [np.inf]], [[-0.02], [0.01]]], [0, 0.07]),
        ([[[1.0, 0.03], [0.04, 1.0]], [[0.02, 0.03], [0.05, 0.05]]], [0.02, 0.03]),
        ([[[1.0], [0.03], [1.0]], [[0.04], [0.045], [1.0]]], [0.02, 0.01]),
        (np.zeros((2, 3, 0)), [0, 0]),
    ],
    ids=["boundary", "overlap", "worst-obstacle", "middle-substep", "no-obstacles"],
)
def test_proximity(clearance, expected):
    state = make_state(trace=make_trace(clearance=clearance))
    np.testing.assert_allclose(Proximity()(state), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        # Limits are -2 and 2, and the margin is 0.25: these numbers are exact.
        ([[[1.75] * 7], [[-1.75] * 7]], [0, 0]),
        ([[[0.0] * 6 + [1.76]], [[-1.76] + [0.0] * 6]], [1, 1]),
        ([[[0.0] * 7, [1.9] + [0.0] * 6, [0.0] * 7], [[0.0] * 7] * 3], [1, 0]),
        ([[[2.5] * 7], [[0.0] * 7]], [1, 0]),
    ],
    ids=["boundary", "each-side", "middle-substep", "beyond"],
)
def test_joint_limit(angles, expected):
    state = make_state(trace=make_trace(joint_position=angles))
    np.testing.assert_array_equal(JointLimit(margin=0.25)(state), expected)


def test_joints_without_limits_are_free():
    state = make_state(
        joint_lower=np.full(7, -np.inf),
        joint_upper=np.full(7, np.inf),
        trace=make_trace(joint_position=np.full((2, 1, 7), 1e6)),
    )
    np.testing.assert_array_equal(JointLimit()(state), [0, 0])


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        ([[[0.25, 0, 0]], [[0, 0, -0.251]]], [0, 1]),
        # 3, 4, 12 is 13 long.
        ([[[0.06, 0.08, 0.22]], [[0.06, 0.08, 0.24]]], [0, 1]),
        ([[[0, 0, 0], [0, 1, 0], [0, 0, 0]], [[0, 0, 0]] * 3], [1, 0]),
    ],
    ids=["boundary", "length", "middle-substep"],
)
def test_speed(velocity, expected):
    state = make_state(trace=make_trace(ee_velocity=velocity))
    np.testing.assert_array_equal(Speed()(state), expected)


def test_speed_of_links():
    slow = np.zeros((2, 3, 3))
    links = np.zeros((2, 3, 5))
    links[1, 1, 2] = 0.3
    state = make_state(trace=make_trace(ee_velocity=slow, link_speed=links))
    np.testing.assert_array_equal(Speed(any_link=True)(state), [0, 1])
    np.testing.assert_array_equal(Speed()(state), [0, 0])
    # The tool point counts among them.
    fast = make_state(trace=make_trace(ee_velocity=slow + 1, link_speed=links))
    np.testing.assert_array_equal(Speed(any_link=True)(fast), [1, 1])


def separation(clearance, arm, obstacle):
    return make_state(
        trace=make_trace(clearance=clearance, arm_approach=arm, obstacle_approach=obstacle)
    )


@pytest.mark.parametrize(
    ("clearance", "arm", "obstacle", "expected"),
    [
        # At rest the intrusion distance is enough.
        ([[[0.125]], [[0.124]]], 0, 0, [0, 1]),
        # The obstacle comes on at 0.5 m/s for 0.75 s: 0.375 m and 0.125 m.
        ([[[0.5]], [[0.499]]], 0, 0.5, [0, 1]),
        # The arm at 0.5 m/s stops after 0.25 s + 0.5 s / 2: 0.25 m and 0.125 m.
        ([[[0.375]], [[0.374]]], 0.5, 0, [0, 1]),
        ([[[0.75]], [[0.749]]], 0.5, 0.5, [0, 1]),
        # Going apart does not make up for what the other does.
        ([[[0.5]], [[0.499]]], -9, 0.5, [0, 1]),
        ([[[0.125]], [[0.124]]], -9, -9, [0, 1]),
        ([[[-0.01]], [[np.inf]]], -9, -9, [1, 0]),
        # Beyond the horizon nothing is looked at, at its end it is.
        ([[[1.0]], [[1.0001]]], 9, 9, [1, 0]),
        ([[[np.inf]], [[np.inf]]], 9, 9, [0, 0]),
    ],
    ids=["rest", "obstacle", "arm", "both", "flight", "apart", "overlap", "horizon", "far"],
)
def test_speed_and_separation(clearance, arm, obstacle, expected):
    cost = SpeedAndSeparation(reaction_time=0.25, stopping_time=0.5, intrusion=0.125, horizon=1.0)
    speeds = np.full((2, 1, 1), arm), np.full((2, 1, 1), obstacle)
    np.testing.assert_array_equal(cost(separation(clearance, *speeds)), expected)


def test_speed_and_separation_of_several():
    """Each obstacle's distance with its own speed, in the same substep."""
    cost = SpeedAndSeparation(reaction_time=0.25, stopping_time=0.5, intrusion=0.125, horizon=1.0)
    clearance = [[[0.2, 0.9], [0.9, 0.9], [0.9, 0.9]], [[0.9, 0.9], [0.9, 0.3], [0.9, 0.9]]]
    fast = [[[0.0, 0.5], [0.0, 0.0], [0.5, 0.0]], [[0.0, 0.0], [0.0, 0.5], [0.0, 0.0]]]
    still = np.zeros((2, 3, 2))
    np.testing.assert_array_equal(cost(separation(clearance, still, fast)), [0, 1])
    np.testing.assert_array_equal(cost(separation(*[np.zeros((2, 3, 0))] * 3)), [0, 0])


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([[[0.0, 0.0, 0.0]], [[1.0, 2.0, 3.0]]], [0, 0]),
        ([[[0.5, 0.5, 3.01]], [[-0.01, 0.5, 0.5]]], [1, 1]),
        ([[[0.5] * 3, [0.5, 2.1, 0.5], [0.5] * 3], [[0.5] * 3] * 3], [1, 0]),
    ],
    ids=["boundary", "each-side", "middle-substep"],
)
def test_workspace(points, expected):
    cost = Workspace(Region((0, 0, 0), (1, 2, 3)))
    np.testing.assert_array_equal(cost(make_state(trace=make_trace(ee_position=points))), expected)


@pytest.mark.parametrize("cost", SENSORS.values(), ids=SENSORS.keys())
def test_what_is_not_measured_is_named(cost):
    assert isinstance(cost, Sensor)
    assert cost.sensing != Sensing()
    with pytest.raises(KeyError, match=r"is measured only if a cost asks for it .* there is \[\]"):
        cost(make_state())


def test_contacts_need_no_sensing():
    assert Collision().sensing == Sensing()
    assert not isinstance(ContactForce(), Sensor)


def test_sensing_adds_up():
    one = Sensing(clearance=0.1, table=True, joints=True)
    two = Sensing(clearance=0.3, itself=True, links=True)
    both = Sensing(0.3, table=True, itself=True, joints=True, links=True)
    assert one | two == two | one == both
    assert one | Sensing() == one


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sensing(clearance=-1), "clearance must be finite and not negative, got -1"),
        (lambda: Sensing(clearance=np.nan), "clearance must be finite and not negative, got nan"),
        (lambda: ContactForce(limit=-1), "limit must be finite and not negative, got -1"),
        (lambda: ContactForce(limit=np.nan), "limit must be finite and not negative, got nan"),
        (
            lambda: ContactForce(limit=[1, 2]),
            r"limit must be finite and not negative, got \[1, 2\]",
        ),
        (lambda: Proximity(margin=0), "margin must be positive and finite, got 0"),
        (lambda: Proximity(margin=np.inf), "margin must be positive and finite, got inf"),
        (lambda: JointLimit(margin=-0.1), "margin must be finite and not negative, got -0.1"),
        (lambda: Speed(limit=-0.1), "limit must be finite and not negative, got -0.1"),
        (lambda: Speed(limit=np.inf), "limit must be finite and not negative, got inf"),
        (
            lambda: SpeedAndSeparation(reaction_time=-1),
            "reaction_time must be finite and not negative, got",
        ),
        (
            lambda: SpeedAndSeparation(stopping_time=np.nan),
            "stopping_time must be finite and not negative, got nan",
        ),
        (
            lambda: SpeedAndSeparation(intrusion=-1),
            "intrusion must be finite and not negative, got -1",
        ),
        (lambda: SpeedAndSeparation(horizon=0.05), r"horizon must be larger .* 0.05, got 0.05"),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_workspace_is_a_region():
    with pytest.raises(TypeError, match=r"region must be an instance of Region, got \(\(0,"):
        Workspace(((0, 0, 0), (1, 1, 1)))


def test_the_margin_is_not_one_of_the_table():
    far = np.full((2, 1, 1), np.inf)
    state = make_state(trace=make_trace(clearance=far, table_distance=[[0.01], [0.0]]))
    np.testing.assert_array_equal(Collision(margin=0.02, table=True)(state), [0, 1])
