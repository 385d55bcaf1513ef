from pathlib import Path
from xml.etree import ElementTree

import pybullet_data
import pytest

from torchrl_safe.envs.urdf import prepare_urdf

PANDA_URDF = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"


def test_fingers_are_fixed_and_visuals_dropped():
    text, chain = prepare_urdf(PANDA_URDF, "panda_grasptarget", visuals=False, fix_fingers=True)
    root = ElementTree.fromstring(text)
    movable = {j.get("name") for j in root.findall("joint") if j.get("type") != "fixed"}
    assert movable == chain == {f"panda_joint{i}" for i in range(1, 8)}
    assert not [*root.iter("visual")]
    assert len([*root.iter("collision")]) == 11


def test_every_joint_beyond_the_tool_is_fixed():
    """Also one that turns."""
    text, chain = prepare_urdf(PANDA_URDF, "panda_link5", visuals=False, fix_fingers=True)
    joints = ElementTree.fromstring(text).findall("joint")
    movable = {j.get("name") for j in joints if j.get("type") != "fixed"}
    assert movable == chain == {f"panda_joint{i}" for i in range(1, 6)}


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
    root = ElementTree.fromstring(prepare_urdf(path, "tool", visuals=False, fix_fingers=True)[0])
    assert [found.get("filename") for found in root.iter("mesh")] == [str(mesh)]
    assert not [*root.iter("visual")]


def test_everything_else_stays():
    text, _ = prepare_urdf(PANDA_URDF, "panda_hand", visuals=True, fix_fingers=False)
    root = ElementTree.fromstring(text)
    types = {j.get("name"): j.get("type") for j in root.findall("joint")}
    assert types["panda_finger_joint1"] == "prismatic"
    assert all(Path(mesh.get("filename")).is_file() for mesh in root.iter("mesh"))
    assert [*root.iter("visual")]


def test_unknown_link_is_named():
    with pytest.raises(ValueError, match=r"ee_link must be a link .*panda_hand.*got 'nowhere'"):
        prepare_urdf(PANDA_URDF, "nowhere", visuals=False, fix_fingers=True)


@pytest.mark.parametrize("content", [None, "not xml"], ids=["missing", "not-xml"])
def test_unreadable_file_is_named(tmp_path, content):
    path = tmp_path / "arm.urdf"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=r"urdf must be a readable URDF file, got '.*arm.urdf'"):
        prepare_urdf(path, "tool", visuals=False, fix_fingers=True)


def test_missing_mesh_is_named(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="r"><link name="tool"><collision><geometry>'
        '<mesh filename="package://gone.obj"/></geometry></collision></link></robot>'
    )
    with pytest.raises(ValueError, match=r"names a mesh that does not exist: 'package://gone.obj'"):
        prepare_urdf(path, "tool", visuals=False, fix_fingers=True)
