"""Cloud files: what is written is read back; what is damaged is refused before memory is taken."""

import contextlib
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from grindvision.clouds import Cloud, check_unit, extent, finite_points, read_cloud, write_ply
from grindvision.errors import FileError, GrindvisionError, GrindvisionWarning, InputError, UnitError


@pytest.fixture
def points(rng):
    return rng.normal(size=(50, 3)).astype(np.float32).astype(float)


def ply(points, form, extra="", kind="float"):
    header = f"ply\nformat {form} 1.0\ncomment test\nelement vertex {len(points)}\n"
    header += "".join(f"property {kind} {name}\n" for name in "xyz") + extra + "end_header\n"
    return header.encode()


def test_ply_is_read_back(tmp_path, points, rng):
    normals = rng.normal(size=points.shape).astype(np.float32).astype(float)
    write_ply(tmp_path / "cloud.ply", points, normals)
    cloud = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.normals, normals)
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.ply", "m").points, 1000 * points)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_every_kind_of_ply_says_the_same(tmp_path, points, form, kind):
    extra = "property uchar red\n"
    path = tmp_path / "cloud.ply"
    if form == "ascii":
        body = "".join("{!r} {!r} {!r} 7\n".format(*map(float, row)) for row in points).encode()
    else:
        order, letter = (">" if "big" in form else "<"), {"float": "f", "double": "d"}[kind]
        body = b"".join(struct.pack(f"{order}3{letter}B", *row, 7) for row in points)
    faces = b"" if form == "ascii" else b"\x03" + bytes(12)
    path.write_bytes(ply(points, form, extra, kind) + body + faces)
    np.testing.assert_allclose(read_cloud(path).points, points, rtol=1e-7)


def test_organised_pcd_keeps_its_grid(tmp_path, points):
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 10\nHEIGHT 5\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 50\nDATA "
    rows = np.column_stack([points, np.zeros(50)])
    rows[3, :3] = np.nan
    ascii_path, binary_path = tmp_path / "ascii.pcd", tmp_path / "binary.pcd"
    ascii_path.write_text(head + "ascii\n" + "\n".join(" ".join(repr(float(v)) for v in row) for row in rows))
    binary_path.write_bytes((head + "binary\n").encode() + rows.astype("<f4").tobytes())
    for path in (ascii_path, binary_path):
        cloud = read_cloud(path)
        assert cloud.grid == (5, 10)
        np.testing.assert_allclose(cloud.points, rows[:, :3], rtol=1e-6)


def test_compressed_pcd_is_read(tmp_path, points):
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.io.write_point_cloud(str(tmp_path / "cloud.pcd"), cloud, compressed=True)
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.pcd").points, points, rtol=1e-6)


@pytest.mark.parametrize(("name", "gap"), [("a.xyz", " "), ("a.asc", "\t"), ("a.csv", ","), ("a.txt", " ; ")])
def test_tables_are_read_with_blanks_or_commas(tmp_path, points, name, gap):
    head = "x,y,z\n" if name.endswith("csv") else "# exported\n"
    (tmp_path / name).write_text(head + "\n".join(gap.join(repr(float(v)) for v in row) for row in points) + "\n")
    np.testing.assert_allclose(read_cloud(tmp_path / name).points, points)


def test_numpy_arrays_and_meshes_are_read(tmp_path, points):
    np.save(tmp_path / "a.npy", points.reshape(5, 10, 3))
    assert read_cloud(tmp_path / "a.npy").grid == (5, 10)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy").points, points)
    (tmp_path / "a.obj").write_text("".join("v {} {} {}\n".format(*row) for row in points[:3]) + "f 1 2 3\n")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.obj").points, points[:3], rtol=1e-5)
    triangle = struct.pack("<80xI", 1) + struct.pack("<12fH", 0, 0, 1, *points[:3].ravel(), 0)
    (tmp_path / "a.stl").write_bytes(triangle)
    assert {tuple(row) for row in np.round(read_cloud(tmp_path / "a.stl").points, 4)} == {
        tuple(row) for row in np.round(points[:3], 4)
    }


def test_pickled_arrays_are_not_loaded(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FileError, match="NumPy"):
        read_cloud(tmp_path / "a.npy")


PCD_HEAD = b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"

BAD = {
    "empty.ply": b"",
    "giant.ply": ply(range(10**12), "binary_little_endian"),
    "giant_ascii.ply": ply(range(10**12), "ascii"),
    "cut.ply": ply(range(100), "binary_little_endian") + bytes(50 * 12),
    "no_end.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
    "no_z.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n",
    "list.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1 2\n",
    "no_points.ply": ply([], "ascii"),
    "not.ply": b"solid nothing",
    "words.xyz": b"1 2 three\n4 5 6\n",
    "ragged.xyz": b"1 2 3\n4 5\n",
    "two.csv": b"x,y\n1,2\n",
    "bytes.xyz": bytes(range(128, 256)),
    "head.pcd": b"VERSION .7\nFIELDS x y z\nDATA ascii\n1 2 3\n",
    "giant.pcd": PCD_HEAD + b"WIDTH 1000000000000\nHEIGHT 1\nPOINTS 1\nDATA binary\n",
    "packed.pcd": PCD_HEAD
    + b"WIDTH 900000\nHEIGHT 1\nPOINTS 900000\nDATA binary_compressed\n"
    + struct.pack("<II", 10, 10800000)
    + bytes(10),
    "giant.stl": struct.pack("<80xI", 4_000_000_000) + bytes(50),
    "what.las": b"abc",
    "shape.npy": b"\x93NUMPY\x01\x00",
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_refused_in_one_line(tmp_path, name):
    (tmp_path / name).write_bytes(BAD[name])
    with pytest.raises(FileError) as caught:
        read_cloud(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_and_unknown_units_are_refused(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        read_cloud(tmp_path / "none.ply")
    with pytest.raises(InputError, match="inch"):
        read_cloud(tmp_path / "none.ply", "inch")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 700), flips=st.lists(st.tuples(st.integers(0, 699), st.integers(0, 255)), max_size=4))
def test_a_mangled_file_gives_points_or_a_named_error(tmp_path, cut, flips):
    body = bytearray(ply(range(40), "binary_little_endian") + np.arange(120, dtype="<f4").tobytes())
    for at, value in flips:
        if at < len(body):
            body[at] = value
    path = tmp_path / "mangled.ply"
    path.write_bytes(bytes(body[:cut]))
    with contextlib.suppress(GrindvisionError):
        assert len(read_cloud(path)) > 0


def test_nan_points_are_dropped_with_a_warning(points):
    points[[2, 5]] = np.nan
    with pytest.warns(GrindvisionWarning, match="2 of 50"):
        assert len(finite_points(Cloud(points), "a.ply")) == 48
    with pytest.raises(FileError, match="all 50"):
        finite_points(Cloud(np.full((50, 3), np.inf)), "a.ply")
    assert extent(np.full((3, 3), np.nan)).tolist() == [0, 0, 0]


def test_metres_and_millimetres_are_told_apart(points):
    part = points / np.abs(points).max() * 100
    check_unit(part, "a.ply", "mm")
    with pytest.raises(UnitError, match="--unit m"):
        check_unit(part / 1000, "a.ply", "mm")
    with pytest.raises(UnitError, match="--unit mm"):
        check_unit(part * 1000, "a.ply", "m")
