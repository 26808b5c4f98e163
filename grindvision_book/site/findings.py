"""Numbers for the page "What the papers got wrong": computed from the printed tables and from what chapters saved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from grindvision import geometry, paper
from grindvision.files import read_table
from grindvision_book.chapter_07 import HALF_DIGIT, tried_readings
from grindvision_book.chapter_11.waypoints import PLATES_MM
from grindvision_book.machinery.answers import scoreboard

Numbers = dict[str, float | int | str]


def findings_page(text: str, figures: Path) -> str:
    """The page's text with every ``{name}`` filled in; ``figures`` holds the tables and answers of the chapters.

    Raises:
        FileError: a table that the page quotes is missing.
    """
    return text.format_map(printed_numbers() | rebuilt_numbers(figures) | numbers_not_reproduced(figures))


def printed_numbers() -> Numbers:
    """What follows from the printed tables alone."""
    points, normals = paper.path_points(3)
    points_base, triples = paper.path_points(4)
    fit = geometry.fit_rigid(points, points_base)
    about_base, about_scanner = (p - p.mean(axis=0) for p in (points_base, points))
    longer = np.linalg.norm(about_base) / np.linalg.norm(about_scanner)
    tangents = np.gradient(points, axis=0)
    as_printed, mended = (
        np.abs(np.degrees(geometry.vector_angle(normals * signs, tangents)) - 90) for signs in ([1, 1, 1], [-1, -1, 1])
    )
    lengths = np.linalg.norm(triples, axis=1)
    readings = tried_readings(normals, triples, fit.T_target_source)
    conventions, affine = readings.iloc[:-1], readings.iloc[-1]
    errors = paper.table("diao2018_table1").set_index("position")["absolute_error_mm"]
    origin = fit.T_target_source[:3, 3]
    return {
        "motion_rms_um": 1e3 * fit.rms_mm,
        **{f"origin_{axis}_mm": value for axis, value in zip("xyz", origin, strict=True)},
        "stretch_ppm": 1e6 * (longer - 1),
        "off_least_deg": as_printed.min(),
        "off_most_deg": as_printed.max(),
        "mended_most_deg": mended.max(),
        "length_least": lengths.min(),
        "length_most": lengths.max(),
        "readings_tried": int(conventions["tried"].sum()),
        "reading_left_digits": conventions["left_rms"].min() / HALF_DIGIT,
        "affine_left": affine["left_rms"],
        "heights": len(errors),
        "centre_rank": int(errors.rank()["P3"]),
        "centre_um": 1e3 * errors["P3"],
        "best_um": 1e3 * errors.min(),
        "best_place": str(errors.idxmin()),
        "mean_height_mm": errors.mean(),
        "printed_height_mm": paper.headline("height_mean_absolute_error"),
        "printed_sphere_mm": paper.headline("sphere_mean_absolute_error"),
        "printed_sphere_most_mm": paper.headline("sphere_max_error"),
        "printed_scanner_mm": paper.headline("scanner_accuracy"),
        "printed_compound_mm": paper.headline("compound_error"),
        "five_mm": np.sqrt(5.0),
        "half_mm": np.sqrt(0.5),
        "half_in_m_mm": 1e3 * np.sqrt(0.5e-3),
    }


def rebuilt_numbers(figures: Path) -> Numbers:
    """What the chapters found and saved in ``figures``."""

    def saved(name: str, numbers: tuple[str, ...], texts: tuple[str, ...] = ()) -> pd.DataFrame:
        return read_table(figures / f"{name}.csv", numbers, texts)

    pairs = saved("table4_arm_pairs", ("left_mm",), ("matrix", "arm")).set_index(["matrix", "arm"])["left_mm"]
    seeds = saved("table1_seeds", ("mean_absolute_error_mm",))["mean_absolute_error_mm"]
    spectra = saved("calibration_rank", ("beta_before_the_joint", "beta_behind_the_joint"))
    known = (spectra > 1e-9 * spectra.max()).sum()
    spreads = saved("compound_spreads", ("spread_x_mm", "spread_y_mm", "spread_z_mm"))
    ridge = saved("compound_error", ("median cell",), ("quantity",)).set_index("quantity")["median cell"]
    overlap = saved("peng_table2", ("mean_percent",), ("piece", "method")).set_index(["piece", "method"])
    variants = saved("peng_waypoints", ("off_mean_mm", "shown_mean_mm"), ("piece", "variant")).set_index("variant")
    waypoints, off = variants["shown_mean_mm"], variants["off_mean_mm"]
    cameras = saved("peng_calibrated", ("off_mean_mm",), ("piece", "camera")).groupby("camera")["off_mean_mm"].mean()
    sweep = saved("peng_sensitivity", ("threshold_deg", "overlap_percent"), ("piece",))
    by_radii = sweep[(sweep["piece"] == "line") & (sweep["threshold_deg"] == 4.75)]["overlap_percent"]
    rows = scoreboard(figures).set_index(["item", "quantity"])
    board = rows["rebuilt"]
    return {
        **{
            f"{matrix}_{name}_mm": pairs[matrix, arm]
            for matrix in ("accurate", "coarse")
            for name, arm in (("nominal", "nominal"), ("corrected", "with Table 2"))
        },
        "instruments": len(seeds),
        "seeds_low_mm": seeds.quantile(0.05),
        "seeds_high_mm": seeds.quantile(0.95),
        "rank_before": int(known["beta_before_the_joint"]),
        "rank_behind": int(known["beta_behind_the_joint"]),
        "twin_sphere_mm": board["fig05", "mean error after accurate calibration"],
        "twin_sphere_most_mm": board["fig05", "largest error after accurate calibration"],
        "spread_most_mm": spreads[["spread_x_mm", "spread_y_mm", "spread_z_mm"]].to_numpy().max(),
        "ridge_most_mm": ridge["largest of 24 points"],
        **{
            f"{method}_{piece}_percent": overlap.loc[(piece, method), "mean_percent"]
            for piece in ("line", "cylinder")
            for method in ("printed", "paper", "ours")
        },
        "median_least_mm": waypoints["paper"].min(),
        "median_most_mm": waypoints["paper"].max(),
        "root_least_mm": waypoints["ours"].min(),
        "root_most_mm": waypoints["ours"].max(),
        "bought_mm": off["ours"].mean(),
        "shown_mm": waypoints["ours"].mean(),
        "oracle_mm": off["oracle"].mean(),
        "asked_mm": rows.loc[("peng_fig14", "way points to the root line, mean, ours"), "tolerance"],
        "plates": len(PLATES_MM),
        "calibrated_mm": cameras["calibrated"],
        "exact_mm": cameras["true field"],
        "radii_least_percent": by_radii.min(),
        "radii_most_percent": by_radii.max(),
    }


def numbers_not_reproduced(figures: Path) -> Numbers:
    """What the papers' own methods came to, from the scoreboard and the tables in ``figures``."""
    rows = scoreboard(figures).set_index(["item", "quantity"])
    board, after = rows["rebuilt"], "error after accurate calibration, Eq 18"
    causes = read_table(figures / "fig05_causes.csv", ("size", "mean_mm"), ("cause", "meets_all_three"))
    possible = causes[causes["meets_all_three"].astype(str) == "True"]
    sizes = ("nearest_min_mm", "nearest_max_mm", "one_to_one_max_mm")
    boxes = read_table(figures / "table3_variants.csv", sizes, ("path",)).set_index("path")
    return {
        "numbers": len(rows),
        "reproduced": int((rows["verdict"] == "reproduced").sum()),
        "eq18_sphere_mm": board["fig05", f"mean {after}"],
        "eq18_sphere_most_mm": board["fig05", f"largest {after}"],
        "rigs": len(causes) - 1,
        "possible": len(possible),
        "causes": ", ".join(f"{row.cause.replace('_', ' ')} {row.size:g}" for row in possible.itertuples()),
        "boxes_least_mm": boxes.loc[["boxes"], "nearest_min_mm"].min(),
        "boxes_most_mm": boxes.loc[["boxes"], "nearest_max_mm"].max(),
        "ours_most_mm": boxes.loc["ours", "nearest_max_mm"],
        "one_to_one_most_mm": boxes.loc["ours", "one_to_one_max_mm"],
        **{
            f"early_{piece}_percent": board["peng_table2", f"overlap on the {piece}, method of the paper, radii 10/5/5"]
            for piece in ("line", "cylinder")
        },
    }
