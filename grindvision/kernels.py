"""Compiled kernels: numba's ``njit`` with a cache of this package's own.

Numba's cache compiles a kernel anew when the file it stands in changes, not when a kernel that it calls, in another
file, does: the old machine code would go on, and be silently wrong. It also fails where it finds no folder to write
to. Here an entry's name holds a hash of the kernel's file and of all files of the package that this one imports,
directly or through others, of its argument types, of the processor and of the versions of Python and numba; so nothing
stale can be found, and nothing has to be deleted before work begins. Kernels are imported from the file they stand in.
Other code of the process that uses numba is left alone.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, _Cache
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from grindvision.caches import PACKAGE, cache_folders, is_ours, made

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_IMPORT = re.compile(rb"^from grindvision\.([\w.]+) import", re.MULTILINE)
_DIGEST_BYTES = 16

#: Called with the name of each kernel that is ready, loaded or compiled; for a bar.
listener: Callable[[str], None] | None = None

#: Names of all kernels of the modules that are loaded.
known: list[str] = []

#: How many have been compiled by this process.
compiled = 0


def njit(*, cache: bool = False, **options: Any) -> Callable[[Kernel], Kernel]:
    """Decorator: ``numba.njit(**options)``; with ``cache`` the machine code is kept from one process to the next."""

    def compiled(function: Kernel) -> Kernel:
        dispatcher = numba.njit(**options)(function)
        if cache:
            dispatcher._cache = KernelCache(function)
            known.append(dispatcher._cache.name)
        return dispatcher

    return compiled


class KernelCache(_Cache):
    """Keeps the machine code of one kernel, a file for each set of argument types and each processor."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        code = function.__code__
        self._source = Path(code.co_filename)
        module = function.__module__.removeprefix("grindvision.")
        self.name = f"{module}.{function.__qualname__}-{code.co_firstlineno}.{sys.implementation.cache_tag}"
        self._enabled = True
        self._numba = CompileResultCacheImpl.__new__(CompileResultCacheImpl)  # turns code into bytes and back, no more

    @property
    def cache_path(self) -> str:
        """The folder that new entries go to."""
        return str(_folders()[0])

    def enable(self) -> None:
        """Use the cache."""
        self._enabled = True

    def disable(self) -> None:
        """Do not use the cache."""
        self._enabled = False

    def flush(self) -> None:
        """Forget what is kept of this kernel."""
        self._drop(keep="")

    def load_overload(self, signature: Any, target: Any) -> Any:
        """What is kept for these argument types, or None; what is damaged counts as not kept.

        Machine code needs numba's memory management and no more: what else ``target.refresh()`` would load, a third of
        what the first kernel of a process takes, serves compilation, which loads it itself.
        """
        rtsys.initialize(target)
        if not self._enabled:
            return None
        name = self._entry(signature, target.codegen())
        for folder in _folders():
            try:
                content = (folder / name).read_bytes() if is_ours(folder) else b""
                digest, data = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
                if data and digest == _digest(data):
                    found = self._numba.rebuild(target, pickle.loads(data))
                    self._tell()
                    return found
            except Exception:
                continue
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep what has been compiled, in the first folder that takes it; where none does, it is not kept."""
        global compiled
        compiled += 1
        self._tell()
        if not self._enabled or any(not part.can_cache for part in result.lifted) or result.library.has_dynamic_globals:
            return
        name = self._entry(signature, result.codegen)
        data = dumps(self._numba.reduce(result))
        for folder in _folders():
            if made(folder) and _written(folder / name, _digest(data) + data):
                self._drop(keep=self._stamp[:12])
                return

    def _entry(self, signature: Any, codegen: Any) -> str:
        kind = (str(signature), codegen.magic_tuple(), self._function.__code__.co_code)
        return f"{self.name}-{self._stamp[:12]}-{hashlib.sha256(repr(kind).encode()).hexdigest()[:20]}.kernel"

    @functools.cached_property
    def _stamp(self) -> str:
        found = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
        for source in sources_of(self._source):
            found.update(_content(source))
        return found.hexdigest()

    def _drop(self, keep: str) -> None:
        """Remove entries of this kernel, but for those of the stamp ``keep``, from the folders that let us."""
        for folder in _folders():
            for old in folder.glob(f"{self.name}-*.kernel"):
                if not (keep and old.name.startswith(f"{self.name}-{keep}-")):
                    with suppress(OSError):
                        old.unlink()

    def _tell(self) -> None:
        if listener is not None:
            listener(self.name)


def folder() -> Path:
    """Where the machine code that is compiled from now on is kept."""
    return _folders()[0]


def sources_of(file: Path, package: Path = PACKAGE) -> list[Path]:
    """A file, and the files of the package that it imports from, directly or through others; sorted."""
    found: set[Path] = set()
    waiting = [file]
    while waiting:
        source = waiting.pop()
        if source not in found and source.is_file():
            found.add(source)
            waiting += _imported_by(source, package)
    return sorted(found)


@functools.cache
def _imported_by(source: Path, package: Path) -> list[Path]:
    """Files of the package that a file imports from: of a name, the module and the folder, be they there or not."""
    places = [package.joinpath(*module.decode().split(".")) for module in _IMPORT.findall(_content(source))]
    return [file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")]


@functools.cache
def _content(source: Path) -> bytes:
    return source.read_bytes()


@functools.cache
def _folders() -> list[Path]:
    asked: str = getattr(config, "CACHE_DIR", "")  # NUMBA_CACHE_DIR
    return [Path(asked) / "grindvision"] if asked else cache_folders("kernels")


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_DIGEST_BYTES).digest()


def _written(path: Path, content: bytes) -> bool:
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except OSError:
            os.unlink(temporary)
            raise
    except OSError:
        return False
    return True
