"""Races of grindvision against its peers, in turn and in one run: ``./run bench`` or ``python -m benchmarks``."""
