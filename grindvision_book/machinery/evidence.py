"""What a rebuilt number may be called: by the class of its evidence, and by whether a trivial answer would pass too."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from grindvision.paper import EVIDENCE

if TYPE_CHECKING:
    import pandas as pd

VERDICTS = (
    "reproduced", "not reproduced", "recovered", "within its bound", "outside its bound", "not comparable", "not yet",
)  # fmt: skip

#: Classes in which a value that is printed could have been refuted.
_AGAINST_PRINT = ("print alone", "paper's method on a twin", "ours on a twin")
#: Classes in which a trivial answer has a meaning: the row asks for a value, not for the size of an error.
_ASKS_A_VALUE = (*_AGAINST_PRINT, "recovers a planted truth")


def verdict(rebuilt: float, paper: float, tolerance: float, claim: str, evidence: str, trivial: str = "") -> str:
    """The word for one rebuilt number.

    A row of the class *not comparable* gets no other word. Where a value is printed, or planted in the twin, and no
    trivial answer passes, agreement is called ``reproduced``, or ``recovered``; a printed value that is missed is ``not
    reproduced`` in any case. What only keeps a bound of our own is ``within its bound``.

    Args:
        rebuilt: NaN when no chapter has answered.
        paper: NaN when nothing is printed; the tolerance then is the bound of the rebuilt value itself.
        tolerance: see ``holds``.
        claim: ``equal``, ``at most`` or ``at least``.
        evidence: one of ``grindvision.paper.EVIDENCE``.
        trivial: ``yes`` when a trivial answer would pass, see ``trivial_answers_pass``.
    """
    if rebuilt != rebuilt:
        return "not yet"
    if evidence == "not comparable":
        return evidence
    good, printed = holds(rebuilt, paper, tolerance, claim), paper == paper and evidence in _AGAINST_PRINT
    if printed and (not good or trivial != "yes"):
        return "reproduced" if good else "not reproduced"
    if good and evidence == "recovers a planted truth" and trivial != "yes":
        return "recovered"
    return "within its bound" if good else "outside its bound"


def holds(value: float, paper: float, tolerance: float, claim: str) -> bool:
    """Whether a value is ``equal`` to the printed one, ``at most`` or ``at least`` that, but for the tolerance.

    Without a printed value the tolerance is the bound itself: ``at most`` or ``at least`` the tolerance.
    """
    if claim == "equal":
        return abs(value - paper) <= tolerance
    if paper != paper:
        return value <= tolerance if claim == "at most" else value >= tolerance
    return value <= paper + tolerance if claim == "at most" else value >= paper - tolerance


def trivial_answers_pass(rows: pd.DataFrame) -> list[str]:
    """``yes`` or ``no`` for every row of ``expected.csv`` that asks for a value, empty for the others.

    Trivial answers are 0, the nominal value where there is one, and the mean of the printed values of the rows that are
    held to one bound for one reason (one printed table), where there are several.
    """
    held_together = rows.groupby(["item", "unit", "evidence", "reason"])["paper"]
    mean_of_print, printed = held_together.transform("mean"), held_together.transform("nunique")
    found = []
    for row, mean, values in zip(rows.itertuples(index=False), mean_of_print, printed, strict=True):
        if row.evidence not in _ASKS_A_VALUE or np.isnan(row.paper):
            found.append("")
            continue
        answers = [0.0, row.nominal, *([mean] if values > 1 else [])]
        passing = (holds(one, row.paper, row.tolerance, row.claim) for one in answers if one == one)
        found.append("yes" if any(passing) else "no")
    return found


def count_by_class(table: pd.DataFrame) -> pd.DataFrame:
    """Numbers of a scoreboard by class of evidence and verdict, and how many a trivial answer would pass."""
    import pandas as pd

    rows = []
    for name in EVIDENCE:
        part = table[table["evidence"] == name]
        counts = {word: int((part["verdict"] == word).sum()) for word in VERDICTS}
        trivial = int((part["trivial answer passes"] == "yes").sum())
        rows.append({"evidence": name, "numbers": len(part), **counts, "trivial answer passes": trivial})
    counts = pd.DataFrame(rows)
    total = counts.sum(numeric_only=True).to_dict() | {"evidence": "all"}
    return pd.concat([counts[counts["numbers"] > 0], pd.DataFrame([total])], ignore_index=True)
