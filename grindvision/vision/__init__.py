"""A cloud in, path points out. Never sees the virtual cell or the papers.

Names are fetched from their modules when first used; what is not listed here is imported from its module.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "bead_path": ("BeadPath", "trace_bead"),
    "detection": ("DetectOptions", "Detection", "detect"),
    "difference": ("Difference", "difference_paper", "find_difference"),
    "field_correction": ("FieldCorrection", "calibrate_field", "read_field", "write_field"),
    "gfh_groove": ("GfhSettings", "find_groove_gfh"),
    "groove": ("DetectedGroove", "GrooveDetection", "find_grooves"),
    "icp": ("icp_generalised", "icp_points"),
    "plane_icp": ("icp_planes",),
    "proposals": ("propose_poses",),
    "sac_ia": ("sac_ia_paper",),
    "seam_path": ("root_path", "slab_path"),
    "verification": ("choose_pose",),
    "weld": ("Weld", "trace_weld"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    raise AttributeError(f"module {__name__} has no {name}")
