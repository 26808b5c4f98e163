"""Data that others measured: which sets there are, where their files lie on this machine, and whether they are whole.

The files are not in the repository; ``data/measured.csv`` names each with its origin, licence and hash. A set is looked
for in the folder that ``GRINDVISION_DATA`` names, then in the user's cache, where ``grindvision data NAME`` puts it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from grindvision.caches import user_cache
from grindvision.data_files import data_folder, own_folder
from grindvision.errors import DataNotHereError, FileError, InputError
from grindvision.files import read_table, sha256

_OF_A_SET = ("instrument", "unit", "frame", "licence", "credit", "truth")
_OF_A_FILE = ("file", "address", "sha256", "conversion")

#: Begins the ``conversion`` of a file that is some lines of another: those with one of the words that follow.
LINES = "lines with "


@dataclass(frozen=True)
class MeasuredFile:
    """One file of a set.

    ``address`` is where its origin stands, at a commit; behind ``!`` the member of an archive. ``conversion`` says how
    the file differs from it, empty where it does not.
    """

    file: str
    address: str
    size_bytes: int
    sha256: str
    conversion: str

    @property
    def fetchable(self) -> bool:
        """Whether the file follows from what stands at its address."""
        return not self.conversion or self.conversion.startswith(LINES)


@dataclass(frozen=True)
class MeasuredSet:
    """A set of measured data: its instrument, unit and frame, whose it is, and what is known of the truth."""

    name: str
    instrument: str
    unit: str
    frame: str
    licence: str
    credit: str
    truth: str
    files: tuple[MeasuredFile, ...]

    @property
    def size_bytes(self) -> int:
        """Of all its files."""
        return sum(file.size_bytes for file in self.files)


def measured_sets() -> dict[str, MeasuredSet]:
    """All sets of ``data/measured.csv`` by name.

    Raises:
        FileError: the list is missing or damaged.
    """
    path = data_folder() / "measured.csv"
    rows = read_table(path, ("size_bytes",), ("name", *_OF_A_SET, *_OF_A_FILE)).fillna("")
    sets = {}
    for name, files in rows.groupby("name", sort=False):
        told = files[list(_OF_A_SET)].drop_duplicates()
        if len(told) > 1:
            raise FileError(f"{path}: the rows of {name} do not agree on {', '.join(_OF_A_SET)}; mend the file")
        listed = tuple(
            MeasuredFile(row.file, row.address, int(row.size_bytes), row.sha256, row.conversion)
            for row in files.itertuples(index=False)
        )
        sets[str(name)] = MeasuredSet(str(name), **told.iloc[0].to_dict(), files=listed)
    return sets


def measured_set(name: str) -> MeasuredSet:
    """One set by its name.

    Raises:
        InputError: there is none of this name.
    """
    sets = measured_sets()
    if name not in sets:
        raise InputError(f"no set of measured data {name!r}; there are {', '.join(sets)}")
    return sets[name]


def measured_folders() -> list[Path]:
    """Where sets are looked for, in this order.

    Raises:
        FileError: ``GRINDVISION_DATA`` names no folder.
    """
    own, cache = own_folder(), user_cache()
    return [*([own] if own else []), *([cache / "grindvision" / "measured"] if cache else [])]


def missing_files(wanted: MeasuredSet, folder: Path) -> list[MeasuredFile]:
    """Files of a set that are not in a folder.

    Raises:
        FileError: one that is there is not the file that is listed.
    """
    missing = []
    for file in wanted.files:
        path = folder / file.file
        if not path.exists():
            missing.append(file)
        elif (found := sha256(path)) != file.sha256:
            raise FileError(
                f"{path}: not the file of {wanted.name} that is listed (sha256 {found[:12]}..., listed "
                f"{file.sha256[:12]}...); move it away, then `grindvision data {wanted.name}` fetches it again"
            )
    return missing


def find_measured(name: str) -> Path:
    """The folder that holds all files of a set, each as its hash says.

    Raises:
        InputError: no such set. DataNotHereError: no folder holds it. FileError: a file of it was changed.
    """
    wanted, folders = measured_set(name), measured_folders()
    for folder in folders:
        if not missing_files(wanted, folder):
            return folder
    looked = " and ".join(map(str, folders)) or "no folder"
    raise DataNotHereError(
        f"the measured data {name} are not here (looked into {looked}); "
        f"`grindvision data {name}` fetches them, or GRINDVISION_DATA names a folder that has them"
    )


def absent_sets(names: tuple[str, ...] | list[str]) -> list[str]:
    """Those of some sets that are not here.

    Raises:
        InputError, FileError: see ``find_measured``.
    """
    absent = []
    for name in names:
        try:
            find_measured(name)
        except DataNotHereError:
            absent.append(name)
    return absent
