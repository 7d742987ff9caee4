"""A table as HTML for notebooks."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any


def html_table(title: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as an HTML table with a caption; every text is escaped.

    Parameters
    ----------
    title : str
    rows : sequence of mapping
        All with the same keys, which become the headings.
    """
    heads = "".join(f"<th scope='col'>{escape(key)}</th>" for key in (rows[0] if rows else ()))
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(_text(value))}</td>" for value in row.values()) + "</tr>"
        for row in rows
    )
    return f"<table><caption>{escape(title)}</caption><tr>{heads}</tr>{body}</table>"


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
