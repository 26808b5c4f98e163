"""Field calibration on flat plates: what it takes off, what it cannot know, its file, and its smoothing spline."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from grindvision import cell
from grindvision.errors import DegenerateError, FileError, InputError
from grindvision.geometry import fit_plane
from grindvision.vision.depth_calibration.field_correction import (
    CalibrateFieldOptions,
    FieldCorrection,
    _at_measured,
    calibrate_field,
    held_out_rms_mm,
    read_field,
    write_field,
)
from grindvision.vision.depth_calibration.field_errors import predict_field_errors
from grindvision.vision.depth_calibration.grid_smoothing import (
    fitting_stiffness,
    on_axes,
    roughness,
    smooth_grid,
    spline_matrix,
)
from grindvision.vision.depth_calibration.plate_checks import diagnose_plates
from grindvision_book.chapter_11.waypoints import PLATES_MM, depth_left, plate_scans

STEPS_MM = np.array([0.0, 20.0, 40.0, 60.0])
FIRST_MM = 420.0
FIRST = CalibrateFieldOptions(FIRST_MM)
TILTED = np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])


def rays(count=120):
    u, v = np.meshgrid(np.linspace(-0.3, 0.3, count), np.linspace(-0.2, 0.2, count * 2 // 3))
    return np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)])


def waves(points):
    """A bend of 0.4 mm, waves of some 150 mm, in mm."""
    x, y, z = points.T
    return 0.4 * np.sin(x / 25) * np.cos(y / 30 + z / 40)


def shown(distance_mm, error, rng=None, noise_mm=0.0, normal=(0.0, 0.0, 1.0)):
    """A plate's points as a scanner with this depth error shows them."""
    at = rays() * (distance_mm / (rays() @ normal))[:, None]
    depth = at[:, 2] + error(at) + (noise_mm * rng.standard_normal(len(at)) if noise_mm else 0.0)
    return rays() * depth[:, None]


def plates(error, **more):
    return [shown(FIRST_MM + step, error, **more) for step in STEPS_MM]


def off_mm(correction, error, distance_mm=447.0):
    """Signed depth errors that are left on a plate that took no part."""
    fresh = shown(distance_mm, error)
    return correction.apply(fresh)[:, 2] - distance_mm


def test_a_scale_error_is_taken_off_when_the_distance_is_known():
    def scale(points):
        return 2e-3 * points[:, 2]

    assert_allclose(off_mm(calibrate_field(plates(scale), STEPS_MM, FIRST), scale), 0, atol=1e-4)
    free = off_mm(calibrate_field(plates(scale), STEPS_MM), scale)
    assert np.ptp(free) < 1e-4 and free.mean() == pytest.approx(2e-3 * (FIRST_MM + STEPS_MM.mean()), abs=0.01)


@pytest.mark.parametrize("normal", [np.array([0.0, 0.0, 1.0]), TILTED])
def test_waves_and_noise_leave_little_whichever_way_the_plate_is_tilted(rng, normal):
    learned = calibrate_field(plates(waves, rng=rng, noise_mm=0.3, normal=normal), STEPS_MM, FIRST)
    left = off_mm(learned, waves)
    assert np.abs(waves(shown(447.0, waves))).max() > 0.39
    assert left.std() < 0.05
    assert off_mm(learned, waves).mean() == pytest.approx(0, abs=0.02)


def test_order_of_the_plates_and_strays_do_not_matter(rng):
    clouds = plates(waves, rng=rng, noise_mm=0.1)
    learned = calibrate_field(clouds, STEPS_MM, FIRST)
    other = calibrate_field(
        clouds[1:] + clouds[:1], np.append(STEPS_MM[1:], 0) - 20, CalibrateFieldOptions(FIRST_MM + 20)
    )
    assert_allclose(other.error_grid_mm, learned.error_grid_mm, atol=1e-6)
    spoilt = clouds[2].copy()
    spoilt[::50] *= rng.uniform(0.5, 2.0, len(spoilt[::50]))[:, None]
    robust = calibrate_field([*clouds[:2], spoilt, clouds[3]], STEPS_MM, FIRST)
    assert np.abs(off_mm(robust, waves) - off_mm(learned, waves)).max() < 0.05


def test_holes_in_the_plates_are_bridged(rng):
    clouds = plates(waves, rng=rng, noise_mm=0.1)
    holed = [cloud[np.hypot(cloud[:, 0] - 20 * k, cloud[:, 1]) > 15] for k, cloud in enumerate(clouds)]
    assert off_mm(calibrate_field(holed, STEPS_MM, FIRST), waves).std() < 0.06


@pytest.mark.parametrize("serial", range(4))
def test_a_depth_camera_is_left_with_a_quarter_of_its_error_corners_included(serial):
    camera, rng = cell.DepthCamera(serial=serial), np.random.default_rng(serial)
    clouds = plate_scans(camera, rng)
    left = depth_left(camera, calibrate_field(clouds, PLATES_MM - PLATES_MM[0], CalibrateFieldOptions(PLATES_MM[0])))
    rms = np.sqrt((left[["left_mm", "true_mm"]] ** 2).mean())
    assert rms["left_mm"] < 0.25 * rms["true_mm"]
    before, after = held_out_rms_mm(clouds, PLATES_MM - PLATES_MM[0])
    assert after < 0.5 * before


def test_a_stage_that_errs_spoils_no_more_than_it_errs():
    camera = cell.DepthCamera(serial=5)
    rms = []
    for step_error_mm in (0.0, 0.2):
        clouds = plate_scans(camera, np.random.default_rng(1), step_error_mm=step_error_mm)
        learned = calibrate_field(clouds, PLATES_MM - PLATES_MM[0])
        rms.append(depth_left(camera, learned)["left_mm"].std())
    assert rms[0] < rms[1] < rms[0] + 0.2


def test_the_kernel_agrees_with_its_plain_twin_and_nan_stays_nan(rng):
    learned = calibrate_field(plates(waves, rng=rng, noise_mm=0.1), STEPS_MM, FIRST)
    points = rng.uniform([-250, -150, 380], [250, 150, 520], (5000, 3))
    place = np.stack([points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], points @ learned.normal])
    intervals = np.subtract(learned.error_grid_mm.shape, 1)[:, None]
    at = (place - learned.low[:, None]) / (learned.high - learned.low)[:, None] * intervals
    twin = map_coordinates(learned.error_grid_mm, at, order=1, mode="nearest")
    assert_allclose(learned.error_mm(points), twin, atol=1e-9)
    points[7] = np.nan
    assert np.isnan(learned.apply(points)[7]).all() and np.isfinite(np.delete(learned.apply(points), 7, axis=0)).all()


def test_one_plate_bends_alike_at_every_distance(rng):
    learned = calibrate_field([shown(FIRST_MM, waves)], [0.0])
    near, far = (learned.error_mm(rays() * z) for z in (300.0, 600.0))
    assert_allclose(near, far, atol=1e-12)
    assert learned.holds(rays() * 900.0).mean() > 0.95
    flat = learned.apply(shown(FIRST_MM, waves))
    assert fit_plane(flat).rms_mm < 0.1 * fit_plane(shown(FIRST_MM, waves)).rms_mm


def test_points_outside_the_volume_are_told_and_take_the_rims_error():
    learned = calibrate_field(plates(waves), STEPS_MM, FIRST)
    axis = np.array([[0.0, 0.0, z] for z in (300.0, 450.0, 700.0)])
    assert learned.holds(axis).tolist() == [False, True, False]
    assert learned.error_mm(axis)[0] == learned.error_mm(np.array([[0.0, 0.0, learned.low[2]]]))[0]


def test_what_is_written_is_read_back(tmp_path):
    learned = calibrate_field(plates(waves), STEPS_MM, FIRST)
    write_field(learned, tmp_path / "field.npz")
    again = read_field(tmp_path / "field.npz")
    assert_allclose(again.apply(shown(450.0, waves)), learned.apply(shown(450.0, waves)), rtol=0, atol=0)


def test_a_damaged_file_is_refused_by_name(tmp_path):
    path = tmp_path / "field.npz"
    with pytest.raises(FileError, match="no such file"):
        read_field(path)
    learned = calibrate_field(plates(waves), STEPS_MM, FIRST)
    write_field(learned, path)
    whole = path.read_bytes()
    for damaged in (whole[:-200], whole[: len(whole) // 2], b"ply\n", b"", whole[:2000] + b"XXXXXX" + whole[2006:]):
        path.write_bytes(damaged)
        with pytest.raises(FileError, match=r"field\.npz: "):
            read_field(path)
    np.savez(path, points=np.zeros((9, 3)))
    with pytest.raises(FileError, match="no array error_grid_mm"):
        read_field(path)
    for wrong in (
        replace(learned, low=learned.high, high=learned.low),
        replace(learned, normal=np.array([0.0, 0.0, 2.0])),
        replace(learned, error_grid_mm=learned.error_grid_mm[0]),
        replace(learned, error_grid_mm=learned.error_grid_mm * np.nan),
    ):
        write_field(wrong, path)
        with pytest.raises(FileError, match="not a field correction"):
            read_field(path)


def test_bad_input_is_named():
    clouds = plates(waves)
    for steps in ([0.0, 0.0, 1.0, 2.0], STEPS_MM[:2], []):
        with pytest.raises(InputError, match="different steps"):
            calibrate_field(clouds, steps)
    with pytest.raises(InputError, match="sign and unit"):
        calibrate_field(clouds, -STEPS_MM)
    with pytest.raises(InputError, match="sign and unit"):
        calibrate_field(clouds, STEPS_MM / 10)
    with pytest.raises(InputError, match="is tilted by"):
        calibrate_field([clouds[0], shown(440.0, waves, normal=[0.1, 0, np.sqrt(0.99)])], [0.0, 20.0])
    with pytest.raises(InputError, match="distance_mm is 42"):
        calibrate_field(clouds, STEPS_MM, CalibrateFieldOptions(42.0))
    with pytest.raises(InputError, match="distance_mm is nan"):
        calibrate_field(clouds, STEPS_MM, CalibrateFieldOptions(np.nan))
    with pytest.raises(InputError, match="behind the scanner"):
        calibrate_field([-cloud for cloud in clouds], STEPS_MM)
    with pytest.raises(DegenerateError, match="plate 1"):
        calibrate_field([cloud[:50] for cloud in clouds], STEPS_MM)
    with pytest.raises(InputError, match="at least 3"):
        held_out_rms_mm(clouds[:2], STEPS_MM[:2])


NODES = [np.array([0.0, 1.0, 2.5, 3.0, 4.0]), np.arange(6.0), np.array([0.0, 2.0, 3.0, 7.0])]


def test_the_smoothing_spline_solves_its_normal_equations(rng):
    shape = tuple(map(len, NODES))
    values, weights = rng.standard_normal(shape), (rng.random(shape) > 0.3).astype(float)
    stiffness = np.array([0.7, 0.2, 3.0])
    system = np.diag(weights.ravel())
    for axis, nodes in enumerate(NODES):
        parts = [roughness(nodes) if other == axis else np.eye(len(NODES[other])) for other in range(3)]
        system += stiffness[axis] * np.kron(np.kron(parts[0], parts[1]), parts[2])
    plain = np.linalg.solve(system, (weights * values).ravel()).reshape(shape)
    assert_allclose(smooth_grid(values, weights, NODES, stiffness), plain, atol=1e-4)


def test_straight_fields_pass_unchanged_however_stiff():
    x, y, z = np.meshgrid(*NODES, indexing="ij")
    straight = 1 + 2 * x - y + 0.5 * z + 0.1 * x * y
    weights = np.ones(straight.shape)
    weights[2:4, 1, :2] = 0
    assert_allclose(smooth_grid(straight, weights, NODES, np.full(3, 1e4)), straight, atol=1e-3)


def test_the_roughness_is_the_splines_bending(rng):
    nodes, values = NODES[0], rng.standard_normal(5)
    fine = np.linspace(nodes[0], nodes[-1], 20001)
    curve = spline_matrix(nodes, fine) @ values
    bending = (np.gradient(np.gradient(curve, fine), fine)[2:-2] ** 2).sum() * (fine[1] - fine[0])
    assert values @ roughness(nodes) @ values == pytest.approx(bending, rel=1e-2)
    assert_allclose(spline_matrix(nodes, nodes), np.eye(5), atol=1e-12)


def test_more_noise_asks_for_a_stiffer_spline_and_no_other_would_be_much_better(rng):
    nodes = [np.arange(40.0), np.arange(30.0), np.arange(8.0)]
    x, y, z = np.meshgrid(*nodes, indexing="ij")
    truth = np.sin(x / 4) * np.cos(y / 5 + z / 4)
    asked = []
    for size in (0.1, 0.3, 1.0):
        values, weights = truth + size * rng.standard_normal(truth.shape), np.ones(truth.shape)
        stiffness = fitting_stiffness(values, weights, nodes)
        asked.append(stiffness[0])
        reached = np.std(smooth_grid(values, weights, nodes, stiffness) - truth)
        others = [
            np.std(smooth_grid(values, weights, nodes, stiffness * [a, a, b]) - truth)
            for a, b in ((0.1, 1), (10, 1), (1, 0.1), (1, 10))
        ]
        assert reached < 1.05 * min(others) and reached < 0.3 * size
    assert asked[0] < asked[1] < asked[2]


def test_matrices_are_applied_along_their_axes(rng):
    values = rng.standard_normal((2, 3, 4))
    matrices = [rng.standard_normal((5, n)) for n in values.shape]
    assert_allclose(on_axes(matrices, values), np.einsum("ai,bj,ck,ijk->abc", *matrices, values))


def test_a_correction_says_what_it_is():
    grid = np.full((2, 2, 2), 0.25)
    words = str(FieldCorrection(grid, np.array([-0.3, -0.2, 400]), np.array([0.3, 0.2, 500]), np.array([0.0, 0, 1])))
    assert words == "field correction of 0.250 mm rms from 400 to 500 mm"


def test_a_field_over_the_measured_place_is_the_one_over_the_true_place_where_the_point_stood():
    """A true field that grows along the plate's normal has a closed form over what was measured, for every ray."""
    normal = np.array([0.5, -0.3, np.sqrt(1 - 0.34)])
    low, high = np.array([-0.4, -0.2, 300.0]), np.array([0.4, 0.3, 500.0])
    fine = [np.linspace(start, end, count) for start, end, count in zip(low, high, (5, 4, 21), strict=True)]
    u, v, distance = np.meshgrid(*fine, indexing="ij")
    found = _at_measured(FieldCorrection(0.01 * (distance - 300) + 2 * u - v, low, high, normal), fine)
    along = u * normal[0] + v * normal[1] + normal[2]
    wanted = (0.01 * (distance - 300) + 2 * u - v) / (1 + 0.01 * along)
    assert_allclose(found.error_grid_mm[:, :, 2:-2], wanted[:, :, 2:-2], atol=1e-5)


def steadily_tilted(deg_per_scan):
    normals = [[np.sin(a), 0.0, np.cos(a)] for a in np.radians(deg_per_scan * np.arange(4))]
    return [shown(FIRST_MM + step, waves, normal=normal) for step, normal in zip(STEPS_MM, normals, strict=True)]


def test_plates_that_contradict_their_steps_are_named_with_the_size():
    good = plates(waves)
    wrong = STEPS_MM + [0, 0, 1, 0]
    for clouds, steps, first, said in (
        (steadily_tilted(0.15), STEPS_MM, FIRST_MM, r"plates 1 and 4 are tilted against each other by 0\.4\d deg"),
        (good, wrong, FIRST_MM, r"plate 3 stands (1|0\.9\d?|1\.1) mm nearer than its step, 41 mm"),
        (good[::-1], wrong[::-1], FIRST_MM, r"plate 2 stands"),
        (good, STEPS_MM * 16 / 15, None, r"0\.93\d mm for each mm of the steps"),
        (good, STEPS_MM, FIRST_MM + 10, r"430 lies (10\.\d|9\.\d) mm behind the first plate's points"),
    ):
        (doubt,) = diagnose_plates(clouds, steps, first).warnings
        assert re.search(said, doubt), doubt
    with pytest.raises(InputError, match="is tilted by"):
        calibrate_field(steadily_tilted(0.8), STEPS_MM)


def test_faults_above_what_the_scans_could_hide_are_named_and_those_below_are_not():
    clouds = plates(waves)
    unseen = diagnose_plates(clouds, STEPS_MM, FIRST_MM).unseen
    assert unseen.step_mm is not None and unseen.distance_mm is not None
    assert unseen.tilt_deg >= 0.25 and 0 < unseen.step_mm < 1 and 2 <= unseen.distance_mm < 10
    for part, named in ((0.5, 0), (1.3, 1)):
        steps = STEPS_MM + [0, 0, part * unseen.step_mm, 0]
        assert len(diagnose_plates(clouds, steps, FIRST_MM).warnings) == named
        assert len(diagnose_plates(clouds, STEPS_MM, FIRST_MM + part * unseen.distance_mm).warnings) == named
        tilted = steadily_tilted(part * unseen.tilt_deg / 3)
        assert len(diagnose_plates(tilted, STEPS_MM, FIRST_MM).warnings) == named
    assert "a first distance wrong by up to" in str(unseen)
    assert diagnose_plates(clouds[:3], STEPS_MM[:3]).unseen.step_mm is None


@pytest.mark.parametrize("serial", range(3))
def test_good_plates_raise_no_doubt(serial):
    camera, rng = cell.DepthCamera(serial=serial + 20), np.random.default_rng(serial)
    for stands in (PLATES_MM, PLATES_MM[:4]):
        assert diagnose_plates(plate_scans(camera, rng, stands), stands - stands[0], stands[0]).warnings == ()
    assert diagnose_plates(plates(waves)[:1], [0.0], FIRST_MM).warnings == ()


@pytest.mark.parametrize(("serial", "every"), [(20, 1), (21, 2)])
def test_the_error_predicted_over_the_volume_is_the_one_that_is_left(serial, every):
    camera, rng = cell.DepthCamera(serial=serial), np.random.default_rng(serial)
    stands = PLATES_MM[::every]
    clouds, steps = plate_scans(camera, rng, stands), stands - stands[0]
    left = depth_left(camera, calibrate_field(clouds, steps, CalibrateFieldOptions(stands[0])))["left_mm"]
    predicted = predict_field_errors(clouds, steps, rng)
    assert 0.6 < predicted.mean_mm / np.sqrt(np.mean(left**2)) < 1.6
    assert predicted.mean_mm < predicted.p95_mm < predicted.worst[0]
    assert "predicted over the volume" in str(predicted)


def test_a_hole_in_all_plates_and_wide_gaps_are_predicted_worse(rng):
    clouds = plates(waves, rng=rng, noise_mm=0.05)
    whole = predict_field_errors(clouds, STEPS_MM, rng)
    holed = [cloud[np.hypot(*(cloud[:, :2] / cloud[:, 2:]).T) > 0.08] for cloud in clouds]
    part = predict_field_errors(holed, STEPS_MM, rng)
    u, v = (np.argmin(np.abs(axis)) for axis in part.slopes)
    assert part.rms_mm[u, v].mean() > 1.5 * whole.rms_mm[u, v].mean()
    assert part.rms_mm[2, 2].mean() < 2 * whole.rms_mm[2, 2].mean()
    at = np.searchsorted(whole.distances_mm, FIRST_MM + STEPS_MM[1:3])
    assert whole.rms_mm[:, :, at[0] + 1].mean() > whole.rms_mm[:, :, at].mean()
    with pytest.raises(InputError, match="at least 3"):
        predict_field_errors(clouds[:2], STEPS_MM[:2], rng)
