"""Plan a motion of a UR3 along a seam, clear of the table and itself, and write it as URScript."""

import numpy as np

from grindvision import PlanMotionOptions, load_robot, plan_motion, tool_trajectory, write_programme

along = np.linspace(-50, 50, 11)
seam_mm = np.column_stack([300 + 10 * np.sin(along / 20), along, np.full(11, 60.0)])
trajectory = tool_trajectory(seam_mm, np.tile([0.0, 0.0, 1.0], (11, 1))).refined(step_mm=10.0, step_rad=0.1)

robot = load_robot("ur3")
motion = plan_motion(robot, trajectory, PlanMotionOptions(tool_speed_mm_s=8.0, table_top_mm=0.0))
print(motion)
write_programme(motion, "weld.script", "urscript")
write_programme(motion, "weld.csv", "csv")
print(f"weld.script and weld.csv: {motion.timing.time_s[-1]:.1f} s")
