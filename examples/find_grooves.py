"""Find the V-grooves of a scan, with width, depth and length."""

import numpy as np

from grindvision import FindGroovesOptions, SimulateOptions, find_grooves, simulate

scene = simulate("welding", SimulateOptions(seed=2, every=3))["curve"]
found = find_grooves(scene.points, FindGroovesOptions(viewpoint_mm=(0, 0, 0)))

for groove in found.grooves:
    print(groove)
print(f"{found.labels.sum()} of {len(scene.points)} points lie in a groove")
print(f"simulated: {scene.piece.groove.width_mm:.1f} mm wide; found: {np.median(found.grooves[0].width_mm):.1f} mm")
