"""How much two registered scans differ about a piece where nothing has changed: a plane, and the noise about it.

What registration and the scanner's smooth distortion leave is common to a whole piece and would pass for its height. It
is measured on the unchanged surface around the piece; the pose's covariance is what is known of it beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from grindvision.records import by_content

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

MIN_RING = 40
"""Fewer unchanged nodes say nothing about a piece's surroundings."""


@by_content
@dataclass(frozen=True)
class NoiseField:
    """Noise of a height map whose values are alike where they are near: ``covariance_mm2`` (K,) of two nodes at each
    distance, counted in nodes and rounded; zero beyond."""

    covariance_mm2: Floats

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of one node."""
        return float(np.sqrt(self.covariance_mm2[0]))

    def of_sums(self, weights: Floats) -> Floats:
        """Covariance (K, K) of the sums of the noise over a map with each of the weights (K, R, C)."""
        shape = weights.shape[1:]
        padded = [next_fast_len(2 * count) for count in shape]
        spectra = rfft2(weights, s=padded)
        lags = [np.minimum(np.arange(count), count - np.arange(count)) for count in padded]
        away = np.rint(np.hypot(lags[0][:, None], lags[1][None])).astype(np.int64)
        noise = np.append(self.covariance_mm2, 0.0)[np.minimum(away, len(self.covariance_mm2))]
        spread = irfft2(spectra * rfft2(noise), s=padded)[:, : shape[0], : shape[1]]
        white = self.covariance_mm2[0] * np.einsum("aij,bij->ab", weights, weights)
        found = np.einsum("aij,bij->ab", weights, spread)
        # what is left of a few nodes may claim that they cancel one another; independent ones are the least
        return found if np.linalg.eigvalsh(found - 0.5 * white)[0] > 0 else np.maximum(found, white)


@by_content
@dataclass(frozen=True)
class LocalDatum:
    """The plane by which two scans differ about a piece: ``plane`` (3,) in mm over ``terms`` (3, R, C), with its
    covariance (3, 3); ``noise`` about it; ``nodes``: how many told it, 0 where the pose alone did."""

    terms: Floats
    plane: Floats
    covariance: Floats
    noise: NoiseField
    nodes: int

    @cached_property
    def heights_mm(self) -> Floats:
        """Height (R, C) of the plane over the nodes."""
        return np.einsum("k,kij->ij", self.plane, self.terms)

    @cached_property
    def variances_mm2(self) -> Floats:
        """Variance (R, C) of that height."""
        return np.einsum("kij,kl,lij->ij", self.terms, self.covariance, self.terms)

    def __str__(self) -> str:
        sigma = np.sqrt(self.variances_mm2.mean())
        return f"datum {self.heights_mm.mean():+.3f} mm +- {sigma:.3f} mm from {self.nodes:,} unchanged nodes"


def plane_terms(shape: tuple[int, int]) -> Floats:
    """Constant and slopes (3, R, C) over a grid, from -1 to 1."""
    x, y = np.meshgrid(*(np.linspace(-1, 1, count) for count in shape), indexing="ij")
    return np.stack([np.ones(shape), x, y])


def fit_datum(heights: Floats, unchanged: Flags, prior: Floats, sigma_mm: float, reach_nodes: int) -> LocalDatum:
    """Fit the plane to the unchanged nodes of a map.

    Args:
        heights: (R, C), mm.
        unchanged: nodes (R, C) that belong to no piece.
        prior: covariance (3, 3) of the plane's terms that the pose and the scanner leave.
        sigma_mm: standard deviation of a node, where too few nodes tell it.
        reach_nodes: noise is alike over no more nodes.
    """
    terms = plane_terms((heights.shape[0], heights.shape[1]))
    used = unchanged & np.isfinite(heights)
    for _ in range(3):
        if used.sum() < MIN_RING:
            return LocalDatum(terms, np.zeros(3), prior, NoiseField(np.array([sigma_mm**2])), 0)
        design = terms[:, used].T
        plane = np.linalg.lstsq(design, heights[used], rcond=1e-6)[0]
        left = np.where(unchanged, heights - np.einsum("k,kij->ij", plane, terms), np.nan)
        spread = 1.4826 * np.nanmedian(np.abs(left[used]))
        used = unchanged & (np.abs(np.nan_to_num(left, nan=np.inf)) <= 4 * spread + 1e-12)
    noise = _noise_of(np.where(used, left, 0.0), used, reach_nodes)
    design = terms[:, used].T
    inverse = np.linalg.pinv(design.T @ design, rcond=1e-9, hermitian=True)
    found = inverse @ noise.of_sums(np.where(used, terms, 0.0)) @ inverse
    plane = inverse @ design.T @ heights[used]
    gain = prior @ np.linalg.pinv(prior + found, rcond=1e-12, hermitian=True)
    return LocalDatum(terms, gain @ plane, prior - gain @ prior, noise, int(used.sum()))


def _noise_of(left: Floats, used: Flags, reach_nodes: int) -> NoiseField:
    """Covariance by distance of what is left (R, C), zero outside the used nodes."""
    padded = [next_fast_len(count + reach_nodes + 1) for count in left.shape]
    products = irfft2(np.abs(rfft2(left, s=padded)) ** 2, s=padded)
    pairs = irfft2(np.abs(rfft2(used.astype(float), s=padded)) ** 2, s=padded)
    lags = [np.minimum(np.arange(count), count - np.arange(count)) for count in padded]
    away = np.rint(np.hypot(lags[0][:, None], lags[1][None])).astype(np.int64)
    near = away <= reach_nodes
    found = np.bincount(away[near], products[near], reach_nodes + 1)
    counts = np.bincount(away[near], pairs[near], reach_nodes + 1)
    return NoiseField(np.where(counts > 0.5, found / np.maximum(counts, 1.0), 0.0))
