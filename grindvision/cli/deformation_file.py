"""``deformation.csv``: where and how far a part is bent against its good one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from grindvision.vision.registration.deformed_registration import DeformedPart

DEFORMATION_FILE = "deformation.csv"


def deformation_text(deformed: DeformedPart) -> str:
    """CSV text of where and how far a part is bent along its outward normal."""
    rows = zip(deformed.points, deformed.sizes_mm, deformed.sigma_mm, strict=True)
    lines = [",".join(f"{value:.4f}" for value in (*point, size, sigma)) for point, size, sigma in rows]
    return "\n".join(["x_mm,y_mm,z_mm,outward_mm,sigma_mm", *lines]) + "\n"
