"""A URDF becomes the modified DH table of the same arm; a file that is no robot is refused in one line."""

import numpy as np
import pinocchio as pin
import pytest

from grindvision.arm import PARAMETERS, forward, read_arm
from grindvision.arm.model import urdf_model
from grindvision.arm.urdf import mesh_files
from grindvision.arm.urdf_chain import urdf_arm
from grindvision.data_files import data_folder
from grindvision.errors import FileError, GrindvisionWarning, UnitError
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


HALF = np.pi / 2
#: Joints as the makers' descriptions have them: (xyz in m, rpy in rad) and axes.
MADE = {
    "ur5": (
        [
            ([0, 0, 0.089159], [0, 0, 0]),
            ([0, 0.13585, 0], [0, HALF, 0]),
            ([0, -0.1197, 0.425], [0, 0, 0]),
            ([0, 0, 0.39225], [0, HALF, 0]),
            ([0, 0.093, 0], [0, 0, 0]),
            ([0, 0, 0.09465], [0, 0, 0]),
        ],
        [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0]],
    ),
    "panda": (
        [
            ([0, 0, 0.333], [0, 0, 0]),
            ([0, 0, 0], [-HALF, 0, 0]),
            ([0, -0.316, 0], [HALF, 0, 0]),
            ([0.0825, 0, 0], [HALF, 0, 0]),
            ([-0.0825, 0.384, 0], [-HALF, 0, 0]),
            ([0, 0, 0], [HALF, 0, 0]),
            ([0.088, 0, 0], [HALF, 0, 0]),
        ],
        [[0, 0, 1]] * 7,
    ),
}
FINGERS = "".join(
    f'<link name="f{i}"/><joint name="finger{i}" type="prismatic"><parent link="hand"/><child link="f{i}"/>'
    f'<axis xyz="0 {sign} 0"/><limit effort="1" lower="0" upper="0.04" velocity="1"/></joint>'
    for i, sign in enumerate((1, -1))
)


@pytest.mark.parametrize(("name", "joints"), [("ur5", 6), ("ur5", 4), ("panda", 7)])
def test_robots_as_their_makers_describe_them(tmp_path, name, joints, rng):
    hand = '<link name="hand"/><joint name="flange" type="fixed"><parent link="link7"/><child link="hand"/></joint>'
    text = urdf(*MADE[name])
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", hand + FINGERS + "</robot>") if joints == 7 else text)
    arm = urdf_arm(tmp_path / "arm.urdf", joints)
    assert fixed_behind_the_last_joint(tmp_path / "arm.urdf", arm, rng) < 1e-8
    if name == "ur5":
        np.testing.assert_allclose(np.abs(arm.table[:4, 1]), [0, 0, 425, 392.25][: len(arm.table)], atol=1e-9)
    if joints == 7:
        with pytest.raises(FileError, match="not a single chain of 8 joints"):
            urdf_arm(tmp_path / "arm.urdf")


def test_the_ur3_that_comes_with_the_package(rng):
    path = data_folder() / "robots" / "ur3" / "ur3.urdf"
    arm = urdf_arm(path)
    assert arm.joints[0] == "shoulder_pan_joint" and fixed_behind_the_last_joint(path, arm, rng) < 1e-8
    assert all((path.parent / name).is_file() for name in mesh_files(path))


BAD = {
    "words": ("hello", "not a readable URDF"),
    "nothing": ("", "not a readable URDF"),
    "two_roots": ('<robot name="a"><link name="b"/><link name="c"/></robot>', "Two root links"),
    "deep": ("<robot>" * 5000, "nested 201 deep"),
    "laughs": ('<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><robot name="&b;"/>', "XML entities"),
    "slide": (urdf([([0, 0, 0], [0, 0, 0])], [[0, 0, 1]], "floating"), "only revolute and prismatic"),
    "aside": (urdf([([0, 0.2, 0], [0, 0, 0])], [[0, 0, 1]]), "does not cross the root link's x axis"),
    "huge": (urdf([([0, 0, 1e300], [0, 0, 0])], [[0, 0, 1]]), "a number within 1e6 is needed"),
    "no_number": (urdf([([0, 0, 0], [0, 0, 0])], [[0, 0, 1]]).replace('xyz="0 0 0"', 'xyz="0 0 x"'), "holds 'x'"),
    "no_axis": (urdf([([0, 0, 0], [0, 0, 0])], [[0, 0, 0]]), "axis of length zero"),
    "orphan": (
        urdf([([0, 0, 0], [0, 0, 0])], [[0, 0, 1]]).replace('parent link="link0"', 'parent link="x"'),
        "link 'x'",
    ),
    "loop": (
        ('<robot name="a"><link name="b"/><link name="c"/>' + 2 * "{}" + "</robot>").format(
            *(
                f'<joint name="{a}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>'
                for a, b in ("bc", "cb")
            )
        ),
        "no root link",
    ),
    "encoding": ('<?xml version="1.0" encoding="UTF-7"?><robot name="a"/>', "not a readable URDF"),
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
    with pytest.warns(GrindvisionWarning, match="add up to 0.3715 mm, as of a positioner .* name them a_m and d_m"):
        read_arm(tmp_path / "r.csv")
    links = "".join(f"J{joint},0,0.3,0,0,0\n" for joint in range(1, 5))
    (tmp_path / "r.csv").write_text(f"joint,{','.join(PARAMETERS)}\n{links}")
    with pytest.raises(UnitError, match="name them a_m and d_m"):
        read_arm(tmp_path / "r.csv")
