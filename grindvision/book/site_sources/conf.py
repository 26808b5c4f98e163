"""Sphinx settings of the HTML book: already executed chapters, everything served from the page's own folder."""

project = "grindvision"
author = "grindvision contributors"
project_copyright = "grindvision contributors, CC BY 4.0"

extensions = ["myst_nb", "sphinx.ext.mathjax", "sphinx-mathjax-offline"]
exclude_patterns = ["**.ipynb_checkpoints"]
suppress_warnings = ["myst.xref_missing", "config.cache"]

nb_execution_mode = "off"
nb_ipywidgets_js = {}
nb_render_markdown_format = "myst"
myst_enable_extensions = ["amsmath", "dollarmath", "html_image"]
myst_heading_anchors = 3

html_theme = "sphinx_book_theme"
html_title = "grindvision"
html_theme_options = {
    "use_download_button": False,
    "show_toc_level": 2,
    "show_navbar_depth": 1,
    "navbar_persistent": [],
    "navbar_end": [],
}
html_sidebars = {"**": ["navbar-logo.html", "search-button-field.html", "sbt-sidebar-nav.html"]}
html_context = {"default_mode": "light"}
html_static_path = ["book.css"]
html_css_files = ["book.css"]
html_show_sourcelink = False
html_copy_source = False
# A page opened from disk may not fetch other pages, so the search shows titles only.
html_show_search_summary = False


def setup(app):
    """Draw formulas as SVG: unlike web fonts, they may be loaded by a page that is opened from disk."""
    app.config.mathjax_path = "mathjax/tex-svg.js"
