"""Notebooks to take away: to download from the page, and to open on Binder or Colab where the book has an address."""

from __future__ import annotations

import html
from importlib.metadata import metadata


def repository() -> str:
    """Address of the GitHub repository that this installation came from; empty where none is known."""
    for entry in metadata("grindvision").get_all("Project-URL") or []:
        name, _, address = entry.partition(", ")
        if name == "Repository":
            return str(address)
    return ""


def notebook_links(notebook: str, root: str, address: str, in_browser: str = "") -> str:
    """HTML that offers one notebook.

    Args:
        notebook: its place below ``notebooks``, such as ``exercises/03_calibrating_scanner_and_arm.ipynb``.
        root: leads from the page to the first folder of the site.
        address: of the GitHub repository; without one there are no buttons of Binder and Colab.
        in_browser: HTML of a link that runs it in the browser, if there is one; it stands first.
    """
    links = [f"<a class='download' href='{root}downloads/{notebook}' download>Download this notebook</a>"]
    if in_browser:
        links.insert(0, in_browser)
    if address:
        name = html.escape(address.removeprefix("https://github.com/"))
        colab = f"https://colab.research.google.com/github/{name}/blob/HEAD/notebooks/{notebook}"
        links += [
            f"<a href='https://mybinder.org/v2/gh/{name}/HEAD?labpath=notebooks/{notebook}'>Run it on Binder</a>",
            f"<a href='{colab}'>Open in Colab</a>",
        ]
    return f"<p class='take'>{' '.join(links)}</p>\n"
