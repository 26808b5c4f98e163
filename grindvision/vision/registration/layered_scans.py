"""What two layers in a scan leave unknown of its pose: which of them is right."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from grindvision.errors import GrindvisionWarning
from grindvision.vision.registration.free_motions import rms_extent
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.layers import find_layers
from grindvision.vision.surface.scan import Scan


def allow_for_layers(registration: FineRegistration, scans: Mapping[str, Scan]) -> FineRegistration:
    """The registration, its hidden covariance larger by the misfit between the layers of its scans, each by its name.

    The pose lies anywhere between those by either layer: half their distance is the standard deviation at most. It
    counts along all directions, and at the extent's ends as a turn as well, as layers may cover a part of a scan.

    Warns:
        GrindvisionWarning: a scan shows two layers.
    """
    square, extent = 0.0, 0.0
    for name, scan in scans.items():
        layers, extent = find_layers(scan), max(extent, rms_extent(scan.surfels.points))
        if layers is None:
            continue
        square += (layers.apart_mm / 2) ** 2
        warnings.warn(
            f"{name}: {layers}: views merged with such a misfit, a part that moved, or both sides of so thin a sheet;"
            " pose and heights may be off by as much: merge the views again, or give a single one",
            GrindvisionWarning,
            stacklevel=2,
        )
    if square == 0:
        return registration
    by_layers = np.diag(np.repeat([square, square / extent**2], 3))
    return replace(registration, hidden_covariance=registration.hidden_covariance + by_layers)
