"""What a person expects of a file that was accepted."""

import json
import math
import re
import unicodedata
from collections.abc import Iterator
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from acquire.cli.display import plan_summary
from protocols.plan import Plan
from protocols.yaml_files.strict_yaml import Description
from reports.run_tables import plan_table
from reports.tables import terminal_table


class Implausible(Exception):  # noqa: N818  # an outcome of a benchmark, not an error of a program
    """An accepted file that does not mean what a person reads in it.

    Attributes
    ----------
    what : str
        What is wrong, in words that are the same for every file that it is wrong with.
    """

    def __init__(self, what: str, details: str = "") -> None:
        super().__init__(f"{what}: {details}"[:300])
        self.what = what


# --- What a person reads -----------------------------------------------------------------------

DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
QUANTITY = re.compile(rf"({DECIMAL.pattern})\s*(\S+)")
_PREFIXES = {
    "": 0, "n": -9, "u": -6, "µ": -6, "μ": -6, "m": -3, "c": -2, "k": 3, "M": 6, "G": 9,
    "nano": -9, "micro": -6, "milli": -3, "centi": -2, "kilo": 3, "mega": 6, "giga": 9,
}  # fmt: skip
_BASES = {
    "Hz": ("Hz", 1), "hertz": ("Hz", 1), "V": ("V", 1), "volt": ("V", 1), "m": ("m", 1),
    "meter": ("m", 1), "metre": ("m", 1), "s": ("s", 1), "second": ("s", 1), "min": ("s", 60),
    "minute": ("s", 60), "ohm": ("ohm", 1), "cent": ("cents", 1), "rad": ("rad", 1),
    "radian": ("rad", 1), "Pa": ("Pa", 1), "pascal": ("Pa", 1), "g": ("g", 1), "gram": ("g", 1),
    "K": ("K", 1), "kelvin": ("K", 1),
}  # fmt: skip


def _unit(written: str) -> tuple[str, Fraction] | None:
    """Unit that a quantity is kept in, and how many of it a written unit is, also in the plural."""
    return _single_unit(written) or _single_unit(written.removesuffix("s"))


def _single_unit(written: str) -> tuple[str, Fraction] | None:
    mass, slash, length = written.partition("/")
    if slash:
        top, below = _unit(mass), _unit(length.removesuffix("^3"))
        if top is None or below is None or top[0] != "g" or below[0] != "m":
            return None
        return "kg/m^3", top[1] / 1000 / below[1] ** 3
    for prefix, power in _PREFIXES.items():
        base = _BASES.get(written.removeprefix(prefix))
        if written.startswith(prefix) and base is not None:
            return base[0], base[1] * Fraction(10) ** power
    return None


def quantity(text: str, unit: str) -> Fraction | None:
    """Number of a written quantity in a unit; None if it is none."""
    match = QUANTITY.fullmatch(text.strip())
    if match is None:
        return None
    number, written = Fraction(match[1]), match[2]
    if unit == "degC":
        known = _unit(written)
        if known is not None and known[0] == "K":
            return number * known[1] - Fraction("273.15")
        return number if written in ("degC", "degCs") else None
    known = _unit(written)
    return number * known[1] if known is not None and known[0] == unit else None


def composed(text: str) -> yaml.Node:
    """Return the nodes of a text, with every scalar as text."""
    root = yaml.compose(text, Loader=yaml.BaseLoader)
    if root is None:
        raise Implausible("an empty file was accepted")
    return root


def disagreements(node: yaml.Node, content: Any, path: str = "") -> Iterator[Implausible]:
    """Where plain content differs from the file, node by node.

    Parameters
    ----------
    node : Node
        Of the text, by a loader that takes every scalar for text.
    content : object
        What `Description.content` says there.
    """
    if isinstance(node, yaml.MappingNode):
        if not isinstance(content, dict):
            yield Implausible("a mapping was read as something else", f"{path}: {content!r}")
            return
        seen = set()
        for key, value in node.value:
            below = f"{path}.{key.value}"
            if key.value in seen:
                yield Implausible("a key given twice was accepted", below)
            seen.add(key.value)
            yield from disagreements(value, content.get(key.value), below)
    elif isinstance(node, yaml.SequenceNode):
        if not isinstance(content, list) or len(content) != len(node.value):
            yield Implausible("a list was read as something else", f"{path}: {content!r}")
            return
        for number, (value, item) in enumerate(zip(node.value, content, strict=True)):
            yield from disagreements(value, item, f"{path}[{number}]")
    elif isinstance(node, yaml.ScalarNode) and not _agrees(node.value, node.style, content):
        kind = type(content).__name__
        yield Implausible(
            f"a value was read as another {kind}", f"{path}: {node.value!r}: {content!r}"
        )


def _agrees(written: str, style: str | None, content: Any) -> bool:
    """Whether a scalar means a value to a person."""
    if content is None:
        return style is None and written.lower() in ("null", "~")
    if isinstance(content, bool):
        return style is None and written.lower() in (
            ("true", "yes", "on") if content else ("false", "no", "off")
        )
    if isinstance(content, int | float):
        if style is not None or not DECIMAL.fullmatch(written):
            return False
        return (
            float(written) == content if isinstance(content, float) else Decimal(written) == content
        )
    if not isinstance(content, str) or not is_seen(content):
        return False
    if content == written:
        return True
    match = QUANTITY.fullmatch(content)
    return match is not None and quantity(written, match[2]) == Fraction(match[1])


def is_seen(text: str) -> bool:
    """Whether a text can be shown: no control, bidirectional or other invisible characters."""
    return all(c.isprintable() or unicodedata.category(c) in ("Zs", "Cn", "Co") for c in text)


def require(holds: bool, what: str, details: object = "") -> None:
    """Raise `Implausible` unless something holds."""
    if not holds:
        raise Implausible(what, str(details))


def require_meant(description: Description, file: Path) -> None:
    """Require that a description says what its file says, and reads back as the same."""
    content = description.content()
    root = composed(file.read_bytes().decode("utf-8-sig"))
    for disagreement in disagreements(root, content):
        raise disagreement
    json.dumps(content, allow_nan=False)
    again = type(description).from_text(description.replace({}).text, description.source)
    require(again.content() == content, "its written content reads as something else")
    require(again == description, "its written content makes another description")
    require(again.sha256 == description.sha256, "its written content has another hash")
    same = type(description).from_text(description.text, description.source)
    require(same.content() == content, "its text reads as something else")


# --- Plans -------------------------------------------------------------------------------------


def require_plausible(plan: Plan) -> None:
    """Require what everybody expects of a plan."""
    said = json.loads(json.dumps(plan.to_json(), allow_nan=False))
    require(len(said["steps"]) == len(plan.steps), "a plan's JSON has other steps")
    terminal_table(plan_table(plan))
    for line in plan_summary(plan):
        require(line.isprintable() and len(line) < 1000, "a summary of a plan", line)
    require(sorted(plan.sequence) == list(range(len(plan.steps))), "steps are not taken once each")
    require(math.isfinite(plan.duration_s) and plan.duration_s > 0, "a duration is not positive")
    require(0 <= plan.file_size_bytes <= plan.largest_size_bytes, "a size is negative")
    _require_steps(plan)
    if not plan.violations:
        _require_possible(plan)


def _require_steps(plan: Plan) -> None:
    protocol, steps = plan.protocol, plan.steps
    if protocol.calibration is not None:
        exposures = protocol.calibration.exposures_s or (protocol.exposure_s,)
        count = protocol.calibration.count * len(exposures)
    else:
        count = len(protocol.sweep.indices) * len(protocol.sideband.selected)
    require(len(steps) == count > 0, "the number of steps is not that of the file")
    for step in steps:
        require(math.isfinite(step.volts) and step.volts >= 0, "volts of a step", step)
        require(math.isfinite(step.carrier_leak), "leak of a step", step)
        require(step.aom1_hz - step.aom2_hz == step.difference_hz, "AOM1 − AOM2 is another number")


def _require_possible(plan: Plan) -> None:
    """Require that a plan without violations keeps all limits of its bench."""
    require(plan.file_size_bytes > 0, "a possible plan has no size")
    limits, instruments = plan.bench.limits, plan.bench.instruments
    synthesizers, camera = instruments.synthesizers, plan.protocol.camera
    still = plan.protocol.calibration is not None
    driven: set[tuple[Fraction, int]] = set()
    for step in plan.steps:
        for name, hz in (("AOM1", step.aom1_hz), ("AOM2", step.aom2_hz)):
            away_hz = abs(hz - synthesizers.centre_hz)
            require(hz > 0, f"{name} is not positive", hz)
            require(away_hz <= synthesizers.window_hz, f"{name} stands outside the window")
            require(hz % synthesizers.step_hz == 0, f"{name} is not on the synthesizers' grid")
        require(0 < step.exposure_s <= camera.period_s, "an exposure longer than its period")
        if still:
            continue
        require(limits.drive_min_hz <= step.drive_hz <= limits.drive_max_hz, "drive outside limits")
        require(step.drive_hz % instruments.generator.step_hz == 0, "a drive off its grid")
        require((step.drive_hz, step.order) not in driven, "two steps have the same drive")
        driven.add((step.drive_hz, step.order))
        # Volts are to 1 µV.
        require(
            float(limits.volts_min_v) - 1e-6 <= step.volts <= float(limits.volts_max_v) + 1e-6,
            "volts outside limits",
        )
    require(camera.frame_rate_hz <= instruments.camera.max_frame_rate_hz, "too fast a camera")
    rows, columns = plan.frame_shape
    require(
        rows <= instruments.camera.height and columns <= instruments.camera.width, "a large frame"
    )
    region = plan.region
    require(
        region.row + region.height <= rows and region.column + region.width <= columns,
        "a region outside the image",
    )
