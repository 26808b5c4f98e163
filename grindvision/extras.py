"""Packages that not every user needs, and what their absence is reported as."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from grindvision.errors import MissingExtraError


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Imports inside the block belong to the extra ``name`` of this package, as in ``grindvision[robot]``.

    Raises:
        MissingExtraError: one of them is not installed, or cannot be loaded.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or str(error)).partition(".")[0]
        raise MissingExtraError(
            f"this needs {package}, which is not installed; pip install 'grindvision[{name}]'"
        ) from error
    except (ImportError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise MissingExtraError(f"a package of grindvision[{name}] cannot be loaded ({reason}); mend it") from error
