"""Sphinx settings of the HTML book: already executed chapters, everything served from the page's own folder."""

import os
import re
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.parallel import make_chunks

import grindvision

ABOUT = (
    "A reproducible experiment book of two robot-vision papers: 3D vision for grinding, groove detection for welding"
)

project = "grindvision"
author = "grindvision contributors"
project_copyright = "grindvision contributors, CC BY 4.0"
release = grindvision.__version__
language = "en"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["**.ipynb_checkpoints"]
suppress_warnings = ["myst.xref_missing", "config.cache", "ref.python"]  # two rooms may give one name to a result

autodoc_default_options = {"no-value": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_use_type_comments = False  # there are none, and to look for them takes its time
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("ArrayLike", "Floats", "Flags", "Integers", "NDArray")}
napoleon_custom_sections = [("Warns", "params_style")]
add_module_names = False
python_maximum_signature_line_length = 88

nb_execution_mode = "off"
nb_ipywidgets_js: dict[str, dict[str, str]] = {}
nb_merge_streams = True
nb_render_markdown_format = "myst"
nb_code_prompt_show = "Show the code that draws"
nb_code_prompt_hide = "Hide the code that draws"
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath", "html_image"]
myst_heading_anchors = 3

html_theme = "sphinx_book_theme"
html_title = "grindvision"
html_favicon = "_static/favicon.svg"
html_theme_options = {
    "use_download_button": False,
    "use_fullscreen_button": False,
    "show_toc_level": 2,
    "show_navbar_depth": 1,
    "navbar_persistent": [],
    "navbar_end": [],
    "secondary_sidebar_items": {"**": ["page-toc.html"], "figures/scoreboard": []},  # its tables take the whole width
    "extra_footer": f"<p>Version {release}</p>",
}
html_sidebars = {"**": ["navbar-logo.html", "search-button-field.html", "sbt-sidebar-nav.html"]}
html_context = {"default_mode": "auto"}
html_static_path = ["_static"]
templates_path = ["_templates"]
html_css_files = ["book.css"]
html_js_files = [("book.js", {"defer": "defer"})]
html_use_index = False
html_domain_indices = False
html_show_sourcelink = False
html_copy_source = False
# A page opened from disk may not fetch other pages, so the search shows titles only.
html_show_search_summary = False

# From parts, because drawing formulas as SVG is needed, and menu and speech, a third of the whole, are not. (SVG
# because a page that is opened from disk may not load web fonts.) Assistive MathML stays for screen readers.
mathjax3_config = {
    "loader": {"load": ["input/tex", "output/svg", "a11y/assistive-mml"]},
    "tex": {"packages": {"[+]": []}},
}


def setup(app: Sphinx) -> None:
    """Choose the parts of MathJax, and leave out the theme's icon library: the style sheet draws the few in use."""
    app.config.mathjax_path = "mathjax/startup.js"
    app.extensions["sphinx-mathjax-offline"].parallel_read_safe = True  # it only adds files; it does not say so
    app.connect("autodoc-process-signature", _with_plain_aliases)
    app.connect("html-page-context", _about_the_page)
    app.connect("html-page-context", _contents_by_titles)
    app.connect("env-before-read-docs", _deal_out)
    app.connect("env-updated", _look_up_names_once)
    app.connect("build-finished", _finish_pages)


def _about_the_page(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """What a page that is shared shows: its first paragraph of some length, and its first picture.

    The picture's address is whole where ``GRINDVISION_SITE_URL`` says where the site will stand; relative ones are not
    followed by the services that show it.
    """
    paragraphs = [node.astext().replace("\n", " ") for node in tree.findall(nodes.paragraph)] if tree else []
    about = next((text for text in paragraphs if len(text) > 80), ABOUT)
    shown = [node["uri"] for node in tree.findall(nodes.image)] if tree else []
    files = [uri.split("_images/")[-1] for uri in shown if "_images/" in uri and not uri.endswith(".svg")]
    picture = f"_images/{files[0]}" if files else "_static/share.png"
    context["page_about"] = about if len(about) < 200 else about[:197].rsplit(" ", 1)[0] + "..."
    context["page_picture"] = os.environ.get("GRINDVISION_SITE_URL", "") + picture


def _deal_out(app: Sphinx, env: BuildEnvironment, names: list[str]) -> None:
    """Deal the pages out so that each of the runs in which Sphinx reads them has its part of the reference.

    That takes two thirds of the time, and stands together in the alphabet: one core read it while the others waited.
    """
    modules = {name: env.doc2path(name).read_text(encoding="utf-8").count("automodule::") for name in names}
    longest = sorted(names, key=lambda name: (-modules[name], name))
    runs = len(make_chunks(names, app.parallel))
    names[:] = [name for run in reversed(range(runs)) for name in longest[run::runs]]  # the last run is read first


def _look_up_names_once(app: Sphinx, env: BuildEnvironment) -> list[str]:
    """Names in annotations are sought once each: Sphinx goes through all objects of the reference for every one."""
    domain = env.get_domain("py")
    domain.find_obj = cache(domain.find_obj)  # type: ignore[attr-defined]
    return []


def _contents_by_titles(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """The contents on the left, which show titles alone, are made of titles alone.

    Sphinx copies every section and every documented object of the book into them, for every page, and drops them again:
    a third of the time that the pages take.
    """
    whole = context["toctree"]

    def contents(**asked: Any) -> str:
        if not asked.get("titles_only"):
            return str(whole(**asked))
        kept, app.env.tocs = app.env.tocs, _titles(app)
        try:
            return str(whole(**asked))
        finally:
            app.env.tocs = kept

    context["toctree"] = contents


def _titles(app: Sphinx) -> dict[str, Any]:
    """Contents of every page less its sections: its title, and the contents that it lists."""
    made: dict[str, Any] | None = getattr(app, "titles_of_pages", None)
    if made is None:
        made = {name: toc.deepcopy() for name, toc in app.env.tocs.items()}
        for entry in (entry for toc in made.values() for entry in toc.children):
            if len(entry) > 1:
                if listed := list(entry.findall(addnodes.toctree)):
                    entry[1][:] = listed
                else:
                    entry.pop(1)
        app.titles_of_pages = made  # type: ignore[attr-defined]
    return made


def _with_plain_aliases(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Sphinx writes ``TypeAliasForwardRef('Floats')`` for an alias inside another type: only the alias is meant."""

    def plain(text: str | None) -> str | None:
        return text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text)

    return plain(signature), plain(returned)


def _finish_pages(app: Sphinx, error: Exception | None) -> None:
    """Finish the pages: without the icon library, and with the address of a figure's dark copy where there is one."""
    if error is None:
        for name in ("fontawesome.js", "fontawesome.js.map"):
            script = Path(app.outdir) / "_static" / "scripts" / name
            if script.exists():
                script.write_text("/* the icons are drawn by book.css */\n", encoding="utf-8")
        made = {picture.name for picture in (Path(app.outdir) / "_images" / "dark").glob("*")}
        figures = {name: Path(source) for source, (_, name) in app.env.images.items()}
        dark = {
            name: source.name
            for name, source in figures.items()
            if source.name in made and source.parent.name == "figures"
        }

        def with_dark(match: re.Match[str]) -> str:
            return f'{match[0]} data-dark="{match[1]}dark/{dark[match[2]]}"' if match[2] in dark else match[0]

        # The theme's release for Python 3.10 links the library's fonts instead.
        for page in Path(app.outdir).glob("**/*.html"):
            text = page.read_text(encoding="utf-8")
            lighter = re.sub(r"\s*<(?:link|script)[^>]*vendor/fontawesome[^>]*>(?:</script>)?", "", text)
            lighter = re.sub(r'(?<= )src="([^"]*_images/)([\w.]+)"', with_dark, lighter)
            if lighter != text:
                page.write_text(lighter, encoding="utf-8")
