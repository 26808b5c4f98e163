"""A workpiece with a bead on a plate or a cylinder, without scans, for the tests of grinding."""

import numpy as np

from grindvision.geometry.height_map import HeightMap
from grindvision.motion.grinding import Workpiece

SPACING = 0.5


def flat_work(height=None, size=(60.0, 30.0), bend_per_mm=0.0, keep=None, sigma=0.01):
    """A bead along x on a cylinder about x (``bend_per_mm`` its curvature), height(x, y) over it."""
    x, y = (np.arange(round(side / SPACING) + 1) * SPACING for side in size)
    x, y = np.meshgrid(x, y, indexing="ij")
    across = y - size[1] / 2
    ground = 0.5 * bend_per_mm * across**2
    normals = np.stack([np.zeros_like(x), -bend_per_mm * across, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    if height is None:
        heights = 1.5 * np.clip(1 - (across / 2.5) ** 2, 0, None) * ((x > 15) & (x < 45))
    else:
        heights = height(x, y)
    grid = HeightMap(np.eye(4), SPACING, ground, normals, heights)
    inside = heights > 0.02
    keep = np.zeros_like(inside) if keep is None else keep(x, y)
    course = np.column_stack([np.linspace(15, 45, 40), np.full(40, size[1] / 2)])
    return Workpiece(grid, inside, keep, 0.05, sigma, course)
