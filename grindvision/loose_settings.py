"""Settings that were given one by one and now stand in an options class: the old way works one more version."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import Any, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def settings_in(
    options: type, data: int, old_order: tuple[str, ...] = ()
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Decorate a function whose ``options`` follow ``data`` arguments.

    Keyword arguments that are fields of ``options``, and further positional ones by ``old_order``, are put into one,
    with a ``DeprecationWarning``.
    """
    names = {one.name for one in fields(options)} | getattr(options, "old_fields", frozenset())

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Result:
            loose = {name: kwargs.pop(name) for name in list(kwargs) if name in names}
            further = args[data:]
            if further and not (isinstance(further[0], options) or (further[0] is None and len(further) == 1)):
                if len(further) > len(old_order):
                    raise TypeError(f"{function.__name__} takes {data} arguments and {options.__name__}")
                args, loose = args[:data], {**dict(zip(old_order, further, strict=False)), **loose}
            if loose:
                given = ", ".join(loose)
                warnings.warn(
                    f"{function.__name__} takes {given} in {options.__name__}({given.split(', ')[0]}=...) now; single"
                    " arguments go with the next version",
                    DeprecationWarning,
                    stacklevel=2,
                )
                kwargs["options"] = options(**loose)
            return function(*args, **kwargs)

        return call

    return decorate
