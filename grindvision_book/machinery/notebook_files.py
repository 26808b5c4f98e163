"""``nbformat``, loaded in a seventh of the time: without a grammar that no check of a notebook asks for.

``jsonschema``, which ``nbformat`` checks notebooks with, loads ``rfc3987_syntax`` where it is installed (JupyterLab
wants it): that builds a parser of international addresses for a second, in every process that reads a notebook. The
schema of notebooks has no such addresses. Import it before other packages that read notebooks.

A pytest plugin too, which does nothing but be loaded before those that read notebooks.
"""

from __future__ import annotations

import sys

_GRAMMAR = "rfc3987_syntax"

if "jsonschema" not in sys.modules and _GRAMMAR not in sys.modules:
    sys.modules[_GRAMMAR] = None  # type: ignore[assignment]  # Python's own way to say that there is none
    try:
        import jsonschema  # noqa: F401
    finally:
        del sys.modules[_GRAMMAR]

import nbformat  # noqa: E402

__all__ = ["nbformat"]
