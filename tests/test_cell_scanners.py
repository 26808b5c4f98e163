"""Scanners: exact without errors, honest with them, and clear when they see nothing."""

from dataclasses import replace

import numpy as np
import pytest

from grindvision import cell
from grindvision.cell import ScannerErrors
from grindvision.cell.scanner_errors import sum_of_cosines
from grindvision.cell.solids import box
from grindvision.errors import InputError, NotRigidError, SightError
from grindvision.geometry import fit_plane, inverse, move_points, rigid, rotate_vectors, rotation_about
from grindvision.vision.depth_calibration.field_correction import calibrate_field
from grindvision.vision.metrology.step_height import measure_step

DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def plate():
    return cell.Target(cell.flat_plate())


def sighting(plate, scanner, distance, every):
    return scanner.sight(plate, rigid(DOWN, [0, 0, distance]), every)


def test_without_errors_points_lie_on_the_surface_exactly(plate):
    scanner = cell.StructuredLightScanner(errors=ScannerErrors())
    pose = rigid(rotation_about([1, 2, 0], 0.2) @ DOWN, [5.0, -60.0, 400.0])
    scan = scanner.scan(plate, pose, np.random.default_rng(0), every=8)
    assert np.abs(scan.world_points()[:, 2]).max() < 1e-9
    np.testing.assert_array_equal(scan.points, scan.true_points)


def plain_sighting(scanner, target, pose, every):
    """Twin of ``Scanner.sight`` in plain NumPy: the hits' points, normals, light and incidence."""
    u, v = np.arange(0, scanner.columns, every), np.arange(0, scanner.rows, every)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = scanner.rays(pixels)
    hits = target.cast(pose[:3, 3], rays @ pose[:3, :3].T)
    corners, normals = target.corners[hits.triangle], target.normals[hits.triangle]
    to_plane = np.einsum("ij,ij->i", corners - pose[:3, 3], normals)
    points = rays[hits.ray] * (to_plane / np.einsum("ij,ij->i", (rays @ pose[:3, :3].T)[hits.ray], normals))[:, None]
    eyes = np.zeros(3), np.array([scanner.baseline_mm, 0.0, 0.0])
    light = target.sees(move_points(pose, points), normals, move_points(pose, eyes[1]))
    normals = rotate_vectors(inverse(pose), normals)
    ways = [(eye - points) / np.linalg.norm(eye - points, axis=1, keepdims=True) for eye in eyes]
    cosines = [np.clip(np.einsum("ij,ij->i", way, normals), -1, 1) for way in ways]
    return pixels[hits.ray] // every, points, normals, light, np.maximum(*(np.arccos(cosine) for cosine in cosines))


@pytest.mark.parametrize(
    "scanner", [cell.StructuredLightScanner(far_mm=600.0), cell.DepthCamera()], ids=["EinScan", "D415"]
)
@pytest.mark.parametrize("every", [3, 7])
@pytest.mark.parametrize(
    "aim", [[5.0, -3.0, 2.0], [95.0, 70.0, 0.0], [-150.0, 0.0, 0.0]], ids=["whole", "corner", "side"]
)
def test_a_sighting_is_what_plain_arrays_make_of_the_same_rays(scanner, every, aim):
    target = cell.Target(cell.grinding_part().test)
    pose = cell.view_from(np.array(aim), 430.0, 0.3, 1.0, 0.2)
    seen = scanner.sight(target, pose, every)
    pixels, points, normals, light, incidence = plain_sighting(scanner, target, pose, every)
    np.testing.assert_array_equal(seen.pixels, pixels)
    np.testing.assert_array_equal(seen.in_light, light)
    for found, plain in ((seen.points, points), (seen.normals, normals), (seen.incidence_rad, incidence)):
        np.testing.assert_allclose(found, plain, atol=1e-9)


def test_the_sum_of_cosines_is_exact_to_rounding(rng):
    points, waves, phases = (
        400 * rng.standard_normal((500, 3)),
        rng.standard_normal((24, 3)) / 30,
        rng.uniform(0, 7, 24),
    )
    plain = np.cos(points @ waves.T + phases).sum(axis=1)
    np.testing.assert_allclose(sum_of_cosines(points, waves, phases), plain, atol=1e-11)


def test_height_target_is_measured_exactly_without_errors():
    scanner = cell.StructuredLightScanner(errors=ScannerErrors())
    for position in cell.POSITIONS_MM.values():
        scan = scanner.measure(cell.height_sighting(scanner, position, 4), np.random.default_rng(0))
        assert measure_step(scan.points, np.random.default_rng(0)).height_mm == pytest.approx(30.40, abs=1e-6)


def test_table_1_errors_are_tens_of_micrometres_at_the_specified_accuracy():
    scanner = cell.StructuredLightScanner()
    sightings = [cell.height_sighting(scanner, position, 6) for position in cell.POSITIONS_MM.values()]
    means = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        scans = [scanner.with_serial(seed).measure(sighting, rng) for sighting in sightings]
        means.append(np.mean([abs(measure_step(scan.points, rng).height_mm - 30.40) for scan in scans]))
    assert 0.008 < np.median(means) < 0.05


@pytest.mark.parametrize("distance", [350.0, 500.0, 700.0])
def test_depth_camera_noise_follows_the_published_formula(plate, distance):
    camera = cell.DepthCamera(errors=cell.DepthCamera().errors.only("triangulation_px", "correlated_px"))
    scan = camera.measure(sighting(plate, camera, distance, 4), np.random.default_rng(1))
    rms = np.std(scan.points[:, 2] - scan.true_points[:, 2])
    subpixel = np.hypot(0.05, 0.06)
    assert rms == pytest.approx(distance**2 * subpixel / (1005 * 55), rel=0.05)


def test_disparity_comes_in_steps(plate):
    camera = cell.DepthCamera(errors=ScannerErrors(triangulation_px=0.05, disparity_step_px=1 / 32))
    scan = camera.measure(sighting(plate, camera, 500.0, 16), np.random.default_rng(1))
    steps = 32 * camera.focal_px * camera.baseline_mm / scan.points[:, 2]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_distortion_belongs_to_the_instrument_and_has_its_stated_size(plate):
    scanner = cell.StructuredLightScanner().with_errors(cell.StructuredLightScanner().errors.only("distortion_mm"))
    view = sighting(plate, scanner, 400.0, 16)
    one, again = (scanner.measure(view, np.random.default_rng(seed)).points for seed in (1, 2))
    other = scanner.with_serial(2).measure(view, np.random.default_rng(1)).points
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 0.01
    errors = [scanner.with_serial(s).systematic_mm(view.points).std() for s in range(10)]
    assert np.mean(errors) == pytest.approx(0.045, rel=0.1)


def test_every_error_moves_a_point_along_its_ray(plate):
    scanner = cell.StructuredLightScanner()
    scan = scanner.measure(sighting(plate, scanner, 400.0, 16), np.random.default_rng(3))
    assert np.abs(np.cross(scan.points, scan.true_points)).max() < 1e-9


def test_correlated_noise_is_shared_by_neighbours_and_white_noise_is_not(plate):
    scanner = cell.StructuredLightScanner()
    for source, shared in (("correlated_px", 0.9), ("white_mm", 0.0)):
        instrument = scanner.with_errors(scanner.errors.only(source))
        view = instrument.sight(plate, rigid(DOWN, [0, 0, 400.0]), window=(400, 640, 300, 460))
        scan = instrument.measure(view, np.random.default_rng(0))
        noise = scan.image(scan.points[:, 2] - scan.true_points[:, 2])
        assert np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1] == pytest.approx(shared, abs=0.1)


def test_shadow_mixed_pixels_and_grazing_angles_act_where_they_should():
    step = cell.Target((box("low", [-80, -60, -20], [80, 60, 0]) + box("high", [-20, -60, 0], [20, 60, 30])).solid())
    scanner = cell.StructuredLightScanner(errors=ScannerErrors())
    view = scanner.sight(step, rigid(DOWN, [0, 0, 420.0]), 4)
    rng = np.random.default_rng(0)
    lit = scanner.with_errors(ScannerErrors(shadow=True)).measure(view, rng)
    lost = view.points[~view.in_light]
    assert 0 < len(lost) < 0.2 * len(view.points)
    assert (lost[:, 0] < -18).all()  # the projector stands at +x, so shadows fall towards -x
    assert len(lit) == len(view.points) - len(lost)
    mixed = scanner.with_errors(ScannerErrors(mixed_pixels=1.0)).measure(view, rng)
    between = mixed.surface_id == -1
    assert between.any()
    assert (mixed.points[between, 2] > 389).all() and (mixed.points[between, 2] < 421).all()
    assert not mixed.on("high")[between].any()
    beside = scanner.sight(step, rigid(DOWN, [50.0, 0, 420.0]), 4)
    flat = scanner.with_errors(ScannerErrors(grazing_deg=60.0)).measure(beside, rng)
    wall = np.abs(beside.normals[:, 2]) < 0.5
    assert wall.any() and len(flat) == len(beside.points) - wall.sum()


def test_same_seed_same_scan(plate):
    scanner = cell.StructuredLightScanner()
    pose = rigid(DOWN, [0, 0, 400.0])
    one, two = (scanner.scan(plate, pose, np.random.default_rng(9), every=8) for _ in range(2))
    np.testing.assert_array_equal(one.points, two.points)


def test_a_pose_that_sees_nothing_and_a_part_out_of_range_are_named(plate):
    scanner = cell.StructuredLightScanner()
    rng = np.random.default_rng(0)
    with pytest.raises(SightError, match="sees nothing"):
        scanner.scan(plate, rigid(np.eye(3), [0, 0, 400.0]), rng, every=16)
    with pytest.raises(SightError, match="measuring range of 350 to 450"):
        scanner.scan(plate, rigid(DOWN, [0, 0, 700.0]), rng, every=16)
    with pytest.raises(NotRigidError, match="T_world_scanner"):
        scanner.scan(plate, np.ones((4, 4)), rng)


def test_bad_error_budgets_are_named():
    with pytest.raises(InputError, match="white_mm is -1"):
        ScannerErrors(white_mm=-1)
    with pytest.raises(InputError, match="no error source wind"):
        ScannerErrors().only("wind")
    with pytest.raises(InputError, match="fraction of pixels"):
        ScannerErrors(mixed_pixels=2.0)
    with pytest.raises(InputError, match="reference distance"):
        replace(cell.StructuredLightScanner(), reference_mm=900.0)


def test_field_calibration_takes_the_bend_off_a_flat_plate(plate):
    scanner = cell.StructuredLightScanner(serial=7)
    rng = np.random.default_rng(7)
    steps = np.array([0.0, 16.0, 32.0])
    plates = [scanner.measure(sighting(plate, scanner, 384.0 + step, 12), rng).points for step in steps]
    correction = calibrate_field(plates, steps)
    fresh = scanner.measure(sighting(plate, scanner, 395.0, 12), rng).points
    quiet = scanner.with_errors(scanner.errors.without("white_mm", "triangulation_px", "correlated_px"))
    fresh = quiet.measure(sighting(plate, scanner, 395.0, 12), rng).points
    before, after = fit_plane(fresh).rms_mm, fit_plane(correction.apply(fresh)).rms_mm
    assert after < 0.4 * before
    with pytest.raises(InputError, match="different steps"):
        calibrate_field(plates, [0.0, 0.0, 1.0])


def test_distortion_grows_with_the_square_of_the_distance():
    """As the error of a disparity does. The view is far wider than a wave, so that it holds as much of the field."""
    scanner = cell.StructuredLightScanner().with_errors(cell.StructuredLightScanner().errors.only("distortion_mm"))
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21))
    rays = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    near, far = (
        np.mean([scanner.with_serial(s).systematic_mm(z * rays).var() for s in range(40)])
        for z in (scanner.reference_mm, 2 * scanner.reference_mm)
    )
    assert np.sqrt(far / near) == pytest.approx(4.0, rel=0.1)
