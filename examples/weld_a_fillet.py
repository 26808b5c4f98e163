"""Find a joint that is no groove, and put way points along its root."""

import numpy as np

from grindvision import SimulateOptions, TraceWeldOptions, simulate, trace_weld

scene = simulate("welding", SimulateOptions(seed=5, joint="t-joint", camera="fine", every=6))["t-joint"]
weld = trace_weld(scene.points, TraceWeldOptions(waypoints=20, joint="fillet"))
print(weld)

seam = weld.seams[0]
print(
    f"{seam.kind}, faces {np.median(seam.opening_deg):.1f} +- {seam.opening_sigma_deg:.1f} deg apart: {seam.evidence}"
)
across = np.linalg.norm(weld.path.points[:, None] - scene.root_mm, axis=2).min(axis=1)
print(f"way points off the true root: {across.mean():.2f} mm in the mean, {across.max():.2f} mm at most")
