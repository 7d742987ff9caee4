"""Settings of Sphinx for this site; `make docs` builds it."""

import sys
import tomllib
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT)]

from generated import fill_in  # noqa: E402  # found on the path that is set above

_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

project = _PROJECT["name"]
author = "The reedbench authors"
project_copyright = author
version = release = _PROJECT["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
# A page with a broken link, or that no table of contents names, is an error: `make docs` builds
# with --fail-on-warning. Types in signatures that no page describes are not links, and no error.
nitpicky = False
# Words of numpy-style types, such as "shape", are names of several attributes and link to none.
suppress_warnings = ["ref.python"]
# `name` in a docstring is code.
default_role = "code"

myst_enable_extensions = ["attrs_block"]
# Depth to which headings can be linked to as PAGE.md#heading.
myst_heading_anchors = 4

autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
# Types of parameters are words such as "path"; fields would link them to attributes so named.
napoleon_use_param = False

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": project},
    "show_prev_next": False,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_nav_level": 2,
    "header_links_before_dropdown": 7,
}
html_sidebars = {"index": [], "tutorial": [], "glossary": []}


def setup(app):
    """Replace markers such as ``<!-- generated: verbs -->`` before a page is read."""
    app.connect("source-read", lambda _app, _name, source: source.append(fill_in(source.pop())))
