"""Pages of the reference: one for every room of the package, drawn from its docstrings by Sphinx."""

from __future__ import annotations

import ast
from pathlib import Path

from grindvision_book.machinery.places import ROOT

PACKAGE = ROOT / "grindvision"
ROOMS = ("geometry", "arm", "vision", "calibration", "motion", "cell", "paper")

_HEAD = (
    "# The package\n\n"
    "What the package offers, room by room, in the order data flow through it. The walls between the rooms are tested: "
    "`vision` and `calibration` never import `cell` or `paper`, so no algorithm can see the truth it is judged by.\n\n"
    "Millimetres and radians everywhere; `T_a_b @ p_b = p_a`; clouds are `(N, 3)`. The "
    "[conventions](../conventions.md) say more.\n\n"
)


def write_reference(folder: Path) -> None:
    """Write ``index.md`` and one page per room, which Sphinx fills from the docstrings."""
    folder.mkdir(parents=True)
    lines = [f"- [{room}]({room}.md): {_summary(PACKAGE / room / '__init__.py')}" for room in ROOMS]
    contents = "\n".join(["", "```{toctree}", ":hidden:", "", *ROOMS, "```", ""])
    (folder / "index.md").write_text(_HEAD + "\n".join(lines) + "\n" + contents, encoding="utf-8")
    for room in ROOMS:
        (folder / f"{room}.md").write_text(_room_page(room), encoding="utf-8")


def _room_page(room: str) -> str:
    parts = [f"# grindvision.{room}\n", _summary(PACKAGE / room / "__init__.py") + "\n"]
    for module in public_modules_of(room):
        inner = module.relative_to(PACKAGE / room).with_suffix("").parts
        parts.append(f"## {'.'.join(inner)}\n")
        parts.append(f"```{{eval-rst}}\n.. automodule:: grindvision.{room}.{'.'.join(inner)}\n   :members:\n```\n")
    return "\n".join(parts)


def public_modules_of(room: str) -> list[Path]:
    """Files of a room's public modules, in the order of its page."""
    return [module for module in sorted((PACKAGE / room).rglob("*.py")) if not module.stem.startswith("_")]


def _summary(module: Path) -> str:
    """First paragraph of a module's docstring."""
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split())
