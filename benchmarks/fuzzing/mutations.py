"""Mutations of text files: of their bytes, of their lines and values, and of their parsed tree."""

import random
import re
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

import yaml

Mutation = Callable[[bytes, random.Random], bytes]

NUMBERS = (
    "0", "-1", "-0", "1.0", "+5", "5.", ".5", "1e3", "1.5e3", "1E+3", "1e400", "1.0e+999", "1e-400",
    "1e308", "99999999999999999999", "9" * 60, "9" * 900, "0x10", "010", "0o10", "0b101", "1_000",
    "1__0", "1:30", "1:30.5", "190:20:30", ".inf", "-.inf", ".nan", "nan", "inf", "1,5", "½", "١٢",
    "１２", "12 ", "1 2", "2/3", "1e", "0x_", "4294967296", "-9223372036854775809", "10001", "1e-9",
)  # fmt: skip
UNITS = (
    "Hz", "hz", "HZ", "kHz", "MHz", "mHz", "uHz", "GHz", "V", "mV", "Vs", "m", "mm", "um", "µm",
    "μm", "nm", "cm", "s", "ms", "us", "min", "mins", "cents", "cent", "ccent", "rad", "mrad",
    "deg", "Pa", "Pas", "GPa", "MPa", "kg/m^3", "g/cm^3", "kg", "degC", "K", "ohm", "kohm", "Ohm",
    "in", "rpm", "Bq", "%", "dB", "Hz/s", "m/s^3", "kkHz", "Hz Hz", "Hz^2", "", "_", "Н z",
    "m" * 60,
)  # fmt: skip
WORDS = (
    "true", "false", "yes", "no", "on", "off", "Yes", "NO", "y", "null", "~", "", '""', "''", "[]",
    "{}", "[1, 2]", "{a: 1}", "[[[[[[[[[[[[[[1]]]]]]]]]]]]]]", "- 1", "2026-01-01",
    "2026-01-01T0:0", "!!int 3", "!!binary aGk=", "&a x", "*a", "<<", "=", "'", '"', "|", ">", "%",
    "@x", "`x`", "?",
    '"\\e[2J\\e[31m"', '"\\0"', '"a\\nb"', '"\\u202e12 V"', '"\\ud800"', '"\\x85"', "a\u202eb",
    "a\u200bb", "\u2066x", "\u00e9t\u00e9", "\U0001f600", "x" * 50, "x" * 300, "x" * 3000,
    "\u00e9" * 250, "/dev/null", "../../etc/passwd", ".", "..", "/", "a/b", "a:b", ":", "a.b:c",
    ".a:b", "simulated:", ":simulated", "benches/simulated.yaml", "clarinet", "seriesA", "campaign",
    "bass-clarinet.yaml", "shuffled", "frames", "dark", "both", "rms", "a..b", "sweep.", ".sweep",
)  # fmt: skip
BYTES = (
    b"\x00", b"\x01", b"\x1b[2J", b"\x7f", b"\x85", b"\xc2\x85", b"\xff\xfe", b"\xef\xbb\xbf",
    b"\xe2\x80\xae", b"\xe2\x80\xa8", b"\xc2\xa0", b"\t", b"\r", b"\r\n", b"\n", b"\xed\xa0\x80",
    b"\xf0\x9f\x98\x80", b'"', b"'", b"{", b"}", b"[", b"]", b":", b"#", b",", b"-", b"&", b"*",
    b"!", b"|", b">", b"%", b"@", b"`", b"?", b" ", b"  ", b"_", b"0", b"9", b".", b"e", b"\\",
)  # fmt: skip
_SPELLINGS = (
    "{n}e3 m{u}", "{n}e-3 k{u}", "{n}{u}", "+{n} {u}", "  {n}   {u} ", "'{n} {u}'", '"{n} {u}"',
    "0{n} {u}", "{n}\u00a0{u}", "{n}e0 {u}", "{n},0 {u}", "{n} {lower}", "{n} {upper}", "{n} {u}s",
    "{n}_0 {u}", "{n} {u} x", "{n}0 {u}", "{n}.{u}", "{n} ({u})", "{u} {n}",
)  # fmt: skip
_VALUE = re.compile(r"(?<=[:,\[{]) *([^\s,\]}\[{:#][^,\]}\n#:]*)")
_NUMBER = re.compile(r"[0-9][0-9._]*")
_UNIT = re.compile(r"(?<=[0-9] )[A-Za-zµ][A-Za-zµ/^3]*")
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_.]*(?=:)")


# --- Bytes -------------------------------------------------------------------------------------


def flip_bytes(data: bytes, rng: random.Random) -> bytes:
    """Replace a few bytes by any others."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5, 20))):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def flip_bit(data: bytes, rng: random.Random) -> bytes:
    """Flip one bit of one byte."""
    changed = bytearray(data)
    if changed:
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def insert_bytes(data: bytes, rng: random.Random) -> bytes:
    """Insert something that means something to YAML, CSV or a terminal."""
    place = rng.randint(0, len(data))
    return data[:place] + rng.choice(BYTES) * rng.choice((1, 1, 1, 2, 200)) + data[place:]


def delete_bytes(data: bytes, rng: random.Random) -> bytes:
    """Delete a stretch."""
    place = rng.randint(0, len(data))
    return data[:place] + data[place + rng.choice((1, 1, 2, 5, 50, 500)) :]


def truncate(data: bytes, rng: random.Random) -> bytes:
    """Keep the first bytes only."""
    return data[: rng.randint(0, len(data))]


def mark_as_utf8(data: bytes, _rng: random.Random) -> bytes:
    """Put a byte order mark first, as Windows does."""
    return b"\xef\xbb\xbf" + data


def windows_lines(data: bytes, rng: random.Random) -> bytes:
    """End lines as Windows, or as old Macs did."""
    return data.replace(b"\n", rng.choice((b"\r\n", b"\r")))


def other_encoding(data: bytes, rng: random.Random) -> bytes:
    """Save the text in another encoding."""
    text = data.decode("utf-8", errors="replace")
    return text.encode(rng.choice(("utf-16", "utf-32", "latin-1", "cp037")), errors="replace")


def grow(data: bytes, rng: random.Random) -> bytes:
    """Repeat a stretch very often, or nest very deeply."""
    place = rng.randint(0, len(data))
    stuff = rng.choice(
        (b"[", b"{a: ", b"- ", b"x", b"9", b"# ", b"\n", b" ", b"a: 1\n", b"R,A,F1,1\n")
    )
    return data[:place] + stuff * rng.choice((100, 1000, 20_000)) + data[place:]


# --- Lines and values --------------------------------------------------------------------------


def delete_line(data: bytes, rng: random.Random) -> bytes:
    """Delete a line."""
    lines = data.splitlines(keepends=True)
    if lines:
        del lines[rng.randrange(len(lines))]
    return b"".join(lines)


def duplicate_line(data: bytes, rng: random.Random) -> bytes:
    """Write a line a second time, next to itself or elsewhere."""
    lines = data.splitlines(keepends=True)
    if lines:
        lines.insert(rng.randint(0, len(lines)), rng.choice(lines))
    return b"".join(lines)


def swap_lines(data: bytes, rng: random.Random) -> bytes:
    """Exchange two lines."""
    lines = data.splitlines(keepends=True)
    if len(lines) > 1:
        one, other = rng.sample(range(len(lines)), 2)
        lines[one], lines[other] = lines[other], lines[one]
    return b"".join(lines)


def indent_line(data: bytes, rng: random.Random) -> bytes:
    """Indent a line more, less, or by a tab."""
    lines = data.splitlines(keepends=True)
    if lines:
        place = rng.randrange(len(lines))
        stripped = lines[place].lstrip(b" ")
        lines[place] = rng.choice((b"", b"  ", b"    ", b"\t", b" ")) + stripped
    return b"".join(lines)


def _replaced(
    data: bytes, pattern: re.Pattern[str], new: Callable[[str], str], rng: random.Random
) -> bytes:
    """Replace one match of a pattern, outside comments."""
    text = data.decode("utf-8", errors="surrogateescape")
    comments = [m.span() for m in re.finditer(r"#[^\n]*", text)]
    found = [
        match
        for match in pattern.finditer(text)
        if not any(start <= match.start() < end for start, end in comments)
    ]
    if not found:
        return data
    match = rng.choice(found)
    group = 1 if pattern.groups else 0
    start, end = match.span(group)
    changed = text[:start] + new(match[group]) + text[end:]
    return changed.encode("utf-8", errors="surrogateescape")


def change_number(data: bytes, rng: random.Random) -> bytes:
    """Put another number, or something like one, in the place of a number."""
    return _replaced(data, _NUMBER, lambda _: rng.choice(NUMBERS), rng)


def scale_number(data: bytes, rng: random.Random) -> bytes:
    """Multiply a number by a power of ten, or change its sign."""

    def scaled(number: str) -> str:
        return (
            rng.choice(("-", ""))
            + number
            + rng.choice(("0", "000", "e3", "e-3", "e12", "e-12", "e30"))
        )

    return _replaced(data, _NUMBER, scaled, rng)


def nudge_number(data: bytes, rng: random.Random) -> bytes:
    """Put a number of the same size in the place of a number."""

    def nudged(number: str) -> str:
        try:
            value = min(float(number), 1e300)
        except ValueError:
            return number
        factor = rng.choice((0.1, 0.5, 0.9, 0.99, 1.01, 1.1, 2.0, 10.0))
        whole = "." not in number
        return str(round(value * factor)) if whole else f"{value * factor:.4f}"

    return _replaced(data, _NUMBER, nudged, rng)


def respell(data: bytes, rng: random.Random) -> bytes:
    """Write a quantity in another way that means the same, or looks as if it did."""

    def respelt(quantity: str) -> str:
        number, unit = quantity.split()
        return rng.choice(_SPELLINGS).format(
            n=number, u=unit, lower=unit.lower(), upper=unit.upper()
        )

    return _replaced(data, re.compile(r"[0-9][0-9.]* [A-Za-zµ]+"), respelt, rng)


def change_unit(data: bytes, rng: random.Random) -> bytes:
    """Put another unit, or something like one, in the place of a unit."""
    return _replaced(data, _UNIT, lambda _: rng.choice(UNITS), rng)


def change_value(data: bytes, rng: random.Random) -> bytes:
    """Put a word, a number or a structure in the place of a value."""
    return _replaced(data, _VALUE, lambda _: rng.choice(WORDS + NUMBERS), rng)


def change_both(data: bytes, rng: random.Random) -> bytes:
    """Put another number with another unit in the place of a value."""

    def quantity(_: str) -> str:
        return rng.choice(NUMBERS) + rng.choice((" ", "", "  ", "\u00a0", "_")) + rng.choice(UNITS)

    return _replaced(data, _VALUE, quantity, rng)


def swap_values(data: bytes, rng: random.Random) -> bytes:
    """Put one value in the place of another."""
    text = data.decode("utf-8", errors="replace")
    values = [match[1] for match in _VALUE.finditer(text)]
    return _replaced(data, _VALUE, lambda _: rng.choice(values), rng) if values else data


def misspell_key(data: bytes, rng: random.Random) -> bytes:
    """Change a key by a letter, its case, or altogether."""

    def misspelt(key: str) -> str:
        place = rng.randrange(len(key))
        return rng.choice(
            (
                key[:place] + key[place + 1 :],
                key[:place] + key[place] + key[place:],
                key.upper(),
                key + "s",
                key.replace("_", "-"),
                key + " ",
                "",
                rng.choice(WORDS),
                "k" * 2000,
            )
        )

    return _replaced(data, _KEY, misspelt, rng)


def swap_keys(data: bytes, rng: random.Random) -> bytes:
    """Put one key in the place of another."""
    text = data.decode("utf-8", errors="replace")
    keys = [match[0] for match in _KEY.finditer(text)]
    return _replaced(data, _KEY, lambda _: rng.choice(keys), rng) if keys else data


def empty_value(data: bytes, rng: random.Random) -> bytes:
    """Leave a value out, with its key standing."""
    return _replaced(data, re.compile(r"(?<=:)( +[^\n]+|\n)"), lambda _: "\n", rng)


# --- The parsed tree ---------------------------------------------------------------------------

_Place = tuple[Any, Any]


def _places(tree: Any) -> Iterator[_Place]:
    """Every container with a key or index of it."""
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    for key, value in list(items):
        yield tree, key
        yield from _places(value)


def _tree_mutation(
    change: Callable[[dict[str, Any], list[_Place], random.Random], None],
) -> Mutation:
    def mutated(data: bytes, rng: random.Random) -> bytes:
        try:
            tree = yaml.safe_load(data)
        except (yaml.YAMLError, ValueError, TypeError, RecursionError):
            return data
        places = list(_places(tree))
        if not isinstance(tree, dict) or not places:
            return data
        change(tree, places, rng)
        try:
            written: str = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=200)
            return written.encode("utf-8", errors="replace")
        except (yaml.YAMLError, RecursionError, TypeError, ValueError):
            return data

    mutated.__name__ = change.__name__.lstrip("_")
    mutated.__doc__ = change.__doc__
    return mutated


def _drop_key(_tree: dict[str, Any], places: list[_Place], rng: random.Random) -> None:
    """Drop a key or an item."""
    holder, key = rng.choice(places)
    del holder[key]


def _retype(_tree: dict[str, Any], places: list[_Place], rng: random.Random) -> None:
    """Give a value another type."""
    holder, key = rng.choice(places)
    value = holder[key]
    holder[key] = rng.choice(
        (
            None,
            True,
            False,
            0,
            -1,
            1.5,
            float("nan"),
            float("inf"),
            "",
            [],
            {},
            [value],
            {"a": value},
            str(value),
            f"{value} Hz",
            10**30,
            [value] * 3,
            {"from": value},
            [[value]],
            "x" * 500,
        )
    )


def _move(tree: dict[str, Any], places: list[_Place], rng: random.Random) -> None:
    """Move a value to another section."""
    holder, key = rng.choice(places)
    value = deepcopy(holder[key])
    del holder[key]
    _put(tree, key, value, rng)


def _copy_elsewhere(tree: dict[str, Any], places: list[_Place], rng: random.Random) -> None:
    """Copy a value to another section."""
    holder, key = rng.choice(places)
    _put(tree, key, deepcopy(holder[key]), rng)


def _put(tree: dict[str, Any], key: Any, value: Any, rng: random.Random) -> None:
    holders = [tree, *(h[k] for h, k in _places(tree) if isinstance(h[k], dict | list))]
    holder = rng.choice(holders)
    if isinstance(holder, list):
        holder.insert(rng.randint(0, len(holder)), value)
    else:
        holder[str(key)] = value


def _swap(_tree: dict[str, Any], places: list[_Place], rng: random.Random) -> None:
    """Exchange two values."""
    (one, key), (other, other_key) = rng.choice(places), rng.choice(places)
    first, second = deepcopy(one[key]), deepcopy(other[other_key])
    one[key] = second
    if other_key in other if isinstance(other, dict) else other_key < len(other):
        other[other_key] = first


def _rename(_tree: dict[str, Any], places: list[_Place], rng: random.Random) -> None:
    """Give a value the key of another one."""
    named = [(holder, key) for holder, key in places if isinstance(holder, dict)]
    holder, key = rng.choice(named)
    holder[rng.choice(named)[1]] = holder.pop(key)


_BYTES = (flip_bytes, flip_bit, insert_bytes, delete_bytes, truncate, mark_as_utf8, windows_lines,
          other_encoding, grow)  # fmt: skip
_LINES = (delete_line, duplicate_line, swap_lines, indent_line)
_VALUES = (nudge_number, nudge_number, respell, respell, change_number, scale_number, change_unit,
           change_value, change_both, swap_values, misspell_key, swap_keys,
           empty_value)  # fmt: skip
_TREE = tuple(map(_tree_mutation, (_drop_key, _retype, _move, _copy_elsewhere, _swap, _rename)))

# Values and trees most often: what a byte changes is mostly no YAML any more.
_GROUPS: dict[tuple[Mutation, ...], int] = {_BYTES: 2, _LINES: 1, _VALUES: 4, _TREE: 3}


def drawn_mutations(rng: random.Random) -> list[tuple[Mutation, int]]:
    """One to three mutations, each with the seed of its randomness."""
    chosen = rng.choices(
        tuple(_GROUPS), tuple(_GROUPS.values()), k=rng.choice((1, 1, 1, 1, 2, 2, 3))
    )
    return [(rng.choice(group), rng.getrandbits(32)) for group in chosen]


# --- Tables ------------------------------------------------------------------------------------


def change_cell(data: bytes, rng: random.Random) -> bytes:
    """Put something else in a cell of a table."""
    return _on_cells(data, rng, lambda _: rng.choice(NUMBERS + WORDS))


def swap_cells(data: bytes, rng: random.Random) -> bytes:
    """Put one cell of a table in the place of another."""
    cells = [
        cell
        for line in data.decode("utf-8", errors="replace").splitlines()
        for cell in line.split(",")
    ]
    return _on_cells(data, rng, lambda _: rng.choice(cells))


def decimal_comma(data: bytes, rng: random.Random) -> bytes:
    """Write the decimals of a cell, or of all, with a comma."""
    return data.replace(b".", b",", rng.choice((1, -1)))


def other_separator(data: bytes, rng: random.Random) -> bytes:
    """Separate cells as spreadsheets of other countries do."""
    return data.replace(b",", rng.choice((b";", b"\t", b", ", b" ,")))


def add_column(data: bytes, rng: random.Random) -> bytes:
    """Add a column, in all rows or in one."""
    lines = data.splitlines()
    chosen = (
        range(len(lines)) if rng.random() < 0.5 else [rng.randrange(len(lines))] if lines else []
    )
    for place in chosen:
        lines[place] += b"," + rng.choice((b"", b"hz", b"1", b"note", b"error_cents"))
    return b"\n".join(lines)


def drop_cell(data: bytes, rng: random.Random) -> bytes:
    """Drop a cell."""
    return _on_cells(data, rng, None)


def quote_cell(data: bytes, rng: random.Random) -> bytes:
    """Quote a cell, or open a quote only."""
    return _on_cells(
        data, rng, lambda cell: rng.choice(('"{}"', '"{}', '{}"', '"{}\n"', "'{}'")).format(cell)
    )


def _on_cells(data: bytes, rng: random.Random, new: Callable[[str], str] | None) -> bytes:
    lines = data.decode("utf-8", errors="surrogateescape").split("\n")
    place = rng.randrange(len(lines))
    cells = lines[place].split(",")
    column = rng.randrange(len(cells))
    cells[column : column + 1] = [] if new is None else [new(cells[column])]
    lines[place] = ",".join(cells)
    return "\n".join(lines).encode("utf-8", errors="surrogateescape")


_TABLE = (change_cell, change_cell, change_cell, change_number, nudge_number, nudge_number,
          scale_number, swap_cells, decimal_comma, other_separator, add_column, drop_cell,
          quote_cell)  # fmt: skip


def drawn_table_mutations(rng: random.Random) -> list[tuple[Mutation, int]]:
    """One to three mutations of a table, each with the seed of its randomness."""
    chosen = rng.choices((_BYTES, _LINES, _TABLE), (2, 2, 6), k=rng.choice((1, 1, 1, 1, 2, 2, 3)))
    return [(rng.choice(group), rng.getrandbits(32)) for group in chosen]


def mutated(data: bytes, mutations: list[tuple[Mutation, int]]) -> bytes:
    """Apply mutations, one after the other."""
    for mutation, seed in mutations:
        data = mutation(data, random.Random(seed))
    return data
