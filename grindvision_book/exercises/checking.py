"""Checks a student's function on seeded cases, and names the likely mistake by trying known wrong variants."""

from __future__ import annotations

import copy
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

Function = Callable[..., Any]

RIGHT, WRONG, NOT_YET = "right", "wrong", "not yet"


@dataclass(frozen=True)
class Mistake:
    """A known way to go wrong: its ``name``, a ``hint`` at what to look at, and the ``variant`` that makes it."""

    name: str
    hint: str
    variant: Function


@dataclass(frozen=True)
class Exercise:
    """One exercise, ``number`` as "03-2".

    ``right`` is the package's own function or a law; ``cases`` draws the tuples of arguments that it is tried on;
    ``mistakes`` come most likely first. Results agree if they differ by at most ``tolerance`` times the largest
    entry of the right one, after ``arranged``, which undoes what is free, as the order of points.
    """

    number: str
    title: str
    right: Function
    cases: Callable[[np.random.Generator], Sequence[tuple[Any, ...]]]
    mistakes: tuple[Mistake, ...]
    unit: str = ""
    tolerance: float = 1e-6
    arranged: Function = np.asarray

    def drawn_cases(self) -> list[tuple[Any, ...]]:
        """The cases, the same in every run."""
        return list(self.cases(np.random.default_rng(zlib.crc32(self.number.encode()))))


@dataclass(frozen=True, repr=False)
class Checked:
    """What a check found: ``state`` is "right", "wrong" or "not yet"; ``mistake`` is the likely one, if it is known."""

    number: str
    state: str
    message: str
    mistake: str = ""

    def __str__(self) -> str:
        return f"{self.number} {self.state}: {self.message}"

    __repr__ = __str__


#: Mistakes that any number can suffer, tried after the exercise's own: what they make of the right result.
SLIPS = tuple(
    Mistake(name, hint, variant)
    for name, hint, *variants in (
        (
            "sign",
            "The sign is the other way round. From where to where does it point, and what is subtracted from what?",
            np.negative,
        ),
        (
            "metres and millimetres",
            "Off by a factor of a thousand. Every length here is in millimetres.",
            lambda right: right / 1000,
            lambda right: right * 1000,
        ),
        (
            "degrees for radians",
            "Off by a factor of 57.3. Which unit does the name of the result, or of an argument, ask for?",
            np.degrees,
            np.radians,
        ),
        ("square", "This is the square of what is asked for. Is a root missing at the end?", np.square),
        ("root", "This is the root of what is asked for. Is one taken too many?", lambda right: np.sqrt(np.abs(right))),
        (
            "factor of two",
            "Off by a factor of two. Is something counted from both sides, or a radius taken for a diameter?",
            lambda right: 2 * right,
            lambda right: right / 2,
        ),
        ("rows and columns", "This is the transpose of what is asked for. What does one row stand for?", np.transpose),
    )
    for variant in variants
)

_states: dict[str, str] = {}


def exercises_of(chapter: str) -> tuple[Exercise, ...]:
    """The exercises of a chapter, named by its two digits.

    Raises:
        InputError: the chapter has none.
    """
    home = f"{__package__}.chapter_{chapter}"
    try:
        return import_module(home).EXERCISES
    except ModuleNotFoundError as error:
        if error.name != home:
            raise
        raise InputError(f"there are no exercises to chapter {chapter!r}; 01 to 12 have some") from None


def exercise(number: str) -> Exercise:
    """The exercise with this number, as "03-2".

    Raises:
        InputError: there is none.
    """
    there = {found.number: found for found in exercises_of(number[:2])}
    if number not in there:
        raise InputError(f"there is no exercise {number!r}; chapter {number[:2]} has {', '.join(there)}")
    return there[number]


def check(number: str, function: Function) -> Checked:
    """Try a student's function on the exercise's cases; a wrong one is told where to look, never the solution.

    Raises:
        InputError: there is no such exercise, or what is given is no function.
    """
    task = exercise(number)
    if not callable(function):
        raise InputError(
            f"exercise {number}: hand over the function itself, not {type(function).__name__}: no brackets"
        )
    checked = _checked(task, function)
    _states[number] = checked.state
    return checked


def progress(chapter: str) -> pd.DataFrame:
    """Exercises of a chapter and how far they are: ``exercise``, ``title``, ``state`` of the last check."""
    import pandas as pd

    rows = [(task.number, task.title, _states.get(task.number, "not checked")) for task in exercises_of(chapter)]
    return pd.DataFrame(rows, columns=["exercise", "title", "state"])


def _checked(task: Exercise, function: Function) -> Checked:
    cases = task.drawn_cases()
    given: list[Any] = []
    for number, case in enumerate(cases, start=1):
        try:
            result = function(*copy.deepcopy(case))
        except Exception as error:
            reason = f"case {number} of {len(cases)} ends in {type(error).__name__}: {error}"
            return Checked(task.number, WRONG, " ".join(reason.split()))
        if result is None or result is Ellipsis:
            return Checked(task.number, NOT_YET, "the function returns nothing so far (does it end in a return?)")
        given.append(result)
    wanted = [task.arranged(task.right(*copy.deepcopy(case))) for case in cases]
    try:
        given = [_numbers(task.arranged(result)) for result in given]
    except (TypeError, ValueError, IndexError) as error:
        return Checked(task.number, WRONG, f"the result cannot be read ({error}); {_shape(wanted[0])} is asked for")
    agree = [_agree(task, a, b) for a, b in zip(given, wanted, strict=True)]
    if all(agree):
        return Checked(task.number, RIGHT, f"{task.title}, all {len(cases)} cases")
    for mistake in task.mistakes:
        with np.errstate(all="ignore"):
            variants = [task.arranged(mistake.variant(*copy.deepcopy(case))) for case in cases]
        if all(_agree(task, a, b) for a, b in zip(given, variants, strict=True)):
            return Checked(task.number, WRONG, f"likely mistake: {mistake.name}. {mistake.hint}", mistake.name)
    for slip in SLIPS:
        if all(_agree(task, a, slip.variant(np.asarray(b, dtype=float))) for a, b in zip(given, wanted, strict=True)):
            return Checked(task.number, WRONG, f"likely mistake: {slip.name}. {slip.hint}", slip.name)
    first = agree.index(False)
    some = f"{sum(agree)} of {len(cases)} cases are right; " if any(agree) else ""
    return Checked(task.number, WRONG, f"{some}case {first + 1} {_apart(task, given[first], wanted[first])}")


def _numbers(result: Any) -> NDArray[Any]:
    array = np.asarray(result)
    if array.dtype.kind not in "biuf":
        raise ValueError("it holds no numbers")
    return array


def _agree(task: Exercise, a: Any, b: Any) -> bool:
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.shape != b.shape:
        return False
    size = np.abs(b[np.isfinite(b)]).max(initial=0.0)
    return bool(np.allclose(a, b, rtol=0, atol=task.tolerance * (size or 1.0), equal_nan=True))


def _shape(wanted: Any) -> str:
    shape = np.shape(wanted)
    return f"an array of shape {shape}" if shape else "one number"


def _apart(task: Exercise, given: NDArray[Any], wanted: Any) -> str:
    """What can be said of a wrong result whose mistake is not known: shape, NaN, or how far off."""
    if given.shape != np.shape(wanted):
        return f"gives {_shape(given)}; {_shape(wanted)} is asked for"
    if not np.isfinite(given.astype(float)).all() and np.isfinite(np.asarray(wanted, dtype=float)).all():
        return "gives NaN or infinity: is something divided by zero there?"
    off = f"{np.nanmax(np.abs(given.astype(float) - np.asarray(wanted, dtype=float))):.3g} {task.unit}".strip()
    return f"is off by up to {off}; it is none of the mistakes that the checker knows"
