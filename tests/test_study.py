"""Studies: the same rows whatever the order, the worker or the interruption; no case lost, none counted twice."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pandas as pd
import pytest

from grindvision.cli import main
from grindvision.errors import DegenerateError, FileError, InputError
from grindvision_book.machinery.places import ROOT
from grindvision_book.studies.designs import one_at_a_time, rank_sensitivity, space_filling
from grindvision_book.studies.rows import RowsFile
from grindvision_book.studies.running import case_rng, run_study

CASES = pd.DataFrame({"scale": [0.5, 1.0, 2.0, 4.0, 8.0, 16.0], "label": list("abcdef")})


def draw(rng, scale, label):
    """A case: a scaled random number, or a refusal for label e."""
    if label == "e":
        raise DegenerateError("label e is\nnot measured")
    return {"value": scale * rng.standard_normal(), "count": int(rng.integers(10))}


def test_one_row_per_case_with_its_own_stream():
    rows = run_study(draw, CASES, seed=3, jobs=1)
    assert list(rows.columns) == ["case", "scale", "label", "value", "count", "error"]
    assert rows["case"].tolist() == list(range(6))
    for row in rows[rows["error"] == ""].itertuples():
        again = draw(case_rng(3, row.case), row.scale, row.label)
        assert (row.value, row.count) == (again["value"], again["count"])
    assert len(set(rows["value"].dropna() / rows["scale"][rows["error"] == ""])) == 5


def test_rows_do_not_depend_on_order_or_processes():
    numbered = CASES.assign(case=[10, 20, 30, 40, 50, 60])
    straight = run_study(draw, numbered, seed=3, jobs=1)
    shuffled = run_study(draw, numbered.sample(frac=1, random_state=1), seed=3, jobs=2)
    pd.testing.assert_frame_equal(straight, shuffled)
    assert not straight["value"].equals(run_study(draw, numbered, seed=4, jobs=1)["value"])


def test_cases_of_one_stream_draw_the_same_numbers():
    rows = run_study(draw, pd.DataFrame({"scale": 1.0, "label": "a", "stream": [5, 6, 5]}), seed=3, jobs=1)
    assert rows["value"][0] == rows["value"][2] != rows["value"][1]
    assert rows["value"][0] == case_rng(3, 5).standard_normal()


def test_a_refused_case_is_a_row_with_its_message():
    rows = run_study(draw, CASES, seed=3, jobs=1)
    assert rows.loc[4, "error"] == "DegenerateError: label e is not measured"
    assert np.isnan(rows.loc[4, "value"])
    assert (rows["error"].drop(4) == "").all()


def test_a_refused_first_case_leaves_room_for_the_results(tmp_path):
    path = tmp_path / "rows.csv"
    rows = run_study(draw, CASES.iloc[::-1].iloc[1:], seed=3, results=path, jobs=1)
    assert rows["error"].iloc[0] and rows["value"].iloc[1:].notna().all()
    only_failures = run_study(draw, CASES.iloc[[4]], seed=3, jobs=1)
    assert list(only_failures.columns) == ["case", "scale", "label", "error"]


def test_a_bug_in_a_case_stops_the_study_and_names_the_case(tmp_path):
    def broken(rng, scale, label):
        return {"value": 1 / (scale - 4.0)}

    with pytest.raises(RuntimeError, match=r"case 3 .*ZeroDivisionError"):
        run_study(broken, CASES, seed=3, results=tmp_path / "rows.csv", jobs=1)
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 4


@pytest.mark.parametrize("cut", [0, 1, 7, 40, 41, 100, 150])
def test_a_run_cut_at_any_byte_resumes_to_the_same_file(tmp_path, cut):
    path, calls = tmp_path / "rows.csv", []

    def counted(rng, **parameters):
        calls.append(parameters["label"])
        return draw(rng, **parameters)

    whole = run_study(counted, CASES, seed=3, results=path, jobs=1)
    text = path.read_bytes()
    path.write_bytes(text[: len(text) - cut])
    kept = text[: len(text) - cut].count(b"\n") - 1
    calls.clear()
    pd.testing.assert_frame_equal(run_study(counted, CASES, seed=3, results=path, jobs=1), whole)
    assert path.read_bytes() == text
    assert len(calls) == len(CASES) - kept


def test_resuming_runs_only_missing_cases_of_a_longer_table(tmp_path):
    run_study(draw, CASES.iloc[:3], seed=3, results=tmp_path / "rows.csv", jobs=1)
    longer = run_study(draw, CASES, seed=3, results=tmp_path / "rows.csv", jobs=1)
    pd.testing.assert_frame_equal(longer, run_study(draw, CASES, seed=3, jobs=1))


def test_results_of_another_study_are_refused(tmp_path):
    path = tmp_path / "rows.csv"
    run_study(draw, CASES, seed=3, results=path, jobs=1)
    with pytest.raises(InputError, match="seed 3, now it is 4"):
        run_study(draw, CASES, seed=4, results=path, jobs=1)
    with pytest.raises(InputError, match=r"case 1 was run with scale 1.0, now it is 1.5"):
        run_study(draw, CASES.replace({"scale": {1.0: 1.5}}), seed=3, results=path, jobs=1)
    with pytest.raises(InputError, match="holds case 3"):
        run_study(draw, CASES.iloc[:3], seed=3, results=path, jobs=1)
    path.write_text(path.read_text().replace(path.read_text().splitlines()[1].split(",")[2], "0" * 12))
    with pytest.raises(InputError, match="with code 000000000000"):
        run_study(draw, CASES, seed=3, results=path, jobs=1)


def test_a_damaged_file_is_refused_by_line(tmp_path):
    path = tmp_path / "rows.csv"
    run_study(draw, CASES, seed=3, results=path, jobs=1)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:2], lines[2][5:], *lines[3:]]))
    with pytest.raises(FileError, match="line 3 is damaged"):
        run_study(draw, CASES, seed=3, results=path, jobs=1)
    path.write_text("".join([*lines, lines[1]]))
    with pytest.raises(FileError, match="line 8 repeats case 0"):
        run_study(draw, CASES, seed=3, results=path, jobs=1)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(FileError, match="not a study's results"):
        run_study(draw, CASES, seed=3, results=path, jobs=1)


def test_two_runs_cannot_write_one_file(tmp_path):
    with RowsFile(tmp_path / "rows.csv"), pytest.raises(FileError, match="another run is writing"):
        run_study(draw, CASES, seed=3, results=tmp_path / "rows.csv", jobs=1)


def test_bad_tables_are_refused():
    for cases, message in [
        (CASES.iloc[:0], "no rows"),
        (CASES.assign(seed=1), "reserved name 'seed'"),
        (CASES.assign(case=[1, 2, 2, 3, 4, 5]), "case 2 stands twice"),
        (CASES.assign(case=0.5), "whole and not negative"),
    ]:
        with pytest.raises(InputError, match=message):
            run_study(draw, cases, seed=3, jobs=1)


def test_results_must_be_named_alike():
    def uneven(rng, scale, label):
        return {"value": 1.0, f"only_{label}": 1.0}

    with pytest.raises(InputError, match="only_a, only_b"):
        run_study(uneven, CASES, seed=3, jobs=1)


#: A time that nothing here takes, however busy the machine.
PATIENCE_S = 600


@pytest.fixture
def cluster(tmp_path):
    """Address of a real Dask scheduler on this machine, its process, and the two worker processes it has."""
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "5"}
    dask = [sys.executable, "-m", "dask"]
    address_file = tmp_path / "scheduler.json"
    log = open(tmp_path / "dask.log", "w")  # noqa: SIM115
    options = {"stdout": log, "stderr": log, "env": environment, "cwd": tmp_path}
    place = ["--host", "127.0.0.1", "--no-dashboard"]
    address = ["--scheduler-file", str(address_file)]
    processes = [subprocess.Popen([*dask, "scheduler", "--port", "0", *place, *address], **options)]
    worker = [*dask, "worker", "--no-nanny", "--nthreads", "1", *place, *address, "--local-directory", str(tmp_path)]
    processes += [subprocess.Popen(worker, **options) for _ in range(2)]
    try:
        from distributed import Client

        with Client(scheduler_file=str(address_file), timeout=PATIENCE_S, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=PATIENCE_S)
            found = client.scheduler.address
        yield found, processes
    finally:
        for process in processes:
            process.kill()
            process.wait()
        log.close()


def until_the_middle(path, go_on, then):
    """A measure of which half waits for the file ``go_on``, but on a late worker; ``then`` happens when some of the
    other rows are in."""

    def half_of_them_wait(rng, scale, label):
        while scale > 1.5 and not (os.path.exists(go_on) or "LATE" in os.environ):
            time.sleep(0.01)
        return {"value": scale * rng.standard_normal(), "process": os.getpid()}

    def in_the_middle():
        while not path.exists() or path.read_bytes().count(b"\n") < 10:
            time.sleep(0.01)
        then()

    threading.Thread(target=in_the_middle, daemon=True).start()
    return half_of_them_wait


def test_a_killed_worker_loses_no_case_and_doubles_none(cluster, tmp_path):
    scheduler, (_, *workers) = cluster
    cases = pd.DataFrame({"scale": np.linspace(1.0, 2.0, 60), "label": "a"})
    path, go_on, finished_at_kill = tmp_path / "rows.csv", tmp_path / "go_on", []

    def kill_one():
        workers[0].send_signal(signal.SIGKILL)
        finished_at_kill.append(path.read_bytes().count(b"\n") - 1)
        go_on.touch()

    measure = until_the_middle(path, str(go_on), kill_one)
    rows = run_study(measure, cases, seed=3, results=path, scheduler=scheduler)

    assert workers[0].wait(timeout=PATIENCE_S) == -signal.SIGKILL and workers[1].poll() is None
    assert rows["case"].tolist() == list(range(60)) and (rows["error"] == "").all()
    assert len(path.read_text().splitlines()) == 61
    assert {workers[1].pid} <= set(rows["process"]) <= {workers[0].pid, workers[1].pid}
    assert 9 <= finished_at_kill[0] < 60
    here = run_study(draw, cases, seed=3, jobs=1)
    assert rows["value"].tolist() == here["value"].tolist()


def test_rows_from_a_cluster_are_those_of_this_machine_to_the_byte(cluster, tmp_path):
    import numba

    scheduler, _ = cluster
    cases = pd.DataFrame({"size": [300, 400, 500, 600]})

    def sums(rng, size):
        import numpy
        from numba import get_num_threads
        from threadpoolctl import threadpool_info

        matrix = rng.standard_normal((size, size))
        threads = max([get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())])
        return {"value": float((matrix @ matrix @ numpy.linalg.inv(matrix)).sum()), "threads": threads}

    before = numba.get_num_threads()
    for name, options in (("here", {"jobs": 1}), ("pool", {"jobs": 2}), ("cluster", {"scheduler": scheduler})):
        rows = run_study(sums, cases, seed=3, results=tmp_path / f"{name}.csv", **options)
        assert (rows["threads"] == 1).all(), name
    assert (tmp_path / "here.csv").read_bytes() == (tmp_path / "pool.csv").read_bytes()
    assert (tmp_path / "here.csv").read_bytes() == (tmp_path / "cluster.csv").read_bytes()
    assert numba.get_num_threads() == before


def test_a_lost_scheduler_is_told_and_no_row_is_lost(cluster, tmp_path):
    import dask

    scheduler, (process, *_) = cluster
    path, cases = tmp_path / "rows.csv", pd.DataFrame({"scale": np.linspace(1.0, 2.0, 60), "label": "a"})
    measure = until_the_middle(path, str(tmp_path / "go_on"), process.kill)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(InputError, match=r"scheduler at tcp://.* was lost; finished rows are in the results file"),
    ):
        run_study(measure, cases, seed=3, results=path, scheduler=scheduler)
    (tmp_path / "go_on").touch()
    found = pd.read_csv(path)
    assert 9 <= len(found) < 60 and found["error"].isna().all() and found["value"].notna().all()
    assert len(run_study(measure, cases, seed=3, results=path, jobs=2)) == 60


def test_a_worker_with_other_code_is_refused_when_it_joins_later_too(cluster, tmp_path):
    scheduler, _ = cluster
    other = tmp_path / "other"
    for package in ("grindvision", "grindvision_book"):
        shutil.copytree(ROOT / package, other / package, ignore=shutil.ignore_patterns("__pycache__", "site_sources"))
    (other / "pyproject.toml").write_text("")
    (other / "data").symlink_to(ROOT / "data")
    with open(other / "grindvision_book" / "designs.py", "a") as file:
        file.write("# changed\n")
    path, cases = tmp_path / "rows.csv", pd.DataFrame({"scale": np.linspace(1.0, 2.0, 60), "label": "a"})
    joined = []

    def join():
        words = [sys.executable, "-m", "dask", "worker", scheduler, "--no-nanny", "--no-dashboard", "--nthreads", "1"]
        log = open(tmp_path / "late.log", "w")  # noqa: SIM115
        environment = {**os.environ, "PYTHONPATH": str(other), "LATE": "1"}
        joined.append(subprocess.Popen(words, env=environment, cwd=tmp_path, stdout=log, stderr=log))

    measure = until_the_middle(path, str(tmp_path / "never"), join)
    try:
        with pytest.raises(InputError, match=r"worker tcp://\S+ has grindvision code \w{12}, here it is \w{12}"):
            run_study(measure, cases, seed=3, results=path, scheduler=scheduler)
        with pytest.raises(InputError, match=r"worker tcp://\S+ has grindvision code"):
            run_study(measure, cases, seed=3, results=tmp_path / "again.csv", scheduler=scheduler)
    finally:
        for process in joined:
            process.kill()
            process.wait()


def test_a_build_of_the_book_keeps_the_rows_of_its_studies(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setenv("GRINDVISION_STUDIES", str(tmp_path))

    def kept(rng, scale, label):
        calls.append(label)
        return draw(rng, scale, label)

    kept.__module__ = "grindvision_book.studies.designs"
    first = run_study(kept, CASES, seed=3, jobs=1)
    (path,) = tmp_path.iterdir()
    torn = path.read_bytes()[:-30]
    path.write_bytes(torn)
    pd.testing.assert_frame_equal(run_study(kept, CASES, seed=3, jobs=1), first)
    assert len(calls) == len(CASES) + 1
    path.write_text("damaged\nfrom the start\n")
    pd.testing.assert_frame_equal(run_study(kept, CASES, seed=3, jobs=1), first)
    assert len(calls) == 2 * len(CASES) + 1
    run_study(kept, CASES, seed=4, jobs=1)
    run_study(kept, CASES.iloc[:2], seed=3, jobs=1)
    assert len(list(tmp_path.iterdir())) == 3
    run_study(draw, CASES, seed=3, jobs=1)
    assert len(list(tmp_path.iterdir())) == 3, "a measure that is not the book's own is not kept"


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    import dask

    with (
        dask.config.set({"distributed.comm.timeouts.connect": "0.3s"}),
        pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"),
    ):
        run_study(draw, CASES, seed=3, scheduler="tcp://127.0.0.1:9")


def test_the_book_stays_light_to_import():
    heavy = "{'dask', 'distributed', 'joblib', 'pandas'}"
    light = f"import sys; import grindvision_book.studies.running; print({heavy} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", light], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "set()"


def test_one_at_a_time_moves_one_parameter():
    table = one_at_a_time({"a": 1, "b": 2.0}, {"a": [1, 5], "b": [0.0, 2.0, 4.0]}, repeats=2)
    assert len(table) == 2 * 5 and set(table["repeat"]) == {0, 1}
    assert (table.loc[table["varied"] == "a", "b"] == 2.0).all()
    assert (table.loc[table["varied"] == "b", "a"] == 1).all()
    with pytest.raises(InputError, match="'c' is varied"):
        one_at_a_time({"a": 1}, {"c": [1]}, repeats=1)


def test_space_filling_covers_every_range_evenly():
    table = space_filling({"x": (0.0, 2.0), "n": (3, 6)}, cases=64, seed=1)
    assert (np.histogram(table["x"], bins=16, range=(0, 2))[0] == 4).all()
    assert (table["n"].value_counts().reindex([3, 4, 5, 6]) == 16).all()
    pd.testing.assert_frame_equal(table, space_filling({"x": (0.0, 2.0), "n": (3, 6)}, cases=64, seed=1))
    with pytest.raises(InputError, match="power of two"):
        space_filling({"x": (0.0, 1.0)}, cases=60, seed=1)
    with pytest.raises(InputError, match="range of x is empty"):
        space_filling({"x": (1.0, 1.0)}, cases=64, seed=1)


def test_ranking_recovers_known_shares(rng):
    cases = space_filling(dict.fromkeys("abcd", (-1.0, 1.0)), cases=256, seed=2)
    noise = 0.3 * rng.standard_normal(256)
    response = 2 * cases["a"] + cases["b"] ** 2 + cases["b"] * cases["c"] + noise
    parts = {"a": 4 / 3, "b": 1 / 5 - 1 / 9, "c": 0.0, "d": 0.0, "unexplained": 1 / 9 + 0.09}
    ranked = rank_sensitivity(cases, response, rng).set_index("parameter")
    assert list(ranked.index[:2]) == ["a", "b"] and ranked.index[-1] == "unexplained"
    for name, part in parts.items():
        assert ranked.loc[name, "share"] == pytest.approx(part / sum(parts.values()), abs=0.02)
    assert (ranked["share_std"] < 0.06).all() and (ranked.loc[["c", "d"], "share_std"] < 0.01).all()
    assert ranked.loc["a", "effect"] == pytest.approx(4.0, abs=0.1)
    with pytest.raises(InputError, match="at least 18"):
        rank_sensitivity(cases.iloc[:15], response[:15], rng)


def test_the_command_refuses_what_it_cannot_run(tmp_path, capsys):
    out = str(tmp_path / "rows.csv")
    assert main(["study", "path", "-o", out, "--cases", "100"]) == 2
    assert "power of two" in capsys.readouterr().err
    assert main(["study", "compound", "-o", out, "--cases", "0"]) == 2
    assert "--cases is 0" in capsys.readouterr().err
    assert not (tmp_path / "rows.csv").exists()


def test_the_command_streams_rows_and_resumes(tmp_path, capsys):
    command = ["study", "compound", "-o", str(tmp_path / "rows.csv"), "--cases", "1", "--jobs", "1"]
    assert main(command) == 0
    assert "1 cases" in capsys.readouterr().out
    first = (tmp_path / "rows.csv").read_text()
    assert main(command) == 0
    assert (tmp_path / "rows.csv").read_text() == first
