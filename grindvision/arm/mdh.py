"""Modified Denavit-Hartenberg tables with Hayati's tilt: ``Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d)``.

Craig's convention: row i holds alpha_{i-1}, a_{i-1}, d_i, theta_i. The tilt beta stands before the joint turns, where
two nominally parallel axes need it; behind the joint it would only mimic the next theta. A prismatic joint adds its
coordinate, in mm, to d instead: ``Rx(alpha) Tx(a) Ry(beta) Rz(theta) Tz(d + q)``.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import FileError, GrindvisionWarning, InputError, UnitError
from grindvision.files import column_names, read_table, write_text
from grindvision.records import by_content

Floats = NDArray[np.float64]

#: The five parameters of a joint, in the order of every parameter vector, table and Jacobian.
PARAMETERS = ("alpha_rad", "a_mm", "d_mm", "theta_rad", "beta_rad")

#: Lengths of all links of an arm that is made: outside, the table is in another unit.
SHORTEST_MM, LONGEST_MM = 20.0, 50_000.0

#: Optional columns of a robot CSV: limits and speed of every joint (mm and mm/s at a prismatic joint).
LIMITS = ("lower_rad", "upper_rad", "speed_rad_s")

REVOLUTE, PRISMATIC = "revolute", "prismatic"


@by_content
@dataclass(frozen=True)
class MdhArm:
    """A serial arm of revolute joints, some of which may be prismatic.

    ``table`` (n, 5): one row per joint, columns as ``PARAMETERS``; ``theta_rad`` is added to the joint angle, ``d_mm``
    to the coordinate of a prismatic joint. ``joints`` names the rows, ``prismatic`` (n flags; left out: none) says
    which slide. ``limits`` (n, 3), where known: lower, upper and speed as ``LIMITS``. Arrays are read-only;
    ``with_table`` and ``changed_by`` make a new arm.
    """

    table: Floats
    joints: tuple[str, ...]
    prismatic: tuple[bool, ...] = ()
    limits: Floats | None = None

    def __post_init__(self) -> None:
        table = np.array(self.table, dtype=float)
        if table.ndim != 2 or table.shape[1] != 5 or len(table) == 0:
            raise InputError(f"an MDH table has shape (joints, 5), got {table.shape}")
        if not np.isfinite(table).all():
            raise InputError("the MDH table holds NaN or infinity")
        if len(self.joints) != len(table):
            raise InputError(f"{len(self.joints)} joint names for {len(table)} rows")
        angles = np.abs(table[:, [0, 3, 4]])
        if angles.max() > 2 * np.pi + 1e-9:
            raise UnitError(f"an angle of {angles.max():.4g} in the MDH table looks like degrees; give radians")
        table.setflags(write=False)
        object.__setattr__(self, "table", table)
        prismatic = tuple(bool(flag) for flag in self.prismatic) or (False,) * len(table)
        if len(prismatic) != len(table):
            raise InputError(f"{len(prismatic)} flags of prismatic joints for {len(table)} rows")
        object.__setattr__(self, "prismatic", prismatic)
        if self.limits is not None:
            limits = np.array(self.limits, dtype=float)
            if limits.shape != (len(table), 3):
                raise InputError(f"joint limits have shape {limits.shape}; {(len(table), 3)} needed")
            limits.setflags(write=False)
            object.__setattr__(self, "limits", limits)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.table)

    def with_table(self, table: ArrayLike) -> MdhArm:
        """Return the same joints with another table (n, 5)."""
        return replace(self, table=np.asarray(table, dtype=float))

    def changed_by(self, delta: ArrayLike) -> MdhArm:
        """Return the arm with ``delta`` (n, 5) or (5 n,), row by row, added to its table."""
        return self.with_table(self.table + np.reshape(np.asarray(delta, dtype=float), self.table.shape))

    def first(self, joints: int) -> MdhArm:
        """Return the arm that ends at joint number ``joints`` (1 is the first)."""
        if not 1 <= joints <= self.n:
            raise InputError(f"joint {joints} asked for; the arm has joints 1 to {self.n}")
        limits = None if self.limits is None else self.limits[:joints]
        return MdhArm(self.table[:joints], self.joints[:joints], self.prismatic[:joints], limits)

    def __str__(self) -> str:
        kinds = f"{self.n - sum(self.prismatic)} revolute" + (
            f" and {sum(self.prismatic)} prismatic" if any(self.prismatic) else ""
        )
        return f"arm of {kinds} joints, links {np.hypot(self.table[:, 1], self.table[:, 2]).sum():.1f} mm in all"


def read_arm(path: str | Path) -> MdhArm:
    """Read a robot CSV: ``joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad``, one row per joint from the base.

    Angles may be given in degrees (``alpha_deg``) and lengths in metres (``a_m``). Left out, ``beta`` is zero and the
    joints are J1, J2, ... A column ``type`` says revolute or prismatic (left out: revolute); columns ``lower_rad``,
    ``upper_rad`` and ``speed_rad_s`` hold limits. The links of an arm of up to three joints may have no length at all:
    a positioner whose axes meet.

    Args:
        path: file.

    Returns:
        The arm, its table (n, 5) in mm and rad.

    Raises:
        FileError: missing, damaged, a column missing, text where a number belongs. UnitError: degrees among radians,
            or metres among millimetres.

    Example:
        >>> from pathlib import Path
        >>> from grindvision import read_arm
        >>> rows = "joint,alpha_deg,a_mm,d_mm,theta_deg", "J1,0,0,320,0", "J2,-90,50,0,-90", "J3,0,270,0,0"
        >>> _ = Path("robot.csv").write_text("\\n".join(rows))
        >>> print(read_arm("robot.csv"))
        arm of 3 revolute joints, links 640.0 mm in all
    """
    names = column_names(path)
    tilted = bool({"beta_rad", "beta_deg"} & set(names))
    limited = all({name, name.replace("_rad", "_deg")} & set(names) for name in LIMITS[:2]) and LIMITS[2] in names
    table = read_table(
        path,
        (*(PARAMETERS if tilted else PARAMETERS[:4]), *(LIMITS if limited else ())),
        texts=tuple(name for name in ("joint", "type") if name in names),
    )
    numbers = table.reindex(columns=list(PARAMETERS), fill_value=0.0).to_numpy(dtype=float)
    joints = table["joint"] if "joint" in names else [f"J{row}" for row in range(1, len(table) + 1)]
    kinds = [str(kind).strip().lower() for kind in table["type"]] if "type" in names else [REVOLUTE] * len(table)
    odd = next((row for row, kind in enumerate(kinds) if kind not in (REVOLUTE, PRISMATIC)), None)
    if odd is not None:
        raise FileError(f"{path}: row {odd + 1}, column type: {kinds[odd]!r}; write {REVOLUTE} or {PRISMATIC}")
    try:
        arm = MdhArm(
            numbers,
            tuple(str(name) for name in joints),
            tuple(kind == PRISMATIC for kind in kinds),
            table[list(LIMITS)].to_numpy(dtype=float) if limited else None,
        )
    except UnitError as error:
        raise UnitError(f"{path}: {error}") from None
    reach = float(np.abs(arm.table[:, 1:3]).sum())
    if SHORTEST_MM < reach < LONGEST_MM:
        return arm
    small = f"{path}: the links add up to {reach:.4g} mm"
    if reach > SHORTEST_MM or arm.n > 3:
        raise UnitError(f"{small}, which is no arm; give a and d in mm, or name them a_m and d_m")
    if reach > 0.1:
        warnings.warn(
            f"{small}, as of a positioner whose axes nearly meet; if these are metres, name them a_m and d_m",
            GrindvisionWarning,
            stacklevel=2,
        )
    return arm


def write_arm(arm: MdhArm, path: str | Path) -> None:
    """Write the robot CSV that ``read_arm`` reads, every number to full precision."""
    columns: list[tuple[str, list[str]]] = [("joint", list(arm.joints))]
    columns += [(name, [repr(float(v)) for v in values]) for name, values in zip(PARAMETERS, arm.table.T, strict=True)]
    if any(arm.prismatic):
        columns.append(("type", [PRISMATIC if flag else REVOLUTE for flag in arm.prismatic]))
    if arm.limits is not None:
        columns += [(name, [repr(float(v)) for v in values]) for name, values in zip(LIMITS, arm.limits.T, strict=True)]
    lines = [",".join(row) for row in zip(*(values for _, values in columns), strict=True)]
    write_text(path, "\n".join((",".join(name for name, _ in columns), *lines)) + "\n")


def link_transforms(arm: MdhArm, q_rad: ArrayLike) -> Floats:
    """Transforms T_{i-1}_i of every link (..., n, 4, 4) at joint angles (..., n)."""
    q = check_angles(arm, q_rad)
    alpha, a, d, theta, beta = arm.table.T
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    slides = np.array(arm.prismatic)
    if slides.any():
        d = d + np.where(slides, q, 0.0)
        q = np.where(slides, 0.0, q)
    ct, st = np.cos(q + theta), np.sin(q + theta)
    links = np.zeros((*q.shape, 4, 4))
    links[..., 0, 0], links[..., 0, 1], links[..., 0, 2] = cb * ct, -cb * st, sb
    links[..., 1, 0], links[..., 1, 1], links[..., 1, 2] = ca * st + sa * sb * ct, ca * ct - sa * sb * st, -sa * cb
    links[..., 2, 0], links[..., 2, 1], links[..., 2, 2] = sa * st - ca * sb * ct, sa * ct + ca * sb * st, ca * cb
    links[..., 0, 3] = a + d * sb
    links[..., 1, 3] = -d * sa * cb
    links[..., 2, 3] = d * ca * cb
    links[..., 3, 3] = 1.0
    return links


def joint_transforms(arm: MdhArm, q_rad: ArrayLike) -> Floats:
    """Transforms T_base_i of the base (identity) and of every joint frame, (..., n + 1, 4, 4)."""
    links = link_transforms(arm, q_rad)
    chain = [np.broadcast_to(np.eye(4), (*links.shape[:-3], 4, 4)), links[..., 0, :, :]]
    for i in range(1, arm.n):
        chain.append(chain[-1] @ links[..., i, :, :])
    return np.stack(chain, axis=-3)


def forward(arm: MdhArm, q_rad: ArrayLike) -> Floats:
    """Transform T_base_joint (..., 4, 4) of the last joint frame at joint angles (..., n), Eq 7 of the first paper."""
    return joint_transforms(arm, q_rad)[..., -1, :, :]


def check_angles(arm: MdhArm, q_rad: ArrayLike) -> Floats:
    """Return joint angles, rad (mm where the joint is prismatic), as floats (..., n).

    Raises:
        InputError: not n angles per pose, or NaN.
    """
    q = np.asarray(q_rad, dtype=float)
    if q.ndim == 0 or q.shape[-1] != arm.n:
        raise InputError(f"joint angles have shape {q.shape}; this arm needs (..., {arm.n})")
    if not np.isfinite(q).all():
        raise InputError("joint angles hold NaN or infinity")
    return q
