"""``grindvision calibrate``: sphere measurements and a nominal arm in, the calibrated arm and scanner out."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from grindvision.calibration import Calibration, HeldOut


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument(
        "measurements",
        metavar="MEASUREMENTS.csv",
        help="pose,sphere,q1_rad..qN_rad,sx_mm,sy_mm,sz_mm (scanner, or constant: reflector on the tool),"
        " bx_mm,by_mm,bz_mm (tracker)[,split: train or test]",
    )
    parser.add_argument(
        "--robot",
        required=True,
        metavar="ROBOT.csv",
        help="nominal modified DH table up to the scanner's joint: joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad",
    )
    parser.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--base-fixed", action="store_true", help="the tracker measures exactly in the arm's base frame"
    )
    parser.add_argument(
        "--free",
        nargs="+",
        metavar="NAME",
        help="entries of the robot table to estimate, e.g. d3_mm theta4_rad (the number is the row)",
    )
    parser.add_argument("--keep-all", action="store_true", help="use every row, also those that contradict the others")
    parser.add_argument(
        "--variant", choices=("ours", "paper"), default="ours", help="paper: one linear step, equal weights, no priors"
    )


def run(options: argparse.Namespace) -> int:
    """Run it."""
    import grindvision.calibration as calibration
    from grindvision.arm import read_arm, write_arm
    from grindvision.cli.report import Stopwatch, run_facts
    from grindvision.errors import GrindvisionWarning
    from grindvision.files import write_json

    stopwatch = Stopwatch()
    with stopwatch.stage("read"):
        arm = read_arm(options.robot)
        measurements = calibration.read_measurements(options.measurements, arm.n)
    settings = calibration.Options(
        base_fixed=options.base_fixed,
        free=None if options.free is None else tuple(options.free),
        robust=not options.keep_all,
        variant=options.variant,
    )
    with stopwatch.stage("calibrate"):
        result = calibration.calibrate(measurements, arm, settings)
    with stopwatch.stage("held_out"):
        if measurements.train.all():
            unseen = calibration.cross_validated(result, settings)
        else:
            unseen = calibration.on_test_rows(result)
    folder = Path(options.output)
    with stopwatch.stage("write"):
        write_arm(result.arm, folder / "robot.csv")
        hand_eye = {"T_joint_scanner": result.cell.T_joint_scanner, "T_tracker_base": result.cell.T_tracker_base}
        write_json(folder / "hand_eye.json", hand_eye)
        _draw(result, unseen, folder / "report.png")
    facts = run_facts(options, [options.measurements, options.robot], ("numpy", "scipy", "matplotlib"), stopwatch)
    write_json(folder / "report.json", _results(result, unseen) | facts)
    for sentence in result.warnings:
        warnings.warn(sentence, GrindvisionWarning, stacklevel=1)
    print(f"{result}\n{unseen}\nwritten: robot.csv, hand_eye.json, report.json, report.png in {folder}")
    return 0


def _results(result: Calibration, unseen: HeldOut) -> dict[str, Any]:
    from dataclasses import asdict

    knowledge, names = result.identifiability, result.unknowns.names
    errors = {
        "train": {"before": result.errors(train=True, before=True), "after": result.errors(train=True)},
        "test": {"before": unseen.before, "after": unseen.after},
    }
    return {
        "rank": knowledge.rank,
        "unknowns": len(names),
        "singular_values": knowledge.singular_values,
        "errors_mm": {part: {when: asdict(value) for when, value in both.items()} for part, both in errors.items()},
        "held_out": unseen.how,
        "changes": dict(zip(names, result.values, strict=True)),
        "standard_deviations": dict(zip(names, result.std, strict=True)),
        "only_together": list(knowledge.sentences),
        "observability": knowledge.observability,
        "noise": asdict(result.spreads),
        "dropped": [result.measurements.label(row) for row in result.dropped],
        "warnings": list(result.warnings),
        "iterations": result.iterations,
        "converged": result.converged,
    }


def _draw(result: Calibration, unseen: HeldOut, path: Path) -> None:
    """Draw report.png: errors before and after, where they point, what can be known."""
    import numpy as np
    from matplotlib.figure import Figure

    from grindvision.files import write_whole

    before, after = "#999999", "#0072B2"
    figure = Figure(figsize=(11, 8), layout="constrained")
    title = f"Unseen points: mean error {unseen.after.mean:.3f} mm, largest {unseen.after.max:.3f} mm"
    figure.suptitle(
        f"{title} (before: {unseen.before.mean:.3f} and {unseen.before.max:.3f} mm)\n{unseen.how}", fontsize=12
    )
    (errors, arrows), (values, words) = figure.subplots(2, 2)

    for residuals, colour, label in ((unseen.before_mm, before, "before"), (unseen.after_mm, after, "after")):
        lengths = np.sort(np.linalg.norm(residuals, axis=1))
        errors.step(lengths, np.arange(1, len(lengths) + 1) / len(lengths), color=colour, label=label, where="post")
    errors.set(xscale="log", xlabel="error of unseen points, mm", ylabel="share of points below", ylim=(0, 1))
    errors.legend(frameon=False)

    for axis, colour, marker in ((0, "#E69F00", "o"), (1, "#009E73", "s"), (2, after, "^")):
        arrows.plot(unseen.rows + 1, unseen.after_mm[:, axis], marker, color=colour, ms=3, label="xyz"[axis])
    arrows.axhline(0, color="black", lw=0.5)
    arrows.set(xlabel="row of the measurement file", ylabel="residual after, tracker frame, mm")
    arrows.legend(frameon=False, ncols=3)

    singular, rank = result.identifiability.singular_values, result.identifiability.rank
    numbers = np.arange(1, len(singular) + 1)
    values.semilogy(numbers[:rank], singular[:rank], "o", color=after, label="known")
    floor = singular[rank - 1] / 100
    values.semilogy(numbers[rank:], np.maximum(singular[rank:], floor), "x", color="#D55E00", label="not known")
    values.set(xlabel="combination of unknowns", ylabel="singular value, 1/mm", title=f"rank {rank} of {len(singular)}")
    values.legend(frameon=False)

    words.axis("off")
    lines = [f"arm of {result.arm.n} joints, {len(singular)} unknowns", str(result.spreads).replace("; ", "\n"), ""]
    lines += ["Cannot be told apart:"] * bool(result.identifiability.sentences)
    lines += [f"  {sentence}" for sentence in result.identifiability.sentences]
    lines += ["", "Warnings:"] * bool(result.warnings) + [f"  {sentence}" for sentence in result.warnings[:6]]
    words.text(0, 1, "\n".join(line[:95] for line in lines), va="top", fontsize=9, transform=words.transAxes)
    with write_whole(path) as temporary:
        figure.savefig(temporary, dpi=110)
