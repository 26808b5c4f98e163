import importlib
import warnings

import pytest

FACES = ["geometry", "arm", "calibration", "cell", "vision", "motion", "paper"]


@pytest.mark.parametrize("face", FACES)
def test_every_name_of_a_face_is_there(face):
    module = importlib.import_module(f"grindvision.{face}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(getattr(module, name) is not None for name in module.__all__)


@pytest.mark.parametrize(("face", "old", "new"), [("geometry", "turn_vectors", "rotate_vectors")])
def test_an_old_name_works_and_warns(face, old, new):
    module = importlib.import_module(f"grindvision.{face}")
    with pytest.warns(DeprecationWarning, match=new):
        assert getattr(module, old) is getattr(module, new)
    assert old not in module.__all__


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match="no_such_name"):
        importlib.import_module("grindvision.vision").no_such_name  # noqa: B018
