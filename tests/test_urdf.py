import importlib.metadata
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pybullet_data
import pytest
from bullet_worlds import make_world
from worlds import step

from torchrl_safe.envs import (
    PANDA,
    ArmEnv,
    ArmModel,
    Gripper,
    JointDelta,
    NoObstacles,
    Placement,
    Reach,
    Region,
    Scene,
    Sensing,
)
from torchrl_safe.envs.arms.urdf import find_urdf, prepare_urdf
from torchrl_safe.envs.gym import ARMS
from torchrl_safe.envs.physics.mujoco.meshes import read_meshes
from torchrl_safe.envs.physics.mujoco.model import build_world


def arm(path, ee_link, gripper=None):
    return ArmModel(str(path), ee_link, home=(), gripper=gripper)


def movable(root):
    return {j.get("name") for j in root.findall("joint") if j.get("type") != "fixed"}


def test_fingers_are_fixed_and_visuals_dropped():
    text, chain, tool_link = prepare_urdf(PANDA, visuals=False, fix_fingers=True, merge=False)
    root = ElementTree.fromstring(text)
    assert movable(root) == chain == {f"panda_joint{i}" for i in range(1, 8)}
    assert tool_link == "panda_grasptarget"
    assert not [*root.iter("visual")]
    assert len([*root.iter("collision")]) == 11


def test_every_joint_beyond_the_tool_is_fixed():
    """Also one that turns."""
    short = arm(PANDA.urdf, "panda_link5")
    text, chain, _ = prepare_urdf(short, visuals=False, fix_fingers=True, merge=False)
    root = ElementTree.fromstring(text)
    assert movable(root) == chain == {f"panda_joint{i}" for i in range(1, 6)}


def test_meshes_of_a_package_are_found_and_all_visuals_dropped(tmp_path):
    """As in ROS: the URDF and the meshes in different folders of the package."""
    mesh = tmp_path / "robot" / "meshes" / "tool.obj"
    path = tmp_path / "robot" / "urdf" / "arm.urdf"
    for file in (mesh, path):
        file.parent.mkdir(parents=True)
    mesh.write_text("")
    visual = "<visual><geometry><sphere radius='1'/></geometry></visual>"
    path.write_text(
        f'<robot name="r"><link name="tool">{visual}{visual}<collision><geometry>'
        '<mesh filename="package://robot/meshes/tool.obj"/></geometry></collision></link></robot>'
    )
    text = prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True, merge=False).text
    root = ElementTree.fromstring(text)
    assert [found.get("filename") for found in root.iter("mesh")] == [str(mesh)]
    assert not [*root.iter("visual")]


def test_everything_else_stays():
    whole = arm(PANDA.urdf, "panda_hand")
    root = ElementTree.fromstring(
        prepare_urdf(whole, visuals=True, fix_fingers=False, merge=False).text
    )
    types = {j.get("name"): j.get("type") for j in root.findall("joint")}
    assert types["panda_finger_joint1"] == "prismatic"
    assert all(Path(mesh.get("filename")).is_file() for mesh in root.iter("mesh"))
    assert [*root.iter("visual")]


def test_unknown_link_is_named():
    with pytest.raises(ValueError, match=r"ee_link must be a link .*panda_hand.*got 'nowhere'"):
        prepare_urdf(arm(PANDA.urdf, "nowhere"), visuals=False, fix_fingers=True, merge=False)


@pytest.mark.parametrize("content", [None, "not xml"], ids=["missing", "not-xml"])
def test_unreadable_file_is_named(tmp_path, content):
    path = tmp_path / "arm.urdf"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=r"urdf must be a readable URDF file, got '.*arm.urdf'"):
        prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True, merge=False)


def test_another_format_is_named(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(ValueError, match=r"urdf must be a URDF file, .*arm.xml': <mujoco>"):
        prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True, merge=False)


def test_a_slide_without_a_range_is_free(tmp_path):
    """PyBullet would lock it."""
    slide = joint(1, kind="prismatic", limit='lower="0" upper="0"')
    path = make_urdf(tmp_path / "arm.urdf", link("l0"), link("l1"), slide)
    text, _, _ = prepare_urdf(arm(path, "l1"), visuals=False, fix_fingers=True, merge=False)
    assert ElementTree.fromstring(text).find("joint/limit").keys() == ["effort", "velocity"]


def test_missing_mesh_is_named(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="r"><link name="tool"><collision><geometry>'
        '<mesh filename="package://gone.obj"/></geometry></collision></link></robot>'
    )
    with pytest.raises(ValueError, match=r"names a mesh that does not exist: 'package://gone.obj'"):
        prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True, merge=False)


def make_urdf(path, *elements):
    path.write_text(f'<robot name="r">{"".join(elements)}</robot>')
    return str(path)


def test_gripper_is_attached(tmp_path):
    """Under names of its own, by its root link, wherever that stands in the file."""
    flange = make_urdf(tmp_path / "arm.urdf", '<link name="palm"/>')
    claw = make_urdf(
        tmp_path / "claw.urdf",
        '<link name="tip"/><link name="palm"/><joint name="slide" type="prismatic">',
        '<parent link="palm"/><child link="tip"/></joint>',
        '<link name="other"/><joint name="follow" type="prismatic">',
        '<parent link="palm"/><child link="other"/><mimic joint="slide"/></joint>',
    )
    gripper = Gripper(claw, "palm", position=(0.1, 0, 0.02), rotation=(0, 0.5, 0))
    mounted = arm(flange, "palm", gripper)
    prepared = prepare_urdf(mounted, visuals=False, fix_fingers=False, merge=False)
    root = ElementTree.fromstring(prepared.text)
    assert prepared.tool_link == "gripper/palm"
    links = {link.get("name") for link in root.findall("link")}
    assert links == {"palm", "gripper/palm", "gripper/tip", "gripper/other"}
    mount = root.find("joint[@name='gripper/mount']")
    assert mount.get("type") == "fixed"
    assert mount.find("parent").get("link") == "palm"
    assert mount.find("child").get("link") == "gripper/palm"
    assert mount.find("origin").attrib == {"xyz": "0.1 0 0.02", "rpy": "0 0.5 0"}
    assert root.find("joint/mimic").get("joint") == "gripper/slide"
    # The fingers do not move the palm; what does not move the tool is fixed.
    assert not prepared.joints
    assert movable(root) == {"gripper/slide", "gripper/follow"}
    fixed = prepare_urdf(mounted, visuals=False, fix_fingers=True, merge=False)
    assert not movable(ElementTree.fromstring(fixed.text))
    # A joint between flange and tool is one of the arm's, wherever it is written.
    tip = arm(flange, "palm", Gripper(claw, "tip"))
    assert prepare_urdf(tip, visuals=False, fix_fingers=True, merge=False).joints == {
        "gripper/slide"
    }


def test_unknown_tool_link_is_named():
    wrong = arm(PANDA.urdf, "panda_link8", Gripper("gripper.urdf", "tip"))
    with pytest.raises(ValueError, match=r"tool_link must be a link .*palm.*tool.*got 'tip'"):
        prepare_urdf(wrong, visuals=False, fix_fingers=True, merge=False)


def test_urdf_is_found_by_its_path_or_in_the_packages(tmp_path):
    path = make_urdf(tmp_path / "arm.urdf")
    assert find_urdf(path) == tmp_path / "arm.urdf"
    data = Path(pybullet_data.getDataPath())
    assert find_urdf(PANDA.urdf) == data / "franka_panda" / "panda.urdf"
    assert find_urdf("gripper.urdf").parent.name == "arms"
    assert find_urdf("ur_description/urdf/ur5_robot.urdf").is_file()


def test_a_name_of_two_files_is_refused(tmp_path, monkeypatch):
    make_urdf(tmp_path / "gripper.urdf")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"urdf must be the path of one file, got 'gripper.urdf'"):
        find_urdf("gripper.urdf")


@pytest.mark.parametrize("name", ["", "gone.urdf", "/gone.urdf"])
def test_missing_urdf_is_named(name):
    with pytest.raises(ValueError, match=rf"urdf must be .* got '{name}': .*pybullet_data"):
        find_urdf(name)


def test_missing_extra_is_named(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    with pytest.raises(ValueError, match=r"example-robot-data need .*torchrl-safe\[more-arms\]"):
        find_urdf("ur_description/urdf/ur5_robot.urdf")


def test_frames_weigh_nothing(tmp_path):
    """PyBullet gives 1 kg to a link without inertia."""
    path = make_urdf(
        tmp_path / "arm.urdf",
        '<link name="base"/><link name="beam"/><joint name="turn" type="continuous">',
        '<parent link="base"/><child link="beam"/></joint>',
        '<link name="tip"/><joint name="end" type="fixed">',
        '<parent link="beam"/><child link="tip"/></joint>',
    )
    text = prepare_urdf(arm(path, "tip"), visuals=False, fix_fingers=True, merge=False).text
    masses = {link.get("name"): link.find("inertial/mass") for link in ElementTree.fromstring(text)}
    assert masses["tip"].get("value") == "0"
    # What moves needs inertia, and has that of PyBullet.
    assert masses["base"] is masses["beam"] is None
    # Also once it holds another link.
    text = prepare_urdf(arm(path, "tip"), visuals=False, fix_fingers=True, merge=True).text
    beam = ElementTree.fromstring(text).find("link[@name='beam']/inertial")
    assert float(beam.find("mass").get("value")) == 1
    assert float(beam.find("inertia").get("izz")) == 1


def test_links_that_hold_together_become_one(tmp_path):
    """Masses and inertias by hand: a bar of two equal balls on a turning arm, and its tip."""
    path = make_urdf(
        tmp_path / "arm.urdf",
        '<link name="base"/><link name="arm">',
        inertial("0 0 0", "0 0 0", 2.0, (0.1, 0.2, 0.3)),
        '</link><link name="bar">',
        inertial("1 0 0", "0 0 1.5707963267948966", 2.0, (0.5, 0.6, 0.7)),
        '<collision><origin xyz="0 0 2"/><geometry><sphere radius="0.1"/></geometry></collision>',
        '<visual><geometry><sphere radius="0.1"/></geometry></visual></link>',
        '<link name="tip"/><link name="claw"/>',
        '<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/></joint>',
        '<joint name="weld" type="fixed"><parent link="arm"/><child link="bar"/>',
        '<origin xyz="0 0 1" rpy="0 0 0"/></joint>',
        '<joint name="end" type="fixed"><parent link="bar"/><child link="tip"/>',
        '<origin xyz="0 3 0" rpy="0 1.5707963267948966 0"/></joint>',
        '<joint name="grip" type="revolute"><parent link="tip"/><child link="claw"/>',
        '<origin xyz="0 0 4"/></joint>',
    )
    text, chain, _ = prepare_urdf(arm(path, "tip"), visuals=True, fix_fingers=False, merge=True)
    root = ElementTree.fromstring(text)
    assert chain == {"turn"}
    assert [link.get("name") for link in root.findall("link")] == ["base", "arm", "tip", "claw"]
    whole, tip = root.find("link[@name='arm']"), root.find("link[@name='tip']")
    assert float(whole.find("inertial/mass").get("value")) == 4
    # Centres at the origin and, a metre up, 1 m along x: each half a metre away in both.
    assert numbers(whole.find("inertial/origin").get("xyz")) == [0.5, 0, 0.5]
    moments = {name: float(value) for name, value in whole.find("inertial/inertia").attrib.items()}
    # The bar is turned by a quarter: its moments about x and y change places. Each ball of 2 kg
    # adds m (|d|^2 - d d^T) with d = (0.5, 0, 0.5).
    expected = {"ixx": 0.1 + 0.6 + 1, "iyy": 0.2 + 0.5 + 2, "izz": 0.3 + 0.7 + 1, "ixz": -1.0}
    assert moments == pytest.approx({"ixy": 0.0, "iyz": 0.0, **expected})
    assert numbers(whole.find("collision/origin").get("xyz")) == [0, 0, 3]
    assert numbers(whole.find("visual/origin").get("xyz")) == [0, 0, 1]
    # The tool's frame stays, without mass; what it carried is carried by the arm.
    assert float(tip.find("inertial/mass").get("value")) == 0
    assert numbers(root.find("joint[@name='end']/origin").get("xyz")) == [0, 3, 1]
    assert root.find("joint[@name='end']/parent").get("link") == "arm"
    grip = root.find("joint[@name='grip']")
    assert grip.find("parent").get("link") == "arm"
    assert numbers(grip.find("origin").get("xyz")) == pytest.approx([4, 3, 1])
    assert numbers(grip.find("origin").get("rpy")) == pytest.approx([0, np.pi / 2, 0])


def inertial(xyz, rpy, mass, moments):
    diagonal = " ".join(f"{n}='{v}'" for n, v in zip(("ixx", "iyy", "izz"), moments, strict=True))
    return (
        f"<inertial><origin xyz='{xyz}' rpy='{rpy}'/><mass value='{mass}'/>"
        f"<inertia {diagonal} ixy='0' ixz='0' iyz='0'/></inertial>"
    )


def numbers(text):
    return [float(number) for number in text.split()]


@pytest.mark.parametrize("name", sorted(ARMS))
@pytest.mark.parametrize(("urdf_inertia", "tolerance"), [(True, 2e-4), (False, 0.06)])
def test_merged_arms_move_as_they_did(name, urdf_inertia, tolerance):
    """Every arm, flung about for half a second; Bullet's own inertias are those of other boxes."""
    worlds = [
        make_world(ARMS[name], merged_links=merged, urdf_inertia=urdf_inertia)
        for merged in (False, True)
    ]
    generator = np.random.default_rng(0)
    try:
        for world in worlds:
            world.reset(no_obstacles(), np.zeros(3), np.zeros((0, 3)))
        for _ in range(10):
            target = np.add(ARMS[name].home, generator.uniform(-0.3, 0.3, len(ARMS[name].home)))
            for world in worlds:
                world.advance(target.tolist(), [], 12)
        before, after = (np.array(world.read(fresh=True)) for world in worlds)
    finally:
        for world in worlds:
            world.close()
    joints = len(ARMS[name].home)
    np.testing.assert_allclose(after[:joints], before[:joints], atol=tolerance)
    tool = slice(2 * joints, 2 * joints + 7)
    np.testing.assert_allclose(after[tool], before[tool], atol=tolerance)


def no_obstacles():
    return Placement(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0, dtype=bool))


def link(name, shape="<sphere radius='0.03'/>"):
    return (
        f'<link name="{name}"><inertial><mass value="0.5"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
        f"<collision><geometry>{shape}</geometry></collision></link>"
    )


def joint(number, *parts, kind="revolute", axis="0 1 0", limit='lower="-3" upper="3"'):
    return (
        f'<joint name="j{number}" type="{kind}"><parent link="l{number - 1}"/>'
        f'<child link="l{number}"/><origin xyz="0 0 0.2"/><axis xyz="{axis}"/>'
        f'<limit {limit} effort="50" velocity="2"/>{"".join(parts)}</joint>'
    )


@pytest.fixture
def make_chain(make_env, tmp_path):
    """An arm of three joints, the second of which is given."""

    def make(second, shape="<sphere radius='0.03'/>", tool="l3"):
        links = [link("l0"), link("l1"), link("l2", shape), link(tool)]
        ends = joint(1, axis="0 0 1"), joint(3).replace("l3", tool)
        urdf = make_urdf(tmp_path / "chain.urdf", *links, second, *ends)
        model = ArmModel(urdf, tool, home=(0.1, 0.4, 0.8))
        # Where the tool is at home.
        task = Reach(Region((0.077, 0.007, 0.584), (0.078, 0.008, 0.585)))
        return make_env(
            ArmEnv, model, task=task, action=JointDelta(), obstacles=NoObstacles(), seed=0
        )

    return make


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(
    ("second", "limits"),
    [
        (joint(2, axis="0 2 0"), (-3.0, 3.0)),
        (joint(2, limit='lower="0" upper="0"'), (-np.inf, np.inf)),
        (joint(2, kind="continuous", limit='lower="-1" upper="1"'), (-np.inf, np.inf)),
        (joint(2) + "<mujoco><compiler discardvisual='true'/></mujoco>", (-3.0, 3.0)),
    ],
    ids=["long-axis", "no-range", "continuous-with-range", "with-mujoco's-own-element"],
)
def test_both_engines_read_joints_alike(make_chain, second, limits):
    """And each joint goes where it is sent."""
    env = make_chain(second)
    env.reset()
    before = env.arm_state.joint_position.copy()
    for _ in range(10):
        step(env, [0.0, -0.5, 0.0])
    state = env.arm_state
    assert (state.joint_lower[1], state.joint_upper[1]) == limits
    turned = state.joint_position - before
    np.testing.assert_allclose(turned, [[0, -10 * 0.5 * env.action_mode.step, 0]], atol=0.02)


@pytest.mark.usefixtures("engine")
def test_joints_that_cannot_be_driven_are_refused(make_chain):
    with pytest.raises(ValueError, match=r"move each joint up to 'l3' by itself, .*joint: 'j2'"):
        make_chain(joint(2, '<mimic joint="j1"/>'))
    with pytest.raises(ValueError, match="axis of joint 'j2' must not be zero"):
        make_chain(joint(2, axis="0 0 0"))


@pytest.mark.usefixtures("engine")
def test_an_arm_may_have_any_names(make_chain):
    """Also those of what else is to be seen."""
    ball = 'name="table"><geometry><sphere radius="0.05"/></geometry>'
    extra = (
        f'<link name="world"><visual {ball}</visual><collision {ball}</collision></link>'
        '<joint name="sky" type="fixed"><parent link="goal"/><child link="world"/></joint>'
    )
    env = make_chain(joint(2) + extra, tool="goal")
    env.reset()
    assert env.render(64, 48).float().std() > 10


@pytest.mark.usefixtures("engine")
def test_a_shape_that_an_engine_cannot_read_is_no_hole(make_chain, tmp_path):
    """Bullet would only warn, and obstacles would pass through the link."""
    (tmp_path / "shape.stl").write_text("solid s\nendsolid s\n")
    with pytest.raises(ValueError, match=r"urdf '.*chain.urdf' does not load in "):
        make_chain(joint(2), shape="<mesh filename='shape.stl'/>")


def test_a_mesh_without_faces_is_refused(tmp_path):
    (tmp_path / "shape.obj").write_text("# no faces\nv 0 0 0\n")
    root = ElementTree.fromstring(
        "<robot><link><collision><geometry>"
        f"<mesh filename='{tmp_path}/shape.obj'/></geometry></collision></link></robot>"
    )
    with pytest.raises(ValueError, match=r"shape.obj' must have faces, got none"):
        read_meshes(root)


def test_corners_may_be_counted_from_the_last(tmp_path):
    """As some programs write them, here after three of four corners."""
    read = []
    for faces in ("f 1 3 2\nv 0 0 1\nf 1 2 4", "f -3//1 -1//1 -2//1\nv 0 0 1\nf -4/9 -3/9 -1/9"):
        (tmp_path / "shape.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{faces}\n")
        root = ElementTree.fromstring(
            "<robot><link><collision><geometry>"
            f"<mesh filename='{tmp_path}/shape.obj'/></geometry></collision></link></robot>"
        )
        read.append(read_meshes(root))
    assert read[0] == read[1]


@pytest.mark.usefixtures("engine")
def test_meshes_are_read_as_others_write_them(make_chain, tmp_path):
    """By a URL, with tabs, and with a comment in another encoding."""
    corners = ["0 0 0", "0.05 0 0", "0 0.05 0", "0 0 0.05"]
    lines = [f"v\t{corner}" for corner in corners] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 1 4 3"]
    (tmp_path / "s.obj").write_bytes(b"# Gr\xfc\xdfe\n" + "\n".join(lines).encode())
    env = make_chain(joint(2), shape=f"<mesh filename='file://{tmp_path}/s.obj'/>")
    assert env.rollout(2)["next", "observation"].isfinite().all()


def solid(shape, xyz="0 0 0", rpy="0 0 0"):
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>'


ROD, BALL = '<cylinder radius="0.1" length="0.6"/>', '<sphere radius="0.1"/>'


@pytest.mark.parametrize(
    ("solids", "sides"),
    [
        ([solid(ROD)], (0.2, 0.2, 0.6)),
        # Along the diagonal of x and z: both its length and its width show in both.
        ([solid(ROD, rpy="0 0.7853981633974483 0")], (0.8 * 0.5**0.5, 0.2, 0.8 * 0.5**0.5)),
        ([solid(BALL, "0.3 0 0"), solid(BALL, "-0.1 0 0")], (0.6, 0.2, 0.2)),
        ([solid('<box size="0.2 0.4 0.6"/>', rpy="1.5707963267948966 0 0")], (0.2, 0.6, 0.4)),
    ],
    ids=["cylinder", "tilted-cylinder", "two-spheres", "turned-box"],
)
def test_mujocos_inertia_is_that_of_the_box_around_the_shapes(tmp_path, solids, sides):
    """By hand: a twelfth of 0.5 kg times the squares of the two other sides."""
    before, after = link("l1").split("<collision>")[0], "</link>"
    turns = before + "".join(solids) + after
    urdf = make_urdf(tmp_path / "chain.urdf", link("l0"), turns, joint(1))
    arm = ArmModel(urdf, "l1", home=(0.0,))
    model = build_world(arm, Scene(), (), (), Sensing()).model
    square = np.square(sides)
    np.testing.assert_allclose(model.body("l1").inertia, 0.5 / 12 * (square.sum() - square))
