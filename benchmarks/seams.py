"""How well seams are found: joints of known lines under cameras, a row per scene, kept as it is done; and surfaces
without a seam.

``python -m benchmarks.seams ROWS.csv --only 'kinds/bevel*' --views 4`` looks at scenes whose names match and appends a
row for each that is not in the file yet; ``--judge`` prints the table of the file's rows. It is no race and not in
``./run bench``: 20 views a kind take half an hour.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import manifold3d as m3
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision import cell
from grindvision.cell.joint_pieces import JOINTS, JointSize
from grindvision.cell.rays import target_of
from grindvision.cell.solids import Shape, box
from grindvision.cell.views import view_from
from grindvision.cell.weld_pieces import Groove
from grindvision.errors import GrindvisionError, NoGrooveError
from grindvision.geometry import rotation_about
from grindvision.vision.seam.joints import Seam
from grindvision.vision.seam.weld import TraceWeldOptions, Weld, trace_weld

Floats = NDArray[np.float64]

END_MM = 3.0
"""Places within this of a seam's end are not judged across: how far a seam is followed is a column of its own."""
SHOWN_MM = 3.0
"""A place of a seam is shown where a point was measured so near to it."""
BOTH_MM = 5.0
"""Of a joint of two bodies both must be measured so near to a place of the seam."""
WRONG_MM, TRUNCATED = 2.0, 0.6
"""A line farther off in the mean is a wrong one; one that follows less than this fraction is badly cut short."""
SEAMLESS = ("bend", "pipe", "waves", "ball", "cone", "step-less sheet")
COLUMNS = (
    "scene", "seed", "true_kind", "found_kind", "mean_mm", "max_mm", "followed", "sigma_mm",
    "within_1", "within_2", "warnings", "verdict",
    "cpu_s",
)  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """A cloud (N, 3) in the camera's frame, and the seam (K, 3) as the camera shows it; None where there is none."""

    points: Floats
    kind: str
    root: Floats | None


Scene = Callable[[int], Seen]


def shown(root: Floats, points: Floats) -> Floats:
    """The places of a seam (K, 3) beside which points were measured: not those in the projector's shadow."""
    return root[cKDTree(points).query(root)[0] < SHOWN_MM]


def joint(kind: str, size: JointSize | None = None, camera: str = "D415", every: int = 1, spatter: int = 0) -> Scene:
    """Scenes of one joint: the seed draws the camera, the view and the noise."""

    def make(seed: int) -> Seen:
        rng = np.random.default_rng(seed)
        fine = camera == "fine"
        instrument = (cell.StructuredLightScanner if fine else cell.DepthCamera)(serial=seed + 1)
        distance = 400.0 if fine else 450.0
        if kind == "v-groove":
            shape = Groove() if size is None else Groove(size.width_mm, size.thickness_mm)
            plate = cell.weld_scene("line", rng, shape, instrument, distance, every)
            return Seen(plate.points, kind, shown(plate.root_mm + plate.root_errors_mm, plate.points))
        scene = cell.joint_scene(kind, rng, size, instrument, distance, every, spatter)
        root = shown(scene.root_mm + scene.root_errors_mm, scene.points)
        bodies = [scene.points[scene.scan.surface_id == k] for k in range(len(scene.scan.surfaces))]
        away = np.sort([cKDTree(one).query(root)[0] for one in bodies if len(one)], axis=0)
        both = (away[1] < BOTH_MM) | (kind in ("bevel-groove", "u-groove", "outside-corner"))
        return Seen(scene.points, kind, root[both])

    return make


def tubes(radii: tuple[float, float], every: int, table: bool) -> Scene:
    """Two tubes that lie side by side and touch, on a table or not, under a D415: their walls bend into a hollow, and
    where they touch nothing is seen."""

    def make(seed: int) -> Seen:
        rng = np.random.default_rng(seed)
        parts = []
        for radius, side in zip(radii, (-1.0, 1.0), strict=True):
            tube = m3.Manifold.cylinder(160.0, radius, circular_segments=720)
            lay = np.array([[0.0, 0, 1, -80.0], [0, 1, 0, side * radius], [-1, 0, 0, radius]])
            parts.append(Shape.named(tube.transform(lay), "tube"))
        if table:
            parts.append(box("table", [-150.0, -120.0, -10.0], [150.0, 120.0, 0.0]))
        camera = cell.DepthCamera(serial=seed + 1)
        tilt, roll, azimuth = np.radians(rng.uniform((0, -8, 0), (25, 8, 360)))
        pose = view_from([0.0, 0.0, max(radii)], 450.0, tilt, azimuth, roll)
        scan = camera.scan(target_of(sum(parts[1:], parts[0]).solid()), pose, rng, every)
        return Seen(scan.points, "tubes side by side", None)

    return make


def surface(kind: str) -> Scene:
    """A surface of one piece without a seam, its sizes and noise drawn from the seed."""

    def make(seed: int) -> Seen:
        rng = np.random.default_rng([seed, SEAMLESS.index(kind)])
        spacing, noise = rng.choice([0.5, 1.0]), rng.choice([0.05, 0.2, 0.5])
        u, v = np.meshgrid(np.arange(-70.0, 70.0, spacing), np.arange(-50.0, 50.0, spacing))
        height = 0 * u
        if kind == "bend":
            radius = rng.uniform(12, 40)
            turn = np.clip(v / radius, -0.6, 0.6)
            arc = np.stack([u, radius * np.sin(turn), radius * np.cos(turn)], axis=-1)
            rest = (v - radius * turn)[..., None] * np.stack([0 * u, np.cos(turn), -np.sin(turn)], axis=-1)
            sheet = arc + rest
            sheet[..., 2] *= rng.choice([-1.0, 1.0])
        else:
            if kind == "pipe":
                radius = rng.uniform(52, 150)
                height = np.sqrt(radius**2 - v**2)
            elif kind == "ball":
                radius = rng.uniform(90, 200)
                height = np.sqrt(radius**2 - u**2 - v**2)
            elif kind == "cone":
                height = np.sqrt(np.maximum((80 + rng.uniform(0.1, 0.5) * (u + 70)) ** 2 - v**2, 0))
            elif kind == "waves":
                for _ in range(5):
                    w, t, p = rng.uniform(70, 200), rng.uniform(0, np.pi), rng.uniform(0, 6)
                    height = height + 0.02 * w * np.cos(2 * np.pi / w * (u * np.cos(t) + v * np.sin(t)) + p)
            sheet = np.stack([u, v, height], axis=-1)
        points = sheet.reshape(-1, 3) - sheet.reshape(-1, 3).mean(axis=0)
        tilt = rotation_about([1.0, 0.3, 0.0], np.pi + rng.uniform(-0.5, 0.5))
        points = points @ tilt.T + [0.0, 0.0, 450.0]
        rays = points / np.linalg.norm(points, axis=1)[:, None]
        return Seen(points + noise * rng.standard_normal((len(points), 1)) * rays, "no seam", None)

    return make


def off_line(places: Floats, root: Floats) -> Floats:
    """Distances (K,) of places (K, 3) from the line through the places of a seam, which may show holes."""
    nearest = cKDTree(root).query(places)[1]
    off = np.linalg.norm(places - root[nearest], axis=1)
    for other in (np.maximum(nearest - 1, 0), np.minimum(nearest + 1, len(root) - 1)):
        step = root[other] - root[nearest]
        length = np.linalg.norm(step, axis=1)
        part = ((places - root[nearest]) * step).sum(axis=1) / np.maximum(length**2, 1e-9)
        part = np.where(length < SHOWN_MM, np.clip(part, 0.0, 1.0), 0.0)
        off = np.minimum(off, np.linalg.norm(places - root[nearest] - part[:, None] * step, axis=1))
    return off


def scenes() -> dict[str, Scene]:
    """All scenes by name, in groups: the kinds as they are, sizes, disturbances, and what is no seam."""
    found: dict[str, Scene] = {}
    kinds = ("v-groove", *JOINTS)
    for kind in kinds:
        found[f"kinds/{kind}/D415"] = joint(kind)
        found[f"kinds/{kind}/D415 every 2nd"] = joint(kind, every=2)
        found[f"kinds/{kind}/fine every 3rd"] = joint(kind, camera="fine", every=3)
    for angle in (60.0, 75.0, 110.0, 120.0):
        found[f"sizes/t-joint {angle:.0f} deg"] = joint("t-joint", JointSize(length_mm=120, angle_deg=angle))
        found[f"sizes/t-joint {angle:.0f} deg every 2nd"] = joint(
            "t-joint", JointSize(length_mm=120, angle_deg=angle), every=2
        )
    for step in (1.0, 2.0, 3.0, 5.0):
        found[f"sizes/lap {step:.0f} mm"] = joint("lap-joint", JointSize(thickness_mm=step))
        found[f"sizes/lap {step:.0f} mm fine"] = joint(
            "lap-joint", JointSize(thickness_mm=step), camera="fine", every=4
        )
    for thick in (5.0, 12.0):
        for kind in ("bevel-groove", "u-groove"):
            found[f"sizes/{kind} {thick:.0f} mm"] = joint(kind, JointSize(thickness_mm=thick))
    for gap in (1.0, 3.0, 4.0):
        found[f"sizes/butt {gap:.0f} mm"] = joint("butt-gap", JointSize(gap_mm=gap))
    for branch, lean in ((12.0, 0.0), (28.0, 0.0), (20.0, 30.0)):
        size = JointSize(branch_mm=branch, lean_deg=lean)
        found[f"sizes/saddle {branch:.0f} mm {lean:.0f} deg"] = joint("saddle", size)
    for radius in (15.0, 45.0):
        found[f"sizes/tube-on-plate {radius:.0f} mm"] = joint(
            "tube-on-plate", JointSize(radius_mm=radius, branch_mm=10.0)
        )
    for kind in kinds[1:]:
        found[f"disturbed/{kind} tacks"] = joint(kind, JointSize(tacks=3))
        found[f"disturbed/{kind} clamp"] = joint(kind, JointSize(clamp=True))
        found[f"disturbed/{kind} spatter"] = joint(kind, spatter=40)
    for radii in ((20.0, 20.0), (15.0, 30.0), (10.0, 10.0)):
        for every in (1, 2):
            for table in (False, True):
                name = f"tubes/{radii[0]:.0f} and {radii[1]:.0f} mm{' on a table' if table else ''} every {every}"
                found[name] = tubes(radii, every, table)
    for kind in SEAMLESS:
        found[f"seamless/{kind}"] = surface(kind)
    return found


def judged(name: str, seed: int, seen: Seen) -> dict[str, object]:
    """The row of a scene: what ``grindvision groove`` finds in it, and how wrong that is."""
    row: dict[str, object] = dict.fromkeys(COLUMNS, "") | {"scene": name, "seed": seed, "true_kind": seen.kind}
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            weld: Weld | None = trace_weld(seen.points, TraceWeldOptions())
        except NoGrooveError as error:
            weld, row["warnings"] = None, str(error)
        except GrindvisionError as error:
            weld, row["warnings"] = None, f"ERROR {error}"
    row["cpu_s"] = round(time.process_time() - begin, 2)
    if weld is None:
        return row | {"found_kind": "nothing", "verdict": "right" if seen.root is None else "refused"}
    said = " | ".join(str(one.message) for one in caught)
    seam = weld.seams[0]
    row |= {"found_kind": seam.kind, "warnings": said, "sigma_mm": round(float(np.median(seam.sigma_mm)), 3)}
    right = False
    if seen.root is not None:
        alike = [one for one in weld.seams if one.kind == seam.kind]  # a clamp makes two of one
        inner = [_between_ends(one) for one in alike]
        off = off_line(np.concatenate([one.root[here] for one, here in zip(alike, inner, strict=True)]), seen.root)
        stated = np.concatenate([one.sigma_mm[here] for one, here in zip(alike, inner, strict=True)])
        near = cKDTree(np.concatenate([one.root for one in alike])).query(seen.root)[0]
        followed = float((near < 2 * WRONG_MM).mean())
        row |= {"mean_mm": round(off.mean(), 3), "max_mm": round(off.max(), 3), "followed": round(followed, 3)}
        row |= {f"within_{k}": round(float((off <= k * stated).mean()), 3) for k in (1, 2)}
        right = seam.kind == seen.kind and off.mean() < WRONG_MM and followed > TRUNCATED
    return row | {"verdict": "right" if right else "wrong, warned" if said else "SILENTLY WRONG"}


def _between_ends(seam: Seam) -> NDArray[np.bool_]:
    """The stations (S,) of a seam less its ends."""
    if seam.closed:
        return np.ones(len(seam.root), dtype=bool)
    return np.asarray(cKDTree(seam.root[[0, -1]]).query(seam.root)[0] > END_MM)


def run(path: Path, pattern: str, views: range) -> None:
    """Append a row for every scene whose name matches and that is not in the file yet."""
    done = set()
    if path.exists():
        with path.open(newline="") as file:
            done = {(row["scene"], int(row["seed"])) for row in csv.DictReader(file)}
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if path.stat().st_size == 0:
            writer.writeheader()
        for seed in views:
            for name, make in scenes().items():
                if fnmatch.fnmatch(name, pattern) and (name, seed) not in done:
                    row = judged(name, seed, make(seed))
                    writer.writerow(row)
                    file.flush()
                    print(*(row[column] for column in COLUMNS if column != "warnings"), sep="  ", flush=True)


def table(path: Path) -> None:
    """Print, scene by scene, how often it was right, refused, wrong with a warning and silently wrong, and which share
    of the right lines lies within one and two stated sigmas."""
    import pandas as pd

    rows = pd.read_csv(path, keep_default_na=False)
    print(pd.crosstab(rows["scene"], rows["verdict"]).to_string())
    print(rows["verdict"].value_counts().to_string())
    held = rows[(rows["verdict"] == "right") & (rows["true_kind"] != "no seam")]
    if held.empty:
        return
    shares = held[["mean_mm", "max_mm", "sigma_mm", "within_1", "within_2"]].apply(pd.to_numeric)
    print(shares.groupby(held["scene"]).mean().round(3).to_string())
    print(
        f"of all: {shares['within_1'].mean():.1%} within one stated sigma, {shares['within_2'].mean():.1%} within two"
    )


def main(words: list[str] | None = None) -> int:
    """Run or print the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.seams", description=__doc__)
    parser.add_argument("rows", type=Path)
    parser.add_argument("--only", default="*", metavar="PATTERN")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--judge", action="store_true")
    options = parser.parse_args(words)
    if options.judge:
        table(options.rows)
    else:
        run(options.rows, options.only, range(options.first, options.first + options.views))
    return 0


if __name__ == "__main__":
    sys.exit(main())
