"""What reads mutated text files, and what a person expects of a file that was accepted."""

import csv
import io
import json
import math
import re
import unicodedata
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from acquire.cli.display import plan_summary
from benchmarks.fuzz_mutations import Mutation, drawn_mutations, drawn_table_mutations
from diagnosis.known_bench import base_twin, only_once
from diagnosis.mean_reed import tabled_reeds
from drivers.errors import BenchSetupError
from drivers.options import read_options
from drivers.registry import find_driver
from drivers.simulated.settings import (
    bench_constants,
    bench_geometry,
    model_settings,
    read_simulation,
)
from fitting.populations.resonance_table import (
    COLUMNS,
    ERROR_COLUMN,
    read_resonances,
)
from physics.optics import visible_size_m
from physics.reed.mode_classification import PAPER_MODES
from protocols.bench import BenchFile
from protocols.campaign import CampaignFile, tasks_of
from protocols.plan import Plan, make_plan
from protocols.protocol import Protocol
from protocols.reed import ReedFile
from protocols.strict_yaml import Description
from reports.run_tables import campaign_table, plan_table
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


@dataclass(frozen=True)
class Reader:
    """One kind of file.

    Attributes
    ----------
    seeds : tuple of bytes
        Files that are in order.
    name : str
        Of the mutated file.
    read : callable
        Reads a file as the program does; raises `Implausible`.
    mutations : callable
        Draws what to do to a seed.
    """

    seeds: tuple[bytes, ...]
    name: str
    read: Callable[[Path], None]
    mutations: Callable[..., list[tuple[Mutation, int]]] = drawn_mutations


# --- What a person reads -----------------------------------------------------------------------

_DECIMAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_QUANTITY = re.compile(rf"({_DECIMAL.pattern})\s*(\S+)")
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


def _quantity(text: str, unit: str) -> Fraction | None:
    """Number of a written quantity in a unit; None if it is none."""
    match = _QUANTITY.fullmatch(text.strip())
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


def _composed(text: str) -> yaml.Node:
    """Return the nodes of a text, with every scalar as text."""
    root = yaml.compose(text, Loader=yaml.BaseLoader)
    if root is None:
        raise Implausible("an empty file was accepted")
    return root


def disagreements(node: yaml.Node, content: Any, path: str = "") -> Iterator[Implausible]:
    """Where plain content is not what stands in the file, node by node.

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
        if style is not None or not _DECIMAL.fullmatch(written):
            return False
        return (
            float(written) == content if isinstance(content, float) else Decimal(written) == content
        )
    if not isinstance(content, str) or not is_seen(content):
        return False
    if content == written:
        return True
    match = _QUANTITY.fullmatch(content)
    return match is not None and _quantity(written, match[2]) == Fraction(match[1])


def is_seen(text: str) -> bool:
    """Whether a text can be shown: no control, bidirectional or other invisible characters."""
    return all(c.isprintable() or unicodedata.category(c) in ("Zs", "Cn", "Co") for c in text)


def _require(holds: bool, what: str, details: object = "") -> None:
    if not holds:
        raise Implausible(what, str(details))


def require_meant(description: Description, file: Path) -> None:
    """Require that a description says what its file says, and reads back as the same."""
    content = description.content()
    root = _composed(file.read_bytes().decode("utf-8-sig"))
    for disagreement in disagreements(root, content):
        raise disagreement
    json.dumps(content, allow_nan=False)
    again = type(description).from_text(description.replace({}).text, description.source)
    _require(again.content() == content, "its written content reads as something else")
    _require(again == description, "its written content makes another description")
    _require(again.sha256 == description.sha256, "its written content has another hash")
    same = type(description).from_text(description.text, description.source)
    _require(same.content() == content, "its text reads as something else")


# --- Plans -------------------------------------------------------------------------------------


def require_plausible(plan: Plan) -> None:
    """Require what everybody expects of a plan."""
    said = json.loads(json.dumps(plan.to_json(), allow_nan=False))
    _require(len(said["steps"]) == len(plan.steps), "a plan's JSON has other steps")
    terminal_table(plan_table(plan))
    for line in plan_summary(plan):
        _require(line.isprintable() and len(line) < 1000, "a summary of a plan", line)
    _require(sorted(plan.sequence) == list(range(len(plan.steps))), "steps are not taken once each")
    _require(math.isfinite(plan.duration_s) and plan.duration_s > 0, "a duration is not positive")
    _require(0 <= plan.file_size_bytes <= plan.largest_size_bytes, "a size is negative")
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
    _require(len(steps) == count > 0, "the number of steps is not that of the file")
    for step in steps:
        _require(math.isfinite(step.volts) and step.volts >= 0, "volts of a step", step)
        _require(math.isfinite(step.carrier_leak), "leak of a step", step)
        _require(step.aom1_hz - step.aom2_hz == step.difference_hz, "AOM1 − AOM2 is another number")


def _require_possible(plan: Plan) -> None:
    """Require that a plan without violations keeps all limits of its bench."""
    _require(plan.file_size_bytes > 0, "a possible plan has no size")
    limits, instruments = plan.bench.limits, plan.bench.instruments
    synthesizers, camera = instruments.synthesizers, plan.protocol.camera
    still = plan.protocol.calibration is not None
    driven: set[tuple[Fraction, int]] = set()
    for step in plan.steps:
        for name, hz in (("AOM1", step.aom1_hz), ("AOM2", step.aom2_hz)):
            away_hz = abs(hz - synthesizers.centre_hz)
            _require(hz > 0, f"{name} is not positive", hz)
            _require(away_hz <= synthesizers.window_hz, f"{name} stands outside the window")
            _require(hz % synthesizers.step_hz == 0, f"{name} is not on the synthesizers' grid")
        _require(0 < step.exposure_s <= camera.period_s, "an exposure longer than its period")
        if still:
            continue
        _require(
            limits.drive_min_hz <= step.drive_hz <= limits.drive_max_hz, "drive outside limits"
        )
        _require(step.drive_hz % instruments.generator.step_hz == 0, "a drive off its grid")
        _require((step.drive_hz, step.order) not in driven, "two steps have the same drive")
        driven.add((step.drive_hz, step.order))
        # Volts are to 1 µV.
        _require(
            float(limits.volts_min_v) - 1e-6 <= step.volts <= float(limits.volts_max_v) + 1e-6,
            "volts outside limits",
        )
    _require(camera.frame_rate_hz <= instruments.camera.max_frame_rate_hz, "too fast a camera")
    rows, columns = plan.frame_shape
    _require(
        rows <= instruments.camera.height and columns <= instruments.camera.width, "a large frame"
    )
    region = plan.region
    _require(
        region.row + region.height <= rows and region.column + region.width <= columns,
        "a region outside the image",
    )


# --- The kinds of file -------------------------------------------------------------------------


def _read_protocol(file: Path) -> None:
    protocol = Protocol.from_file(file)
    plan = make_plan(protocol, _BENCH)
    require_plausible(plan)
    require_meant(protocol, file)
    again = Protocol.from_text(protocol.text, protocol.source)
    _require(again == protocol, "a text reads as another protocol")


# Options that the drivers of the emulated bench add.
_ADDED = {"emulated-novatech": {"port": "x"}, "emulated-siglent": {"resource": "x"}}


def _read_bench(file: Path) -> None:
    bench = BenchFile.from_file(file)
    plan = make_plan(_QUICK, bench)
    require_plausible(plan)
    require_meant(bench, file)
    plan.require_possible()
    for role in ("synthesizers", "generator", "camera"):
        entry = getattr(bench.instruments, role)
        model = getattr(find_driver(role, entry.driver), "OPTIONS", None)
        if model is not None:
            options = {**entry.options, **_ADDED.get(entry.driver, {})}
            read_options(model, options, bench.name, f"instruments.{role}.options")
    twin, preparation = read_simulation(bench.twin, bench.name), plan.preparation("R07")
    model_settings(twin, bench, preparation)
    try:
        bench_geometry(twin, preparation)
    except ValueError as error:
        # The simulated laboratory says so, with the bench's name.
        raise BenchSetupError(f"bench {bench.name!r}: {error}") from error
    bench_constants(twin, preparation)
    base_twin(bench)
    only_once(bench)


def _read_reed(file: Path) -> None:
    reed = ReedFile.from_file(file)
    require_meant(reed, file)
    geometry, cane = reed.geometry(), reed.cane()
    numbers = [*vars(cane).values(), geometry.heel_radius_m, geometry.heel_sagitta_m]
    numbers += [*vars(geometry.outline).values(), *geometry.vamp_x_m, *geometry.vamp_y_m]
    _require(bool(np.isfinite(numbers).all()), "a reed has a number that is not finite")
    reed.constants()
    viscoelastic = reed.viscoelastic()
    _require(
        viscoelastic is None
        or bool(
            np.isfinite([*astuple(viscoelastic.young_L), *astuple(viscoelastic.shear_LT)]).all()
        ),
        "a viscoelastic cane has a number that is not finite",
    )
    _require(min(visible_size_m(geometry)) > 0, "a reed has no size")


def _read_campaign(file: Path) -> None:
    campaign = CampaignFile.from_file(file)
    tasks = tasks_of(campaign)
    plans = [make_plan(task.protocol, _BENCH) for task in tasks]
    terminal_table(campaign_table(tasks, plans))
    require_meant(campaign, file)
    _require(len(tasks) == len(campaign.parts), "a campaign has other parts")
    for plan in plans:
        require_plausible(plan)
    for task in tasks:
        content = task.protocol.content()
        for key, value in task.part.change.items():
            _require_changed(content, key, value)


def _require_changed(content: dict[str, Any], key: str, value: Any) -> None:
    """Require that a change of a campaign's part shows in its protocol."""
    kept: Any = content
    for name in key.split("."):
        kept = kept.get(name) if isinstance(kept, dict) else None
    written = _composed(yaml.safe_dump(value, allow_unicode=True))
    if isinstance(kept, dict) and isinstance(value, dict):
        for below, inner in value.items():
            _require_changed(kept, below, inner)
        return
    for disagreement in disagreements(written, kept, f"change.{key}"):
        raise disagreement


def _read_table(file: Path) -> None:
    pieces = list(read_resonances(file, PAPER_MODES))
    read = {
        (reed, series, mode): (piece.cents[n, s, m], piece.error_cents[n, s, m])
        for piece in pieces
        for n, reed in enumerate(piece.reeds)
        for s, series in enumerate("AB")
        for m, mode in enumerate(PAPER_MODES)
        if np.isfinite(piece.cents[n, s, m])
    }
    passed_over = sum(piece.passed_over for piece in pieces)
    _require_cells(file, read, passed_over)
    for mean in tabled_reeds(file):
        _require(bool(np.isfinite(mean.cents).all()), "a mean is not finite")
        _require(
            bool((mean.error_cents > 0).all() and np.isfinite(mean.error_cents).all()), "an error"
        )


def _require_cells(file: Path, read: dict[tuple[str, str, str], Any], passed_over: int) -> None:
    """Require that every row of a table was read, as a person reads it."""
    text = file.read_bytes().decode("utf-8-sig")
    rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    heads = rows[0]
    used = [head for head in heads if head in (*COLUMNS, ERROR_COLUMN)]
    _require(len(set(used)) == len(used), "two columns of one name")
    seen = set()
    for row in rows[1:]:
        _require(not any(row[len(heads) :]), "a row of more cells than columns was accepted", row)
        cells = dict(zip(heads, (cell.strip() for cell in row), strict=False))
        _require(
            all(is_seen(cells.get(head, "")) for head in used), "a control character in a cell"
        )
        if cells["mode"] not in PAPER_MODES:
            passed_over -= 1
            continue
        key = cells["reed"], cells["series"], cells["mode"]
        _require(key in read and key not in seen, "a row was not read, or twice", key)
        seen.add(key)
        hz = _DECIMAL.fullmatch(cells["hz"])
        _require(hz is not None, "what is no decimal number was read", cells["hz"])
        cents = 1200 * math.log2(float(cells["hz"]) / 1396.9)
        _require(abs(cents - read[key][0]) < 1e-6, "another frequency was read", cells["hz"])
        _require(abs(cents) < 12_000, "an absurd frequency was accepted", cells["hz"])
        if "error_cents" in cells:
            error = _DECIMAL.fullmatch(cells["error_cents"])
            _require(
                error is not None and float(cells["error_cents"]) == read[key][1],
                "another error was read",
                cells["error_cents"],
            )
    _require(len(seen) == len(read), "resonances that no row has")
    _require(passed_over == 0, "rows passed over are not counted")


# --- Seeds -------------------------------------------------------------------------------------

_SHIPPED = Path(__file__).parents[1] / "protocols"
_BENCH, _QUICK = BenchFile.from_file(), Protocol.from_file("quick").replace({"sweep.stride": 12})

# Keys that no shipped file has.
_MORE_PROTOCOL = b"""name: all keys
series: A
chamber: symmetric
reed: bass-clarinet
sweep: {law: geometric, reference: 1396.9 Hz, interval: 25 cents, first: 12, last: 40, stride: 4}
drive: {law: ramp, from: 500 mV, to: 16 V, first: 1, last: 73}
sideband: {order: 1, orders: [0, 1, 2]}
camera: {frames: 4, frame_rate: 12.4 Hz, exposure: 40 ms, width: 640, height: 512}
settle: 40 ms
tolerance: {lock_phase: 10 mrad}
policy:
  bad_step: {retries: 2, then: stop}
  instrument_error: {retries: 1, then: skip}
keep: frames
"""
_OTHER_LAWS = [
    re.sub(rb"sweep:.*\ndrive:.*", b"sweep: " + sweep + b"\ndrive: " + drive, _MORE_PROTOCOL)
    for sweep, drive in (
        (
            b"{law: linear, from: 1 kHz, to: 1.5 kHz, step: 12.5 Hz, direction: shuffled}",
            b"{law: table, frequencies: [1 kHz, 2 kHz, 9 kHz], volts: [8 V, 4 V, 1 V]}",
        ),
        (
            b"{law: list, frequencies: [1 kHz, 1.7 kHz, 3 kHz], direction: down}",
            b"{law: constant, volts: 500 mV}",
        ),
    )
]
_CALIBRATION = _MORE_PROTOCOL + b"calibration: {kind: flat, count: 2, exposures: [20 ms, 40 ms]}\n"
_MORE_BENCH = b"""name: all keys
instruments:
  synthesizers:
    driver: srs-sg380
    step: 1 uHz
    centre: 80 MHz
    window: 5 MHz
    options: {resources: [a, b], power_dbm: 3.0, power_max_dbm: 10.0, baud: 9600}
  generator:
    driver: sound-card
    step: 1 uHz
    output: {amplifier_gain: 2.0, load: 8 ohm}
    options: {volts_per_full_scale: 1.2, channel: 2, device: card}
  camera:
    driver: basler
    width: 1280
    height: 1024
    pixel: 6.7 um
    bits: 12
    max_frame_rate: 12.5 Hz
    data_sheet: {offset_dn: 12.0, gain_e_dn: 2.5, read_noise_e: 9.0, full_well_e: 10000.0}
    options: {trigger: software, pixel_format: Mono12, timeout_s: 3.0}
optics:
  wavelength: 650 nm
  distance: 1.0 m
  reed_centre: {y: 22 mm, x: -1 mm}
  reed_size: {y: 14 mm, x: 38 mm}
limits: {volts_are: rms, volts_min: 1 mV, volts_max: 12 V, drive_min: 20 Hz, drive_max: 20 kHz}
acoustic_resonances: [4308.6 Hz, 9 kHz]
known:
  sensor_nonlinearity: {fraction: 0.01}
  bench_vibration: {jitter: 100 mrad}
twin:
  reed: {e1: 0.5, e2: -0.5, e3: 0.0, e4: 0.0}
  shape:
    thickness_offset_um: 3.0
    thickness_map:
      {x_mm: [2.0, 20.0], y_mm: [-5.0, 0.0, 5.0], deviation_um: [[3, 0, 3], [-5, 0, -5]]}
  cane_factors: {E_T: 1.1, density: 0.9}
  pressure: {distortion: 0.1, seed: 3}
  loss_factor: 0.02
  light: {gain_scatter: 0.01, phase_scatter: true}
  mesh: coarse
  faults: {drop_frame_at: [3], no_frame_from: 9, generator_wire: {}}
"""
_MORE_REED = b"""  thickness_offset: 10 um
  thickness_map:
    x: [2 mm, 20 mm]
    y: [-5 mm, 0 mm, 5 mm]
    deviation: [[3 um, 0 um, 3 um], [-5 um, 0 um, -5 um]]
"""
_SHORT_CAMPAIGN = b"""name: Short
protocol: quick
parts:
  - name: dark
    do: cover the camera
    change: {keep: frames, calibration: {kind: dark}}
  - name: flat
    change:
      keep: frames
      calibration: {kind: flat, count: 1, exposures: [20 ms, 40 ms]}
  - name: down
    change: {sweep.direction: down, sweep.stride: 40, camera.exposure: 40 ms}
  - name: quiet
    do: take the reed out
    new_clamping: true
    change:
      drive.from: 0.125 V
      drive.to: 4 V
      sweep: {law: geometric, reference: 1396.9 Hz, interval: 25 cents, first: 1, last: 9}
"""


def _shipped(folder: str) -> list[bytes]:
    files = sorted((_SHIPPED / folder).glob("*.yaml"))
    return [file.read_bytes() for file in files if file.name != "campaign.yaml"]


def _reeds() -> list[bytes]:
    reeds = _shipped("reeds")
    with_map = [reed.replace(b"cane:\n", _MORE_REED + b"cane:\n") for reed in reeds]
    return reeds + [re.sub(rb"side: bark", b"side: both", reed) for reed in with_map]


def _table(error: bool) -> bytes:
    """Resonances of three reeds in both series."""
    rng = np.random.default_rng(4)
    lines = ["reed,series,mode,hz" + ",error_cents" * error]
    for reed in ("R01", "R02", "R03"):
        for series in "AB":
            for m, mode in enumerate(PAPER_MODES):
                hz = 1500 * (1 + 0.6 * m) * rng.normal(1, 0.02)
                lines.append(f"{reed},{series},{mode},{hz:.3f}" + f",{3 + m:.1f}" * error)
    return "\n".join([*lines, ""]).encode()


READERS = {
    "protocol": Reader(
        (*_shipped("."), _MORE_PROTOCOL, *_OTHER_LAWS, _CALIBRATION),
        "protocol.yaml",
        _read_protocol,
    ),
    "bench": Reader((*_shipped("benches"), _MORE_BENCH), "bench.yaml", _read_bench),
    "reed": Reader(tuple(_reeds()), "reed.yaml", _read_reed),
    "campaign": Reader(
        # The shipped one has twelve parts of 184 steps: now and then only.
        (*[_SHORT_CAMPAIGN] * 19, (_SHIPPED / "campaign.yaml").read_bytes()),
        "campaign.yaml",
        _read_campaign,
    ),
    "table": Reader(
        (_table(error=False), _table(error=True)), "table.csv", _read_table, drawn_table_mutations
    ),
}
