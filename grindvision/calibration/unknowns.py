"""Which numbers a calibration seeks, their order in a vector, and what they are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from grindvision.arm import PARAMETERS, MdhArm
from grindvision.calibration.joint_terms import JointTerm
from grindvision.calibration.measurements import Measurements
from grindvision.errors import InputError

Floats = NDArray[np.float64]

_MOTION = ("x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad")


@dataclass(frozen=True)
class Unknowns:
    """Which numbers are sought: the scanner's small motion, entries of the MDH table, the base's small motion.

    ``scanner`` is 6 (motion), 3 (translation only) or 0 columns, ``table`` numbers the entries of the flattened MDH
    table, ``base`` is 6 or 0 columns; between table and base stand the coefficients of ``terms``, three columns for
    each of ``reflectors`` and three for each of ``fixtures`` (names and kinds). ``names`` carry the units; the number
    in ``d3_mm`` is the row of the table, so ``alpha3_rad`` is the paper's alpha_2.
    """

    scanner: int
    table: tuple[int, ...]
    base: int
    terms: tuple[JointTerm, ...] = ()
    reflectors: tuple[str, ...] = ()
    fixtures: tuple[tuple[str, str], ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """One name with unit per unknown, in column order."""
        motion = [[f"{part}_{name}" for name in _MOTION] for part in ("scanner", "base")]
        fixtures = [
            f"{kind}_{name}_{part}"
            for kind, name in self.fixtures
            for part in (("tilt1_rad", "tilt2_rad", "distance_mm") if kind == "plane" else ("x_mm", "y_mm", "z_mm"))
        ]
        return (
            *motion[0][: self.scanner],
            *(entry_name(i) for i in self.table),
            *(term.name for term in self.terms),
            *(f"reflector_{name}_{axis}_mm" for name in self.reflectors for axis in "xyz"),
            *fixtures,
            *motion[1][: self.base],
        )

    @cached_property
    def is_angle(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns measured in radians."""
        flags = np.array([name.endswith("_rad") for name in self.names], dtype=bool)
        flags.setflags(write=False)  # kept
        return flags

    @property
    def in_table(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns that are entries of the MDH table."""
        return self._flags(self.scanner, len(self.table))

    @property
    def in_terms(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns that are coefficients of joint terms."""
        return self._flags(self.scanner + len(self.table), len(self.terms))

    @property
    def in_sag(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns that are compliances of joints."""
        flags = self.in_terms
        flags[flags] = [term.kind == "sag" for term in self.terms]
        return flags

    @property
    def in_reflectors(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns that are offsets of reflectors."""
        return self._flags(self.scanner + len(self.table) + len(self.terms), 3 * len(self.reflectors))

    @property
    def in_fixtures(self) -> NDArray[np.bool_]:
        """Flags (K,) of the unknowns that are places of fixtures."""
        return self._flags(len(self) - self.base - 3 * len(self.fixtures), 3 * len(self.fixtures))

    def _flags(self, first: int, count: int) -> NDArray[np.bool_]:
        flags = np.zeros(len(self), dtype=bool)
        flags[first : first + count] = True
        return flags

    def __len__(self) -> int:
        inner = len(self.table) + len(self.terms) + 3 * len(self.reflectors) + 3 * len(self.fixtures)
        return self.scanner + inner + self.base


def entry_name(entry: int) -> str:
    """Name of an entry of the flattened MDH table: 0 is ``alpha1_rad``, 12 is ``d3_mm``."""
    quantity, unit = PARAMETERS[entry % 5].split("_")
    return f"{quantity}{entry // 5 + 1}_{unit}"


def table_entries(arm: MdhArm, names: Sequence[str] | None = None) -> tuple[int, ...]:
    """Entries of the flattened MDH table to estimate: those named, or the usual ones.

    The usual ones are alpha, a, d and theta of every joint, and Hayati's beta where an axis is nominally parallel to
    the one before it (behind the first joint): there, and only there, the other four do not suffice.

    Raises:
        InputError: a name that is no entry of this arm's table.
    """
    if names is None:
        parallel = np.abs(np.sin(arm.table[:, 0])) < 0.02
        return tuple(i for i in range(5 * arm.n) if i % 5 < 4 or (i >= 5 and parallel[i // 5]))
    known = {entry_name(i): i for i in range(5 * arm.n)}
    wrong = [name for name in names if name not in known]
    if wrong:
        near = get_close_matches(wrong[0], known, 1)
        hint = f"; {near[0]} may be meant" if near else ""
        raise InputError(f"{wrong[0]!r} is no entry of this arm's table{hint}; its entries are {', '.join(known)}")
    return tuple(sorted({known[name] for name in names}))


def unknowns_for(measurements: Measurements, table: tuple[int, ...], base_fixed: bool) -> Unknowns:
    """What these measurements leave open, with the entries ``table`` of the MDH table.

    A point that never moves in the last joint's frame has a place, but no rotation; with several reflectors on the tool
    each has its own place. Where no row was tracked, the base is the frame of all that is touched.
    """
    scanner = 0 if measurements.reflectors and measurements.on_tool else 3 if measurements.on_tool else 6
    base = 6 if measurements.tracked.any() and not base_fixed else 0
    return Unknowns(scanner, table, base, reflectors=measurements.reflectors, fixtures=measurements.fixtures)
