"""The page of the short scripts of ``examples/``, each whole and with its title."""

from __future__ import annotations

import ast

from grindvision_book.machinery.places import ROOT

#: Folder of the scripts.
EXAMPLES = ROOT / "examples"

#: In the order a reader meets them.
ORDER = (
    "read_a_cloud",
    "register_two_scans",
    "find_what_to_grind",
    "grind_a_bead",
    "find_grooves",
    "weld_a_fillet",
    "torch_trajectory",
    "robot_programme",
    "calibrate_a_cell",
    "verify_a_calibration",
    "correct_a_scanner",
)

_HEAD = """\
# The package in short scripts

Each runs as it stands, in seconds once the inner loops are compiled, and uses nothing but the names at the top of
`grindvision`. Inputs are synthetic, made by `simulate` or in the script. The scripts are in the folder `examples`; the
[reference](api/index.md) explains every name.
"""


def title_of(name: str) -> str:
    """What a script is for, in one line."""
    return (ast.get_docstring(ast.parse((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))) or "").strip()


def examples_page() -> str:
    """Markdown of the page."""
    parts = [_HEAD]
    for name in ORDER:
        text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
        body = text.split('"""', 2)[2].strip()
        parts.append(
            f"## {name.replace('_', ' ').capitalize()}\n\n{title_of(name)} "
            f"[{name}.py](examples/{name}.py)\n\n```python\n{body}\n```\n"
        )
    return "\n".join(parts)
