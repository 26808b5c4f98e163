"""Scans of a flat plate in, the depth error over the scanner's field of view out (``field_correction``)."""
