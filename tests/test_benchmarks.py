"""The races: each runs on tiny inputs, its tables hold what is promised, and no racer can see the truth."""

import inspect
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import __main__ as bench
from benchmarks import goals, inputs, judging, races, racing, report, scenes
from benchmarks.floors import floors as measured_floors
from benchmarks.racing import Case, Measurement, Racer
from grindvision.clouds import write_ply

TINY = replace(races.QUICK, poses=1)
STAGES = {
    one.name: one
    for one in (races.COARSE, races.DIFFERENCE, races.ICP, races.CALIBRATION, races.HAND_EYE, races.VOXEL, races.FPFH)
}
PROMISED = ["case", "points", "racer", "kind", "rounds", "median_s", "min_s", "max_s", "cpu_s", "of_fastest_peer"]
MEMORY = ["peak_mib", "growth_mib", "judged", "failures"]


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory) -> Iterator[Path]:
    """Small scans in a cache of their own."""
    folder = tmp_path_factory.mktemp("races")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs, "CACHE", folder)
        patch.setattr(inputs, "FINE", 0.3)
        patch.setattr(inputs, "SIZES", {"50k": 1})
        patch.setattr(inputs, "SPHERES", {"54": 9})
        yield folder


def in_process(racer: Racer, case: Case) -> dict:
    module, name = racer.task.split(":")
    return getattr(import_module(f"benchmarks.peers.{module}"), name)(**case.inputs, **racer.settings)


def quick_peers(race: races.Race) -> list[Racer]:
    """The racers that pip installs, less those that take long."""
    there, _ = bench.present(race.racers, "PCL is left out of this test")
    return [racer for racer in there if racer.warm_up and "tries" not in racer.settings]


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_is_raced_and_judged(name):
    race = STAGES[name]
    case = race.cases(TINY)[0][0]
    for racer in quick_peers(race):
        answer = in_process(racer, case)
        accuracy = race.judge(answer, case.truth())
        assert set(race.accuracy) <= set(accuracy)
        assert not accuracy["failed"], f"{racer.name}: {accuracy}"
        assert all(seconds >= 0 for seconds in answer["laps_s"].values())
        assert not race.lap or race.lap in answer["laps_s"]


def test_whole_detection_race_writes_its_table_and_picture(tmp_path, cache, monkeypatch):
    monkeypatch.setattr(bench, "build_pcl", lambda: "PCL is left out of this test")
    monkeypatch.setattr(bench, "floors", partial(measured_floors, rounds=1))
    race = replace(races.DETECT, racers=races.DETECT.racers[:2])
    absent = Racer("nobody", "open3d_peer:detect", needs="no_such_module")
    bench.run([replace(race, racers=(*race.racers, absent))], replace(TINY, rounds=2, scenes=3), tmp_path)
    table = pd.read_csv(tmp_path / "bench_detect.csv")
    assert list(table.columns) == [*PROMISED, *MEMORY, *races.DETECT.accuracy, "stages_s"]
    assert table["racer"].tolist() == ["grindvision", "Open3D"]
    assert (table["rounds"] == 2).all() and (table["judged"] == 3).all() and (table["failures"] == 0).all()
    pairs = pd.read_csv(tmp_path / "bench_scenes.csv")
    assert pairs["error"].tolist() == list(scenes.ERRORS) and (pairs["scenes"] + pairs["failed"] == 3).all()
    assert pairs["ours_median"].tolist() == pytest.approx(table.loc[0, list(scenes.ERRORS)].tolist(), rel=1e-4)
    assert (table["growth_mib"] <= table["peak_mib"]).all() and (table["growth_mib"] >= 0).all()
    assert (table["min_s"] <= table["median_s"]).all() and (table["median_s"] <= table["max_s"]).all()
    ours, peer = table["median_s"]
    assert table["of_fastest_peer"].tolist() == pytest.approx([ours / peer, 1.0], rel=1e-5)
    text = (tmp_path / "bench_detect.md").read_text()
    assert "absent: nobody: no Python module no_such_module" in text
    assert "RANSAC" in text and "seed 10" in text
    assert {path.suffix for path in tmp_path.glob("bench_detect.*")} == {".csv", ".md", ".svg", ".png"}
    floors = pd.read_csv(tmp_path / "bench_floors.csv")
    assert {"read", "features", "icp", "difference"} <= set(floors["stage"])
    assert (floors["floor_s"] > 0).all()
    assert floors["of_floor"].tolist() == pytest.approx((floors["measured_s"] / floors["floor_s"]).tolist(), rel=1e-4)


def test_groove_race_is_judged_by_labels_and_root(cache):
    case = inputs.groove_cases("box", 1, 10, pixels=0.5)[0]
    accuracy = judging.judge_weld(in_process(races.GROOVE.racers[0], case), case.truth())
    assert accuracy["overlap_percent"] > 80 and accuracy["path_mean_mm"] < 1.5 and not accuracy["failed"]


def test_no_racer_is_told_the_truth(cache):
    lists = [race.cases(TINY) for race in (*STAGES.values(), races.DETECT)]
    for case in (case for rounds in lists for cases in rounds for case in cases):
        for file in case.inputs.values():
            assert "truth" not in Path(file).relative_to(cache).parts if Path(file).is_relative_to(cache) else True
            assert "held_out" not in Path(file).read_text(errors="replace")[:10_000]
    for module in Path(inspect.getfile(import_module("benchmarks.peers"))).parent.glob("*.py"):
        text = module.read_text()
        assert not any(
            word in text for word in ("grindvision.cell", "benchmarks.inputs", "benchmarks.judging", "truth(")
        )


def test_racers_need_no_truth_on_disk(cache):
    case = races.DETECT.cases(TINY)[0][0]
    hidden = (cache / "truth").rename(cache / "hidden")
    try:
        assert len(in_process(races.DETECT.racers[0], case)["path"]) == 6
    finally:
        hidden.rename(cache / "truth")


def test_a_held_out_table_does_not_hold_the_tracker(cache):
    case = inputs.calibration_cases("54", 1, 10)[0]
    assert not [name for name in pd.read_csv(case.inputs["test"]) if name.startswith("b")]


def test_inputs_come_from_the_seed(cache):
    one, same, other = (inputs.detection_cases("50k", 1, seed)[0] for seed in (10, 10, 11))
    assert one.inputs == same.inputs and one.inputs != other.inputs
    assert Path(one.inputs["test"]).read_bytes() != Path(other.inputs["test"]).read_bytes()


def measurement(name: str, wall_s: float, kind: str = "peer", number: int = 1, **accuracy: float) -> Measurement:
    racer, case = Racer(name, "any:any", kind), Case("one", 100, {}, dict)
    return Measurement(racer, case, number, wall_s, wall_s, 50.0, 10.0, {"read": 0.1, "icp": wall_s / 2}, "", accuracy)


def test_a_fast_wrong_answer_does_not_set_the_pace():
    found = [measurement("ours", 1.0, "ours"), measurement("right", 4.0), measurement("wrong", 0.5, failed=1.0)]
    table = report.table_of(found, (), "icp").set_index("racer")
    assert table["of_fastest_peer"].to_dict() == {"ours": 0.25, "right": 1.0, "wrong": 0.125}
    assert table.loc["wrong", "failures"] == 1
    assert table.loc["ours", "icp_s"] == 0.5 and table.loc["ours", "icp_of_fastest_peer"] == 0.25
    assert found[1].without_reading().wall_s == pytest.approx(3.9)


def test_untimed_runs_count_for_errors_and_not_for_times():
    timed = [measurement("ours", 1.0, "ours", number, path_mean_mm=0.1) for number in (1, 2)]
    further = [
        replace(measurement("ours", 9.0, "ours", n, path_mean_mm=0.3, failed=1.0), timed=False) for n in (3, 4, 5)
    ]
    row = report.table_of(timed + further, ("path_mean_mm",)).iloc[0]
    assert row["median_s"] == 1.0 and row["rounds"] == 2
    assert row["judged"] == 5 and row["failures"] == 3 and row["path_mean_mm"] == 0.3


def test_errors_are_compared_scene_by_scene(rng):
    """Scenes differ by far more than two racers do: only pairs show who is better."""
    other = rng.uniform(0.01, 1.0, 20)
    found = scenes.compared(0.9 * other, other)
    assert found["median_ratio"] == pytest.approx(0.9) and found["mean_ratio"] == pytest.approx(0.9)
    assert found["ours_less_percent"] == 100 and found["ours_less_95"] == "[100, 100]"
    low, high = map(float, found["mean_ratio_95"].strip("[]").split(","))
    assert low == pytest.approx(0.9) and high == pytest.approx(0.9)
    order = rng.permutation(20)
    again = scenes.compared(0.9 * other[order], other[order])
    assert again["ours_mean"] == pytest.approx(found["ours_mean"])


def test_the_least_error_is_how_deep_the_scan_is_wrong(tmp_path, rng):
    """A ridge of parabolic section, seen from above and scanned too deep by 0.07 mm, at any density."""
    ridge = np.column_stack([np.linspace(0, 30, 121), np.zeros(121), np.full(121, 400.0)])
    x, y = rng.uniform(0, 30, 3000), rng.uniform(-2, 2, 3000)
    points = np.column_stack([x, y, 400.0 + 0.4 * y**2])
    write_ply(tmp_path / "test.ply", points * (1 + 0.07 / points[:, 2:]))
    known = {"ridge": ridge, "on_bead_one": np.ones(3000, dtype=bool)}
    case = Case("one", 3000, {"test": str(tmp_path / "test.ply")}, lambda: known)
    assert scenes.least_error_mm(case) == pytest.approx(0.07, abs=0.002)


def test_an_error_of_a_racer_is_a_failure_with_its_reason(cache):
    case = inputs.voxel_cases("50k", 1, 10)[0]
    racer = Racer("broken", "ours_grinding:voxels", settings={"size_mm": -1.0})
    (found,) = racing.race([racer], [case], judging.judge_voxels)
    assert found.failed and "voxel size" in found.error


def test_a_racer_that_dies_is_a_failure_and_races_on(cache):
    case = inputs.voxel_cases("50k", 1, 10)[0]
    racers = [Racer("dead", "no_such_peer:voxels"), Racer("alive", "ours_grinding:voxels")]
    found = racing.race(racers, [case, case], judging.judge_voxels)
    assert [one.failed for one in found] == [True, False, True, False]
    assert "died" in found[0].error and "no_such_peer" in found[0].error
    table = report.table_of(found, ("voxels",)).set_index("racer")
    assert table["failures"].to_dict() == {"dead": 2, "alive": 0}
    assert np.isnan(table.loc["dead", "median_s"]) and table.loc["alive", "voxels"] > 1000


def test_paths_are_measured_to_the_line_and_not_to_its_points():
    line = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0]])
    distances, arcs = judging.beside(np.array([[5.0, 0, 1], [10, 5, 0], [12, 10, 0]]), line)
    assert distances == pytest.approx([1, 0, 2]) and arcs == pytest.approx([0.25, 0.75, 1.0])
    assert judging.judge_path(np.array([[5.0, 0, 0], [5, 0, 0]]), line)["failed"]
    assert judging.judge_path(np.empty((0, 3)), line)["failed"]


def test_pose_errors_are_those_of_the_truth_turned_and_shifted():
    middle, shift = np.array([0.0, 0, 400]), np.array([3.0, 0, 4])
    off = np.eye(4)
    off[:3, 3] = shift
    found = judging.judge_pose({"T_sample_test": off}, {"T_sample_test": np.eye(4), "middle": middle})
    assert found == pytest.approx({"rotation_deg": 0.0, "shift_mm": 5.0, "failed": 0.0}, abs=1e-6)


def test_growth_of_a_square_law_has_slope_two(tmp_path):
    rows = [
        {"racer": "r", "kind": "peer", "points": n, "median_s": n**2, "failures": 0, "judged": 1} for n in (10, 100)
    ]
    _, slopes = report.growth_picture("title", pd.DataFrame(rows))
    assert slopes["slope"].tolist() == pytest.approx([2.0])


def test_goals_are_read_from_the_tables(tmp_path):
    rows = [
        {"case": "hard", "racer": "grindvision", "kind": "ours", "median_s": 0.4, "failures": 1},
        {"case": "hard", "racer": "peer", "kind": "peer", "median_s": 0.2, "failures": 0},
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "bench_coarse.csv", index=False)
    assert goals.goals(tmp_path)["verdict"].tolist() == ["missed", "met"]
    rows = [{"case": "2M", "peer": "Open3D", "error": "shift_mm", "scenes": 20, "mean_ratio": 0.5}]
    pd.DataFrame(rows).to_csv(tmp_path / "bench_scenes.csv", index=False)
    assert goals.goals(tmp_path)["verdict"].tolist() == ["met", "missed", "met"]
    assert len(goals.goals(tmp_path / "nothing")) == 0


@pytest.mark.parametrize("words", [["--only", "nothing"], ["--rounds", "0"]])
def test_bad_words_are_refused(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        bench.main(words)
    assert stopped.value.code == 2
    assert "nothing" in capsys.readouterr().err or words[0] == "--rounds"


def test_what_is_left_out_never_reaches_figures():
    assert races.Plan().complete
    assert not races.QUICK.complete and not replace(races.Plan(), rounds=1).complete


def test_every_pip_peer_is_pinned():
    listed = (Path(__file__).parents[1] / "benchmarks" / "requirements.txt").read_text()
    assert "kiss-matcher==" in listed
    assert find_spec("small_gicp") and find_spec("open3d")
