"""Scans of one robot cell registered with the good part's, and what stands out of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.cell import Scan
from grindvision.errors import DegenerateError
from grindvision.geometry import inverse, small_motion
from grindvision.vision.change.change_detection import find_change
from grindvision.vision.change.oriented_box import BoxPath
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import icp_planes
from grindvision.vision.registration.scan_registration import propose, refine, refine_from
from grindvision.vision.registration.verification import choose_pose
from grindvision.vision.surface.scan import Resolution, choose_resolution, coarser, prepare_pair, prepare_scan
from grindvision.vision.surface.scan import Scan as PreparedScan
from grindvision_book.chapter_06.boxes import paper_path

Floats = NDArray[np.float64]

#: How well stops put two parts of one kind in the same place: standard deviations of each coordinate, of each turn.
FIXTURE_MM, FIXTURE_DEG = 0.5, 0.2
#: So far apart the surfaces may then be, by four standard deviations of the place and what the turns add.
FIXTURE_REACH_MM = 3.0


@dataclass(frozen=True)
class RegisteredPair:
    """Both scans made ready, and the registration T_sample_test between them."""

    sample: PreparedScan
    test: PreparedScan
    registration: FineRegistration

    @classmethod
    def of(cls, sample_points: Floats, test_points: Floats) -> RegisteredPair:
        """Register two scans (N, 3) from nothing, by the stages of ``vision.detect``.

        Raises:
            DegenerateError: the scans do not fit, do not overlap enough, or leave a motion free.
        """
        proposing, choosing, refining = _draws()
        test, sample = prepare_pair(test_points, sample_points, (np.zeros(3), np.zeros(3)))
        test, poses = propose(test, sample, proposing)
        coarse = choose_pose(test, sample, poses, choosing)
        return cls(sample, test, refine(test, sample, coarse, refining))

    @classmethod
    def near(
        cls, sample_points: Floats, test_points: Floats, T_sample_test: Floats, within_mm: float = 0.0
    ) -> RegisteredPair:
        """``of`` for scans whose pose (4, 4) is known well: ICP alone, from there.

        Where it is known to ``within_mm`` only, the coarse voxels come near first.

        Raises:
            DegenerateError: the scans do not meet there.
        """
        sizes = coarser(choose_resolution(test_points), choose_resolution(sample_points))
        test, sample = (
            prepare_scan(points, sizes, np.zeros(3), feature_voxels=None) for points in (test_points, sample_points)
        )
        if within_mm > 0:
            coarse = test.voxels
            nearer = icp_planes(coarse.points, coarse.normals, sample.surfels, T_sample_test, within_mm)
            T_sample_test = nearer.T_target_source
        return cls(sample, test, refine_from(test, sample, T_sample_test, _draws()[2]))

    def with_test(self, test_points: Floats, T_sample_test: Floats) -> RegisteredPair:
        """Register another scan with the same sample, starting from a pose (4, 4) that is known well."""
        size = self.sample.surfels.grid.size_mm
        sizes = Resolution(size / 3, size, self.sample.voxels.grid.size_mm)
        test = prepare_scan(test_points, sizes, np.zeros(3), feature_voxels=None)
        registration = refine_from(test, self.sample, T_sample_test, np.random.default_rng(0))
        return replace(self, test=test, registration=registration)

    def at(self, T_sample_test: Floats) -> RegisteredPair:
        """The same scans under another registration (4, 4)."""
        return replace(self, registration=replace(self.registration, T_target_source=T_sample_test))

    def piece(self) -> Cluster:
        """The largest piece that stands out, frame of the test scan.

        Raises:
            DegenerateError: nothing stands out.
        """
        pieces = find_change(self.test, self.sample, self.registration).clusters
        if not pieces:
            raise DegenerateError("no bead was found above the level of detection; scan the part from nearer views")
        return pieces[0]

    def boxes(self, piece: Cluster, points: int) -> BoxPath:
        """Path of the paper's boxes (section 3.6) where a piece lies, under the same registration.

        Raises:
            DegenerateError: a part of the box is empty, or the difference has no volume.
        """
        path = paper_path(piece.points, self.test, self.sample, self.registration.T_target_source, points)
        if len(path.points) < points:
            raise DegenerateError(f"{points - len(path.points)} parts of the box hold no point of the difference")
        return path


def true_registration(sample: Scan, test: Scan) -> Floats:
    """T_sample_test (4, 4) as it truly is."""
    return inverse(sample.T_world_scanner) @ test.T_world_scanner


def pairs_in_place(sample: Scan, tests: list[Scan]) -> list[RegisteredPair]:
    """The scans as they truly lie; what is known of each registration comes from ICP that begins there."""
    truth = [true_registration(sample, test) for test in tests]
    first = RegisteredPair.near(sample.points, tests[0].points, truth[0])
    others = [first.with_test(test.points, pose) for test, pose in zip(tests[1:], truth[1:], strict=True)]
    return [pair.at(pose) for pair, pose in zip([first, *others], truth, strict=True)]


def pairs_from_nothing(sample: Scan, tests: list[Scan]) -> list[RegisteredPair]:
    """Register each test scan with the sample's, with nothing known of where it was taken."""
    return [RegisteredPair.of(sample.points, test.points) for test in tests]


def fixture_pose(sample: Scan, test: Scan, rng: np.random.Generator) -> Floats:
    """T_sample_test (4, 4) as it would be if stops put both parts in the same place; how far they miss is drawn."""
    misplaced = small_motion(rng.standard_normal(6) * np.repeat([FIXTURE_MM, np.radians(FIXTURE_DEG)], 3))
    return inverse(sample.T_world_scanner) @ misplaced @ test.T_world_scanner


def pairs_from_fixture(
    sample: Scan, tests: list[Scan], believed: list[Floats], rng: np.random.Generator
) -> list[RegisteredPair]:
    """Register the scans from where they should be: the first as the fixture holds both parts, which is drawn, the
    others from where the calibrated arm says that the scanner went from there, ``believed`` T_base_scanner (4, 4)."""
    roughly = fixture_pose(sample, tests[0], rng)
    first = RegisteredPair.near(sample.points, tests[0].points, roughly, FIXTURE_REACH_MM)
    T_sample_base = first.registration.T_target_source @ inverse(believed[0])
    moved = zip(tests[1:], believed[1:], strict=True)
    return [first, *(first.with_test(test.points, T_sample_base @ pose) for test, pose in moved)]


def _draws() -> list[np.random.Generator]:
    """What the three stages of a registration draw from: proposing, choosing, refining."""
    return np.random.default_rng(0).spawn(3)
