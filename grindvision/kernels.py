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
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numba
from llvmlite import binding
from numba.core import config
from numba.core.caching import _Cache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import compile_result
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from grindvision.caches import PACKAGE, cache_folders, is_ours, made

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

#: Of an environment of compiled code: the name of its module, its constants, its own name.
_Described: TypeAlias = tuple[str, Sequence[Any], str]

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
                    found = restored(target, pickle.loads(data))
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
        data = dumps(_taken_apart(result))
        for folder in _folders():
            if made(folder) and _written(folder / name, _digest(data) + data):
                self._drop(keep=_stamp(self._source)[:12])
                return

    def _entry(self, signature: Any, codegen: Any) -> str:
        kind = (str(signature), _processor(codegen), self._function.__code__.co_code)
        digest = hashlib.sha256(repr(kind).encode()).hexdigest()
        return f"{self.name}-{_stamp(self._source)[:12]}-{digest[:20]}.kernel"

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


class _KeptLibrary(JITCodeLibrary):
    """Machine code that was kept. Its intermediate code serves the compilation of kernels that call it, and is read
    when one is compiled: to read it at once would take half of the time in which a kernel is loaded."""

    def __init__(self, codegen: Any, name: str, machine_code: bytes, intermediate_code: bytes) -> None:
        super().__init__(codegen, name)
        self._intermediate_code = intermediate_code
        self.enable_object_caching()
        self._set_compiled_object(machine_code)
        self._finalize_final_module()

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = binding.parse_bitcode(self._intermediate_code)
        return self._shared_module


class Kept(NamedTuple):
    """A compiled kernel as it is kept: what numba's ``_reduce`` gives, and the ``names`` that its machine code defines;
    environments are described by their module's name, their constants and their own name."""

    names: set[str]
    library: tuple[str, str, tuple[bytes, bytes]]
    description: Any
    environment: _Described
    signature: Any
    object_mode: bool
    lifted: Any
    types: str
    initialisers: Any
    environments: list[_Described]


def _taken_apart(result: Any) -> Kept:
    library, description, environment, signature, object_mode, lifted, types, initialisers, others = result._reduce()
    return Kept(
        _defined_names(result.library), library, description, _described(environment), signature, object_mode, lifted,
        types, initialisers, [_described(one) for one in others],
    )  # fmt: skip


def restored(target: Any, kept: Kept) -> Any:
    """A kept kernel made ready for a ``target``."""
    for initialise in kept.initialisers:
        initialise()
    codegen = target.codegen()
    name, _, codes = kept.library
    library = _KeptLibrary(codegen, name, *codes)
    codegen._engine._defined_symbols |= kept.names
    environment = _environment(*kept.environment)
    entry_point = target.get_executable(library, kept.description, environment)
    referenced = tuple(_environment(*one) for one in kept.environments)
    for one in referenced:
        codegen.set_env(one.env_name, one)
    return compile_result(
        typing_context=target.typing_context, target_context=target, entry_point=entry_point,
        type_annotation=kept.types, signature=kept.signature, objectmode=kept.object_mode, lifted=kept.lifted,
        fndesc=kept.description, library=library, environment=environment, reload_init=kept.initialisers,
        referenced_envs=referenced,
    )  # fmt: skip


def _described(environment: Any) -> _Described:
    """The module that an environment is of, its constants and its name."""
    return environment.globals["__name__"], list(environment.consts), environment.env_name


def _environment(module: str, constants: Sequence[Any], name: str) -> Any:
    """The environment of compiled code, without its module's own names, which only code that is not compiled asks for:
    numba's way imports the module, and with it a tenth of what serves compilation."""
    found = lookup_environment(name)
    if found is None:
        found = Environment({"__name__": module})
        found.consts[:] = constants
        found.env_name = name
        Environment._memo[name] = found
    return found


def _defined_names(library: Any) -> set[str]:
    """Names that compiled code defines, and does not look for elsewhere."""
    module = library._get_module_for_linking()
    return {
        one.name for group in (module.functions, module.global_variables) for one in group if not one.is_declaration
    }


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


@functools.cache
def _processor(codegen: Any) -> Any:
    """What the machine code is made for."""
    return codegen.magic_tuple()


@functools.cache
def _stamp(source: Path) -> str:
    """Hash of what machine code of a file depends on: the file, those it imports from, Python and numba."""
    found = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for one in sources_of(source):
        found.update(_content(one))
    return found.hexdigest()


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
