"""The files and the report of ``grindvision calibrate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from grindvision.arm.urdf_chain import UrdfChain
    from grindvision.calibration import Calibration, HeldOut, Measurements, PredictedErrors, Suggestion
    from grindvision.calibration.joint_terms import GravityLoad

#: Files that an earlier run may have left and a later one may not write.
OUTDATED = (
    "beyond_geometry.json", "robot.urdf", "robot_dh.csv", "zero_offsets.csv", "calibration.conf", "suggested_poses.csv",
)  # fmt: skip


@dataclass(frozen=True)
class RobotSource:
    """The file that the arm came from, and, of a URDF, the chain of joints in it."""

    path: str
    chain: UrdfChain | None

    def load(self, down: tuple[float, float, float]) -> GravityLoad | None:
        """The masses of a URDF's links, where it has them; ``down`` is the direction of gravity in its base link."""
        from grindvision.arm.urdf_masses import link_masses
        from grindvision.calibration.joint_terms import GravityLoad

        found = None if self.chain is None else link_masses(self.path, self.chain)
        if self.chain is None or found is None:
            return None
        masses, centres = found
        return GravityLoad(self.chain.arm, tuple(masses.tolist()), tuple(map(tuple, centres.tolist())), down)

    def in_table_base(self, measurements: Measurements) -> Measurements:
        """Readings in the frame of the URDF's base link, in that of the table."""
        from dataclasses import replace

        from grindvision.geometry import inverse, move_points

        if self.chain is None:
            return measurements
        return replace(measurements, tracker_mm=move_points(inverse(self.chain.T_base_table), measurements.tracker_mm))


def write_results(result: Calibration, source: RobotSource, suggestion: Suggestion | None, place: Path) -> None:
    """Write every file but report.png and report.json into the folder ``place``."""
    from grindvision.arm import write_arm
    from grindvision.arm.controllers import ur_deltas_text, write_standard_table, write_zero_offsets
    from grindvision.files import write_json, write_text
    from grindvision.geometry import inverse

    write_arm(result.arm, place / "robot.csv")
    T_tracker_base = result.cell.T_tracker_base
    if source.chain is not None:
        T_tracker_base = T_tracker_base @ inverse(source.chain.T_base_table)
    hand_eye: dict[str, Any] = {"T_joint_scanner": result.cell.T_joint_scanner, "T_tracker_base": T_tracker_base}
    if source.chain is not None:
        hand_eye["T_tracker_table"] = result.cell.T_tracker_base
    names = result.measurements
    if names.reflectors:
        hand_eye["reflectors_mm"] = dict(zip(names.reflectors, result.cell.reflectors_mm, strict=True))
    if names.fixtures:
        places = zip(names.fixtures, result.cell.fixtures_mm, strict=True)
        hand_eye["fixtures"] = {
            name: {"kind": kind, **({"normal": at[:3], "distance_mm": at[3]} if kind == "plane" else {"at_mm": at[:3]})}
            for (kind, name), at in places
        }
    write_json(place / "hand_eye.json", hand_eye)
    write_standard_table(result.arm, place / "robot_dh.csv")
    if result.unknowns.table:
        alone = result.offsets_alone()
        write_zero_offsets(
            alone.arm.joints, alone.arm.prismatic, alone.change_rad, alone.known, place / "zero_offsets.csv"
        )
    deltas = ur_deltas_text(result.coarse.arm, result.arm)
    if deltas:
        write_text(place / "calibration.conf", deltas)
    if source.chain is not None:
        from grindvision.arm.urdf_chain import write_corrected_urdf

        write_corrected_urdf(source.path, source.chain, result.arm, place / "robot.urdf")
    if result.beyond is not None:
        write_json(place / "beyond_geometry.json", beyond_of(result))
    if suggestion is not None:
        import numpy as np

        header = ",".join(f"q{i + 1}_{'mm' if slides else 'deg'}" for i, slides in enumerate(result.arm.prismatic))
        shown = np.where(result.arm.prismatic, suggestion.q_rad, np.degrees(suggestion.q_rad))
        lines = [
            ",".join([*(f"{value:.2f}" for value in row), f"{mean:.4f}"])
            for row, mean in zip(shown, suggestion.mean_mm, strict=True)
        ]
        write_text(place / "suggested_poses.csv", "\n".join([f"{header},mean_after_mm", *lines]) + "\n")


def beyond_of(result: Calibration) -> dict[str, Any]:
    """What beyond_geometry.json holds: the joint terms with the table and the places that belong to them."""
    from grindvision.arm import PARAMETERS

    beyond = result.beyond
    assert beyond is not None
    terms = beyond.cell.corrections
    return {
        "kind": beyond.kind,
        "note": "add to the commanded angle of `joint` (from 1), in rad: value times cos or sin of `order` times its"
        " angle; for sag, times the torque of gravity as a fraction of reach times weight; for a coupling, times the"
        " angle of joint `source`. The table and the places below belong to these terms, not to robot.csv",
        "terms": [
            {
                "name": term.name,
                "joint": term.joint + 1,
                "kind": term.kind,
                "order": term.order,
                "source": None if term.source < 0 else term.source + 1,
                "value": value,
            }
            for term, value in zip(terms.terms, terms.values, strict=True)
        ],
        "table": {
            joint: dict(zip(PARAMETERS, row, strict=True))
            for joint, row in zip(beyond.cell.arm.joints, beyond.cell.arm.table, strict=True)
        },
        "T_joint_scanner": beyond.cell.T_joint_scanner,
        "T_tracker_base": beyond.cell.T_tracker_base,
        "gravity_load": next(
            (
                {"masses": t.load.masses, "centres_mm": t.load.centres_mm, "down": t.load.down}
                for t in terms.terms
                if t.load is not None
            ),
            None,
        ),
        "tried_rms_mm": {kind: statistics.rms for kind, statistics in beyond.tried.items()},
    }


def results_of(
    result: Calibration, unseen: HeldOut, predicted: PredictedErrors, suggestion: Suggestion | None
) -> dict[str, Any]:
    """What report.json says of a calibration."""
    from dataclasses import asdict

    import numpy as np

    knowledge, names = result.identifiability, result.unknowns.names
    test = {"before": unseen.before, "after": unseen.after}
    if unseen.beyond is not None:
        test["beyond_geometry"] = unseen.beyond
    errors: dict[str, dict[str, Any]] = {
        "train": {"before": result.errors(train=True, before=True), "after": result.errors(train=True)},
        "test": test,
    }
    if result.dropped:
        errors["dropped"] = {"after": result.errors_of_dropped()}
        kept = ~np.isin(unseen.rows, result.dropped)
        if not kept.all() and kept.any():
            errors["test_without_dropped"] = {"after": unseen.part(kept).after}
    everywhere = {
        "where": predicted.where,
        "mean": predicted.mean_mm,
        "p95": predicted.p95_mm,
        "at_measured_poses": predicted.measured_mean_mm,
        "after_suggested_poses": None if suggestion is None else suggestion.mean_mm[-1],
    }
    return {
        "rank": knowledge.rank,
        "unknowns": len(names),
        "singular_values": knowledge.singular_values,
        "errors_mm": {part: {when: asdict(value) for when, value in both.items()} for part, both in errors.items()},
        "held_out": unseen.how,
        "predicted_mm": everywhere,
        "foreseen_mm": everywhere,  # the old key, for one version
        "structure": [
            {name: getattr(finding, name) for name in ("kind", "size_mm", "explained", "p_value", "sentence")}
            for finding in result.findings
        ],
        "beyond_geometry": None
        if result.beyond is None
        else {
            "kind": result.beyond.kind,
            "tried_rms_mm": {kind: statistics.rms for kind, statistics in result.beyond.tried.items()},
        },
        "changes": dict(zip(names, result.values, strict=True)),
        "standard_deviations": dict(zip(names, result.std, strict=True)),
        "only_together": list(knowledge.sentences),
        "observability": knowledge.observability,
        "noise": asdict(result.sigmas),
        "dropped": [result.measurements.label(row) for row in result.dropped],
        "iterations": result.iterations,
        "converged": result.converged,
    }
