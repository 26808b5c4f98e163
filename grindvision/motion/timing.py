"""When to be where: the fastest run that keeps the joints' limits and never outruns the tool's speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import DegenerateError, InputError
from grindvision.extras import extra
from grindvision.lazy import renamed_property
from grindvision.motion.follow import JointPath
from grindvision.motion.robot import JointLimits
from grindvision.records import by_content

with extra("robot"):
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

Floats = NDArray[np.float64]

#: The tool's own acceleration along the seam at start and end, mm/s^2.
TOOL_ACCELERATION = 100.0

#: Paths of more places than this, as weaves have, get a coarser grid between them.
MANY_PLACES = 400

#: Fraction of a joint's limits the time law uses; what is kept back covers the path between two points of its grid.
_USED = 0.99


@by_content
@dataclass(frozen=True)
class TimeLaw:
    """A timed run along a joint path, sampled at M even instants.

    ``time_s`` (M,), joint angles, speeds and accelerations (M, n) in rad, rad/s, rad/s^2; ``arc_mm`` and
    ``tool_speed_mm_s`` (M,) along the way points' polygon; ``waypoint_time_s`` (N,) when each worked pose is passed.
    """

    time_s: Floats
    q_rad: Floats
    speed_rad_s: Floats
    acceleration_rad_s2: Floats
    arc_mm: Floats
    tool_speed_mm_s: Floats
    waypoint_time_s: Floats
    asked_speed_mm_s: float

    @property
    def steady_fraction(self) -> float:
        """Fraction of the seam's length run within 1 % of the speed asked for; the rest starts, brakes or bends."""
        steady = self.tool_speed_mm_s >= 0.99 * self.asked_speed_mm_s
        return float(np.sum(np.diff(self.arc_mm)[steady[1:] & steady[:-1]]) / self.arc_mm[-1])

    steady_share = renamed_property("steady_share", "steady_fraction")

    def __str__(self) -> str:
        return (
            f"{self.time_s[-1]:.1f} s for {self.arc_mm[-1]:.1f} mm, {100 * self.steady_fraction:.1f} % of it at"
            f" {self.asked_speed_mm_s:g} mm/s"
        )


def time_law(
    path: JointPath,
    limits: JointLimits,
    tool_speed_mm_s: float,
    samples: int = 1001,
    *,
    tool_acceleration_mm_s2: float = TOOL_ACCELERATION,
) -> TimeLaw:
    """Time along a joint path: at ``tool_speed_mm_s`` where the joints allow, slower where one would break its limit.

    The joints run on a cubic spline over the seam's arc length. The arc length itself rides along as one more joint
    whose speed limit is the tool's, so one time-optimal problem (TOPP-RA) covers both.

    Raises:
        InputError: the speed is not above zero, fewer than two samples. DegenerateError: no time law exists.
    """
    if not (np.isfinite(tool_speed_mm_s) and tool_speed_mm_s > 0):
        raise InputError(f"the tool's speed is {tool_speed_mm_s:.4g} mm/s; give a number above 0")
    if samples < 2:
        raise InputError(f"samples is {samples}; at least two are needed")
    arc = path.trajectory.arc_mm
    # The spline bends most at its knots: the grid has every one of them, and as many points in between as it takes.
    per_gap = max(20, 400 // len(arc)) if len(arc) <= MANY_PLACES else 6
    grid = np.interp(np.linspace(0, len(arc) - 1, per_gap * (len(arc) - 1) + 1), np.arange(len(arc)), arc)
    for unit_mm in (1.0, 100.0):  # far from the joints' numbers in size, an arc length in mm can defeat the solver
        speed = np.append(_USED * limits.speed_rad_s, tool_speed_mm_s / unit_mm)
        acceleration = np.append(_USED * limits.acceleration_rad_s2, tool_acceleration_mm_s2 / unit_mm)
        solver = TOPPRA(
            [
                JointVelocityConstraint(np.column_stack([-speed, speed])),
                JointAccelerationConstraint(np.column_stack([-acceleration, acceleration])),
            ],
            toppra.SplineInterpolator(arc / unit_mm, np.column_stack([path.q_rad, arc / unit_mm])),
            gridpoints=grid / unit_mm,
            parametrizer="ParametrizeConstAccel",
        )
        run = solver.compute_trajectory(0, 0)
        if run is not None:
            break
    if run is None:
        raise DegenerateError("no time law keeps the joints' limits along this path; check the limits of acceleration")
    time = np.linspace(0.0, run.duration, samples)
    place, velocity, rate = run(time), run(time, 1), run(time, 2)
    along_mm = unit_mm * place[:, -1]
    arrival = np.interp(arc, along_mm, time)
    return TimeLaw(
        time,
        place[:, :-1],
        velocity[:, :-1],
        rate[:, :-1],
        along_mm,
        unit_mm * velocity[:, -1],
        arrival,
        float(tool_speed_mm_s),
    )
