import doctest
import importlib
import warnings

import pytest

FACES = ["", "geometry", "arm", "calibration", "cell", "vision", "motion", "paper"]


@pytest.mark.parametrize("face", FACES)
def test_every_name_of_a_face_is_there(face):
    module = importlib.import_module(f"grindvision.{face}".rstrip("."))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(getattr(module, name) is not None for name in module.__all__)


@pytest.mark.parametrize(("face", "old", "new"), [("geometry", "turn_vectors", "rotate_vectors")])
def test_an_old_name_works_and_warns(face, old, new):
    module = importlib.import_module(f"grindvision.{face}")
    with pytest.warns(DeprecationWarning, match=new):
        assert getattr(module, old) is getattr(module, new)
    assert old not in module.__all__


@pytest.mark.parametrize(
    ("old", "new"), [("find_difference", "find_change"), ("difference_paper", "find_change_paper")]
)
def test_an_old_function_keeps_its_old_order_and_warns(old, new, rng):
    vision = importlib.import_module("grindvision.vision")
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"):
        function = getattr(vision, old)
    if old == "difference_paper":
        sample, test_in_sample = rng.normal(size=(40, 3)), rng.normal(size=(30, 3))
        kept = vision.find_change_paper(test_in_sample, sample, 0.5)
        assert (function(sample, test_in_sample, 0.5) == kept).all() and len(kept) == 30


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match="no_such_name"):
        importlib.import_module("grindvision.vision").no_such_name  # noqa: B018


def test_the_front_door_is_fetched_late_and_is_the_rooms_own():
    import grindvision
    from grindvision import calibration, vision

    assert grindvision.detect is vision.detect
    assert grindvision.CalibrateOptions is calibration.Options
    assert 25 <= len(grindvision.__all__) <= 35


def test_the_example_of_register_runs():
    import grindvision

    finder = doctest.DocTestFinder()
    (example,) = (one for one in finder.find(grindvision.register, "register") if one.examples)
    assert doctest.DocTestRunner().run(example).failed == 0
