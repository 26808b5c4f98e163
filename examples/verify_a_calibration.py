"""Judge last month's calibration by new shots: does it still hold 0.5 mm? And after a knock against the scanner?"""

import dataclasses

from grindvision import SimulateOptions, VerifyOptions, calibrate, read_measurements, simulate, verify

experiment = simulate("calibration", SimulateOptions(seed=2, every=12))
experiment.table.to_csv("shots.csv", index=False)
shots = read_measurements("shots.csv", joints=4)
cell = calibrate(shots, experiment.robot.nominal).cell

new = shots.rows(~shots.train)
print(verify(cell, new, VerifyOptions(limit_mm=0.5)))

knocked = dataclasses.replace(new, scanner_mm=new.scanner_mm + [1.0, 0.0, 0.0])
judged = verify(cell, knocked, VerifyOptions(limit_mm=0.5))
print(judged)
print(f"worst: {judged.worst}; {judged.errors}")
