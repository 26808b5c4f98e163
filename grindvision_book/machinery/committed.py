"""The figures as the checkout's commit holds them: what rebuilt ones are compared with, whatever the folder holds."""

from __future__ import annotations

import io
import subprocess
import tarfile
from dataclasses import dataclass
from pathlib import Path

from grindvision.errors import FileError
from grindvision.files import write_whole
from grindvision_book.machinery.agreement import Files
from grindvision_book.machinery.places import BUILD, FIGURES, ROOT

#: Where there is no git: the figures as they were unpacked, packed before the book writes there for the first time.
UNPACKED = BUILD / "figures_as_unpacked.tar"


@dataclass(frozen=True)
class Committed:
    """Files of ``figures/`` by name, and in words where they come from."""

    files: Files
    origin: str


def committed_figures(figures: Path = FIGURES, root: Path = ROOT, unpacked: Path = UNPACKED) -> Committed:
    """The figures of the commit that is checked out; without git, those that were there before the first build.

    Raises:
        FileError: there is no git, and the packed copy of the first figures is damaged.
    """
    name = figures.relative_to(root).as_posix()
    try:
        done = subprocess.run(
            ["git", "archive", "--format=tar", "HEAD", name], cwd=root, capture_output=True, timeout=60
        )
        reason = done.stderr.decode(errors="replace").strip().splitlines()[:1]
    except (OSError, subprocess.TimeoutExpired) as error:
        done, reason = None, [str(error)]
    if done is not None and done.returncode == 0:
        return Committed(_unpacked(done.stdout), "the commit")
    if not unpacked.exists():
        with write_whole(unpacked) as path, tarfile.open(path, "w") as archive:
            archive.add(figures, arcname=name)
    try:
        files = _unpacked(unpacked.read_bytes())
    except (OSError, tarfile.TarError) as error:
        raise FileError(
            f"{unpacked}: damaged ({error}); put figures/ back as it was unpacked, and remove this file"
        ) from None
    why = f" ({reason[0][:100]})" if reason else ""
    return Committed(files, f"figures/ as it was before the first build here, for git gives no commit{why}")


def _unpacked(content: bytes) -> dict[str, bytes]:
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        members = [member for member in archive.getmembers() if member.isfile()]
        return {Path(member.name).name: archive.extractfile(member).read() for member in members}  # type: ignore[union-attr]
