"""What reads mutated text files, by kind of file, and the files that are mutated."""

import csv
import io
import math
import re
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.fuzzing.mutations import Mutation, drawn_mutations, drawn_table_mutations
from benchmarks.fuzzing.plausibility import (
    DECIMAL,
    composed,
    disagreements,
    is_seen,
    require,
    require_meant,
    require_plausible,
)
from diagnosis.mean_reed import tabled_reeds
from drivers.errors import BenchSetupError
from drivers.options import read_options
from drivers.registry import find_driver
from drivers.simulated.settings import (
    bench_constants,
    bench_geometry,
    bench_parameters,
    read_simulation,
)
from fitting.populations.resonance_table import (
    COLUMNS,
    ERROR_COLUMN,
    read_resonances,
)
from physics.errors import ImpossibleReedError
from physics.parameters.optics import visible_size_m
from physics.reed.mode_classification import PAPER_MODES
from protocols.bench import BenchFile
from protocols.bench_parameters import known_effects, sized_effects
from protocols.campaign import CampaignFile, tasks_of
from protocols.plan import make_plan
from protocols.protocol import Protocol
from protocols.reed import ReedFile
from reports.run_tables import campaign_table
from reports.tables import terminal_table


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


# --- The kinds of file -------------------------------------------------------------------------


def _read_protocol(file: Path) -> None:
    protocol = Protocol.from_file(file)
    plan = make_plan(protocol, _BENCH)
    require_plausible(plan)
    require_meant(protocol, file)
    again = Protocol.from_text(protocol.text, protocol.source)
    require(again == protocol, "a text reads as another protocol")


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
    bench_parameters(twin, bench, preparation)
    try:
        bench_geometry(twin, preparation)
    except ImpossibleReedError as error:
        # The simulated laboratory says so, with the bench's name.
        raise BenchSetupError(f"bench {bench.name!r}: {error}") from error
    bench_constants(twin, preparation)
    sized_effects(known_effects(bench), bench.name)


def _read_reed(file: Path) -> None:
    reed = ReedFile.from_file(file)
    require_meant(reed, file)
    geometry, cane = reed.geometry(), reed.cane()
    numbers = [*vars(cane).values(), geometry.heel_radius_m, geometry.heel_sagitta_m]
    numbers += [*vars(geometry.outline).values(), *geometry.vamp_x_m, *geometry.vamp_y_m]
    require(bool(np.isfinite(numbers).all()), "a reed has a number that is not finite")
    reed.constants()
    viscoelastic = reed.viscoelastic()
    require(
        viscoelastic is None
        or bool(
            np.isfinite([*astuple(viscoelastic.young_L), *astuple(viscoelastic.shear_LT)]).all()
        ),
        "a viscoelastic cane has a number that is not finite",
    )
    require(min(visible_size_m(geometry)) > 0, "a reed has no size")


def _read_campaign(file: Path) -> None:
    campaign = CampaignFile.from_file(file)
    tasks = tasks_of(campaign)
    plans = [make_plan(task.protocol, _BENCH) for task in tasks]
    terminal_table(campaign_table(tasks, plans))
    require_meant(campaign, file)
    require(len(tasks) == len(campaign.parts), "a campaign has other parts")
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
    written = composed(yaml.safe_dump(value, allow_unicode=True))
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
        require(bool(np.isfinite(mean.cents).all()), "a mean is not finite")
        require(
            bool((mean.error_cents > 0).all() and np.isfinite(mean.error_cents).all()), "an error"
        )


def _require_cells(file: Path, read: dict[tuple[str, str, str], Any], passed_over: int) -> None:
    """Require that every row of a table was read, as a person reads it."""
    text = file.read_bytes().decode("utf-8-sig")
    rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    heads = rows[0]
    used = [head for head in heads if head in (*COLUMNS, ERROR_COLUMN)]
    require(len(set(used)) == len(used), "two columns of one name")
    seen = set()
    for row in rows[1:]:
        require(not any(row[len(heads) :]), "a row of more cells than columns was accepted", row)
        cells = dict(zip(heads, (cell.strip() for cell in row), strict=False))
        require(all(is_seen(cells.get(head, "")) for head in used), "a control character in a cell")
        if cells["mode"] not in PAPER_MODES:
            passed_over -= 1
            continue
        key = cells["reed"], cells["series"], cells["mode"]
        require(key in read and key not in seen, "a row was not read, or twice", key)
        seen.add(key)
        hz = DECIMAL.fullmatch(cells["hz"])
        require(hz is not None, "what is no decimal number was read", cells["hz"])
        cents = 1200 * math.log2(float(cells["hz"]) / 1396.9)
        require(abs(cents - read[key][0]) < 1e-6, "another frequency was read", cells["hz"])
        require(abs(cents) < 12_000, "an absurd frequency was accepted", cells["hz"])
        if "error_cents" in cells:
            error = DECIMAL.fullmatch(cells["error_cents"])
            require(
                error is not None and float(cells["error_cents"]) == read[key][1],
                "another error was read",
                cells["error_cents"],
            )
    require(len(seen) == len(read), "resonances that no row has")
    require(passed_over == 0, "rows passed over are not counted")


# --- Seeds -------------------------------------------------------------------------------------

_SHIPPED = Path(__file__).parents[2] / "protocols"
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
