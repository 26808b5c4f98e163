"""The README says what the scoreboard says, and links to what is there."""

import argparse
import importlib
import re
import shlex
from pathlib import Path

import pytest

from grindvision.errors import FileError
from grindvision_book.machinery.answers import scoreboard
from grindvision_book.machinery.places import FIGURES, ROOT
from grindvision_book.machinery.readme import README, scoreboard_block, write_readme
from grindvision_book.site.findings import printed_numbers, rebuilt_numbers


def test_the_block_is_the_committed_scoreboard():
    assert scoreboard_block(scoreboard(FIGURES)) in README.read_text(encoding="utf-8")


def test_only_the_block_is_replaced(tmp_path):
    copy = tmp_path / "README.md"
    copy.write_text(README.read_text(encoding="utf-8"), encoding="utf-8")
    table = scoreboard(FIGURES)
    table.loc[table["quantity"] == "mean of the printed absolute errors", "rebuilt"] = 12.5
    write_readme(table, copy)
    old, new = README.read_text(encoding="utf-8").splitlines(), copy.read_text(encoding="utf-8").splitlines()
    changed = [(a, b) for a, b in zip(old, new, strict=True) if a != b]
    assert len(changed) == 1 and "12.5" in changed[0][1]


def test_a_readme_without_the_marks_is_left_alone(tmp_path):
    copy = tmp_path / "README.md"
    copy.write_text("# grindvision\n")
    with pytest.raises(FileError, match="marks"):
        write_readme(scoreboard(FIGURES), copy)
    assert copy.read_text() == "# grindvision\n"


def test_every_relative_link_and_picture_is_there():
    targets = re.findall(r"\]\(([^)#:]+)\)|(?:src|href)=\"([^\":]+)\"", README.read_text(encoding="utf-8"))
    missing = [target for pair in targets for target in pair if target and not (ROOT / Path(target)).exists()]
    assert targets and not missing


COMMANDS = re.findall(r"(?:^|`)grindvision ([a-z][^`\n]*)", README.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_understood_as_it_is_written(command):
    name, *words = shlex.split(command, comments=True)
    parser = argparse.ArgumentParser()
    importlib.import_module(f"grindvision.cli.{name.replace('-', '_')}").add_arguments(parser)
    parser.parse_args(words)


def test_decisions_and_rules_name_what_is_there():
    roots = (ROOT, ROOT / "grindvision", ROOT / "grindvision_book")
    pages = [*sorted((ROOT / "docs" / "decisions").glob("*.md")), ROOT / "CONTRIBUTING.md"]
    named = {
        (page.name, path)
        for page in pages
        for path in re.findall(r"`((?:[\w-]+/)+[\w.-]+\.\w+)`", page.read_text(encoding="utf-8"))
        if not path.startswith("build/") and "NN" not in path
    }
    assert len(named) > 40
    assert [pair for pair in sorted(named) if not any((root / pair[1]).exists() for root in roots)] == []


def test_every_chapter_is_listed():
    text = README.read_text(encoding="utf-8")
    assert [path.name for path in sorted((ROOT / "notebooks").glob("*.ipynb")) if path.name not in text] == []


def test_every_file_that_the_walk_through_the_rooms_names_is_there():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    walk = text.split("## A walk through the rooms")[1].split("\n## ")[0]
    files = {
        path.relative_to(ROOT).as_posix() for room in ("grindvision", "tests") for path in (ROOT / room).rglob("*.py")
    }
    named = re.findall(r"`([a-z_/]+\.py)`", walk)
    assert len(named) > 50
    assert [name for name in named if not any(f"/{file}".endswith(f"/{name}") for file in files)] == []


def test_what_the_papers_got_wrong_is_what_the_print_says():
    said = " ".join(
        README.read_text(encoding="utf-8").split("## What the papers got wrong")[1].split("\n## ")[0].split()
    )
    numbers = printed_numbers() | rebuilt_numbers(FIGURES)
    assert f"{numbers['motion_rms_um']:.2f} µm rms" in said
    assert f"{numbers['off_least_deg']:.0f} to {numbers['off_most_deg']:.0f} deg" in said
    assert f"{numbers['length_least']:.2f} to {numbers['length_most']:.2f};" in said
    assert numbers["centre_rank"] == 4 and numbers["heights"] == 5 and "the centre is fourth of five" in said
    assert numbers["rank_before"] == 20 and "Of 23 calibration parameters sphere centres determine 20" in said
