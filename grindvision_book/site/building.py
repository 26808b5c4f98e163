"""Builds the HTML book from the executed copies of the chapters; it needs no network to build or to read."""

from __future__ import annotations

import functools
import gc
import hashlib
import io
import json
import os
import re
import shutil
import sys
import warnings
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grindvision
from grindvision.errors import GrindvisionError
from grindvision.files import sha256, write_json
from grindvision_book.machinery.answers import write_scoreboard
from grindvision_book.machinery.kept import installed
from grindvision_book.machinery.notebook_files import nbformat
from grindvision_book.machinery.places import FIGURES, NOTEBOOKS, ROOT, SITE
from grindvision_book.site.chapter_pages import readable
from grindvision_book.site.downloads import notebook_links, repository
from grindvision_book.site.evidence_page import evidence_page
from grindvision_book.site.examples import EXAMPLES, examples_page
from grindvision_book.site.exercise_pages import exercises_page, gather_exercises
from grindvision_book.site.findings import findings_page
from grindvision_book.site.gallery import gallery_page
from grindvision_book.site.pdf import write_pdf
from grindvision_book.site.pictures import dark_copies, figures_in, light_copies, lightened, tables_in
from grindvision_book.site.playbacks import Playback
from grindvision_book.site.reference import write_reference
from grindvision_book.site.scenes import FIRST_SCENE, SCENES, Scene, scene_link, scene_markdown, scenes_page

SOURCES = Path(__file__).parents[1] / "site_sources"

#: What a link to a page without a picture of its own shows where it is shared.
SHARED_FIGURE = "table4_scene"

#: Where the pages offer the whole book as one file.
PDF = "downloads/grindvision.pdf"

_DECISIONS = tuple(sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs" / "decisions").glob("*.md")))
_TEXTS = ("data/README.md", "benchmarks/README.md", "CHANGELOG.md", "CONTRIBUTING.md", *_DECISIONS)
_LINKED = (
    "LICENSE",
    "LICENSE-TEXT",
    "CITATION.cff",
    "environment.txt",
    "data/paper/expected.csv",
    ".github/workflows/pages.yml",
)

_RACES = (
    "goals", "detect", "scenes", "growth", "floors", "coarse", "groove", "difference", "icp", "calibration", "hand_eye",
    "voxel", "fpfh", "startup", "first_call", "large_detect", "large_groove",
)  # fmt: skip

#: The groups of the contents on the left: caption -> pages; chapters are named by their two digits.
_CONTENTS = {
    "The book": ("00", "evidence", "figures/scoreboard", "findings", "gallery", "scenes"),
    "diao2018: grinding": ("01", "02", "03", "04", "05", "06", "07", "08", "09", "16"),
    "peng2020: welding": ("10", "11", "15"),
    "Your own scans and arm": ("12", "13", "14", "examples", "when_it_does_not_work"),
    "Teaching": ("teachers_guide", "lessons", "exercises", "answers"),
    "Races": ("benchmarks/README", *(f"figures/bench_{race}" for race in _RACES)),
    "Reference": (
        "conventions", "glossary", "api/index", "data/README", "references", "errata", "CHANGELOG",
        "CONTRIBUTING",
    ),
    "Decisions": tuple(path.removesuffix(".md") for path in _DECISIONS),
}  # fmt: skip


def build_site(
    build: Path,
    figures: Path,
    notebooks: Path = NOTEBOOKS,
    site: Path = SITE,
    scenes: Sequence[Scene | Playback] = SCENES,
    reference: bool = True,
    in_browser: Path | None = None,
    pdf: bool = False,
) -> Path:
    """Build the pages and return the path of the first one; pages whose sources have not changed stay as they are.

    Args:
        build: working folder with ``executed``; a chapter that has no executed copy there is shown without outputs.
        figures: figures and answers that the pages show; where a chapter has none there, the committed ones are shown.
        notebooks: folder of the chapters.
        site: folder of the pages.
        scenes: 3D scenes to draw.
        reference: whether to draw the pages of the package's reference.
        in_browser: the exercises that run in the browser, as ``build_in_browser`` returns them, or none.
        pdf: whether to print them as one PDF too, ``PDF`` in the folder of the pages.

    Raises:
        GrindvisionError: Sphinx cannot build them, or the PDF cannot be printed; the message has its reason.
    """
    asked = f"{[scene.name for scene in scenes]} {reference} {in_browser and _digest_of(in_browser)} {pdf}"
    record, inputs = (
        site.with_name(f"{site.name}_made.json"),
        _inputs(build / "executed", figures, notebooks, asked),
    )
    if _read_record(record) == {"inputs": inputs, "pages": _digest_of(site)}:
        return site / "index.html"
    sources, extra = build / "site_sources", build / "site_extra"
    shutil.rmtree(extra, ignore_errors=True)
    with ThreadPoolExecutor(1) as pool:
        drawing = pool.submit(lambda: [scene.write(extra / "scenes") for scene in scenes])
        light = _gather(sources, build / "executed", figures, notebooks, scenes, in_browser is not None)
        dark_copies(sources / "figures", extra / "_images" / "dark", light)
        drawing.result()
    for picture in (extra / "scenes").glob("*.png"):
        (sources / "scenes").mkdir(exist_ok=True)
        shutil.move(picture, sources / "scenes" / picture.name)
    (extra / "_static").mkdir()
    shutil.copyfile(FIGURES / f"{SHARED_FIGURE}.png", extra / "_static" / "share.png")
    shutil.copytree(notebooks, extra / "downloads", ignore=_no_chapter_or_exercise, dirs_exist_ok=True)
    _pack_data(extra / "downloads" / "grindvision-data.zip")
    if in_browser:
        shutil.copytree(in_browser, extra / "lite")
    if reference:
        write_reference(sources / "api")
    _write_index(sources, light, pdf)
    unfinished = site.with_name(f".{site.name}-unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    _run_sphinx(sources, build / "doctrees", unfinished, [str(extra)])
    record.unlink(missing_ok=True)
    shutil.rmtree(site, ignore_errors=True)
    unfinished.rename(site)
    if pdf:
        edition = f"Version {grindvision.__version__}" + (
            ", chapters in the fast setting" if build.name == "fast" else ""
        )
        write_pdf(site, sources / "figures", site / PDF, edition, os.environ.get("GRINDVISION_SITE_URL", ""))
    write_json(record, {"inputs": inputs, "pages": _digest_of(site)})
    return site / "index.html"


def _pack_data(target: Path) -> None:
    """What the papers print and the robots' tables, to hand out to a class; what is made from seeds is not in it."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted((ROOT / "data").rglob("*")):
            if path.is_file() and "synthetic" not in path.parts:
                archive.write(path, path.relative_to(ROOT))


def _no_chapter_or_exercise(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not re.match(r"\d\d_.*\.ipynb$|exercises$", name)]


def _run_sphinx(sources: Path, doctrees: Path, pages: Path, extra: list[str]) -> None:
    from sphinx.application import Sphinx
    from sphinx.errors import SphinxError
    from sphinx.search.en import SearchEnglish
    from sphinx.util.console import nocolor

    nocolor()
    if not hasattr(SearchEnglish.stem, "cache_info"):  # Sphinx remembers the stems of words of one page alone
        SearchEnglish.stem = functools.cache(SearchEnglish.stem)  # type: ignore[method-assign]
    complaints = io.StringIO()
    try:
        app = Sphinx(
            srcdir=sources,
            confdir=SOURCES,
            outdir=pages,
            doctreedir=doctrees,
            buildername="html",
            confoverrides={"html_extra_path": extra},
            status=None,
            warning=complaints,
            freshenv=True,
            parallel=os.cpu_count() or 1,
        )
        with warnings.catch_warnings():
            # Sphinx also parses the sources of our classes' parents; one library's write \d unescaped.
            warnings.filterwarnings("ignore", message="invalid escape sequence")
            gc.disable()  # a search for garbage goes through all pages, and finds nothing to speak of
            app.build()
    except SphinxError as error:
        raise GrindvisionError(f"the HTML book cannot be built: {error}") from None
    finally:
        gc.enable()
    if complaints.getvalue():
        print(complaints.getvalue(), file=sys.stderr, end="")


def _inputs(executed: Path, figures: Path, notebooks: Path, asked: str) -> str:
    """One hash of everything that the pages are made of; the sources of the package for its reference."""
    folders = [
        executed,
        figures,
        FIGURES,
        notebooks,
        SOURCES,
        EXAMPLES,
        ROOT / "grindvision",
        ROOT / "grindvision_book",
    ]
    files = [ROOT / page for page in ("README.md", *_TEXTS, *_LINKED)]
    parts = [_digest_of(folder) for folder in folders] + [sha256(file) for file in files if file.exists()]
    return hashlib.sha256("\n".join([installed(), asked, *parts]).encode()).hexdigest()


def _digest_of(folder: Path) -> str:
    """One hash of the files of a folder and their names, but not of what Python compiles there."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts and ".ipynb_checkpoints" not in path.parts:
            digest.update(f"{path.relative_to(folder).as_posix()} {sha256(path)}\n".encode())
    return digest.hexdigest()


def _read_record(record: Path) -> object:
    try:
        return json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _gather(
    sources: Path,
    executed: Path,
    figures: Path,
    notebooks: Path,
    scenes: Sequence[Scene | Playback],
    in_browser: bool,
) -> dict[str, str]:
    """Lay out the sources like the checkout, so that every relative link means the same in both.

    Returns the light copies of the pictures, as ``light_copies`` does.
    """
    from nbformat.v4 import new_markdown_cell

    shutil.rmtree(sources, ignore_errors=True)
    shutil.copytree(FIGURES, sources / "figures")
    shutil.copytree(figures, sources / "figures", dirs_exist_ok=True)
    _say_what_was_committed(sources / "figures")
    board = write_scoreboard(sources / "figures")
    light = light_copies(sources / "figures")
    drawn, tables = figures_in(sources / "figures", light), tables_in(sources / "figures")
    for name, table in tables.items():
        page = sources / "figures" / f"{name}.md"
        page.write_text(f"---\norphan: true\n---\n# Table {table.name}\n\n{page.read_text(encoding='utf-8')}", "utf-8")

    (sources / "notebooks").mkdir()
    links: dict[str, str] = {}
    for scene in scenes:
        for figure in scene.figures:
            links[figure] = links.get(figure, "") + scene_link(scene, "../")
    address = repository()
    titles: dict[str, str] = {}
    for chapter in sorted(notebooks.glob("[0-9][0-9]_*.ipynb")):
        number, copy = chapter.name[:2], executed / chapter.name
        notebook = nbformat.read(copy if copy.exists() else chapter, as_version=4)
        title = re.search(r"^# (.+)$", notebook.cells[0].source, re.MULTILINE)
        titles[number] = f"[{title[1] if title else chapter.stem}](notebooks/{chapter.name})"
        readable(notebook, board[board["chapter"] == number], drawn, light, links)
        notebook.cells.insert(1, new_markdown_cell(notebook_links(chapter.name, "../", address), id="take"))
        nbformat.write(notebook, sources / "notebooks" / chapter.name)

    exercises = sorted((notebooks / "exercises").glob("[0-9][0-9]_*.ipynb"))
    gather_exercises(sources / "notebooks" / "exercises", exercises, address, in_browser)
    for text in (*_TEXTS, *_LINKED):
        if (ROOT / text).exists():
            (sources / text).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / text, sources / text)
    shutil.copytree(EXAMPLES, sources / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    pages = {path.name: path.read_text(encoding="utf-8") for path in SOURCES.glob("*.md")}
    pages["findings.md"] = findings_page(pages["findings.md"], sources / "figures")
    pages["gallery.md"] = gallery_page(
        sources / "figures", drawn, tables, {**titles, "races": "[Races](benchmarks/README.md)"}
    )
    pages["evidence.md"] = evidence_page(board)
    pages["examples.md"] = examples_page()
    if exercises:
        pages["exercises.md"] = exercises_page([path.stem for path in exercises], in_browser)
    if scenes:
        pages["scenes.md"] = scenes_page(scenes, titles, drawn)
    for name, text in pages.items():
        (sources / name).write_text(lightened(text, light), encoding="utf-8")
    return light


def _say_what_was_committed(folder: Path) -> None:
    """Put into words what git calls dirty: a race was run on a commit and changes that it did not hold."""
    for page in folder.glob("bench_*.md"):
        page.write_text(page.read_text(encoding="utf-8").replace("-dirty", " and changes made after it"), "utf-8")


def _write_index(sources: Path, light: dict[str, str], pdf: bool) -> None:
    """The front page: the README, with the contents of the whole book."""
    chapters = {path.name[:2]: f"notebooks/{path.stem}" for path in sorted((sources / "notebooks").glob("*.ipynb"))}
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](grindvision_book/site_sources/", "](")
    readme = re.sub(r"\]\(notebooks/(exercises|solutions)\)", "](exercises.md)", readme)  # folders are no pages
    if (sources / "scenes" / f"{FIRST_SCENE.name}.png").exists():
        readme = readme.replace("\n## ", f"\n{scene_markdown(FIRST_SCENE, '')}\n## ", 1)
    if pdf:
        offer = f"<p class='take'><a class='download' href='{PDF}' download>The whole book as a PDF</a></p>"
        readme = readme.replace("\n\n", f"\n\n{offer}\n\n", 1)
    groups = []
    for caption, names in _CONTENTS.items():
        pages = [chapters.get(name, name) for name in names]
        there = [page for page in pages if any((sources / f"{page}{kind}").exists() for kind in (".md", ".ipynb"))]
        if there:
            groups.append("\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *there, "```", ""]))
    (sources / "index.md").write_text("\n".join([lightened(readme, light), *groups]), encoding="utf-8")
