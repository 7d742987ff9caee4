"""Add an entry to a YAML file and leave every other character as it is."""

from collections.abc import Mapping

import yaml

Entry = Mapping[str, str]
"""Values by key. Each value is a number or a word as YAML writes it, without quotes."""


def with_entry(text: str, section: str, key: str, entry: Entry, comment: str = "") -> str:
    """Return the text of a YAML file with one more entry in a section.

    Parameters
    ----------
    text : str
        Its content is a mapping.
    section : str
        Key of the section, a mapping; it is added at the end if there is none.
    key : str
        Key of the entry, which the section does not have yet.
    entry : mapping of str to str
        The entry: a mapping of values by their keys.
    comment : str
        Line above the entry; left out where the section is written in braces.

    Raises
    ------
    ValueError
        If the content is no mapping.

    Examples
    --------
    >>> with_entry("known: {}  # none", "known", "air", {"part": "0.3"})
    'known: {air: {part: 0.3}}  # none'
    """
    root = yaml.compose(text, yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        raise ValueError("the text is no mapping")
    found = next((value for name, value in root.value if name.value == section), None)
    written = f"{key}: {_in_braces(entry)}"
    if found is None and root.flow_style:
        return _in_flow(text, root, f"{section}: {{{written}}}")
    if found is None:
        return _after_block(text, root, f"{section}:", comment, written)
    if not isinstance(found, yaml.MappingNode):
        end = found.end_mark.index
        return f"{text[: found.start_mark.index]}{{{written}}}{text[end:]}"
    if found.flow_style:
        return _in_flow(text, found, written)
    return _after_block(text, found, "", comment, written)


def _in_braces(entry: Entry) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in entry.items()) + "}"


def _in_flow(text: str, mapping: yaml.MappingNode, written: str) -> str:
    """Add to a mapping in braces, after its last value."""
    if not mapping.value:
        at = mapping.start_mark.index + 1
        return f"{text[:at]}{written}{text[at:]}"
    at = mapping.value[-1][1].end_mark.index
    return f"{text[:at]}, {written}{text[at:]}"


def _after_block(
    text: str, mapping: yaml.MappingNode, heading: str, comment: str, written: str
) -> str:
    """Add lines below the last line of a mapping; below a heading, if there is one."""
    line_end = "\r\n" if "\r\n" in text else "\n"
    at = text.find("\n", _last_character(mapping)) + 1 or len(text)
    before = text[:at] if text[:at].endswith("\n") else text[:at] + line_end
    indent = " " * (mapping.start_mark.column + (2 if heading else 0))
    lines = [heading] if heading else []
    lines += [f"{indent}# {comment}"] if comment else []
    lines.append(indent + written)
    return before + line_end.join(lines) + line_end + text[at:]


def _last_character(node: yaml.Node) -> int:
    """Return where the last value ends; a mapping without braces ends at what follows it."""
    while isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        node = last[1] if isinstance(last, tuple) else last
    return int(node.end_mark.index)
