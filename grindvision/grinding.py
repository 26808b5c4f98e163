"""From two scans to grinding passes, and from a third scan to what they left: vision and motion joined."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, GrindvisionWarning, InputError
from grindvision.geometry import check_points, inverse, move_points
from grindvision.grinding_elsewhere import left_standing
from grindvision.grinding_region import check_region, difference_there, outside_region, piece_in_region, skin_stock
from grindvision.models import Model
from grindvision.motion.grinding import GrindingPlan, Workpiece, plan_grinding
from grindvision.motion.grinding_beside import check_beside, with_free_leads
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.comparison import Comparison, compare
from grindvision.vision.change.ridge_path import lies_on, trace_bead
from grindvision.vision.change.stock import MeasureStockOptions, Stock, StockPiece, measure_stock
from grindvision.vision.registration import scan_registration
from grindvision.vision.registration.scan_registration import StageClock
from grindvision.words import counted, rounded

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

STAGES = (*scan_registration.STAGES, "difference", "stock", "passes")

STANDS_OUT_MM = 1.0
"""Points so near to one that stands out are of the stock, or of its foot."""

MAX_HIDDEN = 0.5
"""A piece whose area is hidden by more than this fraction is interpolated rather than measured."""


@by_content
@dataclass(frozen=True)
class GrindOptions:
    """Settings of ``grind``: the ``passes``, the height ``maps``, ``keep_out`` points (K, 3) in the frame of the test
    scan that must not be touched, ``seed`` of the random draws, the scanners' places where they are known.

    ``place_sigma_mm``: standard deviation of where the arm's wheel meets a surface that the scan shows, by the errors
    of scanner, hand-eye and arm; 0 for a wheel that is touched off on the good surface beside the stock. ``datum_mm``:
    the faces that fix the pose, as in ``DetectOptions``. ``region_mm``: where there is something to be ground, in the
    frame of the test scan: the corners (2, 3) of a box, or points (K, 3) on it; what stands out elsewhere is left, and
    what may be bending of a deformed part is stock there. ``skin_mm``: so much is taken off the surface in the region
    as it lies, whatever the sample says.
    """

    passes: GrindingOptions = field(default_factory=GrindingOptions)
    maps: MeasureStockOptions = field(default_factory=MeasureStockOptions)
    keep_out: ArrayLike | None = None
    seed: int = 0
    viewpoint_sample_mm: ArrayLike | None = None
    viewpoint_test_mm: ArrayLike | None = None
    place_sigma_mm: float = 0.0
    datum_mm: ArrayLike | None = None
    region_mm: ArrayLike | None = None
    skin_mm: float | None = None

    def __post_init__(self) -> None:
        if self.skin_mm is not None and not 0 < self.skin_mm < np.inf:
            raise InputError(f"a skin of {self.skin_mm} mm was asked for; give a thickness above zero")
        if self.skin_mm is not None and self.region_mm is None:
            raise InputError("a skin is taken off in a region only: say where, by its points or a box")
        if not 0 <= self.place_sigma_mm < np.inf:
            raise InputError(f"place_sigma_mm is {self.place_sigma_mm}; give a length, 0 for a wheel touched off")


@by_content
@dataclass(frozen=True)
class Grinding:
    """Result of ``grind``, in the frame of the test scan: the ``compared`` scans, the ``stock``, and a plan for each of
    its pieces, None where there is none (``refusals`` say why, by the number of the piece)."""

    compared: Comparison
    stock: Stock
    plans: tuple[GrindingPlan | None, ...]
    refusals: dict[int, str]
    timings_s: dict[str, float] = field(compare=False)

    @property
    def T_sample_test(self) -> Floats:
        """Registration (4, 4): T_sample_test @ p_test = p_sample."""
        return self.compared.registration.T_target_source

    def __str__(self) -> str:
        planned = [plan for plan in self.plans if plan is not None]
        passes = sum(len(plan.passes) for plan in planned)
        seconds = sum(plan.seconds for plan in planned)
        work = f"{counted(passes, 'pass', 'passes')} on {counted(len(planned), 'piece')}"
        return f"{self.stock}; {work}, {seconds:.0f} s in contact"


@one_blas_thread()
def grind(
    sample: ArrayLike | Model,
    test: ArrayLike,
    options: GrindOptions | None = None,
    finished: Callable[[str], None] | None = None,
) -> Grinding:
    """Measure what stands above the good part, and plan the passes that take it off.

    Args:
        sample: scan of the good part, points (N, 3) in mm in its own scanner's frame, or its ``Model``.
        test: scan of the part to be ground, points (M, 3) in mm in its own scanner's frame.
        options: wheel, cut, process, maps; see ``GrindOptions``.
        finished: is told the name of each stage (``STAGES``) when it is done.

    Returns:
        Stock in mm, mm2 and mm3 with standard deviations, and plans, in the frame of the test scan.

    Raises:
        InputError, DegenerateError: the scans cannot be compared (see ``detect``); nothing stands out, or missing
            material only; no piece can be ground, for the reason that the message names.

    Warns:
        GrindvisionWarning: something speaks against the comparison; a piece that cannot be ground; missing material.

    Example:
        >>> from grindvision import GrindOptions, SimulateOptions, grind, simulate
        >>> scene = simulate("grinding", SimulateOptions(seed=1, every=6))
        >>> ground = grind(scene.sample.points, scene.test.points)
        >>> len(ground.stock.pieces), len(ground.plans[0].passes) > 10
        (1, True)
    """
    options = GrindOptions() if options is None else options
    clock = StageClock(finished)
    compared = compare(sample, test, options, clock)
    there = None if options.region_mm is None else check_region(compared, options.region_mm)
    stock = _stock(compared, there, options)
    clock.lap("stock")
    if not stock.pieces:
        raise DegenerateError(_no_stock(stock) + ("" if there is None else f"; {difference_there(compared, there)}"))
    centrelines = _centrelines(compared.difference)
    keep_out = None if options.keep_out is None else check_points(options.keep_out, "keep-out points")
    plans: list[GrindingPlan | None] = []
    refusals = {}
    for number, (piece, of) in enumerate(zip(stock.pieces, stock.numbers, strict=True), start=1):
        try:
            if options.skin_mm is None:
                _check_stock(compared, piece, of, options.region_mm)
            check_visible(piece)
            plan = plan_grinding(workpiece(piece, keep_out, centrelines, options.place_sigma_mm), options.passes)
            beside = _beside(compared, test, options)
            check_beside(plan, beside)
            plans.append(with_free_leads(plan, beside))
        except InputError as error:
            refusals[number] = str(error)
            plans.append(None)
    if all(plan is None for plan in plans):
        raise InputError(refusals[1] + ("" if there is None else f"; {difference_there(compared, there)}"))
    clock.lap("passes")
    said = [f"piece {number} is not ground: {why}" for number, why in refusals.items()]
    if stock.pits:
        said.append(
            f"material is missing in {counted(len(stock.pits), 'place')}, the largest {stock.pits[0]},"
            f" {stock.pit_depths_mm[0]:.2f} mm deep; it is reported and not ground"
        )
    if there is not None:
        said.append(difference_there(compared, there))
    for sentence in (*against_grinding(compared), *left_standing(compared.difference), *said):
        warnings.warn(sentence, GrindvisionWarning, stacklevel=2)
    return Grinding(compared, stock, tuple(plans), refusals, clock.laps_s)


def _stock(compared: Comparison, there: Flags | None, options: GrindOptions) -> Stock:
    """What is to be ground: what stands out, or a skin of the region, of which ``there`` (M,) are surfels."""
    if there is not None and options.region_mm is not None and options.skin_mm is not None:
        return skin_stock(compared, there, options.region_mm, options.skin_mm, options.maps)
    found = compared.registration
    return measure_stock(found.source, found.target, found.fine, compared.difference, options.maps)


def _beside(compared: Comparison, test: ArrayLike, options: GrindOptions) -> Floats:
    """Points (N, 3) of the test scan that are not ground."""
    if options.region_mm is None or options.skin_mm is None:
        return without_stock(test, compared.difference)
    return outside_region(test, options.region_mm, compared.registration.source.surfels.grid.size_mm)


def _check_stock(compared: Comparison, piece: StockPiece, of: int, region_mm: ArrayLike | None) -> None:
    """Refuse a piece of stock on which the difference's piece ``of`` was measured, where it is no stock for sure.

    Raises:
        InputError: it may be bending, and no region says that it is stock; it lies outside of the region.
    """
    if region_mm is None:
        if of in compared.doubted:
            raise InputError(f"{compared.doubted[of]}; then name the place with --region")
    elif not piece_in_region(piece, region_mm, compared.difference.cell_mm):
        raise InputError("it lies outside of the region")


def against_grinding(compared: Comparison) -> tuple[str, ...]:
    """What speaks against the comparison, in words, less what is said of the stock's pits."""
    return tuple(one for one in compared.diagnose() if "material is missing" not in one)


def without_stock(points: ArrayLike, difference: Difference) -> Floats:
    """Points (N, 3) of a scan, or its model, that are not among those that stand out."""
    points = np.asarray(points, dtype=float)
    if len(difference.points) == 0:
        return points
    return points[cKDTree(difference.points).query(points, distance_upper_bound=STANDS_OUT_MM)[0] > STANDS_OUT_MM]


def check_visible(piece: StockPiece) -> None:
    """Refuse a piece of which the test scan hides so much that its height is a guess.

    Raises:
        InputError: more than ``MAX_HIDDEN`` of its area is interpolated.
    """
    node_mm2 = piece.map.spacing_mm**2
    hidden_mm2, area_mm2 = piece.hidden.sum() * node_mm2, piece.inside.sum() * node_mm2
    if hidden_mm2 > MAX_HIDDEN * area_mm2:
        raise InputError(
            f"{hidden_mm2:.3g} of its {rounded(area_mm2)} mm2 are not shown by the test scan, so that its height is not"
            " known; scan the part from where the piece can be seen"
        )


def workpiece(
    piece: StockPiece,
    keep_out: Floats | None = None,
    centrelines: tuple[Floats, ...] = (),
    offset_sigma_mm: float = 0.0,
) -> Workpiece:
    """A piece of stock as ``plan_grinding`` takes it; ``centrelines`` (M, 3) of beads in the frame of the scan."""
    heights = piece.map
    keep = np.zeros(heights.shape, dtype=bool)
    if keep_out is not None:
        places = move_points(inverse(heights.T_scan_map), keep_out)
        at = np.rint(places[:, :2] / heights.spacing_mm).astype(np.int64)
        at = at[((at >= 0) & (at < heights.shape)).all(axis=1)]
        keep[at[:, 0], at[:, 1]] = True
    centreline = None
    for ridge in centrelines:
        on_map = move_points(inverse(heights.T_scan_map), ridge)[:, :2]
        at = np.rint(on_map / heights.spacing_mm).astype(np.int64)
        there = ((at >= 0) & (at < heights.shape)).all(axis=1)
        if there.all() and piece.inside[at[:, 0], at[:, 1]].mean() > 0.8:
            centreline = on_map
            break
    return Workpiece(
        heights, piece.inside, keep, piece.level_mm, piece.ground_sigma_mm, centreline, offset_sigma_mm=offset_sigma_mm
    )


def _centrelines(difference: Difference) -> tuple[Floats, ...]:
    """Ridges (M, 3) of the open beads among the pieces; a piece without one is worked in rows."""
    ridges = []
    for cluster in difference.clusters:
        try:
            bead = trace_bead(cluster)
        except DegenerateError:
            continue
        if not bead.closed and lies_on(cluster, bead.ridge, 2.0):
            ridges.append(bead.ridge)
    return tuple(ridges)


def _no_stock(stock: Stock) -> str:
    if stock.pits:
        return (
            f"nothing stands out of the good part above {stock.level_mm:.2g} mm, but material is missing in"
            f" {counted(len(stock.pits), 'place')}, the largest {stock.pits[0]}, {stock.pit_depths_mm[0]:.2f} mm deep:"
            " a pit is never ground; were SAMPLE and TEST swapped?"
        )
    return (
        f"nothing stands out of the good part above the level of detection of {stock.level_mm:.2g} mm: nothing to grind"
    )
