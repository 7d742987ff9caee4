"""HTML pages, from one set of templates and one style sheet in ``reports/templates``.

A page stands alone: style and pictures are part of the file, and nothing is loaded from elsewhere.
Every value that a template shows is escaped, and characters that do not print become visible.
"""

import base64
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from reports.own_output import OutputKind
from reports.plain_text import visible
from reports.tables import Table


@dataclass(frozen=True)
class Picture:
    """A PNG picture on a page.

    Attributes
    ----------
    png : bytes
    alt : str
        What the picture shows, for readers who cannot see it.
    caption : str
        How to read it.
    wide : bool
        Whether it must not shrink to the width of a phone, where it can be scrolled instead.
    """

    png: bytes
    alt: str
    caption: str = ""
    wide: bool = False

    @property
    def source(self) -> str:
        """The picture as a data URI."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode()}"


def _shown(value: Any) -> Any:
    """Make characters of a text visible; HTML of macros stays as it is."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


_TEMPLATES = Environment(
    loader=PackageLoader("reports"),
    autoescape=True,
    finalize=_shown,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(template: str, kind: OutputKind, title: str, **content: Any) -> str:
    """Return a whole page.

    Parameters
    ----------
    template : str
        Name of a file in ``reports/templates`` that extends ``base.html``.
    kind : OutputKind
        Its mark is the beginning of the page.
    title : str
    **content
        What the template shows.
    """
    return _TEMPLATES.get_template(template).render(
        mark=Markup(kind.mark), title=title, version=version("reedbench"), **content
    )


def table_html(table: Table) -> str:
    """Return a table as a piece of HTML, such as a notebook shows it."""
    macros: Any = _TEMPLATES.get_template("macros.html").module
    return str(macros.table(table))
