"""Where the files stand that come with the package: printed tables, robots, the list of measured data."""

from __future__ import annotations

import os
from pathlib import Path

from grindvision.errors import FileError

#: Inside the installed package, and at the top of a checkout.
PLACES = (Path(__file__).resolve().parent / "data", Path(__file__).resolve().parents[1] / "data")


def own_folder() -> Path | None:
    """The folder that ``GRINDVISION_DATA`` names; None where it names none.

    Raises:
        FileError: there is no such folder.
    """
    asked = os.environ.get("GRINDVISION_DATA")
    if asked and not Path(asked).is_dir():
        raise FileError(f"{asked}: no such folder; GRINDVISION_DATA must name a folder with data, or be left out")
    return Path(asked) if asked else None


def data_folder() -> Path:
    """Folder ``data`` of the installed package or of the checkout.

    The folder that ``GRINDVISION_DATA`` names takes its place where that holds printed tables (``paper``) too.

    Raises:
        FileError: there is none.
    """
    own = own_folder()
    places = (own, *PLACES) if own else PLACES
    found = next((place for place in places if (place / "paper").is_dir()), None)
    if found is None:
        raise FileError(f"{PLACES[0]}: no folder with the data that come with grindvision; install grindvision again")
    return found
