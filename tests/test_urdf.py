import importlib.metadata
from pathlib import Path
from xml.etree import ElementTree

import pybullet_data
import pytest

from torchrl_safe.envs import PANDA, ArmModel, Gripper
from torchrl_safe.envs.urdf import find_urdf, prepare_urdf


def arm(path, ee_link, gripper=None):
    return ArmModel(str(path), ee_link, home=(), gripper=gripper)


def movable(root):
    return {j.get("name") for j in root.findall("joint") if j.get("type") != "fixed"}


def test_fingers_are_fixed_and_visuals_dropped():
    text, chain, tool_link = prepare_urdf(PANDA, visuals=False, fix_fingers=True)
    root = ElementTree.fromstring(text)
    assert movable(root) == chain == {f"panda_joint{i}" for i in range(1, 8)}
    assert tool_link == "panda_grasptarget"
    assert not [*root.iter("visual")]
    assert len([*root.iter("collision")]) == 11


def test_every_joint_beyond_the_tool_is_fixed():
    """Also one that turns."""
    short = arm(PANDA.urdf, "panda_link5")
    text, chain, _ = prepare_urdf(short, visuals=False, fix_fingers=True)
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
    text = prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True).text
    root = ElementTree.fromstring(text)
    assert [found.get("filename") for found in root.iter("mesh")] == [str(mesh)]
    assert not [*root.iter("visual")]


def test_everything_else_stays():
    whole = arm(PANDA.urdf, "panda_hand")
    root = ElementTree.fromstring(prepare_urdf(whole, visuals=True, fix_fingers=False).text)
    types = {j.get("name"): j.get("type") for j in root.findall("joint")}
    assert types["panda_finger_joint1"] == "prismatic"
    assert all(Path(mesh.get("filename")).is_file() for mesh in root.iter("mesh"))
    assert [*root.iter("visual")]


def test_unknown_link_is_named():
    with pytest.raises(ValueError, match=r"ee_link must be a link .*panda_hand.*got 'nowhere'"):
        prepare_urdf(arm(PANDA.urdf, "nowhere"), visuals=False, fix_fingers=True)


@pytest.mark.parametrize("content", [None, "not xml"], ids=["missing", "not-xml"])
def test_unreadable_file_is_named(tmp_path, content):
    path = tmp_path / "arm.urdf"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=r"urdf must be a readable URDF file, got '.*arm.urdf'"):
        prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True)


def test_missing_mesh_is_named(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="r"><link name="tool"><collision><geometry>'
        '<mesh filename="package://gone.obj"/></geometry></collision></link></robot>'
    )
    with pytest.raises(ValueError, match=r"names a mesh that does not exist: 'package://gone.obj'"):
        prepare_urdf(arm(path, "tool"), visuals=False, fix_fingers=True)


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
    prepared = prepare_urdf(arm(flange, "palm", gripper), visuals=False, fix_fingers=False)
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
    fixed = prepare_urdf(arm(flange, "palm", gripper), visuals=False, fix_fingers=True)
    assert not movable(ElementTree.fromstring(fixed.text))
    # A joint between flange and tool is one of the arm's, wherever it is written.
    tip = arm(flange, "palm", Gripper(claw, "tip"))
    assert prepare_urdf(tip, visuals=False, fix_fingers=True).joints == {"gripper/slide"}


def test_unknown_tool_link_is_named():
    gripper = Gripper("gripper.urdf", "tip")
    with pytest.raises(ValueError, match=r"tool_link must be a link .*palm.*tool.*got 'tip'"):
        prepare_urdf(arm(PANDA.urdf, "panda_link8", gripper), visuals=False, fix_fingers=True)


def test_urdf_is_found_by_its_path_or_in_the_packages(tmp_path):
    path = make_urdf(tmp_path / "arm.urdf")
    assert find_urdf(path) == tmp_path / "arm.urdf"
    data = Path(pybullet_data.getDataPath())
    assert find_urdf(PANDA.urdf) == data / "franka_panda" / "panda.urdf"
    assert find_urdf("gripper.urdf").parent.name == "envs"
    assert find_urdf("ur_description/urdf/ur5_robot.urdf").is_file()


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
    text = prepare_urdf(arm(path, "tip"), visuals=False, fix_fingers=True).text
    masses = {link.get("name"): link.find("inertial/mass") for link in ElementTree.fromstring(text)}
    assert masses["tip"].get("value") == "0"
    # What moves needs inertia, and has that of PyBullet.
    assert masses["base"] is masses["beam"] is None
