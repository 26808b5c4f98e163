"""Kinds of weld joints by their names, after ISO 2553 and ISO 6947, and the families that can be asked for."""

from __future__ import annotations

from grindvision.errors import InputError

V_GROOVE, U_GROOVE, BEVEL = "v-groove", "u-groove", "bevel-groove"
BUTT, T_JOINT, LAP = "butt-gap", "t-joint", "lap-joint"
INSIDE, OUTSIDE = "inside-corner", "outside-corner"
TUBE_ON_PLATE, SADDLE = "tube-on-plate", "saddle"

KINDS = (V_GROOVE, U_GROOVE, BEVEL, BUTT, T_JOINT, LAP, INSIDE, OUTSIDE, TUBE_ON_PLATE, SADDLE)

#: Names that stand for several kinds.
FAMILIES = {
    "any": KINDS,
    "groove": (V_GROOVE, U_GROOVE, BEVEL),
    "butt": (BUTT,),
    "fillet": (T_JOINT, LAP, INSIDE, TUBE_ON_PLATE, SADDLE),
    "corner": (INSIDE, OUTSIDE),
    "tube": (TUBE_ON_PLATE, SADDLE),
}


def kinds_of(joint: str) -> tuple[str, ...]:
    """The kinds that a name stands for: itself, or those of its family.

    Raises:
        InputError: an unknown name.
    """
    if joint in FAMILIES:
        return FAMILIES[joint]
    if joint in KINDS:
        return (joint,)
    raise InputError(f"joint {joint!r} is unknown; choose one of {', '.join((*FAMILIES, *KINDS))}")
