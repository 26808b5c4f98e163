"""How often the standard deviations of a calibration hold the truth: ``python -m benchmarks.coverage``.

Every simulated cell draws its own arm (deviations of the table), scanner noise and tracker, and gear waves and sag or
none; the calibration knows nothing of them. 68.3 % of the known entries of the table should lie within their sigma.
"""

from __future__ import annotations

import argparse

import numpy as np
import pandas as pd

from grindvision import cell
from grindvision.calibration import Calibration, Measurements, Options, calibrate

#: Standard deviations of the true table from the nominal one: alpha, a, d, theta, beta.
DEVIATIONS = (1e-3, 0.5, 0.5, 1e-3, 1e-3)


def simulated_cell(seed: int, clean: bool) -> tuple[cell.GrindingRobot, Measurements]:
    """A cell with its truth, and what is measured in it: nine spheres from six directions, as in the paper."""
    rng = np.random.default_rng(seed)
    nominal = cell.nominal_arm()
    deviation = rng.normal(0, DEVIATIONS, nominal.table.shape)
    parallel = (np.abs(np.sin(nominal.table[:, 0])) < 0.02) & (np.arange(nominal.n) > 0)
    deviation[~parallel, 4] = 0.0
    true = nominal.changed_by(deviation)
    errors = None if clean else cell.drawn_joint_errors(true, rng)
    robot = cell.GrindingRobot(nominal=nominal, true=true, joint_errors=errors)
    made = cell.calibration_experiment(rng, test_spheres=0, robot=robot, every=None)
    columns = [[f"q{i}_rad" for i in range(1, 5)]] + [[f"{frame}{axis}_mm" for axis in "xyz"] for frame in "sb"]
    q, scanner, tracker = (made.table[names].to_numpy(dtype=float) for names in columns)
    labels = made.table["pose"].astype(str).to_numpy(), made.table["sphere"].astype(str).to_numpy()
    return robot, Measurements(q, scanner, tracker, *labels)


def inside(result: Calibration, robot: cell.GrindingRobot) -> np.ndarray:
    """Flags of the known entries of the table whose error is within one stated standard deviation."""
    entries = list(result.unknowns.table)
    error = (result.arm.table - robot.true.table).ravel()[entries]
    stated = result.std[result.unknowns.in_table]
    return (np.abs(error) <= stated)[np.isfinite(stated)]


def coverage(cells: int, clean: bool, diagnose: bool = True) -> tuple[float, pd.DataFrame]:
    """Fraction of known entries within one stated sigma over ``cells`` cells, and every cell's own."""
    rows = []
    for seed in range(cells):
        robot, measurements = simulated_cell(seed, clean)
        flags = inside(calibrate(measurements, robot.nominal, Options(diagnose=diagnose)), robot)
        rows.append({"seed": seed, "known": len(flags), "inside": int(flags.sum())})
    table = pd.DataFrame(rows)
    return float(table["inside"].sum() / table["known"].sum()), table


def main(words: list[str] | None = None) -> int:
    """Print the coverage with waves and sag, and of clean cells."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("--cells", type=int, default=200, metavar="N", help="simulated cells (default: 200)")
    options = parser.parse_args(words)
    for clean, name in ((False, "gear waves and sag"), (True, "clean cells")):
        for diagnose, how in ((True, "as stated"), (False, "without the model's own error")):
            share, table = coverage(options.cells, clean, diagnose)
            print(f"{name}, {how}: {share:.1%} of {table['known'].sum()} entries within one sigma (68.3 % asked)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
