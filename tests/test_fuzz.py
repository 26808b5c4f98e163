"""Damaged files at every reader, odd words at every door: a result, or one error that says what was wrong.

A short slice with fixed draws runs with the other tests; ``./run fuzz`` draws 10,000 new inputs.
"""

import contextlib
import io
import json
import os
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from grindvision.arm import read_arm
from grindvision.arm.urdf_chain import urdf_chain
from grindvision.calibration import read_measurements
from grindvision.calibration.pose_conventions import convention, poses_from, read_pose_rows
from grindvision.cli import COMMANDS, main
from grindvision.cli.camera_pose import camera_content, read_camera
from grindvision.cli.scans import read_pose
from grindvision.clouds import read_cloud
from grindvision.errors import GrindvisionError, GrindvisionWarning
from grindvision.files import plain, read_json, read_toml
from grindvision.geometry import rigid
from grindvision.motion.tool import read_torch
from grindvision.result_set import write_set
from grindvision.vision.depth_calibration.field_correction import read_field
from grindvision_book.studies.rows import RowsFile
from tests.doors_law import pcd

DRAWN = int(os.environ.get("GRINDVISION_FUZZ", 0))
POINTS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32).astype(float) * 30
TABLE = "".join("{:.3f} {:.3f} {:.3f}\n".format(*row) for row in POINTS)
ROBOT = "joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad\nJ1,0,0,321,0,0\nJ2,1.57,50,0,0,0\nJ3,0,270,0,0,0\n"
MEASURED = "pose,sphere,q1_rad,q2_rad,q3_rad,sx_mm,sy_mm,sz_mm,bx_mm,by_mm,bz_mm,split\n" + "".join(
    f"{k},{k % 3},0.{k},-1.{k},2e-1,{k},22.5,400,800,{k}.25,300,{'train' if k % 2 else 'test'}\n" for k in range(9)
)
LINKS = "".join(
    f'<link name="l{k}"/><joint name="j{k}" type="revolute"><parent link="l{k - 1}"/><child link="l{k}"/>'
    f'<origin xyz="{0.1 * (k > 1)} 0 0.2" rpy="0 {k - 1} 0"/><axis xyz="0 {(k - 1) % 2} 1"/>'
    '<limit lower="-3" upper="3" velocity="2" effort="9"/></joint>'
    for k in range(1, 4)
)
URDF = f'<?xml version="1.0" encoding="utf-8"?>\n<robot name="r"><link name="l0"/>{LINKS}</robot>\n'
PARAMETERS = 'points = 6\nseed = 3\nunit = "mm"\nsample-viewpoint = [1.0, 2, 3.5]\nsample-model = true\n'
CAMERA = camera_content(rigid(None, [0, 50.0, 80]), "on-arm", convention("fanuc"))
ROWS = "case,seed,code,value,error\n0,3,abc,1.5,\n1,3,abc,,InputError: no\n"


def saved(save: Callable[..., None], *arrays, **named) -> bytes:
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def ply(form: str, lists: str = "uchar int") -> bytes:
    head = f"ply\nformat {form} 1.0\ncomment c\nelement camera 1\nproperty float f\nelement vertex {len(POINTS)}\n"
    head += "".join(f"property {'float' if form != 'ascii' else 'double'} {axis}\n" for axis in "xyz")
    head += f"element face 1\nproperty list {lists} vertex_indices\nend_header\n"
    order = ">" if "big" in form else "<"
    body = f"1.5\n{TABLE}3 0 1 2\n".encode()
    face = (b"\3" if lists.startswith("uchar") else struct.pack(f"{order}I", 3)) + struct.pack(f"{order}3i", 0, 1, 2)
    return head.encode() + (body if form == "ascii" else bytes(4) + POINTS.astype(f"{order}f4").tobytes() + face)


STL = bytes(80) + struct.pack("<I", 13)
STL += b"".join(struct.pack("<12fH", 0, 0, 1, *corners, 0) for corners in POINTS[:39].reshape(13, 9))
FIELD = {"error_grid_mm": np.zeros((3, 3, 2)), "low": [-0.5, -0.5, 300], "high": [0.5, 0.5, 500], "normal": [0, 0, 1.0]}

#: File name -> a sound file of that kind.
SEEDS: dict[str, bytes] = {
    "ascii.ply": ply("ascii"),
    "little.ply": ply("binary_little_endian"),
    "big.ply": ply("binary_big_endian"),
    "wide.ply": ply("binary_little_endian", "uint int"),
    **{f"{form}.pcd": pcd(POINTS, form) for form in ("ascii", "binary", "binary_compressed")},
    "a.xyz": TABLE.encode(),
    "a.csv": ("x [mm];y [mm];z [mm]\n" + TABLE.replace(" ", ";").replace(".", ",")).encode(),
    "a.npy": saved(np.save, POINTS),
    "a.npz": saved(np.savez_compressed, points=POINTS),
    "a.stl": STL,
    "text.stl": b"solid a\n" + b"facet\n vertex 1 2 3\n vertex 9 2 3\n vertex 1 8 3\nendfacet\n" * 3 + b"endsolid\n",
    "a.obj": (
        "v " + TABLE.strip().replace("\n", "\nv ") + "\nvn 0 0 1\nf 1 2 3\nf -1 -2 -3 4\nf 1/2/1 2//1 3\n"
    ).encode(),
    "pose.json": json.dumps({"T_base_scanner": np.eye(4).tolist()}).encode(),
    "p.toml": PARAMETERS.encode(),
    "camera.json": json.dumps(plain(CAMERA)).encode(),
    "tool.json": json.dumps({"T_flange_tcp": rigid(translation_mm=[0, 0, 300]).tolist()}).encode(),
    "poses.csv": b"x;y;z;rx;ry;rz\n" + b"500;20.5;600;180;0;0\n" * 5,
    "robot.csv": ROBOT.encode(),
    "m.csv": MEASURED.encode(),
    "robot.urdf": URDF.encode(),
    "field.npz": saved(np.savez, **FIELD),
    "rows.csv": ROWS.encode(),
}


def parameters(path: Path) -> None:
    read_toml(path)
    with contextlib.redirect_stderr(io.StringIO()), contextlib.suppress(SystemExit):
        code = main(["detect", "absent.ply", "absent.ply", "-o", str(path.parent / "out"), "--parameters", str(path)])
        assert code == 2, "refused, but not as bad input"


def rows(path: Path) -> None:
    with RowsFile(path) as found:
        assert all(case >= 0 for case in found.stored)


READERS: dict[str, Callable[[Path], Any]] = {
    "pose.json": lambda path: (read_json(path), read_pose(path)),
    "p.toml": parameters,
    "camera.json": read_camera,
    "tool.json": read_torch,
    "poses.csv": lambda path: poses_from(read_pose_rows(path), convention("fanuc")),
    "robot.csv": read_arm,
    "m.csv": read_measurements,
    "robot.urdf": urdf_chain,
    "field.npz": read_field,
    "rows.csv": rows,
}

TOKENS = [
    *(
        b"nan",
        b"inf",
        b"1e999",
        b"-1",
        b"0",
        b"1e300",
        b"True",
        b"None",
        b"1_0",
        b"0x1f",
        b"0.5",
        b"99999999999999999999",
    ),
    *(b"\0", b"\n", b"\r", b"\t", b" ", b",", b";", b'"', b"'", b"#", b"\xff", b"\xe9", b"\xef\xbb\xbf", b"\xff\xfe"),
    *(
        b"(",
        b"[",
        b"{",
        b"}",
        b"<",
        b">",
        b"&amp;",
        b"<!--",
        b"list",
        b"double",
        b"uchar",
        b"binary",
        b"ascii",
        b"vertex",
    ),
    *(
        b"element a 1000000000\n",
        b"property list uchar int v\n",
        b"utf-7",
        b"rot13",
        b"f 0 0 0\n",
        b"v 1 2\n",
        b"DATA binary",
    ),
    *(
        b"9" * 400,
        b"9" * 5000,
        b"[" * 3000,
        b"a" * 3000,
        "é".encode(),
        "²".encode(),
        b"(True, 3)",
        b"<f2",
        b"|O",
        b">c16",
    ),
]
EDITS = st.lists(
    st.tuples(
        st.sampled_from(["put", "cut", "replace", "copy", "byte", "end"]),
        st.integers(0, 1000),
        st.integers(0, 1000),
        st.one_of(st.sampled_from(TOKENS), st.binary(min_size=1, max_size=6)),
    ),
    min_size=1,
    max_size=4,
)


def edited(data: bytes, edits: list[tuple[str, int, int, bytes]]) -> bytes:
    """Sound bytes, damaged; places count in thousandths, every other time of the beginning, where headers stand."""
    for what, at, length, token in edits:
        here = (at * (len(data) if at % 2 else min(len(data), 400))) // 1000
        there = min(len(data), here + max(1, length // 20))
        data = {
            "put": data[:here] + token + data[here:],
            "cut": data[:here] + data[there:],
            "replace": data[:here] + token + data[there:],
            "copy": data[:there] + data[here:there] * (1 + length % 5) + data[there:],
            "byte": data[:here] + token[:1] + data[here + 1 :],
            "end": data[:here],
        }[what]
    return data


def slices(share: float = 1.0):
    """Settings of one fuzz test: its part of the inputs asked for, else a few that are always the same."""
    return settings(
        deadline=None,
        derandomize=not DRAWN,
        max_examples=max(5, round(share * DRAWN)) if DRAWN else 25,
        suppress_health_check=list(HealthCheck),
        print_blob=True,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("name", SEEDS)
def test_the_seeds_are_sound(folder, name):
    (folder / name).write_bytes(SEEDS[name])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrindvisionWarning)
        READERS.get(name, read_cloud)(folder / name)


@pytest.mark.parametrize("name", SEEDS)
@slices(0.9 / len(SEEDS))
@given(edits=EDITS)
@example(edits=[("put", 0, 0, b"9" * 5000)])
@example(edits=[("end", 0, 0, b"")])
def test_a_damaged_file_is_read_or_refused_in_one_line(folder, name, edits):
    path = folder / name
    path.write_bytes(edited(SEEDS[name], edits))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", GrindvisionWarning)
        warnings.filterwarnings("ignore", ".*created on Python 2", UserWarning)  # NumPy reads such headers too
        try:
            found = READERS.get(name, read_cloud)(path)
        except GrindvisionError as error:
            assert name in str(error) and "\n" not in str(error) and len(str(error)) <= 1000
        else:
            if name not in READERS:
                assert found.points.ndim == 2 and found.points.shape[1] == 3 and 0 < len(found) < 2_000_000


@pytest.mark.parametrize("length", [0xFFFFFFFF, 0x7FFFFFFF, 4, 0])
def test_a_face_of_more_corners_than_the_file_holds(tmp_path, length):
    (tmp_path / "a.ply").write_bytes(
        ply("binary_little_endian", "uint int")[:-16] + struct.pack("<I3i", length, 0, 1, 2)
    )
    if length == 0:
        assert len(read_cloud(tmp_path / "a.ply")) == len(POINTS)
        return
    with pytest.raises(GrindvisionError, match="corners"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("length", [np.nan, np.inf, -1.0])
def test_a_face_of_no_number_of_corners(tmp_path, length):
    whole = ply("binary_little_endian", "float int")[:-16] + struct.pack("<f3i", length, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(whole)
    with pytest.raises(GrindvisionError, match="corners"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["a.obj", "a.ply"])
@pytest.mark.parametrize("sign", ["", "-"])
def test_a_vertex_of_more_digits_than_a_machine_counts(tmp_path, name, sign):
    far = f"{sign}{'9' * 23}"
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / name).write_text(f"v 1 2 3\nf 1 1 {far}\n" if name == "a.obj" else f"{head}1 2 3\n3 0 0 {far}\n")
    with pytest.raises(GrindvisionError, match="a face names a vertex of more than 18 digits"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.stl", "solid a\n vertex 1 2 3\n vertex\n vertex 1 8 3\nendsolid\n"),
        ("a.obj", "v 1 2 3\nv \nv 1 8 3\nv 4 8 3\nf 1 2 3\n"),
    ],
)
def test_a_corner_without_numbers_is_not_passed_over(tmp_path, name, text):
    """Else the corners behind it would count one less, and belong to other faces."""
    (tmp_path / name).write_text(text)
    with pytest.raises(GrindvisionError, match=r"1 row holds no numbers"):
        read_cloud(tmp_path / name)


WORDS = st.one_of(
    st.sampled_from(
        ["-o", "out", "--unit", "mm", "--seed", "--points", "--json", "--help", "--parameters", "--robot", "--train"]
        + ["--scanner-pose", "--field-correction", "--viewpoint", "--columns", "--steps-mm", "--free", "--", "-", ""]
        + [
            "/dev/zero",
            "/",
            ".",
            "a.ply",
            "1e400",
            "-1e3",
            "9" * 400,
            "n" * 5000,
            "\udce9.ply",
            "$x$",
            "\x1b[1m",
            "a\0b",
        ]
    ),
    st.text(max_size=6),
)


#: Commands that run without a word.
WORDLESS = ("book", "compile", "robots", "data")


@slices(0.08)
@given(
    door=st.sampled_from([name for name in COMMANDS if name not in WORDLESS]),
    words=st.lists(WORDS, max_size=7),
)
def test_odd_words_are_refused_in_one_line(folder, door, words):
    """Nothing that these words name is there: no run succeeds, but help may be asked for."""
    said, told = io.StringIO(), io.StringIO()
    before = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(said):
            code = main(
                [door, *("absent" if word in ("grinding", "welding", "calibration") else word for word in words)]
            )
    except SystemExit as stop:
        code = int(stop.code or 0)
    finally:
        os.chdir(before)
    if code == 0:
        assert "--help" in words or "-h" in words
    else:
        line = told.getvalue()
        assert code == 2, line
        assert line.count("\n") == 1 and len(line) < 1300 and line[:-1].isprintable()


MANIFESTS = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.text(max_size=5), st.sampled_from(["../mine", "/etc", "mine"])
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=8,
)


@slices(0.02)
@given(files=MANIFESTS)
def test_no_earlier_manifest_can_remove_what_stands_outside(tmp_path_factory, files):
    out = tmp_path_factory.mktemp("set") / "out"
    out.mkdir()
    (out.parent / "mine").write_text("kept")
    (out / "report.json").write_text(json.dumps({"command": "x", "files": files}))
    with write_set(out, "report.json") as place:
        (place / "report.json").write_text(json.dumps({"command": "x", "files": ["report.json"]}))
    assert (out.parent / "mine").read_text() == "kept"
    assert json.loads((out / "report.json").read_text())["files"] == ["report.json"]
