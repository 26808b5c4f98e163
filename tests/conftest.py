"""Settings of the whole test run: one thread per numerical library, no display, and where real data may be found."""

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20180913)


@pytest.fixture(scope="session")
def real_data():
    """Path of a file of real measured data, or a skip with the reason where it is absent."""
    folder = Path(os.environ.get("GRINDVISION_REAL", ROOT.parent / "shared" / "real"))

    def find(name: str) -> Path:
        path = folder / name
        if not path.exists():
            pytest.skip(f"real data set {name} is not part of the project; set GRINDVISION_REAL to its folder")
        return path

    return find
