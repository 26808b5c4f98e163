"""A camera on or beside an arm that sees a target: poses and what the camera sees of it, with the truth known."""

import numpy as np
from scipy.spatial.transform import Rotation

from grindvision.geometry import inverse, move_points, rigid

#: T_flange_camera of the scene.
X = rigid(Rotation.from_euler("xyz", [4.0, -3.0, 40.0], degrees=True).as_matrix(), [60.0, -30.0, 80.0])

#: Where the target rests in the base frame, mm.
TARGET = np.array([500.0, 100.0, 50.0])


def looking_poses(rng, n=10, turn_deg=25.0):
    """Poses T_base_flange (n, 4, 4) from which the camera looks at the target from above, turned about all axes."""
    down = np.diag([1.0, -1.0, -1.0])
    poses = []
    for _ in range(n):
        turned = down @ Rotation.from_rotvec(np.radians(rng.uniform(-turn_deg, turn_deg, 3))).as_matrix()
        seen_at = np.array([*rng.uniform(-60, 60, 2), rng.uniform(330, 470)])
        T_base_camera = rigid(turned, TARGET - turned @ seen_at)
        poses.append(T_base_camera @ inverse(X))
    return np.array(poses)


def seen_points(poses, rng, arm_mm=0.0):
    """The target's points (n, 3) in the camera's frame; the arm stands off what it says by so much."""
    return np.array([move_points(inverse(pose @ X), TARGET + arm_mm * rng.normal(size=3)) for pose in poses])


def seen_poses(poses, rng, arm_mm=0.0, arm_rad=0.0):
    """The target's poses (n, 4, 4) in the camera's frame."""
    off = [
        rigid(Rotation.from_rotvec(arm_rad * rng.normal(size=3)).as_matrix(), TARGET + arm_mm * rng.normal(size=3))
        for _ in poses
    ]
    return inverse(poses @ X) @ np.array(off)


def sphere_view(centre, radius, rng, n=1500, noise_mm=0.1):
    """Points of the side of a sphere that a camera at the origin sees, on a table, beside a box and with strays."""
    towards = -centre / np.linalg.norm(centre)
    rays = rng.normal(size=(4 * n, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays = rays[rays @ towards > 0.25][:n]
    table = np.column_stack([rng.uniform(-150, 150, (4 * n, 2)), np.full(4 * n, centre[2] + radius)])
    box = centre + [90.0, 20.0, 0.0] + np.column_stack([rng.uniform(-30, 30, (n, 2)), np.zeros(n)])
    strays = centre + rng.uniform(-100, 100, (60, 3))
    return np.vstack([centre + radius * rays, table, box, strays]) + noise_mm * rng.normal(
        size=(len(rays) + 5 * n + 60, 3)
    )


def part_view(T_part_camera, rng, n=4000, flat=False, noise_mm=0.02, half_mm=(60, 40)):
    """Points of a bumpy plate, or a flat one, 120 x 80 mm, in the frame of a camera at T_part_camera; where half of it
    is longer, it lies in a larger plane of as many points an area."""
    n = n * half_mm[0] * half_mm[1] // 2400
    x, y = (rng.uniform(-half, half, n) for half in half_mm)
    z = np.zeros(n)
    for a, b, height, width in ((25, -10, 12, 90), (-30, 15, 9, 60), (-10, -20, 7, 40), (40, 25, 8, 50)):
        z += (0.0 if flat else height) * np.exp(-((x - a) ** 2 + (y - b) ** 2) / width)
    points = np.column_stack([x, y, z + noise_mm * rng.normal(size=n)])
    return move_points(inverse(T_part_camera), points)


def plate_view(T_camera_plate, rng, sides=(160.0, 110.0), noise_mm=0.1, n=9000):
    """Points of a plate 6 mm thick on a table, beside a box, in the frame of a camera at the origin."""
    half = np.array(sides) / 2
    plate = np.column_stack([rng.uniform(-half, half, (n, 2)), np.zeros(n)])
    table = np.column_stack([rng.uniform(-250, 250, (4 * n, 2)), np.full(4 * n, -6.0)])
    table = table[(np.abs(table[:, :2]) > half + 3).any(axis=1)]
    box = np.column_stack([rng.uniform(110, 180, n), rng.uniform(-40, 60, n), np.full(n, 25.0)])
    points = np.vstack([plate, table, box])
    return move_points(T_camera_plate, points + noise_mm * rng.normal(size=points.shape))


def three_spheres_view(T_camera_target, rng, radius=19.05, n=500):
    """Points of three spheres on a table, 90, 120 and 150 mm apart, and their centres (3, 3), in the camera's frame."""
    centres = move_points(T_camera_target, [[0.0, 0, 0], [150, 0, 0], [54, 72, 0]])
    views = [sphere_view(centre, radius, rng, n)[:n] for centre in centres]
    table = np.column_stack([rng.uniform(-150, 250, (4 * n, 2)), np.full(4 * n, -radius)])
    return np.vstack([*views, move_points(T_camera_target, table)]), centres
