"""Where the files stand that come with the package: printed tables, robots."""

from __future__ import annotations

import os
from pathlib import Path

from grindvision.errors import FileError

#: Inside the installed package, and at the top of a checkout.
PLACES = (Path(__file__).resolve().parent / "data", Path(__file__).resolve().parents[1] / "data")


def data_folder() -> Path:
    """Folder ``data`` of the installed package or of the checkout, or the one that ``GRINDVISION_DATA`` names.

    Raises:
        FileError: there is none.
    """
    asked = os.environ.get("GRINDVISION_DATA")
    places = (Path(asked),) if asked else PLACES
    found = next((place for place in places if (place / "paper").is_dir()), None)
    if found is None:
        how = "GRINDVISION_DATA must name a folder like it" if asked else "install grindvision again"
        raise FileError(f"{places[0]}: no folder with the data that come with grindvision; {how}")
    return found
