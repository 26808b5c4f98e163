"""Dimensions of a known target measured in a scan: ``step_height``."""
