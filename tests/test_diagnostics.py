"""Mistakes between two scans that the scans themselves give away: other units, a mirrored export, swapped roles."""

import re
import warnings
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from grindvision.errors import AmbiguousError, DegenerateError, GrindvisionWarning, InputError, UnitError
from grindvision.geometry import move_points, random_rotation, rigid
from grindvision.vision.change.detection import DetectOptions, detect
from grindvision.vision.registration import verification
from grindvision.vision.registration.agreement import Agreement
from grindvision.vision.registration.scan_registration import register
from grindvision.vision.surface.dominant_plane import plane_fraction
from grindvision.vision.surface.surfels import build_surfels
from tests.grinding_scene import arc_bead, on_a_table, pair, plate_height, scan, view


@pytest.fixture(scope="module")
def case():
    return pair(seed=11, n_points=30_000, beads=[arc_bead()])


@pytest.mark.parametrize("factor", [25.4, 10.0, 0.1])
def test_one_scan_in_another_unit(case, factor):
    with pytest.raises(UnitError, match="another unit"):
        detect(case.sample, case.test * factor)


MIRRORS = {"y": np.diag([1.0, -1, 1]), "z": np.diag([1.0, 1, -1]), "x and y": np.eye(3)[[1, 0, 2]]}
#: Mirrors with each kind of viewpoint in every run, which mirrors y in the next test; all pairs in `./run laws`.
ALL_RUNS = (("z", True), ("x and y", False))
FULL_RUNS = (("y", False), ("y", True), ("z", False), ("x and y", True))


@pytest.mark.parametrize(("axis", "told"), [*ALL_RUNS, *(pytest.param(*p, marks=pytest.mark.full) for p in FULL_RUNS)])
def test_a_mirrored_scan_is_named(case, axis, told):
    options = DetectOptions(viewpoint_test_mm=np.zeros(3) if told else None)
    named = r"mirror image.*\(overlap \d+%, of it \d+% in agreement\).*--mirrored"
    with pytest.raises((InputError, AmbiguousError), match=named):
        detect(case.sample, case.test @ MIRRORS[axis].T, options)


@pytest.mark.parametrize("seed", [12, *(pytest.param(seed, marks=pytest.mark.full) for seed in (13, 14))])
def test_a_sparse_mirrored_scan_that_leaves_a_motion_free_is_named_too(seed):
    sparse = pair(seed=seed, n_points=3_000, beads=[arc_bead()])
    told = r"mirror image.*\(overlap \d+%.*--mirrored"
    with pytest.raises((InputError, AmbiguousError), match=told):
        detect(sparse.sample, sparse.test * [1, -1, 1])


def corner_of_a_box(sizes, seed):
    """The three faces of a box of such edges that a scanner at the origin sees."""
    rng = np.random.default_rng(seed)
    faces = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        face = -np.array(sizes) * rng.random((int(4 * np.prod([sizes[k] for k in others])), 3))
        face[:, axis] = rng.normal(0, 0.02, len(face))
        faces.append(face)
    look = rigid(random_rotation(rng)) @ rigid(None, [-230.0, -260.0, -210.0])
    return move_points(look, np.concatenate(faces))


def test_a_corner_that_fits_in_part_as_it_is_and_wholly_mirrored_is_refused():
    """As it is, it fits in several poses, one of them with nine tenths of it."""
    good, bad = (corner_of_a_box((90, 40, 12), seed) for seed in (1, 2))
    with pytest.raises(AmbiguousError, match="mirror image"):
        register(bad * [1, -1, 1], good)
    assert register(bad, good).coarse.mirror is None


def test_a_part_that_is_its_own_mirror_image_is_told_with_the_size_of_the_error():
    good, bad = (corner_of_a_box((60, 60, 30), seed) for seed in (3, 4))
    with pytest.warns(GrindvisionWarning, match=r"mirror image .* fits as well .* off by up to \d+") as told:
        found = register(bad, good)
    assert len(told) == 1
    assert 20 < found.coarse.mirror.apart_mm < 2 * np.hypot(60, 60)


@pytest.mark.parametrize("seed", range(8))
def test_another_part_is_not_called_mirrored(case, seed):
    rng = np.random.default_rng(seed)
    plane = np.column_stack([rng.uniform(-60, 60, size=(20_000, 2)), rng.normal(scale=0.02, size=20_000) + 400])
    with pytest.raises(DegenerateError):
        detect(case.sample, plane)


def wheel(seed, folds=3):
    """A flat wheel with round bosses, seen from 400 mm: turned by a whole share of a turn it looks the same."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-60, 60, size=(24_000, 2))
    points = points[np.hypot(*points.T) < 60][:12_000]
    height = np.zeros(len(points))
    for angle in 2 * np.pi * np.arange(folds) / folds:
        away = np.hypot(*(points - 40 * np.array([np.cos(angle), np.sin(angle)])).T)
        height += 8 / (1 + np.exp((away - 8) / 0.5))
    return np.column_stack([points, 400 - height + rng.normal(0, 0.05, len(points))])


@pytest.mark.parametrize("seed", [1, 4, *(pytest.param(seed, marks=pytest.mark.full) for seed in (12, 13, 18, 21, 28))])
def test_a_wheel_is_ambiguous_and_not_mirrored(seed):
    with pytest.raises(AmbiguousError, match="ambiguous: a rotation") as refusal:
        detect(wheel(seed), wheel(seed + 100))
    assert "mirror" not in str(refusal.value)


@pytest.mark.parametrize("overlap", [0.1, 0.19, 0.21, 0.3, 0.73, 0.95])
@pytest.mark.parametrize("fraction", [0.45, 0.5, 0.6, 0.67, 0.69, 0.71, 0.76, 0.9])
def test_a_refusal_names_a_bound_that_was_missed(overlap, fraction):
    found = Agreement(overlap * fraction, overlap * (1 - fraction))
    judge, best = SimpleNamespace(agreement=lambda _: found, within_mm=0.1), SimpleNamespace(pose=np.eye(4))
    enough = overlap >= 0.2 and fraction >= 0.7 and found.score >= 0.15
    with nullcontext() if enough else pytest.raises(DegenerateError, match="do not fit") as refusal:
        verification._check_fit(judge, best)
    if not enough:
        seen, agreed, least_seen, least_agreed = map(int, re.findall(r"(\d+)%", str(refusal.value)))
        assert (seen, agreed) == (round(100 * overlap), round(100 * fraction))
        assert seen < least_seen or agreed < least_agreed


def test_swapped_scans_are_said_and_a_good_part_is_not(case):
    with pytest.warns(GrindvisionWarning, match="SAMPLE and TEST were swapped"):
        swapped = detect(case.test, case.sample)
    assert swapped.beads == ()
    same = pair(seed=12, n_points=30_000)
    assert detect(same.sample, same.test).beads == ()


@pytest.mark.parametrize(
    "factor", [0.98, 1.01, *(pytest.param(factor, marks=pytest.mark.full) for factor in (0.995, 1.003, 1.03))]
)
def test_another_scale_is_said_and_measured(case, factor):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        detect(case.sample, case.test * factor)
    sentence = next(str(one.message) for one in said if "than the sample" in str(one.message))
    share, word = re.search(r"is ([\d.]+)% (larger|smaller)", sentence).groups()
    assert 1 + float(share) / 100 * (1 if word == "larger" else -1) == pytest.approx(factor, abs=1.5e-3)


def corner(seed):
    """Three faces of a box 140 x 90 x 60 mm about the corner nearest to the scanner."""
    rng = np.random.default_rng(seed)
    size = np.array([140.0, 90.0, 60.0])
    faces = [rng.uniform(0, size, size=(int(size.prod() / size[k] / 0.6), 3)) * (np.arange(3) != k) for k in range(3)]
    points = np.vstack(faces) + rng.normal(0, 0.06, size=(sum(map(len, faces)), 3))
    away = np.array([-2.0, -2.5, -3.0])
    z = -away / np.linalg.norm(away)
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    return points @ np.column_stack([x, np.cross(z, x), z]) + [0, 0, 400]


@pytest.mark.parametrize("seed", range(4))
def test_three_faces_of_a_box_tell_nothing_of_the_scale(seed):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        detect(corner(seed), corner(seed + 50))
    assert not [one for one in said if "than the sample" in str(one.message)]


def test_scans_that_hardly_overlap_are_said():
    rng = np.random.default_rng(1)
    left = scan(plate_height, view(0.15, (1.0, 0.3, 0.0)), 15_000, rng, window=(-100, -20, -70, 70))
    right = scan(plate_height, view(0.47, (0.2, -0.5, 0.8)), 15_000, rng, window=(0, 100, -70, 70))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        detect(left, right)
    texts = [str(one.message) for one in said]
    assert any("compared with nothing" in text for text in texts)
    assert any(re.search(r"known to [\d.]+ mm only", text) for text in texts)


def test_real_scans_of_one_part_raise_no_doubt(real_data):
    from grindvision.clouds import read_cloud

    scans = [read_cloud(real_data(name), "m").points for name in ("bun000.ply", "bun045.ply")]
    for pair_of_scans in (scans, scans[::-1]):  # all that is told is what the sample's view did not show
        with pytest.warns(GrindvisionWarning) as told:
            assert detect(*pair_of_scans).beads == ()
        assert all("was not compared" in str(one.message) for one in told)


@pytest.mark.parametrize(
    ("half_mm", "turn_rad"),
    [
        ((300, 220), 0.5),
        ((450, 330), 0.0),
        pytest.param((300, 220), 0.0, marks=pytest.mark.full),
        pytest.param((450, 330), 0.5, marks=pytest.mark.full),
    ],
)
def test_a_large_table_is_said_whatever_comes_of_it(half_mm, turn_rad):
    sample, test = on_a_table(half_mm, turn_rad=turn_rad)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            detect(sample, test)
            sentences = " ".join(str(one.message) for one in said)
        except DegenerateError as refusal:
            sentences = str(refusal)
    share = float(re.search(r"one plane takes up (\d+)% .* crop it away", sentences).group(1)) / 100
    assert share == pytest.approx(1 - 200 * 140 / (4 * half_mm[0] * half_mm[1]), abs=0.04)


def test_no_table_is_seen_on_the_part_itself(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        detect(case.sample, case.test)
        detect(*on_a_table((130, 100)))


def test_the_fraction_of_a_plane_does_not_depend_on_frame_or_order(rng):
    points, _ = on_a_table((300, 220))
    fractions = []
    for _ in range(5):
        T_other_scanner = rigid(random_rotation(rng), rng.uniform(-300, 300, 3))
        moved = move_points(T_other_scanner, rng.permutation(points))
        fractions.append(plane_fraction(build_surfels(moved, 10.0)))
    assert np.ptp(fractions) < 0.04
