"""The page "When it does not work": every mistake on it is made here, and must say what the page quotes."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import grindvision_book
from grindvision.arm import read_arm, write_arm
from grindvision.cli import main
from grindvision.clouds import write_ply
from grindvision.geometry import rigid, rotation_about
from grindvision.vision.seam.groove_fit import MIN_POINTS_ACROSS, MIN_WALL_SLOPE
from tests.calibration_rig import ROBOT, as_table, er3a, rig, ur5
from tests.grinding_scene import arc_bead, on_a_table, pair, plate_height, scan, view
from tests.groove_scenes import cloud, grid, straight_groove, vee
from tests.hand_eye_scene import TARGET, looking_poses, seen_points, sphere_view
from tests.seam_scenes import corner, two_tubes
from tests.test_hand_eye import folder_of_parts
from tests.test_merge import folder_of
from tests.test_moved_body import scanned as part_on_table

pytestmark = pytest.mark.usefixtures("blank_pictures")

PAGE = Path(grindvision_book.__file__).parent / "site_sources" / "when_it_does_not_work.md"
Mistake = Callable[[Path], list[object]]
MISTAKES: list[tuple[str, Mistake]] = []

#: A scanner half a metre above the table that looks straight down.
ABOVE = rigid(np.diag([1.0, -1.0, -1.0]), [310.0, 0.0, 450.0])


def quotations() -> dict[str, str]:
    """Section of the page -> the line it quotes."""
    sections = re.split(r"^### ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    quoted = [(section.splitlines()[0], re.findall(r"^> `(.+)`$", section, re.MULTILINE)) for section in sections]
    assert all(len(lines) == 1 for _, lines in quoted)
    return {title: lines[0] for title, lines in quoted}


def mistake(title: str) -> Callable[[Mistake], Mistake]:
    """Register a function that writes bad input to a folder and returns the command's words, without the output."""

    def register(make: Mistake) -> Mistake:
        MISTAKES.append((title, make))
        return make

    return register


@cache
def beaded():
    """A good part and one with a bead, in two scanner frames."""
    return pair(seed=11, n_points=20_000, beads=[arc_bead()])


def two(folder: Path, sample: np.ndarray, test: np.ndarray, *more: object) -> list[object]:
    """Words of ``detect`` for two clouds."""
    write_ply(folder / "good.ply", sample)
    write_ply(folder / "test.ply", test)
    return ["detect", folder / "good.ply", folder / "test.ply", *more]


def seen_twice(surface, folder: Path, *, second=None, windows=((-70, 70, -70, 70),) * 2) -> list[object]:
    """Words of ``detect`` for two views of a surface, or of two surfaces."""
    rng = np.random.default_rng(1)
    views = view(0.15, (1.0, 0.3, 0.0)), view(0.47, (0.2, -0.5, 0.8))
    pairs = zip((surface, second or surface), views, windows, strict=True)
    return two(folder, *(scan(shape, pose, 15_000, rng, window=window) for shape, pose, window in pairs))


def pose_file(folder: Path, matrix) -> Path:
    (folder / "pose.json").write_text(json.dumps({"T_base_scanner": np.asarray(matrix).tolist(), "base": "model"}))
    return folder / "pose.json"


def seam(folder: Path, points=None, *more: object) -> list[object]:
    """Words of ``groove`` for a cloud, a plate with one good groove when none is given."""
    rng = np.random.default_rng(1)
    write_ply(folder / "cloud.ply", straight_groove(rng)[0] if points is None else points)
    return ["groove", folder / "cloud.ply", *more]


def welded(folder: Path, pose) -> list[object]:
    return seam(folder, None, "--robot", "ur3", "--scanner-pose", pose_file(folder, pose))


@cache
def measured():
    return rig(er3a(), np.random.default_rng(2), test=12)


def spheres(folder: Path, measurements=None, table=None, arm=None) -> list[object]:
    """Words of ``calibrate`` for measurements, or a table of them, and an arm."""
    table = as_table(measurements or measured().measurements) if table is None else table
    table.to_csv(folder / "m.csv", index=False)
    write_arm(arm or er3a(), folder / "r.csv")
    return ["calibrate", folder / "m.csv", "--robot", folder / "r.csv"]


@mistake("The unit is wrong")
def metres(folder):
    return two(folder, beaded().sample, beaded().test / 1000)


@mistake("The unit is in doubt")
def inches_for_millimetres(folder):
    return two(folder, beaded().sample / 25.4, beaded().test / 25.4)


@mistake("One of the two scans has another unit")
def inches(folder):
    return two(folder, beaded().sample, beaded().test * 25.4)


@mistake("The file is cut short")
def half_a_file(folder):
    words = two(folder, beaded().sample, beaded().test)
    cut = folder / "test.ply"
    cut.write_bytes(cut.read_bytes()[:100_000])
    return words


@mistake("Points without a place")
def holes(folder):
    test = beaded().test.copy()
    test[::50] = np.nan
    return two(folder, beaded().sample, test)


@mistake("The two scans do not fit")
def another_part(folder):
    return seen_twice(plate_height, folder, second=lambda x, y: 7 * np.sin(x / 30) * np.cos(y / 25))


@mistake("One of the scans is mirrored")
def left_handed(folder):
    return two(folder, beaded().sample, beaded().test * [1, -1, 1])


@mistake("Ambiguous: the part can slide or turn")
def extruded(folder):
    return seen_twice(lambda x, y: 6 * np.sin(x / 20) + 4 * np.cos(x / 9), folder)


@mistake("Ambiguous: the part is symmetric")
def square(folder):
    return seen_twice(lambda x, y: 6 * np.cos(x / 9) + 6 * np.cos(y / 9), folder)


@mistake("Ambiguous: the part can slide or turn")
def flat(folder):
    return seen_twice(lambda x, y: 0 * x, folder)


@mistake("Ambiguous: the part can slide or turn")
def ball(folder):
    return seen_twice(lambda x, y: np.sqrt(150**2 - x**2 - y**2), folder)


@mistake("Nothing to grind")
def low_bead(folder):
    low = pair(seed=11, n_points=20_000, beads=[arc_bead(height_mm=0.03)])
    return two(folder, low.sample, low.test)


@mistake("Too small to follow")
def spatter(folder):
    spiked = pair(seed=11, beads=[arc_bead(length_mm=1.0, width_mm=4.0, height_mm=6.0)])
    return two(folder, spiked.sample, spiked.test)


@mistake("Sample and test swapped")
def swapped(folder):
    return two(folder, beaded().test, beaded().sample)


@mistake("The test scan has another scale")
def swollen(folder):
    return two(folder, beaded().sample, 1.02 * beaded().test)


@mistake("The overlap hardly fixes the pose")
def apart(folder):
    return seen_twice(plate_height, folder, windows=((-100, -20, -70, 70), (0, 100, -70, 70)))


@mistake("The part was put down anew on its table")
def put_down_anew(folder):
    return two(folder, *part_on_table(1, 1.0, 0.5, False)[0])


@mistake("A table around the part")
def mostly_table(folder):
    return two(folder, *on_a_table((300, 220)))


@mistake("Transposed")
def by_columns(folder):
    return [*two(folder, beaded().sample, beaded().test), "--scanner-pose", pose_file(folder, ABOVE.T)]


@mistake("Not a rotation")
def two_digits(folder):
    rounded = rigid(np.round(rotation_about([1, 2, 3], 1.0), 2), ABOVE[:3, 3])
    return [*two(folder, beaded().sample, beaded().test), "--scanner-pose", pose_file(folder, rounded)]


@mistake("In metres")
def pose_in_metres(folder):
    small = rigid(ABOVE[:3, :3], ABOVE[:3, 3] / 1000)
    return [*two(folder, beaded().sample, beaded().test), "--scanner-pose", pose_file(folder, small)]


@mistake("The inverse, or the wrong moment")
def inverted(folder):
    return welded(folder, np.linalg.inv(ABOVE))


@mistake("The inverse, or the wrong moment")
def inverted_for_detect(folder):
    pose = pose_file(folder, np.linalg.inv(ABOVE))
    return [*two(folder, beaded().sample, beaded().test), "--scanner-pose", pose]


@mistake("No groove")
def a_plate(folder):
    places = grid()
    return seam(folder, cloud(places, 0 * places[:, 0], np.random.default_rng(1)))


@mistake("No groove")
def too_flat(folder):
    places = grid()
    return seam(folder, cloud(places, vee(places[:, 1], 10, 0.8), np.random.default_rng(1)))


@mistake("No groove")
def too_noisy(folder):
    return seam(folder, straight_groove(np.random.default_rng(1), 6.0, 2.0, noise_mm=1.2)[0])


@mistake("No groove")
def too_narrow(folder):
    return seam(folder, straight_groove(np.random.default_rng(1), spacing_mm=3.5)[0])


@mistake("No groove")
def from_behind(folder):
    return seam(folder, None, "--viewpoint", 0, 0, 900)


@mistake("The groove lies partly outside")
def at_the_rim(folder):
    points = straight_groove(np.random.default_rng(1))[0]
    return seam(folder, points[grid()[:, 1] < 4])


def between_blocks(folder: Path, gap_mm: float, high_mm: float, groove_mm: float = 0.0) -> list[object]:
    """Words of ``groove`` for two blocks on a table; a groove in one of them is so deep."""
    places = grid(200, 200, 1.0)
    y = places[:, 1]
    heights = np.where(np.abs(y) < gap_mm / 2, 0, high_mm + vee(y - 60, depth_mm=groove_mm))
    return seam(folder, cloud(places, heights, np.random.default_rng(1)))


@mistake("A hollow without edges")
def between_tubes(folder):
    """Two tubes of 60 mm radius, 90 mm apart, and a weld of 20 mm radius in their corner."""
    places = grid(150, 120)
    y = np.abs(places[:, 1])
    foot = np.sqrt(80.0**2 - 45.0**2) - 60.0
    weld = foot - np.sqrt(np.maximum(20.0**2 - y**2, 0))
    heights = np.where(y < 45.0 * 20 / 80, weld, np.sqrt(60.0**2 - (y - 45.0) ** 2) - 60.0)
    return seam(folder, cloud(places, heights, np.random.default_rng(1)))


@mistake("The groove may be a gap between two things")
def two_blocks(folder):
    return between_blocks(folder, 40, 30)


@mistake("The largest hollows are no grooves")
def deep_gap(folder):
    return between_blocks(folder, 40, 100, groove_mm=6.0)


@mistake("The groove holds few points")
def shiny(folder):
    rng = np.random.default_rng(1)
    points, inside = straight_groove(rng, spacing_mm=0.4)
    return seam(folder, points[~inside | (rng.random(len(points)) < 0.2)])


@mistake("A seam is followed in part")
def behind_a_hole(folder):
    points = corner(np.random.default_rng(1), length=112.0)
    hole = (points[:, 0] > 0) & (points[:, 0] < 42)
    return [*seam(folder, points[~hole]), "--viewpoint", 20, -220, 320]


@mistake("Plates or tubes")
def narrow_tube(folder):
    points = two_tubes(np.random.default_rng(20), 30.0, 6.0, noise_mm=0.3)
    return [*seam(folder, points[points[:, 1] > -10.0]), "--viewpoint", 0, 0, 420]


def sphere_from(folder: Path, poses: np.ndarray, angles: str) -> list[object]:
    """Words of ``hand-eye`` for a sphere seen from poses, whose Euler angles are in degrees."""
    rng = np.random.default_rng(1)
    for row, centre in enumerate(seen_points(poses, rng)):
        write_ply(folder / f"v{row}.ply", sphere_view(centre, 19.05, rng, 500))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    np.savetxt(folder / "poses.txt", np.hstack([poses[:, :3, 3], turns]))
    views = [folder / f"v{row}.ply" for row in range(len(poses))]
    read = ["--rotation", "xyz", "--angles", angles]
    return ["hand-eye", folder / "poses.txt", *views, "--target", "sphere:38.1", *read]


@mistake("The poses are read in another way than they were written")
def degrees_as_radians(folder):
    return sphere_from(folder, looking_poses(np.random.default_rng(3), 7), "rad")


@mistake("All poses turn about one axis")
def one_axis(folder):
    first = looking_poses(np.random.default_rng(3), 1)[0]
    at_sphere = first.copy()
    at_sphere[:3, 3] = TARGET
    poses = []
    for row in range(6):
        swung = at_sphere @ rigid(rotation_about([0.0, 1.0, 0.0], 0.15 * row)) @ np.linalg.inv(at_sphere) @ first
        poses.append(swung + rigid(translation_mm=[4.0 * row, -3.0 * row, 0]) - np.eye(4))
    return sphere_from(folder, np.array(poses), "deg")


def flat_plates(folder: Path, steps: np.ndarray, *, bent: float = 0.0) -> list[object]:
    """Words of ``calibrate-field`` for three plates 20 mm apart; ``bent`` tilts the last."""
    u, v = (part.ravel() for part in np.meshgrid(np.linspace(-0.3, 0.3, 40), np.linspace(-0.2, 0.2, 30)))
    for k, distance in enumerate((400.0, 420.0, 440.0)):
        depth = distance / (1 - bent * (k == 2) * u) + 0.3 * np.sin(20 * u)
        write_ply(folder / f"plate{k}.ply", np.column_stack([u, v, np.ones(u.size)]) * depth[:, None])
    return ["calibrate-field", *(folder / f"plate{k}.ply" for k in range(3)), "--steps-mm", *steps]


def field(folder: Path) -> Path:
    """A field correction, from 400 to 440 mm."""
    assert main([*map(str, flat_plates(folder, np.array([0, 20, 40]))), "-o", str(folder / "camera")]) == 0
    return folder / "camera" / "field.npz"


@mistake("The steps contradict the plates")
def towards_the_scanner(folder):
    return flat_plates(folder, np.array([0, -20, -40]))


@mistake("The plate was tilted between the scans")
def turned(folder):
    return flat_plates(folder, np.array([0, 20, 40]), bent=0.12)


@mistake("Work outside the calibrated volume")
def farther_away(folder):
    points = straight_groove(np.random.default_rng(1))[0]
    return seam(folder, points + [0, 0, 300.0], "--field-correction", field(folder))


@mistake("The cloud is not in the scanner's frame")
def on_the_table(folder):
    points = straight_groove(np.random.default_rng(1))[0]
    return seam(folder, points - points.mean(axis=0), "--field-correction", field(folder))


@mistake("A mesh has no scanner's error")
def joined_views(folder):
    words = two(folder, beaded().sample, beaded().test, "--field-correction", field(folder))
    corners = beaded().test[:2000].tolist()
    lines = [*("v {} {} {}".format(*corner) for corner in corners), *(f"f {i} {i + 1} {i + 2}" for i in range(1, 1999))]
    (folder / "test.obj").write_text("\n".join(lines))
    return [folder / "test.obj" if word == folder / "test.ply" else word for word in words]


@mistake("A way point out of reach")
def far_away(folder):
    return welded(folder, rigid(ABOVE[:3, :3], [810.0, 0.0, 450.0]))


@mistake("Behind the table")
def too_low(folder):
    return welded(folder, rigid(ABOVE[:3, :3], [310.0, 0.0, 370.0]))


@mistake("No line of names")
def without_names(folder):
    words = spheres(folder)
    table = folder / "m.csv"
    table.write_text(table.read_text().split("\n", 1)[1])
    return words


@mistake("Degrees")
def degrees(folder):
    measurements = measured().measurements
    return spheres(folder, replace(measurements, q_rad=np.degrees(measurements.q_rad)))


@mistake("Metres")
def scanner_in_metres(folder):
    measurements = measured().measurements
    return spheres(folder, replace(measurements, scanner_mm=measurements.scanner_mm / 1000))


@mistake("A mirrored frame")
def image_axes(folder):
    measurements = measured().measurements
    return spheres(folder, replace(measurements, scanner_mm=measurements.scanner_mm * [1, -1, 1]))


@mistake("Shifted rows")
def one_reading_too_many(folder):
    measurements = measured().measurements
    return spheres(folder, replace(measurements, tracker_mm=np.roll(measurements.tracker_mm, 1, axis=0)))


@mistake("Too few measurements")
def eight_rows(folder):
    return spheres(folder, measured().measurements.rows(np.arange(8)))


@mistake("The rank is low: a joint did not move")
def joint_three_at_rest(folder):
    measurements, cell = measured().measurements, measured().cell
    q = np.where(np.arange(4) == 2, 0.3, measurements.q_rad)
    return spheres(folder, replace(measurements, q_rad=q, tracker_mm=cell.points_tracker(q, measurements.scanner_mm)))


@mistake("A row contradicts the others")
def one_bad_row(folder):
    table = as_table(measured().measurements)
    table.loc[3, "bx_mm"] += 5
    return spheres(folder, table=table)


@mistake("Something moved during the session")
def tracker_bumped(folder):
    measurements = measured().measurements
    after = np.arange(len(measurements)) >= 30
    moved = measurements.tracker_mm + np.outer(after, [0.6, 0.8, 0.0])
    return spheres(folder, replace(measurements, tracker_mm=moved, train=np.ones(len(after), dtype=bool)))


@mistake("A standard DH table")
def standard_table(folder):
    modified = er3a().table
    standard = np.column_stack([np.roll(modified[:, :2], -1, axis=0), modified[:, 2:]])
    standard[-1, :2] = 0
    return spheres(folder, arm=er3a().with_table(standard))


@mistake("The table is another arm's")
def another_arm(folder):
    return spheres(folder, arm=ur5().first(4))


@mistake("The table is too long")
def all_six_joints(folder):
    return spheres(folder, arm=read_arm(ROBOT))


@mistake("The controller counts from another base")
def a_pose_of_either_base(folder):
    pose = folder / "bare.json"
    pose.write_text(json.dumps(ABOVE.tolist()))
    return seam(folder, None, "--robot", "ur3", "--scanner-pose", pose)


@mistake("The arm speaks another language")
def a_kuka_programme_for_a_yaskawa(folder):
    write_ply(folder / "plate.ply", np.eye(3))
    pose = pose_file(folder, ABOVE)
    return ["groove", folder / "plate.ply", "--scanner-pose", pose, "--robot", "gp7", "--program", "krl"]


@mistake("A hot run that names no output")
def an_arc_without_an_output(folder):
    write_ply(folder / "plate.ply", np.eye(3))
    pose = pose_file(folder, ABOVE)
    return ["groove", folder / "plate.ply", "--scanner-pose", pose, "--robot", "gp7", "--program", "jbi", "--arc"]


def dry_groove(folder: Path, arm: str, program: str, *more: object) -> list[object]:
    """Words of ``groove`` that are refused before the cloud is read."""
    write_ply(folder / "plate.ply", np.eye(3))
    words = ["groove", folder / "plate.ply", "--scanner-pose", pose_file(folder, ABOVE), "--robot", arm]
    return [*words, "--program", program, *more]


@mistake("A swing too fast to stand beside")
def a_wild_weave(folder):
    return dry_groove(folder, "gp12", "jbi", "--weave", "12", "--weave-frequency", "9")


@mistake("The format cannot say where the arc burns")
def tacks_in_a_table_of_poses(folder):
    return dry_groove(folder, "gp12", "csv", "--tacks", "5")


@mistake("A work object without its place")
def a_named_work_object(folder):
    return dry_groove(folder, "irb1200_5_90", "rapid", "--work-object", "wTable")


@mistake("The joints cannot follow the weave")
def a_weave_beyond_the_joints(folder):
    words = ["--program", "urscript", "--weave", "10", "--weave-frequency", "5"]
    return [*welded(folder, ABOVE), *words]


@mistake("A tack away from the seam")
def a_tack_elsewhere(folder):
    (folder / "tacks.csv").write_text("x_mm,y_mm,z_mm\n0,30,400\n")
    return [*welded(folder, ABOVE), "--program", "urscript", "--tacks", folder / "tacks.csv"]


@mistake("The part leaves a motion free")
def a_flat_part(folder):
    return ["hand-eye", *folder_of_parts(folder, flat=True)]


@mistake("One cloud for two poses")
def a_cloud_copied(folder):
    words = folder_of_parts(folder)
    first = folder / "v0.ply"
    for view_file in words[1:-6]:
        Path(view_file).write_bytes(first.read_bytes())
    return ["hand-eye", *words]


@mistake("A pose for each view")
def a_view_too_few(folder):
    words = folder_of(folder)
    return ["merge", *words[:4], *words[5:]]


@mistake("The arm's calibration in place of the camera's")
def the_other_hand_eye_file(folder):
    (folder / "other.json").write_text('{"T_joint_scanner": 1}')
    return ["merge", *folder_of(folder)[:-1], folder / "other.json"]


@mistake("The views meet nowhere")
def views_in_other_places(folder):
    words = folder_of(folder)
    rows = np.loadtxt(words[0])
    rows[:, 0] += 1000.0 * np.arange(len(rows))
    np.savetxt(words[0], rows, fmt="%.9f")
    return ["merge", *words]


def ground(folder: Path, sample: np.ndarray, test: np.ndarray, *more: object) -> list[object]:
    """Words of ``grind`` for two clouds."""
    return ["grind", *two(folder, sample, test, *more)[1:]]


@mistake("Metal is missing, not left over")
def a_pit_to_grind(folder):
    return ground(folder, beaded().test, beaded().sample)


@mistake("A step finer than the scanner sees")
def a_step_below_the_noise(folder):
    return ground(folder, beaded().sample, beaded().test, "--depth", "0.01")


@mistake("The keep-out zone closes the stock in")
def all_is_kept_out(folder):
    return ground(folder, beaded().sample, beaded().test, "--keep-out", folder / "test.ply")


@mistake("No job in that folder")
def no_job_there(folder):
    write_ply(folder / "test.ply", beaded().test)
    return ["grind", "--again", folder / "nowhere", folder / "test.ply"]


@mistake("The folder cannot be written")
def a_file_of_that_name(folder):
    (folder / "out").write_text("in the way")
    return ["simulate", "calibration"]


def test_every_section_of_the_page_has_its_mistake():
    assert set(quotations()) == {title for title, _ in MISTAKES}
    assert len(quotations()) > 30


def test_numbers_on_the_page_are_those_of_the_code():
    page = PAGE.read_text(encoding="utf-8")
    assert f"walls flatter than {np.degrees(np.arctan(MIN_WALL_SLOPE)):.0f} degrees" in page
    assert MIN_POINTS_ACROSS == 4 and "fewer than four points fit across" in page


#: Two more parts that slide or turn: they take longest to be refused.
BY_NIGHT = (flat, ball)


@pytest.mark.parametrize(
    ("title", "make"),
    [
        pytest.param(*one, marks=[pytest.mark.full] if one[1] in BY_NIGHT else [], id=one[1].__name__)
        for one in MISTAKES
    ],
)
def test_the_mistake_says_what_the_page_quotes(title, make, tmp_path, capsys):
    words = [str(word) for word in make(tmp_path)]
    code = main([*words, "-o", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    quoted = quotations()[title]
    pattern = re.escape(quoted).replace("…", ".+")
    assert any(re.fullmatch(pattern, line) for line in (out + err).splitlines()), f"{quoted}\n---\n{out}{err}"
    refused = quoted.startswith("grindvision ")
    assert code == (2 if refused else 0)
    assert err.count("\n") == 1 or not refused
    assert refused != (tmp_path / "out" / "report.json").exists()
