"""The book with other seeds: what is changed, what runs, what is told."""

import json

import pytest

from grindvision.errors import InputError
from grindvision_book.machinery import seeds
from grindvision_book.machinery.places import NOTEBOOKS
from grindvision_book.machinery.rebuilding import Outcome
from grindvision_book.machinery.seeds import has_seed, rebuild_with_seeds, told, with_seed_added


def test_only_the_seed_of_the_parameters_is_changed():
    for path in NOTEBOOKS.glob("[0-9][0-9]_*.ipynb"):
        text = path.read_text(encoding="utf-8")
        assert with_seed_added(text, 0) == text
        changed = with_seed_added(text, 1000)
        lines = [(a, b) for a, b in zip(text.splitlines(), changed.splitlines(), strict=True) if a != b]
        assert len(lines) == has_seed(path)
        for a, b in lines:
            assert "SEED = " in a and "SEED = " in b
        assert json.loads(changed)["metadata"] == json.loads(text)["metadata"]


def test_chapters_run_in_folders_of_their_own_and_those_without_a_seed_once(monkeypatch, tmp_path):
    ran = []

    def rebuilt(numbers, fast, notebooks, build, figures, watcher):
        ran.append((list(numbers), build.name))
        assert figures.parent == build and notebooks.parent == build and fast
        return [Outcome(number, 1.0, "cell 3 failed" if build.name == "1000" else "") for number in numbers]

    monkeypatch.setattr(seeds, "rebuild", rebuilt)
    outcomes = rebuild_with_seeds(3, ["00", "03"], build=tmp_path)
    assert ran == [(["00", "03"], "0"), (["03"], "1000"), (["03"], "2000")]
    assert told(outcomes) == "00: 1 of 1 seeds\n03: 2 of 3 seeds; SEED + 1000: cell 3 failed"


def test_no_seed_at_all_is_refused(tmp_path):
    with pytest.raises(InputError, match="--seeds 0"):
        rebuild_with_seeds(0, build=tmp_path)
