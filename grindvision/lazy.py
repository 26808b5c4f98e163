"""Names of a package that are fetched from their modules when first used, and old names that warn for one version."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


def lazy_names(
    package: str, homes: Mapping[str, Sequence[str]], renamed: Mapping[str, str] | None = None
) -> tuple[list[str], Callable[[str], Any]]:
    """``__all__`` and ``__getattr__`` of ``package``: ``homes`` lists the names by the module they are fetched from,
    and ``name as other`` where they are called otherwise here.

    ``renamed`` gives the new name of an old one, or ``new=module:name`` where something else stands in for the old one
    because the arguments have changed. Old names work, are not listed, and raise a ``DeprecationWarning``.
    """
    home_of = {}
    for module, names in homes.items():
        for entry in names:
            there, _, here = entry.partition(" as ")
            home_of[here or there] = module, there
    old = dict(renamed or {})

    def get(name: str) -> Any:
        if name in home_of:
            module, there = home_of[name]
            return getattr(import_module(f"{package}.{module}"), there)
        if name in old:
            new, _, stand_in = old[name].partition("=")
            warnings.warn(
                f"{package}.{name} is now {new}; the old name goes with the next version",
                DeprecationWarning,
                stacklevel=2,
            )
            module, _, there = stand_in.partition(":")
            return getattr(import_module(f"{package}.{module}"), there) if stand_in else _of(package, new)
        raise AttributeError(f"module {package} has no {name}")

    return sorted(home_of), get


def _of(package: str, name: str) -> Any:
    return getattr(import_module(package), name)


def renamed_property(old: str, new: str) -> property:
    """A property that is called otherwise now: it works and raises a ``DeprecationWarning``."""

    def get(self: object) -> Any:
        warnings.warn(
            f"{type(self).__name__}.{old} is now {new}; the old name goes with the next version",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(self, new)

    return property(get, doc=f"Old name of ``{new}``.")


def renamed_fields(**new_names: str) -> Callable[[Class], Class]:
    """A dataclass whose fields were called ``old=new`` before: old keywords and attributes work and raise a
    ``DeprecationWarning``."""

    def decorate(cls: Class) -> Class:
        init = cls.__init__  # type: ignore[misc]

        @wraps(init)
        def accept(self: object, *values: Any, **named: Any) -> None:
            for old in new_names.keys() & named.keys():
                new = new_names[old]
                warnings.warn(
                    f"{cls.__name__}({old}=) is now {new}=; the old name goes with the next version",
                    DeprecationWarning,
                    stacklevel=2,
                )
                named[new] = named.pop(old)
            init(self, *values, **named)

        cls.__init__ = accept  # type: ignore[misc]
        cls.old_fields = frozenset(new_names)  # type: ignore[attr-defined]
        for old, new in new_names.items():
            setattr(cls, old, renamed_property(old, new))
        return cls

    return decorate
