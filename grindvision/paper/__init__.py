"""What the papers print: tables, transforms, expected values with tolerances."""

from grindvision.data_files import data_folder
from grindvision.paper.printed import (
    CLAIMS,
    EVIDENCE,
    TABLES,
    expected,
    hand_eye,
    headline,
    mdh_corrections,
    path_points,
    table,
)

__all__ = [
    "CLAIMS",
    "EVIDENCE",
    "TABLES",
    "data_folder",
    "expected",
    "hand_eye",
    "headline",
    "mdh_corrections",
    "path_points",
    "table",
]
