"""A small grinding scene for the tests of vision: a free-form plate seen by a scanner at the origin, with the truth."""

from dataclasses import dataclass

import numpy as np

from grindvision.geometry import inverse, move_points, rigid, rotation_about


def plate_height(x, y, relief=1.0):
    """Height in mm of a plate with a boss, a rib and a pocket over a gentle free-form swell."""
    swell = 4 * np.sin(x / 55 + 0.4) * np.cos(y / 47 - 0.3)
    boss = 6 / (1 + np.exp((np.hypot(x - 55, y - 25) - 16) / 1.0))
    rib = 5 / (1 + np.exp((np.abs((y + 40) * 0.94 + (x + 20) * 0.34) - 4) / 0.8)) / (1 + np.exp((np.abs(x + 20) - 45) / 1.5))
    pocket = -5 / (1 + np.exp((np.maximum(np.abs(x + 55) - 18, np.abs(y - 30) - 12)) / 0.8))
    return relief * (swell + boss + rib + pocket)


@dataclass(frozen=True)
class Bead:
    start: tuple = (-5.0, 5.0)
    length_mm: float = 30.0
    bend_per_mm: float = 0.02
    width_mm: float = 4.0
    height_mm: float = 1.5

    def centre(self, s):
        """Plan position (..., 2) at arc length s."""
        s = np.asarray(s, dtype=float)
        angle = 0.5 + self.bend_per_mm * s
        fine = np.linspace(0, self.length_mm, 2001)
        steps = np.column_stack([np.cos(0.5 + self.bend_per_mm * fine), np.sin(0.5 + self.bend_per_mm * fine)])
        path = np.vstack([[0, 0], np.cumsum((steps[1:] + steps[:-1]) / 2 * (fine[1] - fine[0]), axis=0)]) + self.start
        del angle
        return np.column_stack([np.interp(s, fine, path[:, k]) for k in range(2)])

    def height(self, x, y):
        """Height in mm of the bead's parabolic section over the plate, rounded off at both ends."""
        if self.height_mm == 0:
            return np.zeros_like(x)
        from scipy.spatial import cKDTree

        s = np.linspace(0, self.length_mm, 1500)
        away, _ = cKDTree(self.centre(s)).query(np.column_stack([np.ravel(x), np.ravel(y)]))
        return self.height_mm * np.clip(1 - (away.reshape(np.shape(x)) / (self.width_mm / 2)) ** 2, 0, None)


def view(tilt_rad=0.0, axis=(0.0, 1.0, 0.0), turn_rad=0.0, distance_mm=400.0):
    """T_scanner_part of a scanner at the origin that looks along +z at the plate's middle."""
    facing = np.diag([1.0, -1.0, -1.0])
    return rigid(facing @ rotation_about(axis, tilt_rad) @ rotation_about((0, 0, 1), turn_rad), (0, 0, distance_mm))


def scan(n_points, T_scanner_part, rng, relief=1.0, beads=(), noise_mm=0.04, window=None):
    """Points (N, 3) in the scanner frame on the visible side of the plate, on a pixel grid, noise along the ray.

    ``window`` (x0, x1, y0, y1) cuts the plate in part coordinates.
    """
    x0, x1, y0, y1 = (-100.0, 100.0, -70.0, 70.0) if window is None else window
    step = np.sqrt((x1 - x0) * (y1 - y0) / n_points)
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    x, y = x + rng.uniform(0, step), y + rng.uniform(0, step)
    z = plate_height(x, y, relief)
    for bead in beads:
        z = z + bead.height(x, y)
    points = move_points(T_scanner_part, np.column_stack([x.ravel(), y.ravel(), z.ravel()]))
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    points = points + rays * rng.normal(scale=noise_mm, size=len(points))[:, None]
    pixel = 400 * step / 400
    seen = np.round(points[:, :2] / points[:, 2:] * 400 / pixel).astype(np.int64)
    key = seen[:, 0] * 100_000 + seen[:, 1]
    order = np.lexsort((points[:, 2], key))
    nearest_z = dict()
    first = np.r_[True, np.diff(key[order]) != 0]
    front = np.repeat(points[order, 2][first], np.diff(np.r_[np.flatnonzero(first), len(order)]))
    del nearest_z
    visible = np.empty(len(points), dtype=bool)
    visible[order] = points[order, 2] < front + 3 * step + 0.2
    return points[visible]


def pair(seed=0, n_points=50_000, relief=1.0, beads=(Bead(),), angle_rad=0.47, overlap=1.0, noise_mm=0.04, axis=None):
    """A good scan, a test scan with beads, and the truth T_sample_test."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3) if axis is None else axis
    T_sample_part = view(rng.uniform(0, 0.2), (1, 0.3, 0))
    centre = rigid(None, (0, 0, 400.0))
    T_test_part = centre @ rigid(rotation_about(axis, angle_rad)) @ inverse(centre) @ T_sample_part
    cut = 200 * (1 - overlap)
    window_s, window_t = (-100, 100 - cut / 2, -70, 70), (-100 + cut / 2, 100, -70, 70)
    sample = scan(n_points, T_sample_part, rng, relief, (), noise_mm, window_s)
    test = scan(int(n_points * 0.95), T_test_part, rng, relief, beads, noise_mm, window_t)
    return sample, test, T_sample_part @ inverse(T_test_part), T_test_part
