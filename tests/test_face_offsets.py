"""Faces that are off as a whole are named and do not move the pose; the datum says which faces are right."""

import json
import warnings

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from grindvision import DetectOptions, detect
from grindvision.cli import main
from grindvision.clouds import write_ply
from grindvision.errors import AmbiguousError, DegenerateError, GrindvisionWarning, InputError
from grindvision.geometry import inverse, move_points, rigid, rotation_about
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.vision.registration.datum import in_datum
from grindvision.vision.surface import faces
from grindvision.vision.surface.faces import label_faces
from grindvision.vision.surface.surfels import build_surfels

pytestmark = pytest.mark.usefixtures("blank_pictures")

T_SAMPLE_PART = rigid(rotation_about([1.0, 0.2, 0.1], np.pi + 0.35), (4.0, -3.0, 420.0))
T_TEST_PART = rigid(
    rotation_about([1.0, -0.3, 0.15], np.pi - 0.3) @ rotation_about([0, 0, 1.0], 0.5), (0.0, 6.0, 400.0)
)
BASE, LEFT, RIGHT, WALL, SIDE = range(5)


def grid(origin, along, across, rng, step=0.9):
    """Points about ``step`` apart on a parallelogram, and its unit normal."""
    along, across = np.asarray(along, float), np.asarray(across, float)
    u = np.arange(step / 2, np.linalg.norm(along), step) / np.linalg.norm(along)
    v = np.arange(step / 2, np.linalg.norm(across), step) / np.linalg.norm(across)
    u, v = (part.ravel() for part in np.meshgrid(u, v))
    u, v = (part + rng.uniform(-0.3, 0.3, part.size) * step / 100 for part in (u, v))
    normal = np.cross(along, across)
    return origin + u[:, None] * along + v[:, None] * across, normal / np.linalg.norm(normal)


def scan(rng, pose, off=(), right=True, noise=0.015):
    """A plate with two raised faces and two sloping walls, in a scanner's frame; ``off``: face and offset."""
    faces = [
        ([-60, -40, 0], [120, 0, 0], [0, 80, 0]),
        ([-50, -30, 12], [40, 0, 0], [0, 30, 0]),
        ([10, -5, 7], [35, 0, 0], [0, 30, 0]),
        ([-60, 40, 0], [120, 0, 0], [0, 12, 24]),
        ([60, -40, 0], [0, 80, 0], [14, 0, 20]),
    ]
    kept = []
    for number, (origin, along, across) in enumerate(faces):
        if number == RIGHT and not right:
            continue
        points, normal = grid(np.array(origin, float), along, across, rng)
        if number == BASE:  # nothing under the raised faces
            for (x, y, _), (a, _, _), (_, b, _) in faces[1 : 3 if right else 2]:
                points = points[
                    ~((points[:, 0] > x) & (points[:, 0] < x + a) & (points[:, 1] > y) & (points[:, 1] < y + b))
                ]
        if number >= WALL:  # the two walls face inwards
            normal = normal if normal[2] > 0 else -normal
        kept.append(points + dict(off).get(number, 0.0) * normal)
    points = np.concatenate(kept)
    return move_points(pose, points) + noise * rng.standard_normal((len(points), 3))


def pair(off=(), right=True, seed=0, T_test=T_TEST_PART):
    rng = np.random.default_rng(seed)
    return scan(rng, T_SAMPLE_PART, (), right), scan(rng, T_test, off, right)


def found_with(sample, test, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = detect(sample, test, DetectOptions(**options))
    return found, [str(one.message) for one in caught if issubclass(one.category, GrindvisionWarning)]


def pose_error(found, T_test=T_TEST_PART):
    corners = np.array([[x, y, z] for x in (-60, 60) for y in (-40, 40) for z in (0, 20)], float)
    test = move_points(T_test, corners)
    return np.linalg.norm(move_points(found.T_sample_test, test) - move_points(T_SAMPLE_PART, corners), axis=1).max()


def test_a_scan_falls_into_its_faces_largest_first():
    points = scan(np.random.default_rng(0), T_SAMPLE_PART)
    labels = label_faces(build_surfels(points, 1.8))
    assert labels.max() == 4
    counts = np.bincount(labels[labels >= 0])
    assert (np.diff(counts) <= 0).all()
    areas = np.array([120 * 80 - 40 * 30 - 35 * 30, 120 * 26.8, 80 * 24.4, 1200, 1050])
    np.testing.assert_allclose(counts / counts.sum(), areas / areas.sum(), atol=0.03)


def plain_faces(surfels):
    """``label_faces`` in NumPy and SciPy."""
    points, normals, size = surfels.points, surfels.normals, surfels.grid.size_mm
    around = within_radius(build_cells(points, faces.REACH * size), points, faces.REACH * size)
    one, other = np.repeat(np.arange(len(points)), np.diff(around.starts)), around.indices
    step = np.abs(((points[other] - points[one]) * normals[one]).sum(axis=1))
    alike = (normals[one] * normals[other]).sum(axis=1) > faces.COS_SMOOTH
    flat = surfels.roughness_mm < 3 * np.median(surfels.roughness_mm) + faces.MAX_ROUGH * size
    linked = alike & (step < faces.MAX_STEP * size) & flat[one] & flat[other]
    links = coo_matrix((np.ones(int(linked.sum())), (one[linked], other[linked])), shape=(len(points),) * 2)
    piece = connected_components(links, directed=False)[1]
    counts = np.bincount(piece)
    order = np.argsort(-counts, kind="stable")
    rank = np.full(len(counts), -1)
    large = counts[order] >= max(40, 0.01 * len(points))
    rank[order[large]] = np.arange(large.sum())
    labels = rank[piece]
    beside = np.abs(((points[one] - points[other]) * normals[other]).sum(axis=1)) < faces.MAX_STEP * size / 2
    beside &= (labels[one] < 0) & (labels[other] >= 0)
    grown = labels.copy()
    np.maximum.at(grown, one[beside], labels[other[beside]])
    return grown


@pytest.mark.parametrize("size_mm", [1.8, 3.0])
def test_faces_are_those_of_the_plain_way(size_mm, rng):
    points = scan(rng, T_SAMPLE_PART)
    surfels = build_surfels(points + 0.1 * rng.standard_normal(points.shape), size_mm)
    assert label_faces(surfels).max() >= 2
    np.testing.assert_array_equal(label_faces(surfels), plain_faces(surfels))


@pytest.mark.parametrize("offset", [0.2, 0.35, 0.5, -0.3])
@pytest.mark.parametrize("face", [BASE, LEFT])
def test_a_face_that_is_off_is_named_and_moves_no_pose(face, offset):
    found, said = found_with(*pair([(face, offset)], seed=int(100 * abs(offset))))
    assert pose_error(found) < 0.06
    (one,) = found.faces_off
    assert one.offset_mm == pytest.approx(offset, abs=0.03)
    assert one.area_mm2 == pytest.approx({BASE: 7350, LEFT: 1200}[face], rel=0.25)
    assert any("as a whole by" in text and "the pose is theirs" in text for text in said)
    assert not any("swapped" in text or "larger" in text or "smaller" in text for text in said)
    assert not found.beads
    standing = [piece for piece in found.difference.clusters if piece.area_mm2 > 500]
    assert len(standing) == (offset > 0)
    if offset > 0:
        assert np.median(standing[0].signed_mm) == pytest.approx(offset, abs=0.04)


def block(rng, pose, allowance_mm=0.0):
    """A corner block with a rib on its top, whose side is parallel to the right face; the allowance is on that face."""
    faces = [
        ([-40, -30, 50], [80, 0, 0], [0, 60, 0]),
        ([-40, -30, 0], [80, 0, 0], [0, 0, 50]),
        ([40 + allowance_mm, -30, 0], [0, 60, 0], [0, 0, 50]),
        ([0, -30, 50], [0, 22, 0], [0, 0, 14]),
        ([-20, -30, 64], [20, 0, 0], [0, 22, 0]),
        ([-20, -8, 50], [20, 0, 0], [0, 0, 14]),
    ]
    points = np.concatenate([grid(np.array(origin, float), along, across, rng)[0] for origin, along, across in faces])
    return move_points(pose, points) + 0.015 * rng.standard_normal((len(points), 3))


@pytest.mark.parametrize("seed", range(3))
def test_a_face_that_holds_the_pose_and_is_off_is_named_beside_the_one_that_contradicts_it(seed):
    """The pose follows the large face, and the rib's small side disagrees; that is no body that has moved."""
    rng = np.random.default_rng(seed)
    toward = rigid(rotation_about([1.0, -0.7, 0.1], 2.1), (0.0, 0.0, 400.0))
    turned = rigid(rotation_about([1.0, -0.6, 0.2], 2.2) @ rotation_about([0, 0, 1.0], 0.4), (5.0, 3.0, 410.0))
    sample, test = block(rng, toward), block(rng, turned, 0.4)
    with pytest.raises(DegenerateError, match=r"the faces contradict each other: either what is about .* --datum"):
        found_with(sample, test)
    front_and_rib = np.array([[-41, -31, -1], [41, -29, 51]]), np.array([[-1, -31, 49], [1, -7, 65]])
    part = move_points(inverse(toward), sample)
    datum = part[np.any([((part > low) & (part < high)).all(axis=1) for low, high in front_and_rib], axis=0)]
    top = part[(part[:, 2] > 49.5) & (part[:, 2] < 50.5)]
    found, _ = found_with(sample, test, datum_mm=move_points(toward, np.concatenate([datum, top])))
    standing = max(found.difference.clusters, key=lambda piece: piece.area_mm2)
    assert standing.area_mm2 == pytest.approx(3000, rel=0.4)
    assert np.median(standing.signed_mm) == pytest.approx(0.4, abs=0.05)


def test_of_a_good_part_no_face_is_named():
    found, said = found_with(*pair())
    assert found.faces_off == () and not found.difference.clusters
    assert not any("as a whole by" in text for text in said)
    assert pose_error(found) < 0.06


def test_moving_the_test_scan_changes_nothing():
    T_moved = rigid(rotation_about([0.0, 0.1, 1.0], 1.1), (3.0, 2.0, 15.0)) @ T_TEST_PART
    found, _ = found_with(*pair([(BASE, 0.3)], T_test=T_moved))
    assert found.faces_off[0].offset_mm == pytest.approx(0.3, abs=0.03)
    assert pose_error(found, T_moved) < 0.06


def test_two_faces_that_contradict_each_other_are_both_named_and_the_datum_decides():
    sample, test = pair([(BASE, 0.4)], right=False)
    found, said = found_with(sample, test)
    offsets = sorted(one.offset_mm for one in found.faces_off)
    assert len(offsets) == 2 and offsets[0] < -0.3 and offsets[1] > 0.3
    assert any("either" in text and "--datum" in text for text in said)
    part = move_points(inverse(T_SAMPLE_PART), sample)
    left = (np.abs(part[:, 0] + 30) < 19) & (np.abs(part[:, 1] + 15) < 14) & (part[:, 2] > 11)
    walls = (part[:, 2] > 2) & ~left
    by_left, _ = found_with(sample, test, datum_mm=sample[left | walls])
    assert pose_error(by_left) < 0.06
    assert by_left.difference.clusters[0].area_mm2 > 4000
    by_base, _ = found_with(sample, test, datum_mm=sample[~left])
    assert pose_error(by_base) == pytest.approx(0.4, abs=0.15)
    assert not any(piece.area_mm2 > 300 for piece in by_base.difference.clusters)


def test_a_datum_that_fixes_nothing_is_refused_by_name():
    sample, test = pair()
    base = (np.abs(move_points(inverse(T_SAMPLE_PART), sample)) < [55, 35, 1]).all(axis=1)
    with pytest.raises(AmbiguousError, match="the datum leaves a motion free: a translation along"):
        detect(sample, test, DetectOptions(datum_mm=sample[base]))
    with pytest.raises(DegenerateError, match="show only 0 cells of the datum"):
        detect(sample, test, DetectOptions(datum_mm=[[900, 0, 0], [950, 9, 9]]))
    for wrong in (np.zeros((1, 3)), np.zeros((4, 2)), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="a datum of shape"):
            in_datum(sample, wrong, 1.0)


def test_the_command_takes_a_box_or_a_file(tmp_path, capsys):
    sample, test = pair([(BASE, 0.4)])
    write_ply(tmp_path / "sample.ply", sample)
    write_ply(tmp_path / "test.ply", test)
    low, high = sample.min(axis=0) - 1, sample.max(axis=0) + 1
    box = [f"{value:.3f}" for value in (*low, *high)]
    part = move_points(inverse(T_SAMPLE_PART), sample)
    write_ply(tmp_path / "datum.ply", sample[part[:, 2] > 1.5])
    words = ["detect", str(tmp_path / "sample.ply"), str(tmp_path / "test.ply"), "-o", str(tmp_path / "out")]

    def pose(*more):
        assert main([*words, *more]) == 0
        return json.loads((tmp_path / "out" / "report.json").read_text())

    assert pose()["faces_off"][0]["offset_mm"] == pytest.approx(0.4, abs=0.03)
    by_file = pose("--datum", str(tmp_path / "datum.ply"))
    assert by_file["faces_off"] == []
    T = np.array(by_file["T_sample_test"])
    corners = np.array([[x, y, 0.0] for x in (-60, 60) for y in (-40, 40)])
    away = move_points(T, move_points(T_TEST_PART, corners)) - move_points(T_SAMPLE_PART, corners)
    assert np.linalg.norm(away, axis=1).max() < 0.06
    pose("--datum", *box)  # all of the part: every face counts
    capsys.readouterr()
    for wrong in (["1", "2", "3"], ["a", "b", "c", "d", "e", "f"]):
        assert main([*words, "--datum", *wrong]) == 2
        assert "six numbers" in capsys.readouterr().err
