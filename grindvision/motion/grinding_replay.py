"""A plan's strokes replayed with another process than planned, as a scan would show it: to learn what was true.

A wheel's sides, and the strips where neighbouring lines overlap and cut twice, fall between the nodes of a map. What is
measured at a node is the mean around it. So the strokes are replayed over a finer grid, on heights of which the means
are those that were measured, and what they leave is averaged in the same way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from grindvision.geometry.height_map import HeightMap
from grindvision.motion.grinding import RELIEF_MM, GrindingPlan
from grindvision.motion.grinding_contact import envelope_of, nodes_of, tool_shape

Floats = NDArray[np.float64]
Place = tuple[slice, slice]

PER_WIDTH, MAX_TIMES = 16, 5
"""The finer grid has so many nodes across the contact's width, but no more than so many times as many as the map."""


SHARPENED = 2
"""Steps by which the heights before are freed from their own averaging; more would raise their noise."""


class Replay:
    """The strokes of a plan over a grid some ``times`` finer than its map: how low the tool comes is found once.

    ``averaged_mm`` (R, C): by how much the averaging changed the heights before. Where a bead ends steeply it hides how
    it ends, and so what the strokes met there.
    """

    def __init__(self, plan: GrindingPlan) -> None:
        heights = plan.work.heights
        asked = np.ceil(PER_WIDTH * heights.spacing_mm / plan.options.contact_width_mm)
        self.times = int(np.clip(asked, 1, MAX_TIMES))
        self.shown = np.isfinite(heights.heights_mm)
        before = np.where(self.shown, heights.heights_mm, 0.0)
        sharper = before
        for _ in range(SHARPENED):
            sharper = sharper + before - self._means(self._between(sharper, heights))
        self.averaged_mm = np.abs(sharper - before)
        self.fine = self._between(sharper, heights)
        fine = heights.refined(self.times)
        self.depths_mm, self.strokes = self._strokes(plan, fine)

    def _between(self, values: Floats, heights: HeightMap) -> Floats:
        """Values (R, C) on the finer grid, by straight lines."""
        return replace(heights, heights_mm=values).refined(self.times).heights_mm

    def _means(self, fine: Floats) -> Floats:
        """Means (R, C) of values of the finer grid about the nodes, the nearer ones first, as heights are measured."""
        weights = 1 - np.abs(np.arange(1 - self.times, self.times)) / self.times
        for axis in (0, 1):
            fine = convolve1d(fine, weights / weights.sum(), axis=axis, mode="nearest")
        return np.asarray(fine[:: self.times, :: self.times])

    @staticmethod
    def _strokes(plan: GrindingPlan, fine: HeightMap) -> tuple[list[float], list[tuple[Place, Floats]]]:
        """Depth of cut, place on the finer grid and envelope of each stroke that comes over the map."""
        top = float(np.nanmax(np.where(plan.work.inside, plan.work.heights.heights_mm, -np.inf)))
        shape, nodes = tool_shape(plan.options, top + RELIEF_MM), nodes_of(fine)
        depths, strokes = [], []
        for one in plan.passes:
            for stroke in one.strokes:
                envelope = envelope_of(nodes, stroke.poses, stroke.lifts_mm, shape)
                met = np.isfinite(envelope)
                if not met.any():
                    continue
                rows, columns = np.flatnonzero(met.any(axis=1)), np.flatnonzero(met.any(axis=0))
                place = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
                depths.append(one.depth_mm)
                strokes.append((place, envelope[place].copy()))
        return depths, strokes

    def left_mm(self, k_factor: float, offset_mm: float = 0.0) -> Floats:
        """Heights (R, C) of the map's nodes after all strokes.

        Args:
            k_factor: a stroke cuts no deeper than this times its pass's depth.
            offset_mm: how much higher than planned the wheel runs.
        """
        heights = self.fine - offset_mm
        for depth_mm, (place, envelope) in zip(self.depths_mm, self.strokes, strict=True):
            there = heights[place]
            cut = np.maximum(envelope, there - k_factor * depth_mm)
            heights[place] = np.where(envelope < there, cut, there)
        return np.where(self.shown, self._means(heights) + offset_mm, np.nan)
