"""Where things lie in the checkout: one constant per folder that the book reads or writes."""

from __future__ import annotations

import os
from pathlib import Path

from grindvision.errors import FileError


def checkout() -> Path:
    """Folder that holds ``notebooks/``, ``data/`` and this package.

    Raises:
        FileError: the package runs from somewhere else, so there is no book to rebuild.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / "pyproject.toml").is_file() or not (root / "data").is_dir():
        raise FileError(
            f"{root} is no checkout of grindvision (no pyproject.toml and data/ there); "
            "the book needs the repository: clone it and run ./run book in it"
        )
    return root


ROOT = checkout()
NOTEBOOKS = ROOT / "notebooks"
FIGURES = ROOT / "figures"
BUILD = ROOT / "build"
EXECUTED = BUILD / "executed"
FAST_FIGURES = BUILD / "fast" / "figures"
SITE = BUILD / "site"


def figures_folder() -> Path:
    """Folder a chapter writes its figures to: ``GRINDVISION_FIGURES``, else ``build/figures`` (never a tracked one)."""
    return Path(os.environ.get("GRINDVISION_FIGURES") or BUILD / "figures")


def finished_folder() -> Path:
    """Folder with the figures and answers of finished chapters: ``GRINDVISION_FINISHED``, else ``figures``."""
    return Path(os.environ.get("GRINDVISION_FINISHED") or FIGURES)
