"""Bring one scan onto another one; nothing needs to be known of how the scanner stood."""

import numpy as np

from grindvision import RegisterOptions, SimulateOptions, register, simulate

scene = simulate("grinding", SimulateOptions(seed=3, every=6))
source, target = scene.test.points, scene.sample.points

found = register(source, target, RegisterOptions(seed=1))
print(found)
moved = source @ found.T_target_source[:3, :3].T + found.T_target_source[:3, 3]
truth = source @ scene.T_sample_test[:3, :3].T + scene.T_sample_test[:3, 3]
print(f"farthest point from where it belongs: {np.linalg.norm(moved - truth, axis=1).max():.2f} mm")
