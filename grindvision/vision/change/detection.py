"""Detection of what has to be ground away, stage by stage as in the paper's flow chart (Figure 2)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import DegenerateError, GrindvisionWarning, InputError, NoPathError
from grindvision.models import Model
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.comparison import Comparison, compare
from grindvision.vision.change.coverage import Coverage, find_coverage, same_scan
from grindvision.vision.change.diagnostics import MIN_OVERLAP, Unevenness
from grindvision.vision.change.ridge_path import BeadPath, trace_bead
from grindvision.vision.registration import scan_registration
from grindvision.vision.registration.deformed_registration import DeformedPart
from grindvision.vision.registration.face_offsets import FaceOffset
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.scan_registration import Registration, StageClock
from grindvision.vision.registration.verification import VerifiedPose
from grindvision.vision.surface.model_surface import ModelSurface
from grindvision.vision.surface.scan import Scan
from grindvision.words import counted, rounded

Floats = NDArray[np.float64]

STAGES = (*scan_registration.STAGES, "difference", "path")

MUCH_COARSER, WIDE, HIGH = 2.0, 0.03, 0.008
"""Where nothing stands out, it is said that the test scan is coarse: from so many times the sample's point spacing, or
where the least width of a bead is more than this fraction of the scan's diagonal; and that it is noisy, where the least
height is more than that fraction."""


@by_content
@dataclass(frozen=True)
class DetectOptions:
    """Settings of ``detect``: path ``points`` per bead, ``seed`` of the random draws, the scanners' places if known.

    ``datum_mm``: the faces that fix the pose, in the sample's frame: the corners (2, 3) of a box, or points (K, 3) on
    them. Left out, all faces do, less one that the others contradict.
    """

    points: int = 6
    seed: int = 0
    viewpoint_sample_mm: ArrayLike | None = None
    viewpoint_test_mm: ArrayLike | None = None
    datum_mm: ArrayLike | None = None


@by_content
@dataclass(frozen=True)
class Detection:
    """Result of ``detect``; everything but ``T_sample_test`` is in the frame of the test scan.

    ``coarse`` and ``registration`` are the two stages of the registration, ``difference`` what stands out,
    ``coverage`` what could not be seen, ``beads`` the paths, largest first; ``timings_s`` the stages' times. Where the
    sample was a model, ``sample`` is what the test's scanner could see of it, and ``model`` the whole. ``faces_off``:
    faces that are off as a whole, or those of which one is where the data cannot tell which. ``deformed``: how the part
    is bent against the sample, where no rigid pose fits; ``sample`` is then bent like it.
    """

    sample: Scan
    test: Scan
    coarse: VerifiedPose
    registration: FineRegistration
    difference: Difference
    coverage: Coverage
    beads: tuple[BeadPath, ...]
    timings_s: dict[str, float] = field(compare=False)
    model: ModelSurface | None = None
    faces_off: tuple[FaceOffset, ...] = ()
    deformed: DeformedPart | None = None

    @property
    def T_sample_test(self) -> Floats:
        """Registration (4, 4): T_sample_test @ p_test = p_sample."""
        return self.registration.T_target_source

    @property
    def confidence(self) -> float:
        """How sure the registration is, 0..1."""
        return self.coarse.confidence

    @property
    def path_points(self) -> Floats:
        """Path points (n, 3) of all beads, one bead after the other."""
        return np.concatenate([bead.points for bead in self.beads] or [np.empty((0, 3))])

    @property
    def path_normals(self) -> Floats:
        """Unit normals (n, 3) at the path points."""
        return np.concatenate([bead.normals for bead in self.beads] or [np.empty((0, 3))])

    def __str__(self) -> str:
        pieces = len(self.difference.clusters)
        if pieces and not self.beads:
            standing = counted(pieces, "piece stands", "pieces stand")
            return f"no path: {standing} out, none to be followed; {self.registration}; {self.coverage}"
        if self.difference.specks and not pieces:
            standing = counted(len(self.difference.specks), "place stands", "places stand")
            return f"no path: {standing} out, none to be followed; {self.coverage}"
        if not pieces:
            level = f"the level of detection of {self.difference.level_of_detection_mm:.2f} mm"
            return f"nothing to grind above {level}; {self.coverage}"
        beads = counted(len(self.beads), "bead")
        return f"{beads}, {len(self.path_points)} path points; {self.registration}; {self.coverage}"


@one_blas_thread()
def detect(
    sample: ArrayLike | Model,
    test: ArrayLike,
    options: DetectOptions | None = None,
    finished: Callable[[str], None] | None = None,
) -> Detection:
    """Compare a test scan with the scan of a good part, and put path points along what has to be ground away.

    The stages: voxels and surfels, normals and FPFH, first alignment (SAC-IA), verification, ICP, difference, paths.

    Args:
        sample: scan of the good part, points (N, 3) in mm in its own scanner's frame, or its ``Model``: of that, what
            the test's scanner could see is compared.
        test: scan of the part to be ground, points (M, 3) in mm in its own scanner's frame.
        options: path points per bead, seed, viewpoints; see ``DetectOptions``.
        finished: is told the name of each stage (``STAGES``) when it is done.

    Returns:
        ``T_sample_test`` (4, 4); path points and normals (K, 3) in mm in the frame of the test scan; the difference.

    Raises:
        InputError: NaN points, numbers that are no points, or a scan that fits as its mirror image only. UnitError: one
            scan is many times larger than the other.
        DegenerateError: too few points; the scans do not fit, do not overlap enough, or leave a motion free; another
            part; a largest bead that branches.

    Warns:
        GrindvisionWarning: something speaks against the result (``diagnose``); a piece that shows no path, or that
            branches and is not the largest.

    Example:
        >>> from grindvision import DetectOptions, SimulateOptions, detect, simulate
        >>> scene = simulate("grinding", SimulateOptions(seed=1, every=6))
        >>> found = detect(scene.sample.points, scene.test.points, DetectOptions(points=8))
        >>> found.path_points.shape, bool(abs(found.T_sample_test - scene.T_sample_test).max() < 0.1)
        ((8, 3), True)
    """
    options = DetectOptions() if options is None else options
    if options.points < 1:
        raise InputError(f"{options.points} path points asked for; at least 1 is needed")
    clock = StageClock(finished)
    compared = compare(sample, test, options, clock)
    found, difference, deformed = compared.registration, compared.difference, compared.deformed
    coverage = find_coverage(found.source, found.target, found.fine, difference)
    against = compared.diagnose() + _unseen(found, difference, coverage)
    try:
        beads = _follow(compared, options.points)
    except DegenerateError as error:
        raise DegenerateError("; and ".join((str(error), *against))) from None
    clock.lap("path")
    if beads:
        uneven = Unevenness.between(found.source, found.target, difference)
        against += tuple(filter(None, [uneven.doubt_of_path(min(bead.height_mm for bead in beads))]))
    for sentence in against:
        warnings.warn(sentence, GrindvisionWarning, stacklevel=2)
    return Detection(
        found.target, found.source, found.coarse, found.fine, difference, coverage, beads, clock.laps_s,
        compared.model, compared.faces.off, deformed,
    )  # fmt: skip


def _unseen(found: Registration, difference: Difference, coverage: Coverage) -> tuple[str, ...]:
    """In words, what keeps the result from saying that there is nothing to grind."""
    said = []
    if not difference.clusters and same_scan(found.source, found.target, found.fine):
        said.append(
            "the points of both scans fall on one another as those of two measurements never do: SAMPLE and TEST are"
            " one scan, so nothing is said of the part; give the scan of a good part"
        )
    if not difference.clusters and coverage.test_missed and found.overlap >= MIN_OVERLAP:
        places = coverage.test_missed
        said.append(
            f"{1 - coverage.test_fraction:.0%} of the test scan ({rounded(coverage.test_missed_mm2)} mm2) was not"
            f" compared, in {counted(len(places), 'larger place')}, the largest {places[0]}: the sample shows nothing"
            " there, and what stands out there was not seen"
        )
    if not difference.clusters and (coarse := _coarser(found, difference)):
        said.append(coarse)
    if not difference.clusters and (noisy := _noisier(found, difference, coverage)):
        said.append(noisy)
    if difference.specks:
        said.append(
            f"{counted(len(difference.specks), 'place stands', 'places stand')} out without a path, too small for one"
            f" or touching nothing of the part, the largest {difference.specks[0]}: spatter, stray points, or a bead of"
            " which the scan shows little; scan it more finely"
        )
    return tuple(said)


def _coarser(found: Registration, difference: Difference) -> str:
    """In words, that the test scan is too coarse to show narrow beads; empty where it is not."""
    source, target = found.source, found.target
    per_cell = [len(scan.points) / len(scan.surfels) for scan in (target, source)]
    times = 0.0 if target.sided else float(np.sqrt(per_cell[0] / per_cell[1]))
    wide = difference.min_width_mm > WIDE * np.linalg.norm(np.ptp(source.surfels.points, axis=0))
    if times < MUCH_COARSER and not wide:
        return ""
    beside = f" {times:.1f} times as far apart as the sample's" if times >= MUCH_COARSER else " far apart"
    return (
        f"the test scan's points stand{beside}: beads narrower than {difference.min_width_mm:.2g} mm would not be"
        " seen; scan the test part more finely"
    )


def _noisier(found: Registration, difference: Difference, coverage: Coverage) -> str:
    """In words, that noise or rough skins hide low beads; empty where they do not."""
    if coverage.height_mm <= HIGH * np.linalg.norm(np.ptp(found.source.surfels.points, axis=0)):
        return ""
    hidden = f"beads lower than {coverage.height_mm:.2g} mm would not be seen on half of the test scan:"
    uneven = Unevenness.between(found.source, found.target, difference)
    if not uneven.is_noise:
        return f"{hidden} {uneven}"
    noise = [float(np.median(scan.surfels.noise_mm)) for scan in (found.source, found.target)]
    return f"{hidden} its noise is {noise[0]:.2g} mm, the sample's {noise[1]:.2g} mm; scan with less noise"


def _follow(compared: Comparison, points: int) -> tuple[BeadPath, ...]:
    """Paths of all pieces; one without a path on it, that may be bending of a deformed part, or that branches and is
    not the largest, is left out with a warning."""
    beads = []
    one_face, deformed = compared.faces.settled is not None, compared.deformed is not None  # the largest is no bead
    for rank, cluster in enumerate(compared.difference.clusters):
        try:
            if rank in compared.doubted:
                raise NoPathError(compared.doubted[rank])
            beads.append(trace_bead(cluster, points))
        except DegenerateError as error:
            if rank == 0 and not (one_face or deformed or isinstance(error, NoPathError)):
                raise
            warnings.warn(f"piece {rank + 1} of the difference is left out: {error}", GrindvisionWarning, stacklevel=3)
    return tuple(beads)
