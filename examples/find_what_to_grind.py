"""Compare a part with a good one, and get the path along what has to be ground away in the robot's base frame."""

import numpy as np

from grindvision import DetectOptions, SimulateOptions, detect, simulate

scene = simulate("grinding", SimulateOptions(seed=1, every=6))
found = detect(scene.sample.points, scene.test.points, DetectOptions(points=8))
print(found)
print(f"bead: {found.beads[0].length_mm:.0f} mm long, {found.beads[0].height_mm:.1f} mm high")

# T_base_scanner @ p_scanner = p_base: where the scanner stood for the second scan.
T_base_scanner = np.array([[1, 0, 0, 450], [0, -1, 0, 0], [0, 0, -1, 500], [0, 0, 0, 1]])
path_base = found.path_points @ T_base_scanner[:3, :3].T + T_base_scanner[:3, 3]
normals_base = found.path_normals @ T_base_scanner[:3, :3].T
for point, normal in zip(path_base, normals_base, strict=True):
    print(point.round(1), normal.round(2))
