"""A cloud in, path points out. Never sees the virtual cell or the papers.

Rooms, in the order data flows through them: ``surface`` (cloud -> voxels, normals, surfels, features),
``registration`` (two surfaces -> pose), ``change`` (a pose -> difference -> path points), ``seam`` (cloud -> grooves
-> way points); beside them ``depth_calibration`` (flat plates -> the scanner's depth error) and ``metrology``
(heights of steps).

Names are fetched from their modules when first used; what is not listed here is imported from its module.
"""

from __future__ import annotations

from grindvision.lazy import lazy_names

_HOMES = {
    "registration.icp": ("icp_generalised", "icp_points"),
    "registration.plane_icp": ("icp_planes",),
    "registration.global_registration": ("propose_poses",),
    "registration.scan_registration": ("RegisterOptions", "Registration", "register"),
    "registration.sac_ia": ("sac_ia_paper",),
    "registration.verification": ("choose_pose",),
    "change.ridge_path": ("BeadPath", "trace_bead"),
    "change.detection": ("DetectOptions", "Detection", "detect"),
    "change.stock": ("MeasureStockOptions", "Stock", "StockPiece", "measure_stock"),
    "change.change_detection": ("Difference", "find_change", "find_change_paper"),
    "seam.gfh_groove": ("GfhSettings", "find_groove_gfh"),
    "seam.groove": ("DetectedGroove", "FindGroovesOptions", "GrooveDetection", "find_grooves"),
    "seam.seams": ("FindSeamsOptions", "SeamDetection", "find_seams"),
    "seam.seam_path": ("root_path", "slab_path"),
    "seam.weld": ("TraceWeldOptions", "Weld", "trace_weld"),
    "depth_calibration.field_correction": (
        "CalibrateFieldOptions",
        "FieldCorrection",
        "calibrate_field",
        "read_field",
        "write_field",
    ),
}
_RENAMED = {
    "find_difference": "find_change=old_names:find_difference",
    "difference_paper": "find_change_paper=old_names:difference_paper",
}

__all__, __getattr__ = lazy_names(__name__, _HOMES, _RENAMED)
