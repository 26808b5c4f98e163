"""Folders for what may be lost: beside the package, in the user's cache, in a temporary folder; first come, first used.

Nothing is made before it is written to, and nothing is said where none can be written.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from grindvision import __version__

PACKAGE = Path(__file__).resolve().parent


def cache_folders(name: str) -> list[Path]:
    """Places of a cache, the preferred first; each may be missing, or not be writable.

    The first that may be written to takes new entries; entries are read from all of them, so that a user of a read-only
    installation finds what its owner has prepared.
    """
    installation = f"{__version__}-{hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:12]}"
    places = [PACKAGE / "__pycache__" / name]
    user = user_cache()
    if user is not None:
        places.append(user / "grindvision" / installation / name)
    temporary = temporary_folder()
    if temporary is not None:
        places.append(temporary / installation / name)
    return places


def temporary_folder() -> Path | None:
    """Folder of this user alone among the temporary files; it may not exist yet. None where there are none."""
    try:
        base = tempfile.gettempdir()
    except OSError:
        return None
    if base == os.getcwd():  # what Python takes where no other folder can be written to
        return None
    owner = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return Path(base) / f"grindvision-{owner}"


def is_ours(folder: Path) -> bool:
    """Whether a folder exists and nobody else could have put files into it, as in a temporary folder of all users."""
    root = temporary_folder()
    if root is None or not folder.is_relative_to(root) or not hasattr(os, "getuid"):
        return folder.is_dir()
    try:
        seen = root.lstat()
    except OSError:
        return False
    private = stat.S_ISDIR(seen.st_mode) and seen.st_uid == os.getuid() and not seen.st_mode & 0o022
    return private and folder.is_dir()


def made(folder: Path) -> bool:
    """Whether a folder stands and may be written to; it is made where it does not exist."""
    try:
        root = temporary_folder()
        if root is not None and folder.is_relative_to(root):
            root.mkdir(mode=0o700, exist_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return is_ours(folder)
    except OSError:
        return False


@contextmanager
def matplotlib_has_a_folder() -> Iterator[None]:
    """Inside the block, in which Matplotlib is imported, it finds a folder for its settings and its list of fonts.

    Where its own may not be written to (a service without a home) it would say so on stderr, and seek all fonts anew
    every time; it gets one of ``cache_folders`` then. Where it has one, or the user names one, nothing is changed.
    """
    name = "MPLCONFIGDIR"
    if name in os.environ or "matplotlib" in sys.modules or all(made(folder) for folder in _matplotlib_folders()):
        yield
        return
    folder = next((folder for folder in cache_folders("matplotlib") if made(folder)), None)
    if folder is None:
        yield
        return
    os.environ[name] = str(folder)
    try:
        yield
        if matplotlib := sys.modules.get("matplotlib"):
            matplotlib.get_configdir(), matplotlib.get_cachedir()  # it keeps both from now on
    finally:
        del os.environ[name]


def _matplotlib_folders() -> list[Path]:
    """Where Matplotlib puts its settings and its list of fonts of itself; a folder that cannot be where it has none."""
    try:
        home = Path.home()
    except RuntimeError:
        home = Path(os.devnull)
    if sys.platform in ("win32", "darwin"):
        return [home / ".matplotlib"]
    return [
        Path(os.environ.get(variable) or home / folder) / "matplotlib"
        for variable, folder in (("XDG_CONFIG_HOME", ".config"), ("XDG_CACHE_HOME", ".cache"))
    ]


def user_cache() -> Path | None:
    """Folder for what programs of this user may lose; None where there is no home."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return Path(base) if base else None
    if sys.platform != "darwin" and os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"])
    try:
        home = Path.home()
    except RuntimeError:
        return None
    if not home.is_dir():
        return None
    return home / "Library" / "Caches" if sys.platform == "darwin" else home / ".cache"
