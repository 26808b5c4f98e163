"""Which rows that a fit left out belong together, and that single slips do not."""

import numpy as np
import pytest

from grindvision.calibration import Measurements
from grindvision.calibration.dropped import dropped_groups


def rows_of(q_rad, pose=None, sphere=None):
    """Measurements of which only joint angles and labels count here."""
    zeros = np.zeros((len(q_rad), 3))
    return Measurements(q_rad, zeros, zeros, pose=pose, sphere=sphere)


@pytest.fixture
def scattered(rng):
    """60 rows over the whole range of four joints, in no order."""
    return rows_of(rng.uniform(-1.5, 1.5, (60, 4)))


def test_every_pose_beyond_an_angle_is_a_sweep(scattered):
    angle = scattered.q_rad[:, 2]
    groups = dropped_groups(scattered, kept=angle < 0.5)
    assert groups[0].is_sweep
    assert groups[0].rows == (angle >= 0.5).sum()
    assert groups[0].what == f"every pose with q3 from {np.degrees(angle[angle >= 0.5].min()):.0f} to " + (
        f"{np.degrees(angle.max()):.0f} deg"
    )


def test_a_joint_swept_alone_is_named_by_its_rest():
    q = np.zeros((60, 4))
    q[:20, 0], q[20:40, 1], q[40:, 3] = (np.linspace(-1, 1, 20) for _ in range(3))
    moved = np.abs(q[:, 1]) > 0.1
    group = dropped_groups(rows_of(q), kept=~moved)[0]
    assert (group.what, group.is_sweep) == ("every pose in which joint 2 moves away from its rest", True)
    assert group.rows == moved.sum()


def test_a_stretch_of_the_session_is_no_sweep(scattered):
    rows = np.arange(60)
    (group,) = dropped_groups(scattered, kept=(rows < 45))
    assert (group.what, group.rows, group.is_sweep) == ("rows 46 to 60 of the training rows", 15, False)


@pytest.mark.parametrize("label", ["pose", "sphere"])
def test_a_whole_pose_or_sphere_is_named(rng, label):
    others = "sphere" if label == "pose" else "pose"
    names = np.repeat([f"n{i}" for i in range(12)], 5)
    training = rows_of(rng.uniform(-1.5, 1.5, (60, 4)), **{label: names, others: np.tile(list("abcde"), 12)})
    (group,) = dropped_groups(training, kept=~np.isin(names, ["n3", "n8"]))
    assert (group.what, group.rows, group.is_sweep) == (f"all rows of {label}s n3, n8", 10, False)


def test_single_slips_are_no_group(scattered):
    kept = np.ones(60, dtype=bool)
    kept[[3, 30, 47]] = False
    assert dropped_groups(scattered, kept) == ()
    kept[:] = True
    assert dropped_groups(scattered, kept) == ()
