"""Laws of all dataclasses of the package: they compare and hash by what they hold, arrays or not."""

import dataclasses
import importlib
import pkgutil
import re

import numpy as np
import pandas as pd
import pytest

import grindvision
from grindvision.errors import MissingExtraError
from grindvision.records import by_content, content_hash, same

#: Annotations whose values are plain: they compare and hash on their own.
PLAIN = re.compile(r"(int|float|str|bool|None|Path|tuple|type\[\w+\]|np\.dtype|Change|Callable.*|\.\.\.|[\s|,\[\]])*")
ARRAYS = re.compile(
    r"Floats|Integers|Flags|NDArray|ndarray|ArrayLike|Sequence|Any\b|pin\.|DataFrame|Float32|Viewpoints"
)


@by_content
@dataclasses.dataclass(frozen=True)
class Holder:
    """Stands for a nested dataclass with an array in it."""

    numbers: np.ndarray


def classes():
    found = {}
    for module in pkgutil.walk_packages(grindvision.__path__, "grindvision."):
        if module.name.endswith("__main__"):
            continue
        try:
            members = vars(importlib.import_module(module.name)).values()
        except MissingExtraError:
            continue
        for one in members:
            if isinstance(one, type) and dataclasses.is_dataclass(one) and one.__module__ == module.name:
                found[f"{one.__module__}.{one.__qualname__}"] = one
    return found


CLASSES = classes()


def value(annotation, shift):
    text = str(annotation)
    if "dict" in text or "Mapping" in text:
        return {"key": np.array([1.0, np.nan, shift])}
    if "list" in text:
        return [np.array([1.0, np.nan, shift])]
    if ARRAYS.search(text):
        return np.array([1.0, np.nan, -0.0, shift])
    if PLAIN.fullmatch(text):
        return shift
    return Holder(np.array([1.0, np.nan, shift]))


def made(cls, changed=None):
    """An instance made past ``__init__``: every field holds what its annotation allows."""
    instance = object.__new__(cls)
    for field in dataclasses.fields(cls):
        object.__setattr__(instance, field.name, value(field.type, float(field.name == changed)))
    return instance


def test_the_walk_finds_the_package():
    assert len(CLASSES) > 120
    assert {"grindvision.clouds.Cloud", "grindvision.vision.change.detection.Detection"} <= CLASSES.keys()


@pytest.mark.parametrize("name", CLASSES)
def test_equal_is_who_holds_the_same(name):
    cls = CLASSES[name]
    one, other = made(cls), made(cls)
    assert one == one and one != 5 and isinstance(hash(one), int)
    if "__eq__" not in vars(cls):  # eq=False: each is its own
        return
    assert one == other and hash(one) == hash(other)
    assert len({one, other}) == 1
    for field in dataclasses.fields(cls):
        assert (made(cls, field.name) == one) == (not field.compare), field.name


def test_what_two_values_share_is_told():
    numbers = np.array([0.0, 1.0, np.nan])
    assert same(numbers, numbers.copy()) and not same(numbers, numbers[:2]) and not same(numbers, [0.0, 1.0])
    assert same((1, [numbers]), (1, [numbers.copy()])) and not same((1,), [1]) and not same((1,), (1, 2))
    assert same({"a": numbers}, {"a": numbers.copy()}) and not same({"a": 1}, {"b": 1})
    assert same(float("nan"), np.float64("nan")) and not same(0.0, float("nan"))
    assert same(np.array(["a"]), np.array(["a"])) and not same(np.array(["a"]), np.array(["b"]))
    table = pd.DataFrame({"x": numbers})
    assert same(table, table.copy()) and not same(table, table + 1)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (np.array([0.0, 2.0]), np.array([-0.0, 2.0])),
        (np.array([1, 2]), np.array([1.0, 2.0])),
        (np.arange(20.0), np.arange(20)),
        ((1, np.nan), (1.0, float("nan"))),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
        ([pd.DataFrame({"x": [1]})], [pd.DataFrame({"x": [1]})]),
    ],
)
def test_what_is_the_same_has_one_hash(one, other):
    assert same(one, other) and content_hash(one) == content_hash(other)
