"""The book as one PDF: its links, the page numbers of its contents, no empty page, no box beyond the paper."""

import re
from pathlib import Path
from typing import Any

import pytest

from grindvision.cli import main
from grindvision.errors import FileError, GrindvisionError
from grindvision_book.machinery.places import FIGURES
from grindvision_book.site import pdf
from grindvision_book.site.printed import pages_in_order

pypdf = pytest.importorskip("pypdf", reason="reading the PDF needs the package pypdf")
pytest.importorskip("playwright.sync_api", reason="printing needs the package playwright")
needs_chromium = pytest.mark.skipif(
    pdf.installed_chromium() is None, reason="no Chromium on this machine; install the package chromium"
)

#: Pages with formulas, figures, code, wide tables and links to each other: what an everyday run prints. The chapter's
#: drawings have few lines: to read a page with a cloud of vectors takes seconds.
FEW = r"index|evidence|conventions|notebooks/14_.*|errata"


def site_of(pages: str, whole_site: Path, folder: Path) -> Path:
    """Make ``folder`` a site of those pages of the book whose names match, and return it."""
    folder.mkdir()
    for path in whole_site.iterdir():
        if path.name != "index.html":
            (folder / path.name).symlink_to(path)
    text = (whole_site / "index.html").read_text(encoding="utf-8")
    link = re.compile(r'(<a class="reference internal" href=")([\w/]+)\.html"')
    kept = link.sub(lambda found: found[0] if re.fullmatch(pages, found[2]) else f'{found[1]}#"', text)
    (folder / "index.html").write_text(kept, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def few_printed(whole_site: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, list[str]]:
    """What is printed of a few pages, and the text of each page of paper."""
    site = site_of(FEW, whole_site, tmp_path_factory.mktemp("few") / "site")
    target = tmp_path_factory.mktemp("pdf") / "book.pdf"
    pdf.write_pdf(site, FIGURES, target, "Version 1.2.3")
    assert [path.name for path in target.parent.iterdir()] == ["book.pdf"]
    return read(target)


def read(target: Path) -> tuple[Any, list[str]]:
    printed = pypdf.PdfReader(target)
    return printed, [page.extract_text() for page in printed.pages]


@needs_chromium
def test_the_pages_are_whole_and_their_links_lead_to_what_is_there(few_printed: tuple[Any, list[str]]) -> None:
    printed, texts = few_printed
    check_book(printed, texts, inside=50)


@needs_chromium
def test_the_first_page_says_the_version_and_formulas_are_set(few_printed: tuple[Any, list[str]]) -> None:
    first, *others = few_printed[1]
    text = "".join(others)
    assert "Version 1.2.3" in first
    assert "Hand-eye without a tracker" in text and "\\" not in text  # no TeX as it is written


@needs_chromium
@pytest.mark.full
def test_the_whole_book_is_printed(whole_site: Path, tmp_path: Path) -> None:
    printed, texts = read(pdf.write_pdf(whole_site, FIGURES, tmp_path / "book.pdf", "Version 1.2.3"))
    check_book(printed, texts, inside=400)
    titles = [place.title for place in printed.outline if not isinstance(place, list)]
    assert [title[:2] for title in titles if re.match(r"\d\d ", title)] == [
        page[10:12] for _, page in pages_in_order(whole_site) if re.match(r"notebooks/\d\d_", page)
    ]


def check_book(printed: Any, texts: list[str], inside: int) -> None:
    """No page is empty, ``inside`` links or more lead to places that are there, the contents' numbers are right."""
    places = {name.removeprefix("/") for name in printed.named_destinations}
    links = [note.get_object() for page in printed.pages for note in page.get("/Annots", [])]
    links = [note for note in links if note.get("/Subtype") == "/Link"]
    led = [str(note["/Dest"]).removeprefix("/") for note in links if "/Dest" in note]
    outside = [str(note["/A"]["/URI"]) for note in links if "/A" in note and "/URI" in note["/A"]]
    assert len(led) >= inside and set(led) <= places
    assert outside and all(re.match(r"https?:|mailto:", address) for address in outside)
    assert [number for number, text in enumerate(texts, 1) if len(text.strip()) < 40] == []
    titles = {place.title: printed.get_destination_page_number(place) for place in flat(printed.outline)}
    contents = re.findall(r"^(\d\d .+?) ?(\d+)$", "\n".join(texts[1:7]), re.MULTILINE)
    chapters = [(title.strip(), int(number)) for title, number in contents if title.strip() in titles]
    assert chapters and all(titles[title] + 1 == number for title, number in chapters)


def flat(outline: list[Any]) -> list[Any]:
    """The places of an outline, whatever their depth."""
    return [one for place in outline for one in (flat(place) if isinstance(place, list) else [place])]


@needs_chromium
def test_a_box_that_is_wider_than_the_paper_is_refused_and_leaves_no_file(whole_site: Path, tmp_path: Path) -> None:
    site = site_of("index", whole_site, tmp_path / "site")
    first = site / "index.html"
    wide = '<div style="width: 2000px"><p style="max-width: none">wide</p></div></article>'
    first.write_text(first.read_text(encoding="utf-8").replace("</article>", wide, 1), encoding="utf-8")
    with pytest.raises(GrindvisionError, match=r"boxes? (is|are) wider than the paper; the first: index: P"):
        pdf.write_pdf(site, FIGURES, tmp_path / "book.pdf", "Version 1.2.3")
    assert not list(tmp_path.glob("book*"))


def test_without_pages_or_chromium_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(FileError, match=r"index.html is not there; build the pages first"):
        pages_in_order(tmp_path)
    assert main(["book", "--pdf"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    monkeypatch.setattr(pdf, "CHROMIUMS", ("no-such-browser",))
    assert main(["book", "--site", "--pdf"]) != 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "apt-get install chromium" in said
