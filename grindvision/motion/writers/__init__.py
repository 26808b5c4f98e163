"""Robot programmes in the makers' languages, all from one form: ``RobotProgramme`` in, text out."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from grindvision.errors import InputError
from grindvision.motion.programme_steps import RobotProgramme
from grindvision.motion.writers.jbi import jbi
from grindvision.motion.writers.krl import krl
from grindvision.motion.writers.ls import ls
from grindvision.motion.writers.rapid import rapid
from grindvision.motion.writers.steps import steps_csv, steps_json
from grindvision.motion.writers.urscript import urscript_of

#: Language -> (writer, endings of its files in the writer's order, end of a line).
LANGUAGES: Mapping[str, tuple[Callable[[RobotProgramme], tuple[str, ...]], tuple[str, ...], str]] = {
    "rapid": (rapid, (".mod",), "\r\n"),
    "krl": (krl, (".src", ".dat"), "\r\n"),
    "ls": (ls, (".ls",), "\r\n"),
    "jbi": (jbi, (".jbi",), "\r\n"),
    "urscript": (urscript_of, (".script",), "\n"),
    "steps-json": (steps_json, (".json",), "\n"),
    "steps-csv": (steps_csv, (".csv",), "\n"),
}

__all__ = ["LANGUAGES", "jbi", "krl", "ls", "programme_files", "rapid", "steps_csv", "steps_json", "urscript_of"]


def programme_files(programme: RobotProgramme, language: str) -> dict[str, str]:
    """Texts of a programme's files by name, all ASCII.

    Args:
        programme: see ``robot_programme``.
        language: ``rapid``, ``krl``, ``ls``, ``jbi``, ``urscript``, ``steps-json`` or ``steps-csv``.

    Raises:
        InputError: an unknown language, a name or a number that it cannot hold, an arm that it cannot describe.
    """
    if language not in LANGUAGES:
        raise InputError(f"unknown language {language!r}; choose one of {', '.join(LANGUAGES)}")
    write, endings, newline = LANGUAGES[language]
    texts = write(programme)
    return {programme.name + ending: text.replace("\n", newline) for ending, text in zip(endings, texts, strict=True)}
