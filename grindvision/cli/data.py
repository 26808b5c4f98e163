"""``grindvision data``: the sets of measured data that the book uses; a name fetches one."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict
from pathlib import Path

from grindvision.errors import FileError, InputError

EPILOG = """\
Without NAME the command lists the sets: what measured them, how large they are, their licence, and whether they are
here. With NAME it fetches that set from where its owners publish it, checks every file against the listed hash, and
keeps it in the folder that GRINDVISION_DATA names, else in your cache; -o names another folder. `all` fetches all that
can be fetched. Some sets were converted before they were listed: their files cannot be fetched, and the command says
what they are made from.

Each set is its owners' work: keep to its licence, and name them where you show it (--json lists the credits).

exit code: 0 done, 2 it cannot be had (one line says why), 1 anything else

examples:
  grindvision data
  grindvision data ur5 -o measured
  GRINDVISION_DATA=measured grindvision book --only 13
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    parser.add_argument("name", nargs="?", metavar="NAME", help="set to fetch, or all (default: list the sets)")
    parser.add_argument("-o", "--output", metavar="DIR", help="folder for the files")
    parser.add_argument("--json", action="store_true", help="the list as JSON, with files, hashes, origins and credits")


def run(options: argparse.Namespace) -> int:
    """Run it."""
    from grindvision.measured import measured_folders, measured_set, measured_sets

    folders = [Path(options.output)] if options.output else measured_folders()
    if options.name is None:
        if options.output and not options.json:
            raise InputError("-o DIR needs the NAME of the set to fetch into it; `grindvision data` lists the names")
        return _list(folders, options.json)
    if not folders:
        raise FileError("no home to keep a cache in; say where with -o DIR")
    sets = list(measured_sets().values()) if options.name == "all" else [measured_set(options.name)]
    for wanted in sets:
        if options.name == "all" and not all(file.fetchable for file in wanted.files):
            print(f"{wanted.name}: left out, it cannot be fetched as it is")
            continue
        _fetch(wanted.name, folders)
    return 0


def _fetch(name: str, folders: list[Path]) -> None:
    from grindvision.measured import measured_set, missing_files
    from grindvision.measured_fetch import fetch

    wanted = measured_set(name)
    there = next((folder for folder in folders if not missing_files(wanted, folder)), None)
    if there is not None:
        print(f"{name}: here already, in {there}")
        return
    fetched = fetch(wanted, folders[0])
    print(f"{name}: {len(fetched)} files fetched into {folders[0]}; licence {wanted.licence}; credit: {wanted.credit}")
    known = os.environ.get("GRINDVISION_DATA")
    if folders[0].resolve() not in [folder.resolve() for folder in _looked_into()]:
        print(f"the book finds them with GRINDVISION_DATA={folders[0]}" + (f" (it is {known})" if known else ""))


def _looked_into() -> list[Path]:
    from grindvision.measured import measured_folders

    return measured_folders()


def _list(folders: list[Path], as_json: bool) -> int:
    from grindvision.measured import measured_sets

    sets = measured_sets().values()
    places = [_place(wanted.name, folders) for wanted in sets]
    if as_json:
        told = [asdict(wanted) | {"here": place} for wanted, place in zip(sets, places, strict=True)]
        print(json.dumps(told, indent=1, ensure_ascii=False))
        return 0
    rows = [("NAME", "FILES", "MB", "LICENCE", "HERE", "INSTRUMENT")]
    for wanted, place in zip(sets, places, strict=True):
        state = place or ("no" if all(file.fetchable for file in wanted.files) else "no, and cannot be fetched")
        licence = wanted.licence.partition(":")[0]
        rows.append(
            (wanted.name, str(len(wanted.files)), f"{wanted.size_bytes / 1e6:.2f}", licence, state, wanted.instrument)
        )
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    for row in rows:
        print("  ".join([*(word.ljust(width) for word, width in zip(row, widths, strict=False)), row[5]]))
    return 0


def _place(name: str, folders: list[Path]) -> str:
    """The folder that holds a set; ``changed`` where one of its files is another one; empty where it is not here."""
    from grindvision.measured import measured_set, missing_files

    for folder in folders:
        try:
            if not missing_files(measured_set(name), folder):
                return str(folder)
        except FileError as error:
            return f"changed: {str(error).partition(':')[0]}"
    return ""
