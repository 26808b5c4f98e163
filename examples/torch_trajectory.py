"""Turn way points and normals into torch frames, pushing by ten degrees, and write them as a table."""

import numpy as np

from grindvision import SimulateOptions, ToolTrajectoryOptions, TraceWeldOptions, simulate, tool_trajectory, trace_weld

scene = simulate("welding", SimulateOptions(seed=1, every=3))["line"]
path = trace_weld(scene.points, TraceWeldOptions(waypoints=12)).path

options = ToolTrajectoryOptions(closed=path.closed, travel_angle_rad=np.radians(10), steady_mm=8.0)
trajectory = tool_trajectory(path.points, path.normals, options)
print(trajectory)
rows = np.column_stack([trajectory.positions_mm, trajectory.rpy_rad])
np.savetxt("torch.csv", rows, delimiter=",", header="x_mm,y_mm,z_mm,roll_rad,pitch_rad,yaw_rad", comments="")
print(f"torch.csv: {len(rows)} poses in the camera's frame")
