"""Caches of compiled kernels that a change in another file has made stale.

Numba compiles a kernel anew when the file it stands in changes, not when a kernel that it calls, in another file, does:
its old machine code would go on, and be silently wrong. Kernels are imported from the file they stand in.
"""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r"^from grindvision\.([\w.]+) import", re.MULTILINE)


def drop_stale_caches(package: Path = Path(__file__).parent) -> list[Path]:
    """Delete the caches that are older than a file that their kernel's file imports, directly or through others.

    Returns the kernels' index files (``.nbi``) that were deleted; what may not be deleted stays.
    """
    written = {index: index.stat().st_mtime for index in package.rglob("__pycache__/*.nbi")}
    changed = {source: source.stat().st_mtime for source in package.rglob("*.py")}
    if not written or max(changed.values()) <= min(written.values()):
        return []
    stale = []
    for index, time in written.items():
        source = index.parent.parent / f"{index.name.split('.')[0]}.py"
        if any(changed[file] > time for file in _imported(source, package) & changed.keys()):
            try:
                index.unlink(missing_ok=True)
            except OSError:
                continue
            stale.append(index)
    return stale


def _imported(source: Path, package: Path) -> set[Path]:
    """Files of the package that a file imports from, and those that they import from."""
    found: set[Path] = set()
    waiting = [source]
    while waiting:
        file = waiting.pop()
        if file not in found and file.is_file():
            found.add(file)
            names = _IMPORT.findall(file.read_text(encoding="utf-8"))
            waiting += [package.joinpath(*name.split(".")).with_suffix(".py") for name in names]
    return found
