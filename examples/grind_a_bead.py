"""From two scans to grinding passes: how much stands above the good surface, and the wheel's way through all passes."""

from grindvision import GrindOptions, SimulateOptions, grind, simulate
from grindvision.motion import tool_path
from grindvision.motion.grinding_options import GrindingOptions

scene = simulate("grinding", SimulateOptions(seed=1, every=6))
wheel = GrindingOptions(radius_mm=20.0, width_mm=6.0, depth_mm=0.3)
found = grind(scene.sample.points, scene.test.points, GrindOptions(wheel))
print(found)
print(found.stock.pieces[0])
for one in found.plans[0].passes:
    print(one)

# Where the wheel's lowest point goes, in the scanner frame of the test scan, with outward normals and feeds.
way = tool_path(found.plans[0])
print(way)
for point, normal, feed in zip(way.points[:5], way.normals[:5], way.feeds_mm_s[:5], strict=True):
    print(point.round(2), normal.round(3), f"{feed:.1f} mm/s")
