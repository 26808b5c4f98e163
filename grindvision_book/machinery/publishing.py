"""Puts rebuilt files where they are committed, but only those that say something else than the commit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from grindvision.files import sha256, write_text, write_whole
from grindvision_book.machinery.agreement import Files, differences, files_in, of_one_name


@dataclass(frozen=True)
class Publication:
    """What became of the files of one name: ``kept`` as committed, ``restored`` from there, ``replaced`` or ``new``, by
    this build or by an earlier one.

    ``reasons`` tell in which data the rebuilt files differ from the commit; ``aside`` names files that somebody else
    had changed, and that were put aside.
    """

    name: str
    action: str
    reasons: tuple[str, ...] = ()
    aside: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line for the terminal."""
        more = f" and {len(self.reasons) - 1} more" if len(self.reasons) > 1 else ""
        told = {
            "kept": "as committed",
            "restored": "restored from the commit, with whose data the rebuilt ones agree",
            "replaced": f"replaced: {self.reasons[0] if self.reasons else 'redrawn'}{more}",
            "new": "new",
        }[self.action]
        moved = f" (the files found there are now {', '.join(self.aside)})" if self.aside else ""
        return f"{self.name}: {told}{moved}"


def publish(made: Path, figures: Path, committed: Files, aside: Path, redraw: bool = False) -> list[Publication]:
    """Bring the files of one chapter to ``figures``; those of one name go together or not at all.

    Files whose data agree with the commit stay as committed to the byte, or become so again. A file that neither the
    commit nor an earlier call wrote is somebody's own work: before it is overwritten it moves to ``aside``.

    Args:
        made: folder of the rebuilt files.
        figures: where they are committed.
        committed: what the commit holds there; empty where nothing is committed.
        aside: folder for the files of others, and the list of what these calls wrote.
        redraw: replace all, also where the data agree: after a change to how something is drawn.
    """
    ledger = aside / "written.json"
    written = _read_ledger(ledger)
    there, rebuilt, found = _files(figures), files_in(made), []
    for stem in sorted({Path(name).stem for name in rebuilt}):
        new, old = of_one_name(rebuilt, stem), of_one_name(committed, stem)
        reasons = tuple(differences(new, old)) if old else ()
        wanted = new if redraw or reasons or not old else old
        here = of_one_name(there, stem)
        action = "new" if not old else "replaced" if wanted != old else "kept" if here == old else "restored"
        found.append(Publication(stem, action, reasons, _write(wanted, here, old, figures, aside, written)))
    write_text(ledger, json.dumps(written, indent=1, sort_keys=True) + "\n")
    return found


def _write(
    wanted: Files, here: Files, old: Files, figures: Path, aside: Path, written: dict[str, str]
) -> tuple[str, ...]:
    moved = []
    for name in sorted({*wanted, *here}):
        path = figures / name
        if here.get(name) == wanted.get(name):
            continue
        if name in here and here[name] != old.get(name) and sha256(path) != written.get(name):
            aside.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, aside / name)
            moved.append(str(aside / name))
        if name in wanted:
            with write_whole(path) as temporary:
                temporary.write_bytes(wanted[name])
            written[name] = sha256(path)
        else:
            path.unlink()
    return tuple(moved)


def told(publications: Sequence[Publication], origin: str) -> list[str]:
    """Lines for the terminal: what changed, how many agree, and where what they were compared with comes from."""
    agreeing = sum(publication.action in ("kept", "restored") for publication in publications)
    lines = [str(publication) for publication in publications if publication.action != "kept"]
    return [*lines, f"{agreeing} of {len(publications)} figures, tables and sets of answers agree with {origin}"]


def _files(folder: Path) -> dict[str, bytes]:
    return files_in(folder) if folder.is_dir() else {}


def _read_ledger(path: Path) -> dict[str, str]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
