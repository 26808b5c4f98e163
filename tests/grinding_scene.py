"""Surfaces seen by a scanner at the origin, for the tests of vision: small, with the truth, independent of the cell."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from grindvision.geometry import inverse, move_points, rigid, rotation_about

FACING = np.diag([1.0, -1.0, -1.0])


def plate_height(x, y, relief=1.0):
    """Height in mm of a plate 200 x 140 mm with a boss, a rib and a pocket over a gentle free-form swell."""
    swell = 4 * np.sin(x / 55 + 0.4) * np.cos(y / 47 - 0.3)
    boss = 6 / (1 + np.exp((np.hypot(x - 55, y - 25) - 16) / 1.0))
    across, along = (y + 40) * 0.94 + (x + 20) * 0.34, np.abs(x + 20) - 45
    rib = 5 / (1 + np.exp((np.abs(across) - 4) / 0.8)) / (1 + np.exp(along / 1.5))
    pocket = -5 / (1 + np.exp((np.maximum(np.abs(x + 55) - 18, np.abs(y - 30) - 12)) / 0.8))
    return relief * (swell + boss + rib + pocket)


@dataclass(frozen=True)
class Bead:
    """A bead of parabolic section along plan points (K, 2)."""

    line: np.ndarray
    width_mm: float = 4.0
    height_mm: float = 1.5

    def height(self, x, y):
        away, _ = cKDTree(self.line).query(np.column_stack([np.ravel(x), np.ravel(y)]))
        return self.height_mm * np.clip(1 - (away.reshape(np.shape(x)) / (self.width_mm / 2)) ** 2, 0, None)

    def ridge(self, surface=plate_height):
        x, y = self.line.T
        return np.column_stack([x, y, surface(x, y) + self.height_mm])


def arc_bead(start=(-5.0, 5.0), length_mm=30.0, radius_mm=50.0, **size):
    angle = 0.5 + np.linspace(0, length_mm / radius_mm, 1500)
    line = radius_mm * np.column_stack([np.sin(angle), -np.cos(angle)])
    return Bead(line - line[0] + start, **size)


def ring_bead(centre=(0.0, 10.0), radius_mm=12.0, **size):
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    return Bead(np.asarray(centre) + radius_mm * np.column_stack([np.cos(angle), np.sin(angle)]), **size)


def view(angle_rad=0.0, axis=(0.0, 1.0, 0.0), distance_mm=400.0):
    """T_scanner_part of a scanner that looks along its z axis at the part's middle."""
    return rigid(rotation_about(axis, angle_rad) @ FACING, (0, 0, distance_mm))


def scan(
    surface, T_scanner_part, n_points, rng, beads=(), noise_mm=0.04, window=(-100.0, 100.0, -70.0, 70.0), mask=None
):
    """Points (about n_points, 3) of z = surface(x, y) in the scanner frame, with noise along the rays."""
    x0, x1, y0, y1 = window
    step = np.sqrt((x1 - x0) * (y1 - y0) / n_points)
    x, y = np.meshgrid(np.arange(x0, x1, step) + rng.uniform(0, step), np.arange(y0, y1, step) + rng.uniform(0, step))
    x, y = x.ravel(), y.ravel()
    if mask is not None:
        x, y = x[mask(x, y)], y[mask(x, y)]
    z = surface(x, y) + sum(bead.height(x, y) for bead in beads)
    points = move_points(T_scanner_part, np.column_stack([x, y, z]))
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + rays * rng.normal(scale=noise_mm, size=len(points))[:, None]


@dataclass(frozen=True)
class Pair:
    """A good scan, a test scan, and the truth about them."""

    sample: np.ndarray
    test: np.ndarray
    T_sample_test: np.ndarray
    T_test_part: np.ndarray


def pair(
    seed=0, n_points=40_000, relief=1.0, beads=(), angle_rad=0.47, overlap=1.0, axis=(0.2, -0.5, 0.8), noise_mm=0.04
):
    rng = np.random.default_rng(seed)

    def surface(x, y):
        return plate_height(x, y, relief)

    T_sample_part = view(0.15, (1.0, 0.3, 0.0))
    T_test_part = view(angle_rad, axis)
    cut = 200 * (1 - overlap)
    sample = scan(surface, T_sample_part, n_points, rng, (), noise_mm, (-100, 100 - cut / 2, -70, 70))
    test = scan(surface, T_test_part, n_points, rng, beads, noise_mm, (-100 + cut / 2, 100, -70, 70))
    return Pair(sample, test, T_sample_part @ inverse(T_test_part), T_test_part)


def on_a_table(half_mm, n_points=60_000, turn_rad=0.0):
    """Scans of the part without and with its bead, lying on a plane 25 mm below; turned on it in between."""

    def surface(angle, beads):
        def height(x, y):
            u, v = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
            inside = (np.abs(u) < 100) & (np.abs(v) < 70)
            u, v = np.clip(u, -100, 100), np.clip(v, -70, 70)
            return np.where(inside, plate_height(u, v) + sum(bead.height(u, v) for bead in beads), -25.0)

        return height

    rng, window = np.random.default_rng(3), (-half_mm[0], half_mm[0], -half_mm[1], half_mm[1])
    sample = scan(surface(0.0, ()), view(0.15, (1.0, 0.3, 0.0)), n_points, rng, window=window)
    return sample, scan(surface(turn_rad, [arc_bead()]), view(0.3, (0.2, -0.5, 0.4)), n_points, rng, window=window)
