"""Fetches measured data from where their owners publish them: whole and with the listed hash, or not at all."""

from __future__ import annotations

import sys
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from grindvision.errors import FileError, InputError
from grindvision.extras import extra
from grindvision.files import UNFINISHED, sha256, writable_folder, write_whole
from grindvision.measured import LINES, MeasuredFile, MeasuredSet, missing_files

#: Seconds without an answer after which a server counts as out of reach.
PATIENCE_S = 30

#: Brings what stands at an address to a path that does not exist yet.
Download = Callable[[str, Path], None]


def fetch(wanted: MeasuredSet, folder: Path, download: Download | None = None) -> list[Path]:
    """Bring the files of a set that are missing into a folder, and return their paths.

    Each file is downloaded to a temporary name, checked, then renamed; nothing that is there is replaced.

    Args:
        wanted: the set.
        folder: where its files shall be; made where it does not exist.
        download: brings the content of an address to a path; by default over HTTP, with a bar on a terminal.

    Raises:
        MissingExtraError: pooch is not installed.
        InputError: a missing file is made from what is published and cannot be fetched as it is.
        FileError: no answer, another content than listed, a file that was changed here, no space or right to write.
    """
    missing = missing_files(wanted, folder)
    made = [file for file in missing if not file.fetchable]
    if made:
        raise InputError(
            f"{made[0].file} of {wanted.name} cannot be fetched as it is: it is made from {made[0].address} "
            f"({made[0].conversion}); GRINDVISION_DATA names a folder that has it"
        )
    download = download or over_http()
    writable_folder(folder)
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=folder) as temporary:
        for number, address in enumerate(dict.fromkeys(_source(file) for file in missing)):
            whole = Path(temporary) / str(number)
            download(address, whole)
            for file in missing:
                if _source(file) == address:
                    _put(file, whole, folder / file.file, wanted.name)
    return [folder / file.file for file in missing]


def over_http() -> Download:
    """A download by pooch.

    Raises:
        MissingExtraError: pooch, or the tqdm of its bar, is not installed.
    """
    with extra("data"):
        import pooch
        import requests
        import tqdm  # noqa: F401

    pooch.get_logger().setLevel("ERROR")
    downloader = pooch.HTTPDownloader(progressbar=sys.stderr.isatty(), timeout=PATIENCE_S)

    def download(address: str, path: Path) -> None:
        try:
            pooch.retrieve(address, known_hash=None, fname=path.name, path=path.parent, downloader=downloader)
        except requests.HTTPError as error:
            code = error.response.status_code if error.response is not None else "an error"
            raise FileError(f"{address}: the server answers {code}; is the address still right?") from None
        except requests.RequestException as error:
            raise FileError(
                f"no answer from {urlsplit(address).hostname} ({type(error).__name__}); check the network, or let "
                "GRINDVISION_DATA name a folder that has the files"
            ) from None
        except OSError as error:
            raise FileError(
                f"cannot write {path.name} of {path.parent.parent}: {error.strerror or error}; free space or choose "
                "another folder"
            ) from None

    return download


def _source(file: MeasuredFile) -> str:
    """Address of what has to be downloaded for a file."""
    return file.address.partition("!")[0]


def _put(file: MeasuredFile, whole: Path, place: Path, name: str) -> None:
    """Take a file out of what was downloaded, check it, and rename it to its place."""
    with write_whole(place) as path:
        member = file.address.partition("!")[2]
        content = _member(whole, member, file.address) if member else whole.read_bytes()
        if file.conversion:
            content = _with_lines(content, file.conversion.removeprefix(LINES).split(" or "))
        path.write_bytes(content)
        found = sha256(path)
        if found != file.sha256:
            raise FileError(
                f"{file.address}: changed since it was listed: {len(content)} bytes, sha256 {found[:12]}... instead of "
                f"{file.size_bytes} and {file.sha256[:12]}...; nothing of it was kept, {name} cannot be used"
            )


def _member(archive: Path, name: str, address: str) -> bytes:
    try:
        with tarfile.open(archive) as content:
            file = content.extractfile(name)
            if file is None:
                raise KeyError(name)
            return file.read()
    except (tarfile.TarError, KeyError, OSError, EOFError):
        raise FileError(f"{address}: no archive with that file; nothing of it was kept") from None


def _with_lines(content: bytes, words: Sequence[str]) -> bytes:
    lines = content.splitlines(keepends=True)
    return b"".join(line for line in lines if any(word.encode() in line.split() for word in words))
