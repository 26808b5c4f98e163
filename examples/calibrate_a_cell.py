"""Calibrate scanner and arm from spheres that a laser tracker has measured too."""

import numpy as np

from grindvision import SimulateOptions, calibrate, read_measurements, simulate

experiment = simulate("calibration", SimulateOptions(seed=1, every=12))
experiment.table.to_csv("measurements.csv", index=False)

measurements = read_measurements("measurements.csv", joints=4)
result = calibrate(measurements, experiment.robot.nominal)
print(result)
print(f"test rows before: {result.errors(train=False, before=True)}")
print(f"test rows after:  {result.errors(train=False)}")
print("T_joint_scanner, mm:")
print(result.cell.T_joint_scanner.round(4))
for name, value, std in zip(result.unknowns.names, result.values, result.std, strict=True):
    print(f"{name:20} {value:10.5f}", "cannot be told from others" if np.isnan(std) else f"+- {std:.5f}")
