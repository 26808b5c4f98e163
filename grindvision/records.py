"""Frozen dataclasses that hold arrays: two of them compare, and one has a hash, by what they hold.

What ``dataclasses`` writes compares tuples of fields, and an array in a tuple has no single truth value and no hash.
"""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any, TypeVar

import numpy as np

Class = TypeVar("Class", bound=type)

#: So many numbers of an array go into the hash; a comparison looks at all of them.
HASHED_NUMBERS = 8


def by_content(cls: Class) -> Class:
    """Decorate a frozen dataclass: equal is who holds equal values, in every field that takes part in a comparison.

    Arrays are equal with equal shape and numbers, NaN to NaN. Equal ones have equal hashes.
    """

    def equal(self: Any, other: object) -> Any:
        if other.__class__ is not self.__class__:
            return NotImplemented
        return all(same(getattr(self, one.name), getattr(other, one.name)) for one in _compared(self))

    def hashed(self: Any) -> int:
        return hash((self.__class__.__qualname__, *(content_hash(getattr(self, one.name)) for one in _compared(self))))

    cls.__eq__ = equal  # type: ignore[assignment]
    cls.__hash__ = hashed  # type: ignore[assignment]
    return cls


def same(one: Any, other: Any) -> bool:
    """Whether two values hold the same: arrays, tuples, lists and dicts item by item, others by their own ``==``."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return isinstance(one, np.ndarray) and isinstance(other, np.ndarray) and _same_arrays(one, other)
    if isinstance(one, (tuple, list)) and isinstance(other, (tuple, list)):
        alike = isinstance(one, list) == isinstance(other, list) and len(one) == len(other)
        return alike and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(value, other[key]) for key, value in one.items())
    if hasattr(one, "equals"):  # a table of pandas
        return bool(one.equals(other))
    return bool(one == other) or (_is_nan(one) and _is_nan(other))


def content_hash(value: Any) -> int:
    """A hash that is equal where ``same`` says so; for what has no hash of its own, that of its class."""
    if isinstance(value, np.ndarray):
        first = value.ravel()[:HASHED_NUMBERS].tolist()
        return hash((value.shape, *map(content_hash, first)))
    if isinstance(value, (tuple, list)):
        return hash(tuple(map(content_hash, value)))
    if isinstance(value, dict):
        return hash(frozenset((key, content_hash(one)) for key, one in value.items()))
    if _is_nan(value):
        return 0
    try:
        return hash(value)
    except TypeError:
        return hash(type(value).__qualname__)


def _compared(record: Any) -> list[Field[Any]]:
    return [one for one in fields(record) if one.compare]


def _same_arrays(one: np.ndarray, other: np.ndarray) -> bool:
    numbers = all(array.dtype.kind in "fc" for array in (one, other))
    return bool(np.array_equal(one, other, equal_nan=numbers))


def _is_nan(value: Any) -> bool:
    return isinstance(value, (float, np.floating)) and bool(value != value)
