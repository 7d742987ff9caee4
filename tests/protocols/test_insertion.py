"""Entries that are added to YAML files: the rest of the file stays, character by character."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from protocols.yaml_files.insertion import with_entry

ENTRY = {"rate": "0.31 ± 0.04 1/h", "part": "0.2"}
READ = {"rate": "0.31 ± 0.04 1/h", "part": 0.2}

TEXTS = {
    "no section": "name: lab\nother: {a: 1}\n",
    "no section, no last line end": "name: lab\nother: {a: 1}",
    "no section, all in braces": "{name: lab, other: {a: 1}}\n",
    "no section, a list at the end": "name: lab\nother:\n  - a: 1\n  - b  # last\n# end\n",
    "empty": "name: lab\nknown: {}  # none yet\nother: 1\n",
    "null": "name: lab\nknown: null\nother: 1\n",
    "braces": "known: {crack: {depth: 5 um}}  # seen\nother: 1\n",
    "braces on lines": "known: {\n  crack: {depth: 5 um},  # seen\n}\nother: 1\n",
    "lines": "known:\n  crack:\n    depth: 5 um  # seen\n\n# next\nother: 1\n",
    "lines, then the end": "other: 1\nknown:\n    crack: {depth: 5 um}",
    "Windows": "other: 1\r\nknown:\r\n  crack: {depth: 5 um}\r\nlast: 2\r\n",
}


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("comment", ["", "found by a diagnosis"])
def test_an_entry_is_added_and_nothing_else_changes(case: str, comment: str) -> None:
    text = TEXTS[case]
    added = with_entry(text, "known", "drift", ENTRY, comment)
    before, after = (yaml.safe_load(each) for each in (text, added))
    known = (before.get("known") or {}) | {"drift": READ}
    assert after == before | {"known": known}
    # The old text is what is left when the new characters are taken out.
    rest = iter(added)
    old = text.replace("null", "")
    assert all(character in rest for character in old)
    assert "\n" not in added.replace("\r\n", "") or "\r\n" not in text


def test_a_comment_stands_above_the_entry() -> None:
    added = with_entry(TEXTS["lines"], "known", "drift", ENTRY, "found by a diagnosis")
    assert added.splitlines()[2:5] == [
        "    depth: 5 um  # seen",
        "  # found by a diagnosis",
        "  drift: {rate: 0.31 ± 0.04 1/h, part: 0.2}",
    ]


_WORDS = st.text("abcdefgh", min_size=1, max_size=6).filter(lambda word: word != "known")
_ENTRIES = st.dictionaries(_WORDS, st.floats(-1e3, 1e3).map(lambda v: round(v, 3)), min_size=1)


@given(
    rest=st.dictionaries(_WORDS, st.one_of(st.integers(), _ENTRIES, st.lists(_WORDS)), min_size=1),
    known=st.none() | st.dictionaries(_WORDS, _ENTRIES),
    last=st.booleans(),
    style=st.sampled_from([None, True, False]),
)
def test_any_file_can_be_added_to(rest, known, last, style) -> None:
    content = (
        rest if known is None else {**rest, "known": known} if last else {"known": known, **rest}
    )
    text = yaml.safe_dump(content, default_flow_style=style, sort_keys=False, width=1000)
    added = with_entry(text, "known", "new entry", {"size": "1.5 ± 0.2 um"})
    assert yaml.safe_load(added) == {
        **content, "known": {**(known or {}), "new entry": {"size": "1.5 ± 0.2 um"}}
    }  # fmt: skip
