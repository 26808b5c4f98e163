"""How to calibrate: the settings of ``calibrate``."""

from __future__ import annotations

from dataclasses import dataclass

from grindvision.calibration.joint_terms import DOWN, GravityLoad
from grindvision.errors import InputError


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    ``base_fixed``: the tracker already measures in the arm's base frame. ``free``: entries of the MDH table to
    estimate, by name (``d3_mm``), instead of the usual ones. ``length_prior_mm`` and ``angle_prior_rad``: how far the
    table may deviate (standard deviation); learnt from the data where left out. ``robust``: drop rows that contradict
    the others and name them. ``worst_std``: a combination known worse than this many millimetres counts as unknown.
    ``beyond_geometry``: look for gear waves, sag and couplings, and keep what lowers the error of held-out poses;
    ``gear_ratios`` (n,), where given, add one wave a turn of every motor. ``down``: direction of gravity in the base.
    ``load``: masses that the joints may sag under; left out, links of the same weight a length.
    ``diagnose``: look for structure in the residuals.
    ``variant``: ``ours``, or ``paper`` for Eqs 9-18 as printed: one linear step, every row with the same weight, no
    priors, generalised inverse with relative ``tolerance`` on the singular values in mm and rad as they come.
    ``seed`` of the random subsets that are tried as starts, and of the poses that are held out together.
    """

    base_fixed: bool = False
    free: tuple[str, ...] | None = None
    length_prior_mm: float | None = None
    angle_prior_rad: float | None = None
    robust: bool = True
    worst_std: float = 10.0
    beyond_geometry: bool = False
    gear_ratios: tuple[float, ...] = ()
    down: tuple[float, float, float] = DOWN
    load: GravityLoad | None = None
    diagnose: bool = True
    variant: str = "ours"
    tolerance: float = 1e-6
    seed: int = 0

    def __post_init__(self) -> None:
        if self.variant not in ("ours", "paper"):
            raise InputError(f"variant {self.variant!r}; choose ours or paper")
        for name in ("length_prior_mm", "angle_prior_rad", "worst_std", "tolerance"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name} is {value}; it must be above zero")
