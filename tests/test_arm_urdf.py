"""A URDF becomes the modified DH table of the same arm; a file that is no robot is refused in one line."""

from importlib import metadata
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from grindvision.arm import PARAMETERS, forward, read_arm
from grindvision.arm.urdf import mesh_files, urdf_arm, urdf_model
from grindvision.errors import FileError, UnitError
from grindvision.motion import urdf_robot, welding_torch


def urdf(placements, axes, kind="revolute"):
    """A chain of joints at ``placements`` (xyz in m, rpy in rad) that turn about ``axes``."""
    text = '<robot name="made"><link name="link0"/>'
    for i, ((xyz, rpy), axis) in enumerate(zip(placements, axes, strict=True), 1):
        numbers = (" ".join(f"{v:.12g}" for v in values) for values in (xyz, rpy, axis))
        text += '<link name="link{1}"/><joint name="j{1}" type="{2}"><parent link="link{0}"/><child link="link{1}"/>'
        text = text.replace("{0}", str(i - 1)).replace("{1}", str(i)).replace("{2}", kind)
        text += '<origin xyz="{}" rpy="{}"/><axis xyz="{}"/>'.format(*numbers)
        text += '<limit effort="1" lower="-3" upper="3" velocity="1"/></joint>'
    return text + "</robot>"


def fixed_behind_the_last_joint(path, arm, rng):
    """Largest change, over random poses, of the motion between our last frame and the URDF's, mm and 1."""
    model = urdf_model(path)
    data = model.createData()
    found = []
    for q in rng.uniform(-3, 3, (6, arm.n)):
        pin.forwardKinematics(model, data, np.append(q, np.zeros(model.nq - arm.n)))
        T_base_joint = data.oMi[arm.n].homogeneous
        T_base_joint[:3, 3] *= 1000
        found.append(np.linalg.inv(forward(arm, q)) @ T_base_joint)
    return np.abs(np.array(found) - found[0]).max()


def test_a_chain_of_any_axes_moves_as_its_urdf(tmp_path, rng):
    placements = [([0.1, 0, 0.4], [0, 0, 0.5])] + [(rng.uniform(-0.4, 0.4, 3), rng.uniform(-3, 3, 3)) for _ in range(5)]
    axes = [[0, 0, 1], *rng.normal(size=(5, 3))]
    (tmp_path / "arm.urdf").write_text(urdf(placements, axes))
    arm = urdf_arm(tmp_path / "arm.urdf")
    assert arm.n == 6 and arm.joints[2] == "j3"
    assert fixed_behind_the_last_joint(tmp_path / "arm.urdf", arm, rng) < 1e-8


def test_axes_meant_to_be_parallel_get_a_tilt_and_not_a_link_of_kilometres(tmp_path, rng):
    tilts = rng.normal(scale=2e-4, size=(4, 3))
    placements = [([0, 0, 0.3], [0, 0, 0]), ([0, 0, 0], [np.pi / 2, 0, 0]), ([0.4, 0, 0], tilts[0])]
    placements += [([0.3, 0, 0.1], tilts[1]), ([0, 0, 0.1], [np.pi / 2, 0, 0]), ([0, 0, 0], tilts[2])]
    (tmp_path / "arm.urdf").write_text(urdf(placements, [[0, 0, 1]] * 6))
    arm = urdf_arm(tmp_path / "arm.urdf")
    assert fixed_behind_the_last_joint(tmp_path / "arm.urdf", arm, rng) < 1e-8
    assert np.abs(arm.table[:, 1:3]).max() < 500
    assert 0 < np.abs(arm.table[:, 4]).max() < 1e-3


@pytest.mark.parametrize(("name", "joints"), [("ur5_robot", 6), ("ur10_robot", 4), ("panda", 7)])
def test_robots_as_their_makers_describe_them(name, joints, rng):
    files = metadata.distribution("example-robot-data").files
    path = next(Path(str(file.locate())) for file in files if file.name == f"{name}.urdf")
    arm = urdf_arm(path, joints)
    assert fixed_behind_the_last_joint(path, arm, rng) < 1e-8
    if name == "ur5_robot":
        np.testing.assert_allclose(np.abs(arm.table[:5, 1]), [0, 0, 425, 392.25, 0], atol=1e-9)


BAD = {
    "words": ("hello", "not a readable URDF"),
    "nothing": ("", "not a readable URDF"),
    "two_roots": ('<robot name="a"><link name="b"/><link name="c"/></robot>', "Two root links"),
    "deep": ("<robot>" * 5000, "nested 201 deep"),
    "laughs": ('<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><robot name="&b;"/>', "XML entities"),
    "slide": (urdf([([0, 0, 0], [0, 0, 0])], [[0, 0, 1]], "prismatic"), "not a single chain of 1 revolute joints"),
    "aside": (urdf([([0, 0.2, 0], [0, 0, 0])], [[0, 0, 1]]), "does not cross the root link's x axis"),
    "no_joint": ('<robot name="a"><link name="b"/></robot>', "it has 0 joints"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_arm_is_refused_in_one_line(tmp_path, case, capfd):
    content, message = BAD[case]
    path = tmp_path / "arm.urdf"
    path.write_text(content)
    with pytest.raises(FileError, match=message) as caught:
        urdf_arm(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("mesh", ["/etc/passwd", "../secret.stl", "package://../../secret.stl", "file:///etc/passwd"])
def test_meshes_outside_the_folder_are_not_opened(tmp_path, mesh):
    text = urdf([([0, 0, 0.1], [0, 0, 0])], [[0, 0, 1]])
    body = f'<link name="link1"><collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>'
    (tmp_path / "arm.urdf").write_text(text.replace('<link name="link1"/>', body))
    assert mesh_files(tmp_path / "arm.urdf") == [mesh]
    with pytest.raises(FileError, match="outside"):
        urdf_robot(tmp_path / "arm.urdf", welding_torch(), flange="link1")


def test_a_table_in_degrees_and_metres_is_converted_by_its_names(tmp_path):
    (tmp_path / "r.csv").write_text(
        '\ufeff"joint"; "alpha_deg"; "a_m"; "d_m"; "theta_deg"; "beta_deg"\nJ1;0;0;0.3215;0;0\nJ2;90;0.05;0;90;0.1\n'
    )
    arm = read_arm(tmp_path / "r.csv")
    rows = [[0, 0, 321.5, 0, 0], [np.pi / 2, 50, 0, np.pi / 2, np.radians(0.1)]]
    np.testing.assert_allclose(arm.table, rows, atol=1e-12)
    (tmp_path / "r.csv").write_text(f"joint,{','.join(PARAMETERS)}\nJ1,0,0,0.3215,0,0\nJ2,1.57,0.05,0,0,0\n")
    with pytest.raises(UnitError, match="name them a_m and d_m"):
        read_arm(tmp_path / "r.csv")
