"""Which sets of measured data are on this machine, and what the chapter says of those that are not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

import grindvision_book as book
from grindvision.errors import DataNotHereError
from grindvision.measured import find_measured, measured_sets

ABSENT = "data not here"


@dataclass(frozen=True)
class Sets:
    """Folder of every set, None where it is not here."""

    folders: dict[str, Path | None]

    @property
    def absent(self) -> list[str]:
        """Names of the sets that are not here."""
        return [name for name, folder in self.folders.items() if folder is None]

    def __contains__(self, name: str) -> bool:
        return self.folders[name] is not None

    def folder(self, name: str) -> Path:
        """Folder of a set that is here."""
        found = self.folders[name]
        assert found is not None, f"{name} is not here: ask first"
        return found

    def table(self) -> pd.DataFrame:
        """The sets with instrument, size, licence and what is known of the truth."""
        rows = [
            {
                "set": one.name,
                "instrument": one.instrument,
                "files": len(one.files),
                "size_mb": one.size_bytes / 1e6,
                "licence": one.licence,
                "known independently": one.truth,
                "credit": one.credit,
            }
            for one in measured_sets().values()
        ]
        return pd.DataFrame(rows)

    def box(self) -> str:
        """Markdown: all are here, or a box that names those that are not."""
        if not self.absent:
            return "All sets are here."
        names = ", ".join(f"`{name}`" for name in self.absent)
        return (
            f"> **Not here: {names}.** Their sections are left out below, and their rows say *{ABSENT}*. The committed "
            "figures and verdicts of this chapter stay as they are. `grindvision data NAME` fetches a set, "
            "`GRINDVISION_DATA` names a folder that has them."
        )


def sets_here() -> Sets:
    """Look for every set; where one is missing, the chapter's committed figures and answers are left alone.

    Raises:
        FileError: a file of a set was changed.
    """
    folders: dict[str, Path | None] = {}
    for name in measured_sets():
        try:
            folders[name] = find_measured(name)
        except DataNotHereError:
            folders[name] = None
    found = Sets(folders)
    if found.absent:
        book.leave_as_committed(f"the measured data {', '.join(found.absent)} are not here")
    return found


def judged_rows(sets: Sets) -> pd.DataFrame:
    """The chapter's verdicts; a row whose set is not here says so instead."""
    rows = book.verdicts().rename(columns={"rebuilt": "measured"})
    rows.loc[rows["item"].isin(sets.absent), "verdict"] = ABSENT
    return rows
