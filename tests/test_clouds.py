"""Cloud files: what is written is read back; what is damaged is refused before memory is taken."""

import contextlib
import struct
import zipfile

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
    np.save(tmp_path / "two.npy", points)
    with zipfile.ZipFile(tmp_path / "two.npz", "w") as archive:
        archive.write(tmp_path / "two.npy", "points.npy")
        archive.write(tmp_path / "a.npy", "other.npy")
    np.testing.assert_array_equal(read_cloud(tmp_path / "two.npz").points, points)


@pytest.fixture
def patch():
    """Vertices and triangles of a wavy patch, dense enough to stand for its surface."""
    u, v = np.meshgrid(np.arange(120.0), np.arange(100.0))
    at = np.arange(u.size).reshape(u.shape)
    corners = [at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[:-1, :-1], at[1:, 1:], at[1:, :-1]]
    triangles = np.stack([corner.ravel() for corner in corners], axis=1).reshape(-1, 3)
    return np.column_stack([u.ravel(), v.ravel(), np.sin(u / 20).ravel()]), triangles


def stl_text(corners):
    text = "".join(
        "facet normal 0 0 1\n outer loop\n"
        + "".join("  vertex {:.9g} {:.9g} {:.9g}\n".format(*corner) for corner in triangle)
        + " endloop\nendfacet\n"
        for triangle in corners
    )
    return "solid part\n" + text + "endsolid part\n"


def stl_bytes(corners, title=b""):
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *triangle.ravel(), 0) for triangle in corners)
    return title.ljust(80) + struct.pack("<I", len(corners)) + body


def test_dense_meshes_give_their_vertices(tmp_path, patch):
    vertices, triangles = patch
    (tmp_path / "a.stl").write_bytes(stl_bytes(vertices[triangles], title=b"solid though binary"))
    (tmp_path / "b.stl").write_text(stl_text(vertices[triangles]))
    (tmp_path / "a.obj").write_text(
        "mtllib ../../secret.mtl\n"
        + "".join("v {:.9g} {:.9g} {:.9g} 0.5 0.5 0.5\n".format(*row) for row in vertices)
        + "".join("f {}//1 {}//1 {}//1\n".format(*(row + 1)) for row in triangles)
    )
    for name in ("a.stl", "b.stl", "a.obj"):
        assert read_cloud(tmp_path / name).mesh
        found = read_cloud(tmp_path / name).points
        order = np.lexsort(found.T[::-1]), np.lexsort(vertices.T[::-1])
        np.testing.assert_allclose(found[order[0]], vertices[order[1]], atol=1e-4)


@pytest.mark.parametrize("name", ["box.stl", "box.obj"])
def test_a_drawn_part_is_sampled_evenly(tmp_path, name):
    corners = np.array([[x, y, z] for x in (0, 80) for y in (0, 60) for z in (0, 10)], dtype=float)
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    if name.endswith("obj"):
        text = "".join("v {} {} {}\n".format(*row) for row in corners)
        (tmp_path / name).write_text(text + "".join("f {} {} {} {}\n".format(*quad) for quad in quads))
    else:
        triangles = [[corners[i - 1] for i in (q[0], *q[k : k + 2])] for q in quads for k in (1, 2)]
        (tmp_path / name).write_bytes(stl_bytes(np.array(triangles)))
    with pytest.warns(GrindvisionWarning, match="spread evenly"):
        cloud = read_cloud(tmp_path / name)
    faces = np.isclose(cloud.points[:, :, None], [[0, 80], [0, 60], [0, 10]], atol=1e-6).reshape(len(cloud), 6)
    assert faces.any(axis=1).all()
    share = faces[:, 4].mean()
    assert share == pytest.approx(80 * 60 / (2 * (80 * 60 + 80 * 10 + 60 * 10)), rel=0.01)
    floor = cloud.points[faces[:, 4]]
    cells = np.histogram2d(floor[:, 0], floor[:, 1], bins=(8, 6), range=((0, 80), (0, 60)))[0]
    assert cells.min() > 0.9 * cells.mean() and cells.max() < 1.1 * cells.mean()
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, rtol=1e-6)


def test_pickled_arrays_are_not_loaded(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FileError, match="type object"):
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


ROWS = np.array([[1.5, 2.25, 3], [4, 5.5, 6], [7, 8, 9.75], [10, 11, 12]])


def table(form, end="\n"):
    return "".join(form.format(*row) + end for row in ROWS)


AS_EXPORTED = {
    "blank_after_comma.csv": table("{}, {}, {}"),
    "comma_at_the_end.csv": table("{},{},{},"),
    "windows.xyz": table("{} {} {}", "\r\n"),
    "mark.csv": "\ufeffx,y,z\n" + table("{},{},{}"),
    "quoted.csv": '"X","Y","Z"\n' + table('"{}","{}","{}"'),
    "order.csv": "id,r,g,b,z,y,x\n" + "".join("1,9,9,9,{},{},{}\n".format(*row[::-1]) for row in ROWS),
    "cloudcompare.asc": "//R G B X Y Z\n" + table("255 0 0 {} {} {}"),
    "paraview.csv": '"Points:0","Points:1","Points:2","scalar"\n' + table("{},{},{},1"),
    "units.csv": "X [mm];Y [mm];Z [mm]\n" + table("{};{};{}"),
    "count.pts": "4\n" + table("{} {} {} 0.5 255 0 0"),
    "title.txt": "Scan of part 7\nexported 2020\n" + table("{} {} {}"),
    "latin.xyz": "# Maße in °\n" + table("{} {} {}"),
}


@pytest.mark.parametrize("name", AS_EXPORTED)
def test_tables_as_programmes_export_them(tmp_path, name):
    (tmp_path / name).write_bytes(AS_EXPORTED[name].encode("latin-1" if name == "latin.xyz" else "utf-8"))
    np.testing.assert_array_equal(read_cloud(tmp_path / name).points, ROWS)


@pytest.mark.parametrize("form", ["{};{};{}", "{} {} {}", "{}\t{}\t{}"])
def test_decimal_commas_are_read_and_said(tmp_path, form):
    (tmp_path / "a.csv").write_text(table(form).replace(".", ","))
    with pytest.warns(GrindvisionWarning, match="decimal points"):
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv").points, ROWS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (table("{},{},{}").replace(".", ","), "may part columns or stand for decimal points"),
        ("1;;3\n4;5;6\n", "row 1: '' is no number"),
        ("1,234.5;2,000.0;3,5\n", "'1.234.5' is no number"),
        ("a,b,c\n1,2,3\n", "none are named x, y, z"),
        ("x_m,y_m,z_mm\n1,2,3\n", "different units"),
        ("1 2 3\n4 5\n", "row 2 has 2 columns, the rows before 3"),
    ],
)
def test_a_table_that_could_mean_two_things_is_refused(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(FileError, match=message):
        read_cloud(tmp_path / "a.csv")


def test_columns_named_in_metres_are_metres(tmp_path):
    (tmp_path / "a.csv").write_text("x_m,y_m,z_m\n" + table("{},{},{}"))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv").points, 1000 * ROWS)
    with pytest.raises(UnitError, match="named in m"):
        read_cloud(tmp_path / "a.csv", "mm")


def test_elements_before_the_vertices_and_colours_are_passed_over(tmp_path):
    vertices = "element vertex 4\n" + "".join(f"property double {name}\n" for name in "xyz")
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    camera = "element camera 1\nproperty float a\nproperty int b\n"
    grid = "element range_grid 2\nproperty list uchar int vertex_indices\n"
    binary = f"ply\nformat binary_big_endian 1.0\ncomment café\n{camera}{vertices}{colours}end_header\n"
    body = b"".join(struct.pack(">3d3B", *row, 1, 2, 3) for row in ROWS)
    (tmp_path / "a.ply").write_bytes(binary.replace("\n", "\r\n").encode() + bytes(8) + body)
    (tmp_path / "b.ply").write_text(f"ply\nformat ascii 1.0\n{grid}{vertices}end_header\n0\n1 3\n" + table("{} {} {}"))
    for name in ("a.ply", "b.ply"):
        np.testing.assert_array_equal(read_cloud(tmp_path / name).points, ROWS)


def packed_pcd(packed, size, fields="x y z", kinds="F F F", sizes="4 4 4", counts="1 1 1"):
    head = f"VERSION .7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {kinds}\nCOUNT {counts}\nWIDTH 2\nHEIGHT 2\nPOINTS 4\n"
    return (head + "DATA binary_compressed\n").encode() + struct.pack("<II", len(packed), size) + packed


def test_packed_fields_of_any_kind_are_unpacked(tmp_path):
    values = ROWS.T.astype("<f4").tobytes() + np.full(4, 0xFF00FF, "<u4").tobytes() + bytes(16)
    literal = b"".join(
        bytes([len(values[at : at + 32]) - 1]) + values[at : at + 32] for at in range(0, len(values), 32)
    )
    fields = ("x y z rgb _", "F F F U U", "4 4 4 4 1", "1 1 1 1 4")
    (tmp_path / "a.pcd").write_bytes(packed_pcd(literal, len(values), *fields))
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points, ROWS)
    assert cloud.grid == (2, 2)


@pytest.mark.parametrize("packed", [b"\xff\xff\xff", b"\x00", b"\x20\x05", bytes([31, *range(10)]), bytes([0, 1] * 24)])
def test_packed_bytes_that_lie_are_refused(tmp_path, packed):
    (tmp_path / "a.pcd").write_bytes(packed_pcd(packed, 48))
    with pytest.raises(FileError, match="damaged"):
        read_cloud(tmp_path / "a.pcd")
    fields = ("x y z big", "F F F U", "4 4 4 1", "1 1 1 4000000000")
    (tmp_path / "a.pcd").write_bytes(packed_pcd(packed, 48, *fields))
    with pytest.raises(FileError, match="header is damaged"):
        read_cloud(tmp_path / "a.pcd")


def test_an_archive_is_judged_by_its_sizes_before_it_is_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        np.save(tmp_path / "zeros.npy", np.zeros((300_000, 3)))
        archive.write(tmp_path / "zeros.npy", "points.npy")
    with pytest.raises(FileError, match="no measured cloud"):
        read_cloud(tmp_path / "bomb.npz")
    header = (tmp_path / "zeros.npy").read_bytes()[:128].replace(b"(300000, 3)", b"(9" + b"0" * 8 + b",3)")
    for name in ("lie.npz", "lie.npy"):
        path = tmp_path / name
        if name.endswith("npz"):
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("points.npy", header)
        else:
            path.write_bytes(header)
        with pytest.raises(FileError, match="announces 21600000000 bytes"):
            read_cloud(path)
    np.savez(tmp_path / "two.npz", a=ROWS, b=ROWS)
    with pytest.raises(FileError, match="arrays a, b"):
        read_cloud(tmp_path / "two.npz")
    np.save(tmp_path / "turned.npy", np.zeros((3, 500)))
    with pytest.raises(FileError, match="transposed"):
        read_cloud(tmp_path / "turned.npy")


def test_a_doubtful_size_asks_for_the_unit(points):
    small = points / np.linalg.norm(np.ptp(points, axis=0)) * 12
    with pytest.raises(UnitError, match="say --unit mm, cm, m or in"):
        check_unit(small, "a.ply")
    check_unit(small, "a.ply", "mm")
    with pytest.raises(UnitError, match="subtract the offset"):
        check_unit(small + 2e6, "a.ply", "mm")


def test_far_points_are_written_in_double(tmp_path, points):
    write_ply(tmp_path / "a.ply", points + 500_000)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ply").points, points + 500_000, atol=1e-9)


@pytest.mark.parametrize("value", [(0.0, 0.0, 0.0), (7.5, -2.0, 99.0)])
def test_pixels_without_depth_are_left_out_whole(rng, value):
    """Not one of them stays as a point of the surface."""
    points = rng.uniform(0, 100, (3000, 3))
    points[::10] = value
    with pytest.warns(GrindvisionWarning, match="300 of 3000 points are .* a pixel without depth"):
        left = finite_points(Cloud(points), "a.ply")
    assert len(left) == 2700 and (left != value).any(axis=1).all()
    with pytest.raises(FileError, match="all 50 finite points are"):
        finite_points(Cloud(np.tile(value, (50, 1))), "a.ply")
