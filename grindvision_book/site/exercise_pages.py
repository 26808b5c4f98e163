"""Pages of the exercises: one a notebook, with links to take it away, and the list of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from grindvision_book.machinery.notebook_files import nbformat
from grindvision_book.site.downloads import notebook_links
from grindvision_book.site.in_browser import IN_BROWSER, in_browser_link

_HERE = (
    "**Without installing anything.** These run in the browser, checker included; nothing is sent anywhere, and your "
    "browser keeps what you write. The first call loads about 50 MB and takes half a minute. The pages have to come "
    "from a web server (`python -m http.server --directory build/site`), not from a file.",
    "",
)
_NOT_HERE = (
    "This copy of the book was built without the exercises that run in the browser (`./run site --in-browser` builds "
    "them); download the notebooks instead.",
)


def gather_exercises(target: Path, exercises: Sequence[Path], address: str, in_browser: bool) -> None:
    """Copy the exercises, each with links to take it away below its title."""
    from nbformat.v4 import new_markdown_cell

    for exercise in exercises:
        notebook = nbformat.read(exercise, as_version=4)
        here = in_browser_link(exercise.name, "../../") if in_browser and exercise.name[:2] in IN_BROWSER else ""
        offers = notebook_links(f"exercises/{exercise.name}", "../../", address, here)
        notebook.cells.insert(1, new_markdown_cell(offers, id="take"))
        target.mkdir(exist_ok=True)
        nbformat.write(notebook, target / exercise.name)


def exercises_page(names: Sequence[str], in_browser: bool) -> str:
    """Markdown of the page that lists the exercises, and those that run in the browser where there are any."""
    here = [name for name in names if name[:2] in IN_BROWSER] if in_browser else []
    return "\n".join(
        [
            "# Exercises",
            "",
            "One notebook for each chapter, for JupyterLab (`./run lab`, folder `exercises`). After a cell to fill in "
            "comes a check that tries your function on inputs you do not see, and names the likely mistake. Solutions "
            "lie in `notebooks/solutions`.",
            "",
            *(_HERE if here else _NOT_HERE),
            *(f"- {name[:2]}: {in_browser_link(f'{name}.ipynb', '')}" for name in here),
            "",
            "```{toctree}",
            "",
            *(f"notebooks/exercises/{name}" for name in names),
            "```",
            "",
        ]
    )
