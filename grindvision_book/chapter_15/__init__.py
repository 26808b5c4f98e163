"""What chapter 15 computes: joints under the camera, judged by their planted seams, and their pictures."""

from grindvision_book.chapter_15.study import (
    CAMERAS,
    Looked,
    judged,
    look,
    look_at_bend,
    noisier,
    refused_gap,
    true_opening_deg,
)

__all__ = ["CAMERAS", "Looked", "judged", "look", "look_at_bend", "noisier", "refused_gap", "true_opening_deg"]
