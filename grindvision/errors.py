"""Every error this package raises on purpose: its message names what was wrong, the value seen, and what to do."""

import re

#: Characters of a word (a path, a quoted value) and of a whole message; what is longer loses its middle.
LONGEST_WORD, LONGEST_MESSAGE = 200, 1000


class GrindvisionError(Exception):
    """Base of all errors of this package. The command line turns it into one line on stderr and exit code 2."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*(clipped(one) if isinstance(one, str) else one for one in arguments))


class GrindvisionWarning(UserWarning):
    """Something the user should know, though the result stands."""


class InputError(GrindvisionError):
    """An argument, file or table cannot be used as it is."""


class FileError(InputError):
    """A file is missing, damaged, of an unknown format, or cannot be written."""


class DataNotHereError(FileError):
    """A set of measured data is in no folder that is looked into; the message says which, and how to get it."""


class UnitError(InputError):
    """Numbers look like another unit than the one stated (metres for millimetres, degrees for radians)."""


class NotRigidError(InputError):
    """A 4x4 matrix is not a rigid transform."""


class DegenerateError(GrindvisionError):
    """The data do not determine the answer: too few points, collinear points, a free motion."""


class AmbiguousError(DegenerateError):
    """Several answers fit the data alike; the message names the motion between them."""


class NoPathError(DegenerateError):
    """A piece stands out, but it shows no path that lies on it."""


class TooSmallError(NoPathError):
    """A bead shows too few points to be followed."""


class UnreachableError(GrindvisionError):
    """No joint angles reach the pose asked for."""


class SightError(InputError):
    """A scanner's pose shows it nothing, or nothing within its measuring range."""


class CollisionError(GrindvisionError):
    """Arm, tool, work and table would touch, or the work lies where no tool can get."""


class SendError(GrindvisionError):
    """A programme could not be handed over to the robot's controller."""


class NoGrooveError(GrindvisionError):
    """The cloud shows no weld groove."""


class MissingExtraError(GrindvisionError, ImportError):
    """A package of one of grindvision's extras is not installed; the message holds the ``pip install`` line."""


def clipped(text: str) -> str:
    """A message whose long words, and the whole where it is long, have lost their middle: names may be a megabyte."""
    text = re.sub(rf"\S{{{LONGEST_WORD + 1},}}", lambda word: _without_middle(word[0], LONGEST_WORD), text)
    return _without_middle(text, LONGEST_MESSAGE)


def one_line(text: str) -> str:
    """A message on one line that any terminal can show: blanks for line breaks, escapes for what cannot be printed."""
    words = " ".join(clipped(text).split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)


def _without_middle(text: str, max_length: int) -> str:
    if len(text) <= max_length:
        return text
    head = (max_length - 3) * 3 // 5
    return f"{text[:head]}...{text[head + 3 - max_length :]}"
