"""The HTML book in a real browser, with no network: what is drawn, found, enlarged and turned."""

import functools
import importlib.util
import io
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from grindvision_book.machinery.places import FIGURES, ROOT
from grindvision_book.machinery.shown_tables import heading, table_html
from grindvision_book.machinery.sliders import frames_html
from grindvision_book.site.pdf import installed_chromium
from grindvision_book.site.pipelines import PLAYBACKS
from grindvision_book.site.scenes import SCENES

sync_api = pytest.importorskip("playwright.sync_api", reason="the browser tests need the package playwright")
CHROMIUM = installed_chromium()

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine; install the package chromium"),
]

STATIC = ROOT / "grindvision_book" / "site_sources" / "_static"
HEAVIEST_PAGE_BYTES = 3_000_000
HEAVIEST_SCENE_BYTES = 3_000_000
WIDTHS = (1280, 390)
#: Boxes of code, of output and of tables that are wider than the place they have.
CUT_OFF = """async () => {
    for (const _ of [1, 2, 3]) await new Promise(requestAnimationFrame); // the page has arranged its tables anew
    return [...document.querySelectorAll(".bd-article :is(pre, table)")].filter((box) => {
        const place = box.matches("table") ? box.parentElement : box;
        return place.scrollWidth > place.clientWidth + 1;
    }).length;
}"""


@pytest.fixture(scope="module")
def pages(whole_site) -> list[str]:
    found = (path.relative_to(whole_site) for path in whole_site.rglob("*.html"))
    return sorted(path.as_posix() for path in found if path.parts[0] not in ("_static", "scenes"))


@pytest.fixture(scope="module")
def playwright():
    with sync_api.sync_playwright() as started:
        yield started


@pytest.fixture(scope="module")
def browser(playwright):
    """Chromium for pages without 3D scenes: where WebGL is drawn in software, all else is, which takes longer."""
    chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
    yield chromium
    chromium.close()


@pytest.fixture(scope="module")
def browser_with_webgl(playwright):
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
    yield chromium
    chromium.close()


@pytest.fixture
def tab(browser):
    """A tab that refuses everything but files, and a list of what went wrong in it."""
    yield from _tab(browser)


@pytest.fixture
def tab_with_webgl(browser_with_webgl):
    yield from _tab(browser_with_webgl)


def _tab(browser):
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.troubles = []
    page.loaded = set()
    page.on("console", lambda message: message.type == "error" and page.troubles.append(message.text))
    page.on("pageerror", lambda error: page.troubles.append(str(error)))
    page.on("requestfailed", functools.partial(_note_failure, page))
    page.on("request", lambda request: page.loaded.add(request.url))
    context.route("**/*", functools.partial(_only_files, page))
    yield page
    context.close()


def _note_failure(page, request) -> None:
    if request.failure != "net::ERR_ABORTED":  # the test went on to the next page while the picture came in
        page.troubles.append(f"failed: {request.url[:200]}: {request.failure}")


def _only_files(page, route) -> None:
    if route.request.url.startswith(("file:", "data:", "blob:")):
        route.continue_()
    else:
        page.troubles.append(f"asks the network: {route.request.url[:200]}")
        route.abort()


def _bytes_loaded(page) -> int:
    files = {url.removeprefix("file://").split("?")[0].split("#")[0] for url in page.loaded if url.startswith("file:")}
    return sum(Path(unquote(name)).stat().st_size for name in files)


#: Every chapter, and of all other pages as many as stand one in so many, in every run; the rest by night.
ONE_IN = 6


@pytest.mark.parametrize("rest", [False, pytest.param(True, marks=pytest.mark.full)])
def test_every_page_loads_light_and_without_error_draws_its_formulas_and_fits_a_telephone(whole_site, pages, tab, rest):
    wrong = {}
    chapters = {name for name in pages if re.match(r"notebooks/\d\d_", name)}
    chosen = chapters | set(sorted(set(pages) - chapters)[::ONE_IN])
    assert len(chapters) > 10
    for name in sorted(set(pages) - chosen if rest else chosen):
        tab.loaded.clear()
        tab.set_viewport_size({"width": 1280, "height": 900})
        tab.goto((whole_site / name).as_uri())
        formulas = tab.locator(".math").count()
        if formulas:
            tab.evaluate("() => MathJax.startup.promise")
        drawn = tab.locator(".math > mjx-container > svg").count()
        unknown = tab.locator("mjx-container merror, mjx-container [data-mjx-error], mjx-utext").count()
        if drawn != formulas or unknown:
            wrong[name] = f"{drawn} of {formulas} formulas, {unknown} of them wrong"
        if _bytes_loaded(tab) > HEAVIEST_PAGE_BYTES:
            wrong[name] = f"{_bytes_loaded(tab):,} bytes"
        for width in WIDTHS:
            tab.set_viewport_size({"width": width, "height": 900})
            if cut_off := tab.evaluate(CUT_OFF):
                wrong[name] = f"{cut_off} boxes cut off at {width} pixels"
        if tab.evaluate("document.documentElement.scrollWidth") > min(WIDTHS):
            wrong[name] = "wider than a telephone"
    assert not wrong and not tab.troubles


#: Words of links in tables that are broken between two lines.
BROKEN_WORDS = """() => {
    const broken = [];
    for (const link of document.querySelectorAll(".bd-article table a")) {
        const texts = document.createTreeWalker(link, NodeFilter.SHOW_TEXT);
        while (texts.nextNode()) for (const word of texts.currentNode.data.matchAll(/[\\p{L}\\p{N}]+/gu)) {
            const range = document.createRange();
            range.setStart(texts.currentNode, word.index);
            range.setEnd(texts.currentNode, word.index + word[0].length);
            if (new Set([...range.getClientRects()].map((box) => Math.round(box.top))).size > 1) broken.push(word[0]);
        }
    }
    return broken;
}"""


@pytest.mark.parametrize("name", ["errata", "teachers_guide", "index", "figures/scoreboard"])
def test_no_link_in_a_table_is_broken_inside_a_word_on_a_telephone(tab, whole_site, name):
    tab.set_viewport_size({"width": min(WIDTHS), "height": 900})
    tab.goto((whole_site / f"{name}.html").as_uri())
    assert tab.locator(".bd-article table a").count() > 0
    assert tab.evaluate(BROKEN_WORDS) == []


def test_the_scoreboard_of_the_front_page_is_a_table_on_a_desk_and_a_list_on_a_telephone(tab, whole_site):
    tab.goto((whole_site / "index.html").as_uri())
    board = tab.locator(".bd-article table").first
    for width, stacked in zip(WIDTHS, (0, 1), strict=True):
        tab.set_viewport_size({"width": width, "height": 900})
        tab.evaluate(CUT_OFF)
        assert board.locator("xpath=self::*[contains(@class, 'stacked')]").count() == stacked, width


@pytest.mark.parametrize("name", ["bench_detect", "scoreboard"])
def test_many_columns_are_set_in_small_type_on_a_desk_and_as_a_list_on_a_telephone(tab, whole_site, name):
    tab.goto((whole_site / f"figures/{name}.html").as_uri())
    for width, arranged in zip(WIDTHS, ("dense", "stacked"), strict=True):
        tab.set_viewport_size({"width": width, "height": 900})
        tab.evaluate(CUT_OFF)
        assert tab.locator(f".bd-article table.{arranged}").count() > 0, width
        assert tab.locator(".bd-article table.stacked").count() == 0 or width < 600


#: How JupyterLab sets tables (its ``rendermime`` styles), and the place of a cell's output.
LAB = """<style>body {margin: 0} .jp-OutputArea-output {width: %dpx; overflow: auto; font: 13px sans-serif}
table {border-collapse: collapse; table-layout: fixed; font-size: 13px} td, th {padding: 0.5em; white-space: normal}
</style><div class="jp-OutputArea-output jp-RenderedHTMLCommon">%s</div>"""


@pytest.mark.parametrize("width", [840, 290])
@pytest.mark.parametrize("name", ["joints_found", "peng_waypoints", "own_detection_doubts", "registration_accuracy"])
def test_a_table_in_jupyterlab_is_as_wide_as_its_cell_at_most(browser, name, width):
    table = pd.read_csv(FIGURES / f"{name}.csv")
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    tab = context.new_page()
    tab.set_content(LAB % (width, table_html(table)))
    assert tab.evaluate("() => document.querySelector('.jp-OutputArea-output').scrollWidth") <= width
    shown = tab.locator("td").first.evaluate("cell => getComputedStyle(cell, '::before').content")
    stacked = tab.locator("thead").is_hidden()
    assert shown == (f'"{heading(table.columns[0])}"' if stacked else "none")
    context.close()


@pytest.mark.parametrize("words", ["FPFH", "hand-eye"])
def test_the_search_finds(whole_site, tab, words):
    tab.goto((whole_site / "index.html").as_uri())
    tab.keyboard.press("Control+k")
    tab.locator("form.bd-search input:visible").first.fill(words)
    tab.keyboard.press("Enter")
    tab.wait_for_url("**/search.html*")
    chapters = re.compile("Registering|Calibrating")  # results come one after the other
    tab.locator("#search-results a").filter(has_text=chapters).first.wait_for()
    assert not tab.troubles


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_a_scene_opens_on_demand_and_is_not_blank(whole_site, tab_with_webgl, scene):
    tab = tab_with_webgl
    assert (whole_site / "scenes" / f"{scene.name}.html").stat().st_size < HEAVIEST_SCENE_BYTES
    tab.goto((whole_site / "scenes.html").as_uri())
    assert tab.locator("iframe").count() == 0
    link = tab.locator(f"a.scene[href$='{scene.name}.html']")
    link.click()
    frame = tab.locator("iframe.scene")
    tab.frame_locator("iframe.scene").locator("canvas").first.wait_for()
    frame.scroll_into_view_if_needed()
    still = _awaited(tab, frame, lambda picture: _drawn_share(picture) > 0.02)
    _awaited(tab, frame, lambda picture: (np.abs(picture - still).max(axis=2) > 40).mean() > 0.01, _drag)
    link.click()
    assert tab.locator("iframe").count() == 0
    assert not tab.troubles


@pytest.mark.parametrize("playback", PLAYBACKS, ids=lambda playback: playback.name)
def test_a_pipeline_plays_steps_to_its_end_and_hides_layers_by_touch_too(whole_site, browser_with_webgl, playback):
    context = browser_with_webgl.new_context(viewport={"width": 390, "height": 700}, has_touch=True)
    page = context.new_page()
    page.goto((whole_site / "scenes" / f"{playback.name}.html").as_uri())
    last = int(page.locator("#step").get_attribute("max"))
    page.locator("#play").tap()
    page.wait_for_function("() => document.body.dataset.step === '1'")
    page.locator("#next").tap()  # ends the playing, wherever it is by then
    assert page.locator("body").get_attribute("data-playing") == "false"
    first = int(page.locator("body").get_attribute("data-step"))
    assert 2 <= first <= last // 2
    told = {page.locator("#title").text_content()}
    for number in range(first + 1, last + 1):
        page.locator("#next").tap()
        assert page.locator("body").get_attribute("data-step") == str(number)
        told.add(page.locator("#title").text_content())
    assert len(told) == last - first + 1
    page.locator("#step").fill("1")
    stage = page.locator("#stage")
    drawn = _awaited(page, stage, lambda picture: _drawn_share(picture) > 0.02)
    for box in page.locator("#layers label:not(.absent) input").all():
        box.tap()
    _awaited(page, stage, lambda picture: _drawn_share(picture) < 0.1 * _drawn_share(drawn))
    context.close()


def test_every_scene_has_its_picture_for_readers_without_scripts(whole_site, browser):
    context = browser.new_context(java_script_enabled=False)
    tab = context.new_page()
    tab.goto((whole_site / "scenes.html").as_uri())
    for scene in SCENES:
        picture = tab.locator(f"img[src*='{scene.name}']")
        assert _drawn_share(_picture(picture)) > 0.02
    context.close()


def test_a_click_enlarges_a_picture_and_escape_puts_it_back(whole_site, tab):
    tab.goto((whole_site / "conventions.html").as_uri())
    small = tab.locator("button.picture img").first
    width = small.bounding_box()["width"]
    small.click()
    assert tab.locator("dialog.enlarged[open] img").bounding_box()["width"] > 1.5 * width
    tab.keyboard.press("Escape")
    tab.locator("dialog.enlarged[open]").wait_for(state="detached")


def test_code_that_draws_is_folded_and_all_code_can_be_hidden(whole_site, tab):
    tab.goto((whole_site / "notebooks" / "03_calibrating_scanner_and_arm.html").as_uri())
    folded, shown = tab.locator("details.hide.above-input"), tab.locator(".cell > .cell_input")
    assert folded.count() and shown.count() and folded.locator("pre").first.is_hidden() and shown.first.is_visible()
    tab.get_by_role("button", name="Hide all code").click()
    assert shown.first.is_hidden() and folded.first.is_hidden()
    tab.get_by_role("button", name="Show all code").click()
    assert shown.first.is_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_and_pictures_can_be_read_on_either_background(whole_site, browser, scheme):
    context = browser.new_context(color_scheme=scheme)
    tab = context.new_page()
    for name in ("notebooks/03_calibrating_scanner_and_arm.html", "gallery.html"):
        tab.goto((whole_site / name).as_uri())
        assert tab.evaluate("document.documentElement.dataset.theme") == scheme
        readable = (".bd-article p", "figcaption p", ".verdict", ".bd-sidebar-primary a", ".bd-article a.internal")
        for selector in readable:
            for place in range(min(tab.locator(selector).count(), 3)):
                contrast = tab.locator(selector).nth(place).evaluate(CONTRAST)
                assert contrast >= 4.5, f"{name}: {selector} has a contrast of {contrast:.1f}"
        picture = tab.locator(".bd-article img").first
        behind = picture.evaluate("e => getComputedStyle(e).backgroundColor")
        drawn_dark = picture.get_attribute("data-dark") is not None
        assert scheme == "light" or behind == ("rgb(20, 20, 20)" if drawn_dark else "rgb(255, 255, 255)")
    context.close()


def test_a_slider_can_be_read_on_either_background(browser):
    theme = (
        Path(importlib.util.find_spec("pydata_sphinx_theme").origin).parent / "theme/pydata_sphinx_theme/static/styles"
    )
    styles = (theme / "pydata-sphinx-theme.css", STATIC / "book.css")
    sheets = "".join(f"<style>{path.read_text(encoding='utf-8')}</style>" for path in styles)
    frames = frames_html(_a_line, [1.0, 2.0, 3.0], "voxel edge, mm", "A line. Synthetic")
    box = f"<div class='bd-content'><div class='cell_output'><div class='output text_html'>{frames}</div></div></div>"
    context = browser.new_context()
    tab = context.new_page()
    for scheme in ("light", "dark"):
        tab.set_content(f"<html data-theme='{scheme}' data-mode='{scheme}'>{sheets}<body>{box}</body></html>")
        for selector in (".frames figcaption", ".frames output"):
            assert tab.locator(selector).evaluate(CONTRAST) >= 4.5, f"{selector}, {scheme}"
    context.close()


def _a_line(axes, slope) -> pd.DataFrame:
    axes.plot([0.0, 1.0], [0.0, slope])
    return pd.DataFrame({"slope": [slope]})


#: WCAG contrast of an element's text against the first opaque background behind it.
CONTRAST = """element => {
  const numbers = colour => colour.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map(v => v / 255)
    .map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  let behind = element, back = [255, 255, 255];
  while (behind) {
    const found = numbers(getComputedStyle(behind).backgroundColor);
    if (found.length < 4 || found[3] === 1) { back = found; break; }
    behind = behind.parentElement;
  }
  const [a, b] = [light(numbers(getComputedStyle(element).color)), light(back)];
  return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
}"""


def _awaited(tab, frame, shown, act=lambda tab, frame: None) -> np.ndarray:
    """The first picture that is as wanted, within 20 s, acting before each: software draws slowly on a busy machine."""
    for _ in range(40):
        act(tab, frame)
        if shown(picture := _picture(frame)):
            return picture
        tab.wait_for_timeout(500)
    raise AssertionError("the scene never looked as it should")


def _drag(tab, frame) -> None:
    box = frame.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x + 120, y + 40, steps=6)
    tab.mouse.up()


def _picture(locator) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(locator.screenshot())).convert("RGB")).astype(int)


def _drawn_share(picture: np.ndarray) -> float:
    """Share of the pixels, a rim left out, that are not of the commonest colour."""
    inner = picture[8:-8, 8:-8].reshape(-1, 3)
    counts = np.unique(inner // 8, axis=0, return_counts=True)[1]
    return 1 - counts.max() / len(inner)
