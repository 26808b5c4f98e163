"""Of the studies that take chapters 08 and 09 minutes, some cases are measured in every run: they are as committed.

The whole chapters are rebuilt by `./run book`, and every night by `./run laws`.
"""

import io
import itertools

import numpy as np
import pandas as pd
import pytest

from grindvision_book.chapter_08.compound import compound_case
from grindvision_book.chapter_09.limits import ORDINARY, RANGES, path_case
from grindvision_book.machinery.agreement import disagreements
from grindvision_book.machinery.committed import committed_figures
from grindvision_book.machinery.figures import csv_text
from grindvision_book.studies.running import run_study

#: Three robot cells whose paths once moved with the processor, and one that is refused; by night others too.
STREAMS = [33, 104, 109, 147]
MORE_STREAMS = [*range(0, 200, 19)]


@pytest.fixture(scope="module")
def committed():
    files = committed_figures().files
    return {name: pd.read_csv(io.BytesIO(files[name])) for name in ("compound_cells.csv", "limits_one_at_a_time.csv")}


def differences(name: str, measured: pd.DataFrame, there: pd.DataFrame) -> list[str]:
    return disagreements(*({name: csv_text(table).encode()} for table in (measured[list(there)].round(4), there)))


@pytest.mark.parametrize("streams", [STREAMS, pytest.param(MORE_STREAMS, marks=pytest.mark.full)])
def test_robot_cells_of_chapter_08_are_as_committed(committed, streams):
    cells = run_study(compound_case, pd.DataFrame({"stream": streams, "boxes": True}), seed=8, jobs=1)
    cells = cells[cells["error"] == ""]
    for method, plane in itertools.product(("", "boxes_"), ("xy", "xz", "yz")):
        spreads = cells[[f"{method}spread_{axis}_mm" for axis in plane]]
        cells[f"{method}widest_{plane}_mm"] = spreads.max(axis=1)
    there = committed["compound_cells.csv"]
    assert differences("compound_cells.csv", cells, there[there["stream"].isin(streams)]) == []


@pytest.mark.parametrize(
    "name, level", [("voxel_mm", 0), pytest.param("overlap", 3, marks=pytest.mark.full), ("bead_height_mm", 1)]
)
def test_levels_of_chapter_09_are_as_committed(committed, name, level):
    value = np.linspace(*RANGES[name], 4)[level]
    cases = pd.DataFrame([{**ORDINARY, name: value, "stream": repeat} for repeat in range(4)])
    rows = run_study(path_case, cases, seed=9, jobs=1)
    rows["abs_height_mm"], rows["surface_mm"] = rows["height_mm"].abs(), rows[["left_mm", "gouge_mm"]].max(axis=1)
    there = committed["limits_one_at_a_time.csv"]
    there = there[(there["parameter"] == name) & np.isclose(there["level"], value, atol=1e-4)]
    measured = [{"response": of, **rows[of].agg(["median", "min", "max"])} for of in there["response"]]
    assert len(measured) == 3
    columns = ["response", "median", "min", "max"]
    assert differences("limits_one_at_a_time.csv", pd.DataFrame(measured), there[columns]) == []
