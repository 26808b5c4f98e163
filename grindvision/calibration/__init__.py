"""Sphere centres in, calibrated cell out. Never sees the virtual cell or the papers."""
