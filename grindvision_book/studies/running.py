"""Studies: one pure function of parameters and a random generator, run over a table of cases, here or on a cluster.

    rows = run_study(measure, cases, seed=8)                                        # all cores of this machine
    rows = run_study(measure, cases, seed=8, results="study.csv")                   # ... and resume after a crash
    rows = run_study(measure, cases, seed=8, results="study.csv", scheduler="tcp://host:8786")  # a Dask cluster

The random stream of a case depends on the study's seed and the case's number alone, and its numerical libraries get one
thread wherever it runs, so rows do not depend on order, worker or machine, and one row can be made again alone:
``measure(rng=case_rng(seed, case), **parameters)``.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import warnings
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

import grindvision
import grindvision_book
from grindvision.errors import FileError, GrindvisionError, InputError
from grindvision.parallel import thread_pools
from grindvision_book.machinery.dependencies import PACKAGES, modules_of, source_of
from grindvision_book.studies.cluster import on_cluster
from grindvision_book.studies.rows import OWN_COLUMNS, BusyError, RowsFile, as_text

if TYPE_CHECKING:
    import pandas as pd

#: A case: ``measure(rng=..., **parameters)`` gives named numbers, texts or booleans, and nothing else happens.
Measure = Callable[..., Mapping[str, Any]]


def run_study(
    measure: Measure,
    cases: pd.DataFrame,
    seed: int,
    results: str | Path | None = None,
    scheduler: str | None = None,
    jobs: int = -1,
    progress: bool | None = None,
) -> pd.DataFrame:
    """Measure every case and return one row per case, sorted by case: ``case``, parameters, results, ``error``.

    A case that raises a ``GrindvisionError`` becomes a row with that message in ``error`` and no results. Any other
    exception stops the study; what is finished stays in the results file.

    Args:
        measure: pure function; called as ``measure(rng=generator, **parameters)``.
        cases: one row per case, one column per parameter. The case number is the column ``case`` where there is one,
            else the position in the table. Cases with the same number in a column ``stream`` draw the same random
            numbers, so that they can be compared in pairs; without it every case has its own.
        seed: of the study.
        results: CSV file that rows stream to, in any order while running, sorted at the end. If it holds rows of the
            same study already, only missing cases run. While the book is being built, rows of our own measures that
            are given no file are kept in ``build/studies`` in the same way.
        scheduler: address of a Dask scheduler, ``tcp://host:port``; by default joblib uses this machine. Lost
            workers cost their unfinished cases a second run, nothing more.
        jobs: processes on this machine, -1 for all cores.
        progress: show a bar; by default where a terminal watches.

    Raises:
        InputError: no cases, a repeated case number, a reserved name, a results file of another study (other seed,
            parameters or code), a worker with other code (one that joins later too), a scheduler that does not answer
            or is lost.
        FileError: the results file is damaged, locked by another run, or cannot be written.
    """
    from tqdm import tqdm

    parameters, code = _parameters(cases), code_fingerprint(measure.__module__)
    path = Path(results) if results else _kept_rows(measure, cases, seed)
    with TemporaryDirectory() as scratch, RowsFile(path or Path(scratch, "rows.csv")) as rows:
        done = _finished(rows, parameters, seed, code)
        missing = {case: values for case, values in parameters.items() if case not in done}
        finished: Generator[dict[str, Any], None, None] = (
            on_cluster(_measured, measure, missing, seed, scheduler)
            if scheduler
            else _here(measure, missing, seed, jobs)
        )
        bar = tqdm(
            total=len(parameters), initial=len(done), unit="case", disable=None if progress is None else not progress
        )
        with bar, contextlib.closing(finished):
            for row in finished:
                rows.append({"case": row.pop("case"), "seed": seed, "code": code, **row})
                bar.update()
        return rows.finish().drop(columns=["seed", "code"])


def case_rng(seed: int, stream: int) -> np.random.Generator:
    """The random generator of one case: a child of the study's seed, named by the case's stream or number."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


def code_fingerprint(module: str = "") -> str:
    """Twelve hexadecimal digits that name the state of our code: of a module and all it imports, else of everything."""
    digest = hashlib.sha256()
    if module.split(".")[0] in PACKAGES:
        sources = {name: source_of(name) for name in modules_of(module)}
    else:
        roots = (Path(str(package.__file__)).resolve().parent for package in (grindvision, grindvision_book))
        sources = {path.relative_to(root.parent).as_posix(): path for root in roots for path in root.rglob("*.py")}
    for name, path in sorted(sources.items()):
        digest.update(name.encode() + b"\0" + (path.read_bytes() if path else b""))
    return digest.hexdigest()[:12]


def _kept_rows(measure: Measure, cases: pd.DataFrame, seed: int) -> Path | None:
    """Where a build of the book keeps the rows: one file for the same code, data, libraries, cases and seed."""
    folder = os.environ.get("GRINDVISION_STUDIES")
    if not folder or measure.__module__.split(".")[0] not in PACKAGES:
        return None
    from grindvision_book.machinery.kept import study_inputs

    asked = f"{study_inputs(measure.__module__)} {seed} {cases.to_csv(index=False)}"
    name = f"{measure.__name__}-{hashlib.sha256(asked.encode()).hexdigest()[:16]}.csv"
    path = Path(folder, name)
    try:
        with RowsFile(path):
            return path
    except BusyError:
        raise
    except FileError:
        path.unlink(missing_ok=True)  # damaged: its cases are measured again
        return path


def _parameters(cases: pd.DataFrame) -> dict[int, dict[str, Any]]:
    if len(cases) == 0:
        raise InputError("the table of cases has no rows; give at least one case")
    reserved = [name for name in cases.columns if name in OWN_COLUMNS and name != "case"]
    if reserved:
        raise InputError(f"the table of cases uses the reserved name {reserved[0]!r}; rename that column")
    if "case" not in cases.columns:
        return dict(enumerate(cases.to_dict("records")))
    numbers = cases["case"]
    if numbers.dtype.kind not in "iu" or (numbers < 0).any():
        raise InputError("case numbers must be whole and not negative")
    if numbers.duplicated().any():
        raise InputError(f"case {numbers[numbers.duplicated()].iloc[0]} stands twice in the table of cases")
    return dict(zip(numbers.tolist(), cases.drop(columns="case").to_dict("records"), strict=True))


def _finished(rows: RowsFile, parameters: dict[int, dict[str, Any]], seed: int, code: str) -> set[int]:
    """Case numbers that the results hold already, after a check that they belong to this study."""
    for case, found in rows.stored.items():
        if case not in parameters:
            raise InputError(f"{rows.path} holds case {case}, which the table lacks; choose another results file")
        wanted = {"seed": seed, "code": code, **parameters[case]}
        for name, value in wanted.items():
            if found.get(name) != as_text(value):
                raise InputError(
                    f"{rows.path}: case {case} was run with {name} {found.get(name)}, now it is {value}; "
                    "choose another results file or remove this one"
                )
    return set(rows.stored)


def _measured(measure: Measure, case: int, parameters: dict[str, Any], seed: int) -> dict[str, Any]:
    """One row: runs on a worker."""
    import numba

    row = {"case": case, **parameters}
    given = {name: value for name, value in parameters.items() if name != "stream"}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The TBB threading layer")  # another is taken: nothing that matters here
        threads = numba.get_num_threads()
        numba.set_num_threads(1)
    try:
        with thread_pools().limit(limits=1):
            values = measure(rng=case_rng(seed, parameters.get("stream", case)), **given)
    except GrindvisionError as error:
        return {**row, "error": " ".join(f"{type(error).__name__}: {error}".split())}
    except Exception as error:
        raise RuntimeError(f"case {case} with {parameters} raised {type(error).__name__}: {error}") from error
    finally:
        numba.set_num_threads(threads)
    clash = [name for name in values if name in row or name in OWN_COLUMNS]
    if clash:
        raise RuntimeError(f"case {case}: result {clash[0]!r} is named like a parameter or a reserved column")
    return {**row, "error": "", **values}


def _here(
    measure: Measure, missing: dict[int, dict[str, Any]], seed: int, jobs: int
) -> Generator[dict[str, Any], None, None]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config("loky", n_jobs=jobs, inner_max_num_threads=1), warnings.catch_warnings():
        # loky replaces workers that have grown, and says so; their cases run again.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        _start_helper_that_outlives_us()
        parallel = Parallel(return_as="generator_unordered")
        yield from parallel(delayed(_measured)(measure, case, values, seed) for case, values in missing.items())


def _start_helper_that_outlives_us() -> None:
    """Start loky's resource tracker without SIGHUP, which a closed terminal sends to all; loky keeps SIGTERM from it.

    The tracker removes what the workers shared when all of them have ended, and need not say so. When it is gone first,
    loky starts another one, which knows of nothing and complains.
    """
    from joblib.externals.loky.backend import resource_tracker

    if not hasattr(signal, "SIGHUP"):
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
    said = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [said, "ignore:resource_tracker:UserWarning"]))
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        os.environ.pop("PYTHONWARNINGS")
        if said is not None:
            os.environ["PYTHONWARNINGS"] = said
