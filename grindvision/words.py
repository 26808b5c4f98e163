"""Numbers with their nouns, for messages and reports."""

from __future__ import annotations


def counted(number: int, one: str, many: str = "") -> str:
    """``1 bead``, ``3 beads``: the number and its noun; ``many`` where the plural is not ``one`` with an s.

    Example:
        >>> counted(1, "place"), counted(0, "place"), counted(2, "pass", "passes")
        ('1 place', '0 places', '2 passes')
    """
    return f"{number} {one if number == 1 else many or one + 's'}"


def rounded(value: float, digits: int = 3) -> str:
    """A number of so many significant digits, without an exponent where it is large.

    Example:
        >>> rounded(3756.2), rounded(0.12345), rounded(82.0, 2)
        ('3,760', '0.123', '82')
    """
    text = f"{value:.{digits}g}"
    return f"{float(text):,.0f}" if "e+" in text else text
