"""A calibrated arm in the forms that controllers take: standard DH, UR deltas, joint zero offsets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.arm.mdh import MdhArm, joint_transforms
from grindvision.files import write_text

Floats = NDArray[np.float64]

#: Signs and places of the twists (deg) by which an arm of Universal Robots is known, standard DH.
UR_TWISTS_DEG = (90.0, 0.0, 0.0, 90.0, -90.0, 0.0)


def standard_table(arm: MdhArm) -> Floats:
    """The arm as a standard (distal) DH table (n + 1, 5): theta, d, a, alpha, beta a row, the base's fixed row first.

    Row i is ``Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)``; row 0, with theta and d zero, leads to joint 1. The
    product is that of the modified table to the last digit: alpha, a and beta only move one row up.
    """
    alpha, a, d, theta, beta = arm.table.T
    zero = [0.0]
    return np.column_stack(
        [
            np.concatenate([zero, theta]),
            np.concatenate([zero, d]),
            np.concatenate([a, zero]),
            np.concatenate([alpha, zero]),
            np.concatenate([beta, zero]),
        ]
    )


def write_standard_table(arm: MdhArm, path: str | Path) -> None:
    """Write ``standard_table`` as CSV, with how to read it in a comment."""
    lines = [
        "# standard (distal) DH with Hayati's tilt: Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta), row base first",
        "joint,theta_rad,d_mm,a_mm,alpha_rad,beta_rad",
    ]
    for name, row in zip(("base", *arm.joints), standard_table(arm), strict=True):
        lines.append(",".join([name, *(repr(float(value)) for value in row)]))
    write_text(path, "\n".join(lines) + "\n")


def common_normal_table(arm: MdhArm) -> Floats:
    """Standard DH table (n, 4) by common normals, theta, d, a, alpha a row, without any tilt.

    Nearly parallel axes meet far away then: d of their joints grows large and cancels, as controllers that know no tilt
    have it (Universal Robots). Exactly parallel axes keep the place of the modified table. The first frame lies on
    joint 1's axis where the base is nearest, the last one where the modified table has it.
    """
    frames = joint_transforms(arm, np.zeros(arm.n))
    axes, points, hints = frames[1:, :3, 2], frames[1:, :3, 3], frames[1:, :3, 0]
    z, x, origin = axes[0], _across(frames[0, :3, 0], axes[0]), points[0] - axes[0] * (points[0] @ axes[0])
    rows = []
    for joint in range(arm.n):
        if joint + 1 < arm.n:
            start, end, new_x = _common_normal(z, origin, axes[joint + 1], points[joint + 1], hints[joint])
            new_z = axes[joint + 1]
        else:
            start, new_x, new_z = points[joint], hints[joint], z
            start = origin + z * ((points[joint] - origin) @ z)
            end = start
        theta = np.arctan2(np.cross(x, new_x) @ z, x @ new_x)
        alpha = np.arctan2(np.cross(z, new_z) @ new_x, z @ new_z)
        rows.append([theta, (start - origin) @ z, (end - start) @ new_x, alpha])
        z, x, origin = new_z, new_x, end
    return np.array(rows)


def ur_deltas_text(nominal: MdhArm, arm: MdhArm) -> str:
    """Text of a UR controller's ``calibration.conf`` with the deltas of an arm from its nominal table, metres and rad.

    Empty where the nominal table is not that of a six-joint arm of Universal Robots.
    """
    if nominal.n != 6 or any(nominal.prismatic):
        return ""
    wanted = common_normal_table(nominal)
    twists = np.degrees(wanted[:, 3])
    if not np.allclose(twists, UR_TWISTS_DEG, atol=0.5) or not (wanted[1:3, 2] < -100).all():
        return ""
    change = common_normal_table(arm) - wanted
    change[:, 0] = (change[:, 0] + np.pi) % (2 * np.pi) - np.pi
    lines = [
        "# deltas to the nominal standard DH table; joint 1's zero and joint 6's end belong to base and tool",
        "[mounting]",
    ]
    for name, column, factor in (("theta", 0, 1.0), ("a", 2, 1e-3), ("d", 1, 1e-3), ("alpha", 3, 1.0)):
        values = ", ".join(f"{value:.12g}" for value in factor * change[:, column])
        lines.append(f"delta_{name} = [ {values} ]")
    return "\n".join(lines) + "\n"


def write_zero_offsets(
    joints: tuple[str, ...], prismatic: tuple[bool, ...], change: ArrayLike, known: ArrayLike, path: str | Path
) -> None:
    """Write what to add to each joint's reading (n,), rad or mm, in degrees or mm, with both signs.

    ABB asks for calibration offsets of the motors' zero (``add``), KUKA and FANUC for what the display is wrong by when
    the arm stands at its zero (``subtract``): the same number with the other sign. A joint whose zero cannot be told is
    left empty.
    """
    lines = [
        "# the joint really stands at its reading plus `add`; enter it, or its negative, as the controller counts",
        "joint,unit,add,subtract,can_be_known",
    ]
    flags = np.asarray(known, dtype=bool)
    for name, slides, value, told in zip(joints, prismatic, np.asarray(change, dtype=float), flags, strict=True):
        shown = value if slides else np.degrees(value)
        numbers = [f"{shown:.6f}", f"{-shown:.6f}"] if told else ["", ""]
        lines.append(",".join([name, "mm" if slides else "deg", *numbers, "yes" if told else "no"]))
    write_text(path, "\n".join(lines) + "\n")


def _across(vector: Floats, axis: Floats) -> Floats:
    flat = vector - axis * (vector @ axis)
    return flat / np.linalg.norm(flat)


def _common_normal(
    z: Floats, origin: Floats, other_z: Floats, other: Floats, hint: Floats
) -> tuple[Floats, Floats, Floats]:
    """Where the common normal leaves an axis, where it meets the other, and its direction, on the side of ``hint``."""
    cross = np.cross(z, other_z)
    if np.linalg.norm(cross) > 1e-9:
        sides = np.column_stack([z, -other_z, cross])
        along, other_along, _ = np.linalg.solve(sides, other - origin)
        start, end, x = origin + along * z, other + other_along * other_z, cross / np.linalg.norm(cross)
    else:
        start = origin
        end = other + other_z * ((origin - other) @ other_z)
        length = np.linalg.norm(end - start)
        x = (end - start) / length if length > 1e-6 else hint
    return start, end, x if x @ hint >= 0 else -x
