"""Faces that are off as a whole: a milling allowance, a coating. Least squares takes them for a motion of the part.

Each large face in turn may differ from the good part by a constant beside the pose. The one with which far more of the
rest agrees is off, and the pose is fitted to the rest. Where another face explains the scans as well, both are named.
A face that alone holds a motion can be off by any amount: the scans fit all the same, which is told, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points, rigid, rotate_vectors, small_motion
from grindvision.geometry.hash_grid import build_cells, random_order
from grindvision.geometry.neighbours import nearest
from grindvision.records import by_content
from grindvision.vision.registration.deformable import TUKEY, block_covariance
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import NORMAL_NOISE
from grindvision.vision.surface.faces import label_faces
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.words import rounded

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

SAMPLES = 4000
"""So many surfels of the source show what its faces do."""

LARGE, MIN_SAMPLES = 0.02, 40
"""Faces under this share of the samples, or of fewer, are not asked for."""

MAX_FACES = 8
"""So many of the largest faces are asked for."""

AGREES = 3.0
"""Samples within so many standard deviations of a face's own spread agree."""

MIN_GAIN, NEARLY = LARGE, 0.02
"""Share of the samples that must agree more when one face is off, as the smallest face asked for does when it agrees as
a whole, and by which another reading may be worse."""

SAME_MOTION = 0.5
"""A motion is that of a face that is off where the two differ by so much of the offset at most: along the face what
disagrees holds it loosely."""

MIN_OFFSET = 5.0
"""Least offset of a face that is named, in standard deviations of a face's own spread."""

FIRST_SIGMA_CELLS = 0.5
"""Standard deviation in cells of what counts fully at first."""

HELD = 2 * NORMAL_NOISE**2
"""The pose is that of the other faces where every motion is resisted by more than this part of them, which the errors
of the normals alone make up."""

ABSORBED = 0.05
"""A face holds a motion alone where no more than this part of an offset of it shows in other residuals."""

MIN_SOLE_FRACTION, SOLE_FACES = 0.05, 3
"""Of a part of so many faces, each of at least this share, those that hold a motion alone are told."""


@by_content
@dataclass(frozen=True)
class FaceOffset:
    """A face off as a whole: its number, ``middle_mm`` (3,) and unit ``normal`` (3,) in the frame of the source, its
    ``area_mm2``, and ``offset_mm`` with standard deviation ``sigma_mm``, positive where the source stands out."""

    face: int
    middle_mm: Floats
    normal: Floats
    area_mm2: float
    offset_mm: float
    sigma_mm: float

    def place(self) -> str:
        """In words, which face it is."""
        x, y, z = self.middle_mm
        return f"the face of {rounded(self.area_mm2)} mm2 about ({x:.0f}, {y:.0f}, {z:.0f}) mm"

    def __str__(self) -> str:
        side = "stands out" if self.offset_mm > 0 else "is too low"
        return f"{self.place()} {side} as a whole by {abs(self.offset_mm):.2f} mm"


@dataclass(frozen=True, eq=False)
class FaceReading:
    """What ``read_faces`` found: the ``registration`` to go on with; ``off``, the faces that are off by it, or the
    readings that explain the scans equally well, where ``unique`` is false; ``settled`` (M,): the source's surfels on
    all other faces; ``sole``: faces that could be off unseen."""

    registration: FineRegistration
    off: tuple[FaceOffset, ...]
    unique: bool
    settled: Flags | None
    sole: tuple[FaceOffset, ...]

    def explain(self, motion_mm: Floats) -> bool:
        """Whether a motion (3,), frame of the source, is that of a face that is off."""
        return any(
            np.linalg.norm(side * motion_mm - one.offset_mm * one.normal) < SAME_MOTION * abs(one.offset_mm)
            for one in self.off
            for side in (1, -1)
        )

    def diagnose(self, nothing_found: bool) -> tuple[str, ...]:
        """In words, what a person should know; what could be off unseen only where nothing else was found."""
        said = []
        if self.off and self.unique:
            said.append(f"{self.off[0]}: the other faces agree without it, and the pose is theirs")
        elif self.off:
            readings = ", or ".join(str(one) for one in self.off)
            said.append(f"the faces contradict each other: either {readings}; say which are right with --datum")
        if self.sole and nothing_found:
            places = ", ".join(f"{rounded(one.area_mm2)} mm2 about ({', '.join(f'{v:.0f}' for v in one.middle_mm)})"
                               for one in self.sole)  # fmt: skip
            said.append(
                f"faces that are off as a whole would not be seen: the pose rests on each of {len(self.sole)} alone"
                f" ({places} mm), and any allowance on one is taken for a motion; say which are right with --datum"
            )
        return tuple(said)


@dataclass(frozen=True, eq=False)
class _WithoutFace:
    """A fit in which a face may be off: the share that ``agreed``, the ``registration`` by the other faces and whether
    they have ``held`` it, and the face's ``offset``."""

    agreed: float
    registration: FineRegistration
    offset: FaceOffset
    held: bool


class _Samples:
    """The source's samples against the target's faces."""

    def __init__(self, source: Scan, target: Scan, seed: int) -> None:
        surfels = source.surfels
        chosen = np.sort(random_order(surfels.grid.keys, np.random.default_rng(seed))[:SAMPLES])
        self.points, self.normals = surfels.points[chosen], surfels.normals[chosen]
        self.target = target.surfels
        self.labels = label_faces(self.target)
        self.cells = build_cells(self.target.points, 2 * self.target.grid.size_mm)

    def area(self, one: int) -> float:
        """Area in mm2 of a face: a plane passes through so many cells as the sum of its normal's components says."""
        cells_per_area = np.abs(self.target.normals[self.labels == one]).sum(axis=1)
        return float((1 / np.maximum(cells_per_area, 1.0)).sum()) * self.target.grid.size_mm**2

    def at(self, transform: Floats) -> tuple[Floats, Floats, Floats, Integers]:
        """Places (N, 3), normals (N, 3) and residuals (N,) of the samples on the target, and their faces (N,), -2
        where the target shows nothing."""
        return self.on(self.points, self.normals, transform)

    def on(self, points: Floats, normals: Floats, transform: Floats) -> tuple[Floats, Floats, Floats, Integers]:
        """The same of any points (N, 3) with normals (N, 3) of the source."""
        size = self.target.grid.size_mm
        places = move_points(transform, points)
        residuals, up, _ = signed_distances(self.target, places, 2 * size)
        met = np.isfinite(residuals) & ((rotate_vectors(transform, normals) * up).sum(axis=1) > 0.7)
        feet = places - np.nan_to_num(residuals)[:, None] * up
        at, _ = nearest(self.cells, feet, 2 * size)
        return places, up, np.nan_to_num(residuals), np.where(met & (at >= 0), self.labels[at], -2)


def read_faces(source: Scan, target: Scan, registration: FineRegistration, seed: int = 0) -> FaceReading:
    """Which faces of the source are off as a whole; ``registration`` is T_target_source."""
    samples = _Samples(source, target, seed)
    places, up, residuals, face = samples.at(registration.T_target_source)
    counts = np.bincount(face[face >= 0], minlength=1)
    large = np.flatnonzero(counts >= max(MIN_SAMPLES, LARGE * len(face)))[:MAX_FACES]
    if len(large) < 2:
        return FaceReading(registration, (), True, None, ())
    spread = _sigma_within_faces(places, up, residuals, face, large)
    share = _agreeing_fraction(residuals, face, large, spread)
    medians = np.array([np.median(residuals[face == one]) for one in large])
    spans = np.array([np.quantile(np.abs(residuals[face == one]), 0.75) for one in large])
    sole = _sole(samples, places, up, face, large, registration)
    if np.abs(medians).max() < AGREES * spread and spans.max() < AGREES * spread:
        return FaceReading(registration, (), True, None, sole)
    fits = [_fitted(samples, registration, int(one), large, spread) for one in large]
    best = max(fits, key=lambda fit: fit.agreed)
    if best.agreed < share + MIN_GAIN:
        return FaceReading(registration, (), True, None, sole)
    named = [fit for fit in fits if fit.agreed > best.agreed - NEARLY and _is_off(fit.offset, spread)]
    named.sort(key=lambda fit: -fit.agreed)
    if not named or (len(named) == 1 and not named[0].held):
        return FaceReading(registration, (), True, None, sole)
    off = tuple(fit.offset for fit in named)
    if len(named) > 1:
        return FaceReading(registration, off, False, None, sole)
    found = named[0].registration
    surfels = source.surfels
    _, _, _, faces = samples.on(surfels.points, surfels.normals, found.T_target_source)
    return FaceReading(found, off, True, faces != off[0].face, sole)


def _is_off(offset: FaceOffset, spread: float) -> bool:
    return abs(offset.offset_mm) > max(MIN_OFFSET * spread, 5 * offset.sigma_mm)


def _agreeing_fraction(residuals: Floats, face: Integers, large: Integers, spread: float) -> float:
    """Share of the samples on large faces that agree."""
    on = np.isin(face, large)
    return float((np.abs(residuals[on]) < AGREES * spread).mean())


def _sigma_within_faces(places: Floats, up: Floats, residuals: Floats, face: Integers, large: Integers) -> float:
    """Standard deviation in mm of residuals about each face's own best motion: what offsets do not change."""
    left = []
    for one in large:
        on = face == one
        away = places[on] - places[on].mean(axis=0)
        design = np.column_stack([up[on], np.cross(away, up[on]) / max(np.abs(away).max(), 1e-9)])
        weights = np.ones(int(on.sum()))
        rest = residuals[on]
        for _ in range(3):
            fit = np.linalg.lstsq(design * weights[:, None], residuals[on] * weights, rcond=1e-6)[0]
            rest = residuals[on] - design @ fit
            cut = TUKEY * 1.4826 * np.median(np.abs(rest)) + 1e-12
            weights = np.clip(1 - (rest / cut) ** 2, 0, None)
        left.append(np.abs(rest))
    return float(1.4826 * np.median(np.concatenate(left))) + 1e-9


def _fitted(
    samples: _Samples, start: FineRegistration, one: int, large: Integers, spread: float, iterations: int = 6
) -> _WithoutFace:
    """The fit when a face may be off.

    All samples count at first, those that do not agree less and less: faces that least squares has torn apart meet.
    """
    transform, offset = start.T_target_source, 0.0
    size = samples.target.grid.size_mm
    for step in range(iterations):
        every_place, every_up, every_residual, face = samples.at(transform)
        used = np.isin(face, large)
        places, up, residuals = every_place[used], every_up[used], every_residual[used]
        on = (face[used] == one).astype(float)
        centre = places.mean(axis=0)
        design = np.column_stack([up, np.cross(places - centre, up), -on])
        solution = np.array([0.0] * 6 + [offset])
        for _ in range(5):
            rest = residuals + design @ solution
            weights = _weights(rest, max(spread, FIRST_SIGMA_CELLS * 0.4**step * size))
            information = design.T @ (design * weights[:, None])
            solution = -np.linalg.pinv(information, rcond=1e-12, hermitian=True) @ (design.T @ (weights * residuals))
        transform = rigid(None, centre) @ small_motion(solution[:6]) @ rigid(None, -centre) @ transform
        offset = float(solution[6])
    covariance = block_covariance(places, design, rest, weights, information)
    places, up, residuals, face = samples.at(transform)
    mine = face == one
    agreed = _agreeing_fraction(residuals - offset * mine, face, large, spread)
    back = inverse(transform)
    area = samples.area(one)
    found = FaceOffset(
        one, move_points(back, places[mine].mean(axis=0)), rotate_vectors(back, _unit(up[mine].sum(axis=0))), area,
        offset, float(np.sqrt(max(covariance[6, 6], 0.0))),
    )  # fmt: skip
    registration = replace(
        start, T_target_source=transform, centre_mm=centre, covariance=covariance[:6, :6], rms_mm=spread,
        iterations=start.iterations + iterations,
    )  # fmt: skip
    return _WithoutFace(agreed, registration, found, _is_held(information, places - centre))


def _is_held(information: Floats, arms: Floats) -> bool:
    """Whether what holds a pose beside a face's offset, by the information (7, 7) of both and the samples' ``arms``
    (N, 3), resists every motion."""
    extent = np.sqrt((arms**2).sum(axis=1).mean())
    scale = np.array([1, 1, 1, 1 / extent, 1 / extent, 1 / extent])
    rest = information[:6, :6] - np.outer(information[:6, 6], information[6, :6]) / max(information[6, 6], 1e-300)
    resisted = np.linalg.eigvalsh(rest * np.outer(scale, scale))
    return bool(resisted[0] > HELD * np.trace(rest[:3, :3]))


def _weights(rest: Floats, spread: float) -> Floats:
    """Tukey's weights for residuals (N,) of at least this spread."""
    cut = TUKEY * max(1.4826 * float(np.median(np.abs(rest))), spread)
    return np.clip(1 - (rest / cut) ** 2, 0, None) ** 2


def _unit(vector: Floats) -> Floats:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _sole(
    samples: _Samples, places: Floats, up: Floats, face: Integers, large: Integers, registration: FineRegistration
) -> tuple[FaceOffset, ...]:
    """Faces of a part of several that hold a motion alone; none where one face is nearly all that was seen."""
    used = np.isin(face, large)
    centre = places[used].mean(axis=0)
    design = np.column_stack([up[used], np.cross(places[used] - centre, up[used])])
    inverse_information = np.linalg.pinv(design.T @ design, rcond=1e-10, hermitian=True)
    back = inverse(registration.T_target_source)
    found: list[FaceOffset] = []
    sizable = [one for one in large if (face == one).sum() > MIN_SOLE_FRACTION * len(face)]
    for one in sizable if len(sizable) >= SOLE_FACES else ():
        on = face[used] == one
        along = design[on].sum(axis=0)
        left = on.sum() - along @ inverse_information @ along
        if left < ABSORBED * on.sum():
            middle = move_points(back, places[face == one].mean(axis=0))
            normal = rotate_vectors(back, _unit(up[face == one].sum(axis=0)))
            area = samples.area(one)
            found.append(FaceOffset(int(one), middle, normal, area, 0.0, np.inf))
    return tuple(found)
