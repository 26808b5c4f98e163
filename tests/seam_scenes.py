"""Clouds of joints of two plates with a known seam, for the tests of the seam detector: no camera, no Open3D."""

import numpy as np

from grindvision.geometry import rotation_about


def plate(along, across, origin=(0.0, 0.0, 0.0), first=(1.0, 0.0, 0.0), second=(0.0, 1.0, 0.0), spacing=1.0):
    """Points every ``spacing`` mm over a rectangle from ``along`` to ``across`` (each low, high) in a plane."""
    u, v = np.meshgrid(np.arange(along[0], along[1], spacing), np.arange(across[0], across[1], spacing), indexing="ij")
    places = np.stack([u.ravel(), v.ravel()], axis=1)
    return np.asarray(origin) + places @ np.array([first, second], dtype=float)


def noisy(points, rng, noise_mm):
    return points + noise_mm * rng.standard_normal(points.shape)


def corner(rng, angle_deg=90.0, noise_mm=0.1, length=90.0, leg=40.0, spacing=1.0):
    """A base (y < 0, z = 0) and a wall that stands on y = z = 0 with ``angle_deg`` of air between: the seam is x."""
    angle = np.radians(180 - angle_deg)
    base = plate((-length / 2, length / 2), (-leg, 0.0), spacing=spacing)
    wall = plate((-length / 2, length / 2), (0.0, leg), second=(0.0, np.cos(angle), np.sin(angle)), spacing=spacing)
    return noisy(np.concatenate([base, wall]), rng, noise_mm)


def step(rng, height_mm=6.0, noise_mm=0.1, length=90.0, wide=40.0, spacing=1.0):
    """A plate at z = ``height_mm`` for y > 0 over one at z = 0: the seam is x."""
    lower = plate((-length / 2, length / 2), (-wide, 0.0), spacing=spacing)
    upper = plate((-length / 2, length / 2), (0.0, wide), origin=(0.0, 0.0, height_mm), spacing=spacing)
    return noisy(np.concatenate([lower, upper]), rng, noise_mm)


def butt(rng, gap_mm=3.0, noise_mm=0.05, length=90.0, wide=40.0, spacing=1.0, hi_lo_mm=0.0):
    """Two plates at z = 0 with a gap about y = 0, and what lies 40 mm below seen through it."""
    half = gap_mm / 2
    sides = [
        plate((-length / 2, length / 2), (-wide, -half), spacing=spacing),
        plate((-length / 2, length / 2), (half, wide), origin=(0.0, 0.0, hi_lo_mm), spacing=spacing),
        plate((-length / 2, length / 2), (0.0, 0.9 * spacing), origin=(0.0, -spacing / 4, -40.0), spacing=spacing),
    ]
    return noisy(np.concatenate(sides), rng, noise_mm)


def outside(rng, noise_mm=0.1, length=90.0, leg=40.0, spacing=1.0):
    """A convex edge along x between a plate z = 0 (y < 0) and one y = 0 (z < 0)."""
    top = plate((-length / 2, length / 2), (-leg, 0.0), spacing=spacing)
    side = plate((-length / 2, length / 2), (-leg, 0.0), second=(0.0, 0.0, 1.0), spacing=spacing)
    return noisy(np.concatenate([top, side]), rng, noise_mm)


def tube_on_plate(rng, radius=20.0, noise_mm=0.1, spacing=1.0):
    """The half of a tube on a plate that is seen from -y, and the plate around it: the seam is a half circle."""
    base = plate((-60.0, 60.0), (-60.0, 40.0), spacing=spacing)
    base = base[np.hypot(base[:, 0], base[:, 1]) > radius]
    base = base[(base[:, 1] < 0) | (np.abs(base[:, 0]) > radius)]
    angle = np.arange(-np.pi, 0, spacing / radius)
    angle, up = np.meshgrid(angle, np.arange(0.0, 40.0, spacing))
    tube = np.stack([radius * np.cos(angle), radius * np.sin(angle), up], axis=-1).reshape(-1, 3)
    return noisy(np.concatenate([base, tube]), rng, noise_mm)


def tube_all_round(rng, radius=20.0, noise_mm=0.1, spacing=1.0):
    """A tube on a plate as scans from all sides show it once they are merged, far from the origin: a closed seam."""
    base = plate((-50.0, 50.0), (-50.0, 50.0), spacing=spacing)
    base = base[np.hypot(base[:, 0], base[:, 1]) > radius]
    angle, up = np.meshgrid(np.arange(-np.pi, np.pi, spacing / radius), np.arange(0.0, 40.0, spacing))
    tube = np.stack([radius * np.cos(angle), radius * np.sin(angle), up], axis=-1).reshape(-1, 3)
    return noisy(np.concatenate([base, tube]), rng, noise_mm) + [400.0, 0.0, 0.0]


def box_corner(rng, noise_mm=0.1, length=60.0, spacing=1.0):
    """A base z = 0 with two walls x = 0 and y = 0 that meet over it: three seams that run into the origin."""
    sides = [((1, 0, 0), (0, 1, 0)), ((1, 0, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1))]
    faces = [plate((0.0, length), (0.0, length), first=one, second=other, spacing=spacing) for one, other in sides]
    return noisy(np.concatenate(faces), rng, noise_mm)


def two_tubes(rng, radius=30.0, into=4.0, spacing=0.8, noise_mm=0.1, span=1.3):
    """Two tubes along x side by side that run ``into`` each other, seen from 400 mm above their tops."""
    angle, along = np.meshgrid(np.arange(-span, span, spacing / radius), np.arange(-60.0, 60.0, spacing))
    parts = []
    for side in (-1.0, 1.0):
        tube = np.stack([along, radius * np.sin(angle), radius * np.cos(angle)], axis=-1).reshape(-1, 3)
        tube = tube + [0.0, side * (radius - into / 2), 0.0]
        parts.append(tube[side * tube[:, 1] > 0])
    return noisy(np.concatenate(parts), rng, noise_mm)


def turned(points, rng, tilt_rad=0.5):
    """The points turned by up to ``tilt_rad`` and moved, with the rotation and the translation."""
    axis = rng.standard_normal(3)
    rotation = rotation_about(axis / np.linalg.norm(axis), rng.uniform(-tilt_rad, tilt_rad))
    shift = rng.uniform(-100, 100, 3)
    return points @ rotation.T + shift, rotation, shift
