"""What a piece of the book's code depends on: the files of our own modules that it imports, one after another.

Read from the sources, never by importing. What counts: every import statement (those inside functions too, those for
type checkers not), names that a package fetches when they are first used (a table of names and modules in its
``__init__``), modules reached through a package's name (``vision.seam.groove``), and names of modules in texts, where
the end may be left open (``f"grindvision.cli.{command}"``).
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from grindvision.errors import FileError
from grindvision_book.machinery.places import ROOT

PACKAGES = ("grindvision", "grindvision_book")


def modules_of_notebook(notebook: Path) -> set[str]:
    """Names of all modules of ours that the cells of a notebook come to.

    Raises:
        FileError: no readable notebook.
    """
    try:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"{notebook}: not a readable notebook ({error}); restore it") from None
    lines = ("pass" if line.startswith(("%", "!")) else line for line in code.splitlines())
    return _closure(_used_by("\n".join(lines), ""))


def modules_of(name: str) -> set[str]:
    """A module of ours and all modules of ours that it comes to."""
    return _closure({name})


def source_of(module: str) -> Path | None:
    """File of a module of ours; None where there is no such module."""
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def _closure(names: Iterable[str]) -> set[str]:
    found: set[str] = set()
    waiting = {part for name in names for part in _with_parents(name)}
    while waiting:
        name = waiting.pop()
        found.add(name)
        waiting |= {part for used in _used_by_module(name) for part in _with_parents(used)} - found
    return found


def _with_parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[: k + 1]) for k in range(len(parts))]


@cache
def _used_by_module(name: str) -> frozenset[str]:
    path = source_of(name)
    assert path is not None, name
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    return frozenset(_used_by(path.read_text(encoding="utf-8"), package))


def _used_by(code: str, package: str) -> set[str]:
    """Modules of ours that a piece of code names; ``package`` is what its relative imports start from."""
    try:
        nodes = list(_runtime_nodes(ast.parse(code)))
    except SyntaxError:  # it will not run either; nothing is known of what it needs
        return set()
    used: set[str] = set()
    bound: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.split(".")[0]
                if top in PACKAGES and source_of(alias.name):
                    used.add(alias.name)
                    bound[alias.asname or top] = alias.name if alias.asname else top
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node, package)
            if base.split(".")[0] in PACKAGES and source_of(base):
                used.add(base)
                for alias in node.names:
                    if target := _member(base, alias.name):
                        used.add(target)
                        if target == f"{base}.{alias.name}":
                            bound[alias.asname or alias.name] = target
    for node in nodes:
        if isinstance(node, ast.Attribute):
            used |= _reached(node, bound)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _is_ours(node.value):
            used.add(node.value)
        elif isinstance(node, ast.JoinedStr):
            used |= _begun_with(node)
    return used


def _runtime_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Every node but those under ``if TYPE_CHECKING``."""
    yield node
    skipped = node.body if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test) else []
    for child in ast.iter_child_nodes(node):
        if child not in skipped:
            yield from _runtime_nodes(child)


def _absolute(node: ast.ImportFrom, package: str) -> str:
    if not node.level:
        return node.module or ""
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - node.level + 1], *([node.module] if node.module else [])])


def _is_ours(text: str) -> bool:
    parts = text.split(".")
    return (
        parts[0] in PACKAGES and len(parts) > 1 and all(part.isidentifier() for part in parts) and bool(source_of(text))
    )


def _begun_with(node: ast.JoinedStr) -> set[str]:
    """All modules that a formatted text such as ``f"grindvision.cli.{name}"`` may name."""
    first = node.values[0] if node.values else None
    if not isinstance(first, ast.Constant) or not str(first.value).startswith(tuple(f"{name}." for name in PACKAGES)):
        return set()
    package, _, stem = str(first.value).rpartition(".")
    path = source_of(package)
    if path is None:
        return set()
    return {f"{package}.{file.stem}" for file in path.parent.glob(f"{stem}*.py") if file.stem != "__init__"}


def _reached(node: ast.Attribute, bound: dict[str, str]) -> set[str]:
    """Modules along ``room.module.name`` where ``room`` is bound to a package of ours."""
    names = []
    inner: ast.expr = node
    while isinstance(inner, ast.Attribute):
        names.append(inner.attr)
        inner = inner.value
    found: set[str] = set()
    if isinstance(inner, ast.Name) and inner.id in bound:
        at = bound[inner.id]
        for name in reversed(names):
            target = _member(at, name)
            if not target:
                break
            found.add(target)
            at = target
    return found


def _member(package: str, name: str) -> str:
    """The module that ``package.name`` is or comes from; empty where it stands in the package's own file."""
    path = source_of(package)
    if path is None or path.name != "__init__.py":
        return ""
    return f"{package}.{name}" if source_of(f"{package}.{name}") else _fetched(package).get(name, "")


@cache
def _fetched(package: str) -> dict[str, str]:
    """Names that a package fetches when first used: ``{module: names}`` or ``{name: module}`` tables of its file."""
    path = source_of(package)
    assert path is not None, package
    homes: dict[str, str] = {}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values, strict=True):
                texts = [_texts(part) for part in (key, value) if part is not None]
                if len(texts) < 2:
                    continue
                for modules, names in (texts, texts[::-1]):
                    home = next((m for m in _spellings(package, modules)), "")
                    if home:
                        homes |= dict.fromkeys(names, home)
                        break
    return homes


def _spellings(package: str, modules: list[str]) -> Iterator[str]:
    if len(modules) == 1:
        for spelling in (f"{package}.{modules[0].lstrip('.')}", modules[0]):
            if _is_ours(spelling):
                yield spelling


def _texts(node: ast.AST) -> list[str]:
    return [part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)]
