"""From two scans to grinding passes: how much stands above the good surface, and the wheel's lines in every pass."""

from grindvision import GrindOptions, SimulateOptions, grind, simulate

scene = simulate("grinding", SimulateOptions(seed=1, every=6))
# the wheel is not touched off: scanner and arm may err by 0.1 mm, so the passes stop above that until a scan has shown
# where the wheel cut (grindvision grind --again)
found = grind(scene.sample.points, scene.test.points, GrindOptions(place_sigma_mm=0.1))
print(found)
print(found.stock.pieces[0])

plan = found.plans[0]
print(f"{plan}; {plan.leave_mm:.2f} mm are left standing for now")
for one in plan.passes:
    for stroke in one.strokes:
        start, end = (stroke.poses[at, :3] for at in (0, -1))
        print(f"{one}: from {start.round(1)} to {end.round(1)} in the height map's frame")
