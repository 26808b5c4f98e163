"""Read a cloud whose numbers are metres; everything inside is in millimetres."""

import numpy as np

from grindvision import read_cloud, write_ply

x, y = np.meshgrid(np.linspace(-0.08, 0.08, 81), np.linspace(-0.05, 0.05, 51))
write_ply("plate_in_metres.ply", np.column_stack([x.ravel(), y.ravel(), 0.4 + 0 * x.ravel()]))

cloud = read_cloud("plate_in_metres.ply", unit="m")
print(cloud)
print(f"the first point stands at {cloud.points[0].round(1)} mm in the scanner's frame")
