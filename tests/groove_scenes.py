"""Clouds of grooves with known shape: height fields in front of a camera, simple enough to check by hand."""

import numpy as np

from grindvision.geometry import random_rotation


def grid(length_mm=120.0, breadth_mm=80.0, spacing_mm=0.7):
    """Places x, y (N, 2) of a plate, the rows half a spacing off the middle, so that none runs along an edge."""
    x, y = (np.arange((spacing_mm - span) / 2, span / 2, spacing_mm) for span in (length_mm, breadth_mm))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def vee(across_mm, width_mm=10.0, depth_mm=6.0):
    """Height of a V-groove at distances across it."""
    return -depth_mm * np.clip(1 - np.abs(across_mm) / (width_mm / 2), 0, 1)


def cloud(places, heights, rng, noise_mm=0.1):
    """Camera frame: z away from the camera at the origin, the surface 400 mm away, heights towards the camera."""
    return np.column_stack([places[:, 0], -places[:, 1], 400 - heights + noise_mm * rng.standard_normal(len(places))])


def straight_groove(rng, width_mm=10.0, depth_mm=6.0, spacing_mm=0.7, noise_mm=0.1):
    """A plate with a straight groove along x: points (N, 3) and labels (N,)."""
    places = grid(spacing_mm=spacing_mm)
    return cloud(places, vee(places[:, 1], width_mm, depth_mm), rng, noise_mm), np.abs(places[:, 1]) < width_mm / 2


def overlap(found, truth):
    return (found & truth).sum() / (found | truth).sum()


def anywhere(points, rng):
    """The same points in another frame, and the rotation and shift that lead there."""
    rotation, shift = random_rotation(rng), rng.uniform(-300, 300, 3)
    return points @ rotation.T + shift, rotation, shift
