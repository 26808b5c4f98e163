"""The HTML book as files: complete, readable without its own scripts, and with no dead link; no browser needed."""

import contextlib
import io
import os
import re
import zipfile
from pathlib import Path
from urllib.parse import unquote, urlsplit

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import yaml
from PIL import Image

from grindvision_book.machinery.answers import scoreboard
from grindvision_book.machinery.chapters import chapters
from grindvision_book.machinery.evidence import holds
from grindvision_book.machinery.places import FIGURES, ROOT
from grindvision_book.site.chapter_pages import scoreboard_html
from grindvision_book.site.downloads import notebook_links
from grindvision_book.site.evidence_page import strip
from grindvision_book.site.findings import printed_numbers, rebuilt_numbers
from grindvision_book.site.pictures import (
    BRIGHT,
    DARK,
    HEAVY_BYTES,
    LEAST_LUMA,
    _write_dark_picture,
    dark_svg,
    light_copies,
    lightened,
    tables_in,
)
from grindvision_book.site.playbacks import dot_size_mm
from grindvision_book.site.scenes import SCENES
from tests.built_site import SAID, Page, build_whole_site


@pytest.fixture(scope="module")
def pages(whole_site) -> dict[str, Page]:
    return pages_of(whole_site)


def pages_of(whole_site: Path) -> dict[str, Page]:
    found = (path for path in whole_site.rglob("*.html") if "_static" not in path.parts)
    shown = {path.relative_to(whole_site).as_posix(): path for path in sorted(found)}
    return {name: Page(path) for name, path in shown.items() if not name.startswith("scenes/")}


def text_of(whole_site: Path, name: str) -> str:
    return (whole_site / name).read_text(encoding="utf-8")


def test_the_build_says_nothing(site_warnings):
    assert site_warnings == ""


@pytest.mark.full
def test_the_build_with_the_whole_reference_says_nothing_and_no_link_is_dead(tmp_path):
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        site = build_whole_site(tmp_path, one_module_in=1)
    assert said.getvalue() == ""
    assert (site / "api" / "vision.html").read_text(encoding="utf-8").count("grindvision.vision.seam.weld") > 3
    assert not dead_links(pages_of(site))


def test_every_kind_of_page_is_there(pages):
    wanted = {"index", "search", "findings", "gallery", "scenes", "conventions", "glossary", "references"}
    wanted |= {"api/index", "api/vision", "data/README", "figures/scoreboard", "CHANGELOG", "CONTRIBUTING"}
    wanted |= {f"notebooks/{path.stem}" for path in chapters().values()}
    assert {f"{name}.html" for name in wanted} <= pages.keys()


def test_every_page_can_be_reached_from_the_contents(pages):
    index = pages["index.html"]
    reached = {(index.path.parent / urlsplit(link).path).resolve() for link in index.links}
    left = [name for name, page in pages.items() if page.path.resolve() not in reached]
    assert not [name for name in left if not name.startswith(("index", "figures/", "api/", "search"))]


def test_every_resource_of_every_page_is_a_file_of_the_site(pages):
    for name, page in pages.items():
        assert page.resources
        for resource in page.resources:
            assert "//" not in resource and not resource.startswith("data:text"), f"{name} loads {resource}"
            assert (page.path.parent / unquote(resource.split("?")[0])).exists(), f"{name}: {resource} is not there"


def test_styles_fetch_nothing_from_elsewhere(whole_site):
    for style in whole_site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?\s*(https?:)?//", style.read_text(encoding="utf-8")), style


def test_no_link_is_dead(pages):
    assert not dead_links(pages)


def dead_links(pages: dict[str, Page]) -> list[str]:
    at = {os.path.normpath(page.path): page for page in pages.values()}
    dead = []
    for name, page in pages.items():
        for link in sorted(set(page.links)):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = Path(os.path.normpath(page.path.parent / unquote(parts.path)) if parts.path else page.path)
            if not target.is_file():
                dead.append(f"{name} -> {link}")
            elif parts.fragment and target.suffix == ".html" and target.parent.name != "scenes":
                there = at.get(os.path.normpath(target))
                if there is None or unquote(parts.fragment) not in there.targets:
                    dead.append(f"{name} -> {link}")
    return dead


def test_pages_are_in_order_for_those_who_hear_them(pages):
    for name, page in pages.items():
        assert page.language == "en", name
        assert page.headings.count(1) == 1 and page.headings[0] == 1, f"{name}: headings {page.headings}"
        assert all(b <= a + 1 for a, b in zip(page.headings, page.headings[1:], strict=False)), f"{name}: headings"
        for picture in page.pictures:
            alternative = picture.get("alt", "")
            assert len(alternative) > 10 and not alternative.startswith("../"), f"{name}: {picture}"


def test_executed_outputs_are_shown_and_searchable(whole_site):
    assert SAID in text_of(whole_site, "notebooks/07_into_the_robots_frame.html")
    assert "notebooks/07_into_the_robots_frame" in text_of(whole_site, "searchindex.js")


def test_every_chapter_begins_with_its_rows_of_the_scoreboard(whole_site):
    board = scoreboard(FIGURES)
    for number, chapter in chapters().items():
        page, rows = text_of(whole_site, f"notebooks/{chapter.stem}.html"), board[board["chapter"] == number]
        assert page.count('class="verdict') + page.count("class='verdict") == len(rows)
        if len(rows):
            body = page.split("</head>")[1]
            assert body.index("What the numbers of this chapter are worth") < body.index("What you will learn")


def test_every_chapter_and_exercise_is_there_to_download_as_it_stands_in_the_repository(whole_site, pages):
    for number, chapter in chapters().items():
        for name in (chapter.name, f"exercises/{chapter.name}"):
            if not (ROOT / "notebooks" / name).exists():
                continue
            assert (whole_site / "downloads" / name).read_bytes() == (ROOT / "notebooks" / name).read_bytes(), number
            links = pages[f"notebooks/{name.removesuffix('.ipynb')}.html"].links
            assert any(link.endswith(f"downloads/{name}") for link in links), name


def test_binder_and_colab_are_offered_where_the_book_has_an_address():
    links = notebook_links("03_a.ipynb", "../", "https://github.com/owner/name")
    assert "mybinder.org/v2/gh/owner/name/HEAD?labpath=notebooks/03_a.ipynb" in links
    assert "github/owner/name/blob/HEAD/notebooks/03_a.ipynb" in links
    assert "http" not in notebook_links("03_a.ipynb", "../", "")


def test_a_verdict_is_told_in_words():
    row = {"item": "a<b", "quantity": "q", "unit": "mm", "paper": float("nan"), "rebuilt": 1.25, "tolerance": 0.5}
    row |= {"evidence": "own bound", "claim": "at most", "verdict": "outside its bound"}
    row |= {"trivial answer passes": "", "chapter": "03"}
    text = scoreboard_html(pd.DataFrame([row]))
    assert (
        "a&lt;b" in text
        and ">outside its bound</span>" in text
        and "1.25 mm" in text
        and "own bound: 1 outside its bound" in text
        and "nan" not in text
    )


@pytest.mark.parametrize("claim, paper", [("equal", 2.0), ("at most", 2.0), ("at least", 2.0), ("at most", np.nan)])
@pytest.mark.parametrize("rebuilt", [1.0, 1.95, 2.05, 9.0])
def test_a_strip_has_its_dot_in_the_band_where_the_bound_is_kept(claim, paper, rebuilt):
    row = {"paper": paper, "rebuilt": rebuilt, "tolerance": 0.1, "claim": claim, "evidence": "ours on a twin"}
    drawing = strip(next(pd.DataFrame([row]).itertuples(index=False)))
    kept = holds(rebuilt, paper, 0.1, claim)
    assert ("class='kept'" in drawing) == kept and ("class='missed'" in drawing) != kept
    assert ("class='printed'" in drawing) == (paper == paper)
    if kept and (dot := re.search(r"circle cx='([\d.]+)'", drawing)):
        left, width = re.search(r"rect x='([\d.]+)' width='([\d.]+)'", drawing).groups()
        assert float(left) <= float(dot[1]) <= float(left) + float(width)


def test_the_gallery_shows_every_figure_and_table_with_its_files(whole_site, pages):
    page = pages["gallery.html"]
    files = {Path(urlsplit(link).path).name for link in page.links}
    for path in FIGURES.glob("*.svg"):
        assert {path.name, f"{path.stem}.png", f"{path.stem}.csv"} <= files
        assert any(Path(picture["src"]).stem.startswith(path.stem) for picture in page.pictures)
    for name in tables_in(FIGURES):
        assert {f"{name}.csv", f"{name}.md", f"{name}.html"} <= files


def test_heavy_drawings_are_shown_as_light_pictures(whole_site):
    shown = list((whole_site / "_images").glob("*.svg"))
    heavy = [path for path in shown if path.stat().st_size > HEAVY_BYTES]
    assert shown and [path.stem for path in heavy] == ["pipeline_grinding"]


def test_only_pictures_are_replaced_by_light_ones_not_links(tmp_path):
    badge = '<g style="fill: #ffffff" transform="scale(1)"/>'
    for name, size, text in (("big", HEAVY_BYTES + 1, ""), ("small", 100, ""), ("badges", HEAVY_BYTES + 1, badge)):
        (tmp_path / f"{name}.svg").write_text("<svg>" + text + " " * size + "</svg>")
        (tmp_path / f"{name}.png").write_bytes((FIGURES / "fig05.png").read_bytes())
    kept = "[a](figures/big.svg) ![b](figures/small.svg) ![c](figures/badges.svg)"
    text = f'![a](../figures/big.svg) <img src="figures/big.svg"> {kept}'
    light = f'![a](../figures/big.webp) <img src="figures/big.webp"> {kept}'
    assert lightened(text, light_copies(tmp_path)) == light


def test_findings_say_what_the_printed_tables_say(whole_site):
    page = text_of(whole_site, "findings.html")
    numbers = printed_numbers() | rebuilt_numbers(FIGURES)
    for said in (
        f"{numbers['motion_rms_um']:.2f} µm rms",
        f"from {numbers['length_least']:.2f} to {numbers['length_most']:.2f}",
        f"number {numbers['centre_rank']} of {numbers['heights']}",
        f"tell {numbers['rank_before']} combinations",
        f"comes to {numbers['calibrated_mm']:.2f} mm; a field known exactly",
    ):
        assert said in page
    assert numbers["motion_rms_um"] == pytest.approx(0.174, abs=0.001)
    assert (numbers["off_least_deg"], numbers["off_most_deg"]) == pytest.approx((35.08, 52.54), abs=0.01)
    assert (numbers["rank_before"], numbers["rank_behind"], numbers["centre_rank"]) == (20, 19, 4)
    exact, calibrated, asked, oracle = (
        float(numbers[f"{name}_mm"]) for name in ("exact", "calibrated", "asked", "oracle")
    )
    assert exact <= calibrated < asked < oracle
    assert numbers["accurate_nominal_mm"] == pytest.approx(0.129, abs=0.002)


def test_every_word_of_the_glossary_leads_to_a_page_that_explains_it():
    text = (ROOT / "grindvision_book" / "site_sources" / "glossary.md").read_text(encoding="utf-8")
    entries = re.findall(r"^(\S.*)\n  (.+)$", text.split("```{glossary}\n")[1], re.MULTILINE)
    assert len(entries) >= 35 and [word for word, _ in entries] == sorted((w for w, _ in entries), key=str.lower)
    assert all(re.search(r"\]\((notebooks/\S+\.ipynb|conventions\.md)\)$", meaning) for _, meaning in entries)


def test_scenes_stand_under_the_figures_they_belong_to(whole_site):
    for scene in SCENES:
        assert set(scene.figures) <= {path.stem for path in FIGURES.glob("*.svg")}
        assert f"scenes/{scene.name}.html" in text_of(whole_site, "scenes.html")
    assert "scenes/registration.html" in text_of(whole_site, "notebooks/05_registering_two_scans.html")
    assert "scenes/cell.html" in text_of(whole_site, "notebooks/07_into_the_robots_frame.html")
    assert "scenes/welds.html" in text_of(whole_site, "notebooks/10_finding_weld_grooves.html")


def test_dots_of_a_playback_are_as_wide_as_the_points_lie_apart():
    lattice = np.stack(np.meshgrid(np.arange(0, 80, 2.0), np.arange(0, 80, 2.0), [0.0]), axis=-1).reshape(-1, 3)
    assert dot_size_mm(lattice) == pytest.approx(2.0)
    strewn = np.random.default_rng(1).uniform(0, 80, (1600, 3)) * [1, 1, 0]
    assert 2.0 < dot_size_mm(strewn) < 3.0


def test_citations_agree_and_no_doi_is_made_up():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    references = (ROOT / "grindvision_book" / "site_sources" / "references.md").read_text(encoding="utf-8")
    diao, peng = citation["references"]
    assert diao["doi"] in references and "doi" not in peng and peng["url"] in references
    assert all(re.fullmatch(r"10\.\d{4,}/\S+", doi) for doi in re.findall(r"doi:(\S+?)\]", references))


@pytest.mark.parametrize("name", ["pages", "tests"])
def test_workflows_are_valid_and_pin_their_actions(name):
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8"))
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert workflow[True]  # "on" is YAML's word for true
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]) for step in steps if "uses" in step)
    commands = " ".join(step.get("run", "") for step in steps)
    assert {"pages": "./run site", "tests": ".ci/run"}[name] in commands
    scripts = re.findall(r"\./?(\S+)", commands)
    assert all((ROOT / script).exists() for script in scripts if script in ("run", ".ci/run"))


def test_every_figure_of_a_chapter_has_a_dark_copy_and_a_page_that_is_shared_shows_a_picture(whole_site):
    page = text_of(whole_site, "notebooks/05_registering_two_scans.html")
    dark = re.findall(r'data-dark="([^"]+)"', page)
    assert all((whole_site / "notebooks" / name).is_file() for name in dark)
    assert {"fig07.webp", "icp_convergence.svg"} <= {Path(name).name for name in dark}
    for name in ("index.html", "notebooks/02_how_well_does_it_measure.html", "glossary.html"):
        head = text_of(whole_site, name).split("</head>")[0]
        shown = re.search(r'og:image" content="([^"]+)"', head)
        assert shown and (whole_site / shown[1]).is_file(), name
        assert re.search(r'og:title" content="\w', head) and re.search(r'og:description" content="[^"]{60,200}"', head)


def test_a_race_says_in_words_that_its_commit_had_been_changed(whole_site):
    races = {path.stem: path.read_text(encoding="utf-8") for path in (whole_site / "figures").glob("bench_*.html")}
    assert races and not [name for name, page in races.items() if "-dirty" in page]
    changed = [path.stem for path in FIGURES.glob("bench_*.md") if "-dirty" in path.read_text(encoding="utf-8")]
    assert all("and changes made after it" in races[name] for name in changed if name in races)


def test_a_dark_picture_shows_a_translucent_colour_as_it_would_stand_on_a_dark_ground(tmp_path):
    opacities, colour = np.array([0.15, 0.3, 0.6, 1.0]), np.array([0, 114, 178])
    on_white = np.rint(opacities[:, None] * colour + (1 - opacities[:, None]) * 255).astype(np.uint8)
    light, dark = tmp_path / "light.png", tmp_path / "dark.png"
    Image.fromarray(np.stack([on_white, np.array([[0] * 3, [255] * 3, [128] * 3, [255, 0, 0]], np.uint8)])).save(light)
    _write_dark_picture(light, dark)
    drawn = np.asarray(Image.open(dark).convert("RGB"), dtype=float)
    on_dark = opacities[:, None] * colour + (1 - opacities[:, None]) * DARK
    assert np.abs(drawn[0] - on_dark)[[0, 1, 3]].max() < 45  # a pale tint is partly a grey, which is turned
    assert drawn[0, :2].max() < 110  # and no bright field on a dark page
    assert drawn[1, 0, 0] == BRIGHT and drawn[1, 1, 0] == DARK and drawn[1, 3].tolist() == [255, 0, 0]


def test_a_dark_drawing_turns_greys_and_keeps_colours():
    drawing = '<svg x="1"><path style="fill: #ffffff; stroke: #000000"/><path style="fill: #d55e00"/>'
    drawing += '<g style="fill: #ffffff" transform="scale(1)"/></svg>'
    dark = dark_svg(drawing)
    assert '<svg fill="#dedede" x="1">' in dark and 'style="fill: #141414; stroke: #dedede"' in dark
    pale = dark_svg('<svg x="1"><path style="fill: #dbe9f6"/><path style="stroke: #cc79a7"/></svg>')
    assert "#cc79a7" in pale and max(bytes.fromhex(re.findall(r"fill: #(\w+)", pale)[0])) < 70
    assert "#d55e00" in dark and '<g style="fill: #ffffff" transform' in dark


def test_text_and_lines_of_a_dark_drawing_stand_out_from_what_is_behind_them():
    fig, axes = plt.subplots()
    boxes = {"black": "#000000", "blue": "#0072b2", "orange": "#e69f00"}
    for place, colour in enumerate(boxes.values()):
        axes.text(0, place, "x", color="white", bbox={"fc": colour, "ec": "none"})
    axes.text(0, 3, "x", color="#444444")
    axes.text(0, 4, "x", color="white")  # on a dark map
    axes.plot([0, 1], [0, 1], color="#440154")
    drawing = io.StringIO()
    fig.savefig(drawing, format="svg")
    plt.close(fig)
    dark = dark_svg(drawing.getvalue())
    texts = re.findall(r'style="fill: (#\w+)" transform', dark)
    assert texts == ["#141414", "#ffffff", "#ffffff", "#a8a8a8", "#ffffff"]
    assert "#440154" not in dark
    (line,) = {code for code in re.findall(r"stroke: #(\w{6})", dark) if len(set(re.findall("..", code))) > 1}
    red, green, blue = bytes.fromhex(line)
    assert 0.2126 * red + 0.7152 * green + 0.0722 * blue == pytest.approx(LEAST_LUMA, abs=1)
    assert blue > red > green  # still a violet


def test_the_data_of_the_papers_can_be_handed_out(whole_site):
    with zipfile.ZipFile(whole_site / "downloads" / "grindvision-data.zip") as archive:
        names = set(archive.namelist())
        assert archive.read("data/paper/diao2018_table3.csv") == (ROOT / "data/paper/diao2018_table3.csv").read_bytes()
    assert "data/README.md" in names and not any("synthetic" in name for name in names)
