"""Learn the depth error of a scanner from scans of a flat plate, and take it off a cloud."""

import numpy as np

from grindvision import CalibrateFieldOptions, calibrate_field

rng = np.random.default_rng(1)
x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-90, 90, 90), np.linspace(-60, 60, 60)))


def scanned(distance_mm):
    """A flat plate as a scanner sees it that bends the field by up to a millimetre, with noise."""
    bent = 1e-4 * (x**2 + y**2) * distance_mm / 420
    return np.column_stack([x, y, distance_mm + bent + 0.02 * rng.standard_normal(len(x))])


steps_mm = [0.0, 15.0, 30.0, 45.0]
plates = [scanned(420.0 + step) for step in steps_mm]
field = calibrate_field(plates, steps_mm, CalibrateFieldOptions(distance_mm=420.0))
print(field)

work = scanned(440.0)
print(
    f"a plate at 440 mm is off flat by {work[:, 2].std():.2f} mm, corrected by {field.apply(work)[:, 2].std():.2f} mm"
)
