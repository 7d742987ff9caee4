"""Text from files, instruments and the command line, made safe to show.

A name or a note can hold anything: escape sequences that recolour a terminal or set its title,
marks that reverse the direction of writing, bytes that are not UTF-8. All of it is shown as text.
"""

import unicodedata

from rich.text import Text


def visible(text: str) -> str:
    r"""Replace each character that does not print by its escape; keep spaces and line ends.

    Parameters
    ----------
    text : str

    Returns
    -------
    str
        Holds no control character but line ends, no mark of writing direction, no character
        without width, and no surrogate, so that it can be encoded.

    Examples
    --------
    >>> visible("R07\x1b[31m")
    'R07\\x1b[31m'
    """
    # Most text is printable, and this is asked of every cell of every table.
    return text if text.isprintable() else "".join(map(_shown, text))


def one_line(text: str) -> str:
    """Replace line ends as well, for places where a second line would mean something else."""
    return visible(text).replace("\n", "\\n")


def plain(value: object) -> Text:
    """Return a table cell that shows a value as text.

    The consoles of this module make any text safe, but after a table is laid out. A cell that is
    made here has its final width before that, so that the columns stay aligned.
    """
    return Text(visible(str(value)))


def _shown(character: str) -> str:
    # Spaces of other widths (Zs) are not printable by Python's rule, but they are harmless.
    harmless = character == "\n" or unicodedata.category(character) == "Zs"
    if harmless or character.isprintable():
        return character
    return character.encode("unicode_escape").decode("ascii")
