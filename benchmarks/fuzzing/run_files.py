"""Small run files that are in order, and what is read in them or in mutated copies."""

import contextlib
import hashlib
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py

import acquire
from acquire.cli.console import results
from acquire.cli.display import (
    bad_steps_of,
    catalogue_entry,
    details_table,
    run_details,
)
from acquire.runner.resuming import unfinished
from benchmarks.fuzzing.judging import Unnoticed
from benchmarks.fuzzing.plausibility import Implausible
from protocols.bench import BenchFile
from protocols.plan import Plan
from protocols.protocol import Protocol
from runs.errors import RunFileError
from runs.reader import Run

_SMALL = {
    "sweep.first": 14, "sweep.last": 22, "camera.width": 160, "camera.height": 128,
    "policy.bad_step": {"retries": 1, "then": "skip"},
}  # fmt: skip
# No checksum covers these, because they change after they were written
# (docs/reference/run-file.md, Checksums).
_NOT_COVERED = re.compile(
    r"entry/(status|end_time|interruptions/.*|(steps|earlier_attempts)/(verdict|sentence))"
)
_PICTURES = ("field", "frames")


@dataclass(frozen=True)
class Original:
    """A run file that is in order.

    Attributes
    ----------
    path : Path
    plan : Plan
    content : mapping
        What is read in it, see `content_of`.
    paths : tuple of str
        Of all groups and datasets.
    values, unchecked : list of (int, int)
        Ranges of bytes that hold values of datasets, and those of them that have no checksum.
    """

    path: Path
    plan: Plan
    content: dict[str, str]
    paths: tuple[str, ...]
    values: list[tuple[int, int]]
    unchecked: list[tuple[int, int]]


@dataclass(frozen=True)
class Mutant:
    """A changed run file.

    Attributes
    ----------
    path : Path
    original : Original
    what : str
        How it was changed.
    expected : {'same', 'unnoticed', 'refused', 'any'}
        'same': what is read must be the original's content, or the file refused; 'unnoticed': other
        content may be read, because no checksum covers it; 'refused': the file must be refused;
        'any': other values may be read, because others were written as a program would.
    """

    path: Path
    original: Original
    what: str
    expected: str


# --- Originals ---------------------------------------------------------------------------------


def originals(folder: Path) -> list[Original]:
    """Measure two small runs on the simulated bench."""
    bench = BenchFile.from_file().replace(
        {"twin": {"mesh": "coarse", "faults": {"drop_frame_at": [3]}}}
    )
    made = []
    for keep in ("holograms", "frames"):
        path = folder / f"{keep}.h5"
        plan = acquire.plan(
            Protocol.from_file("quick").replace({**_SMALL, "keep": keep}), bench
        ).plan
        # As if read from files, whose text is not written again for every run.
        plan = acquire.plan(
            Protocol.from_text(plan.protocol.text), BenchFile.from_text(plan.bench.text)
        ).plan
        acquire.run(plan, path, reed="R07", seed=1, labels=None)
        with h5py.File(path) as file:
            paths = tuple(_object_paths(file))
            values = sorted(_value_ranges(path, file, paths))
            bare = filter(_NOT_COVERED.fullmatch, paths)
            unchecked = sorted(_dataset_ranges(file[name] for name in bare))
        made.append(Original(path, plan, content_of(path, plan), paths, values, unchecked))
    return made


def _object_paths(file: Any) -> Iterator[str]:
    names: list[str] = []
    file.visit(names.append)
    yield from names


def _value_ranges(path: Path, file: Any, paths: Sequence[str]) -> Iterator[tuple[int, int]]:
    """Ranges of bytes that hold values: raw data, chunks, and heaps of texts of variable length."""
    yield from _dataset_ranges(file[name] for name in paths)
    data, start = path.read_bytes(), 0
    while (start := data.find(b"GCOL", start)) >= 0:
        yield start, start + int.from_bytes(data[start + 8 : start + 16], "little")
        start += 16


def _dataset_ranges(nodes: Iterable[Any]) -> Iterator[tuple[int, int]]:
    """Ranges of bytes of the values of datasets; groups have none."""
    for dataset in nodes:
        if not isinstance(dataset, h5py.Dataset):
            continue
        offset, size = dataset.id.get_offset(), dataset.id.get_storage_size()
        if offset is not None:
            yield offset, offset + size
        elif dataset.chunks:
            for number in range(dataset.id.get_num_chunks()):
                chunk = dataset.id.get_chunk_info(number)
                yield chunk.byte_offset, chunk.byte_offset + chunk.size


# --- What is read ------------------------------------------------------------------------------


def content_of(path: Path, plan: Plan) -> dict[str, str]:
    """Hashes of all that a run file says, by what it is.

    What is refused by itself, such as one step, has no entry.

    Raises
    ------
    RunFileError
        If the file is refused.
    """
    read: dict[str, str] = {}
    with Run.open(path) as run:
        details = run_details(run)
        shown = {"details": details, "entry": catalogue_entry(run), "troubles": bad_steps_of(run)}
        for name, value in shown.items():
            text = json.dumps(value, default=repr).replace(str(path), "")
            json.loads(text)
            read[name] = text
        _require_seen(details)
        for name in ("uid", "title", "labels", "acquisition", "reconstruction", "frame_rate_hz",
                     "exposure_s", "saturation_dn", "sideband_order", "acoustic_resonances_hz",
                     "keep", "protocol_text", "bench_text", "reed_text",
                     "package_versions"):  # fmt: skip
            read[name] = repr(getattr(run, name))
        read["axes"] = repr((run.y_m.tolist(), run.x_m.tolist()))
        read["reed"] = run.reed_file().sha256
        for step in run.steps:
            read[f"step {step.position}"] = repr(step)
            if step.verdict.measured:
                _add_array(read, f"field {step.position}", partial(run.field, step.position))
            if step.verdict.measured and run.keep == "frames":
                _add_array(read, f"frames {step.position}", partial(run.frames, step.position))
        for number, attempt in enumerate(run.earlier_attempts):
            read[f"attempt {number}"] = repr(attempt)
            _add_array(read, f"field of attempt {number}", partial(run.earlier_field, number))
    try:
        read["unfinished"] = repr(unfinished(path, plan))
    except RunFileError as error:
        _require_line(str(error))
    return read


def _add_array(read: dict[str, str], name: str, call: Callable[[], Any]) -> None:
    try:
        array = call()
    except RunFileError as error:
        _require_line(str(error))
        return
    read[name] = f"{array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}"


def _require_line(said: str) -> None:
    if not said.isprintable() or len(said) > 400:
        raise Implausible("a message that is not one line", said)


def _require_seen(details: Mapping[str, Any]) -> None:
    """Require that `acquire show` prints no control characters but line ends."""
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        results().print(details_table(details))
    if not shown.getvalue().replace("\n", "").isprintable():
        raise Implausible("a control character reaches the terminal", repr(shown.getvalue())[:300])


def shown(mutant: Mutant) -> str:
    """Name a mutant and its original."""
    return f"{mutant.path.name} of {mutant.original.path.name}"


def compare(mutant: Mutant) -> None:
    """Read a mutant, and require that it is what it should be."""
    read, first = content_of(mutant.path, mutant.original.plan), mutant.original.content
    if mutant.expected == "refused":
        raise Implausible(f"{mutant.what}: read as if in order")
    if mutant.expected == "any":
        return
    # Steps that are refused by themselves are missing.
    other = [name for name in read if read[name] != first.get(name)]
    if other and mutant.expected == "unnoticed":
        raise Unnoticed
    missing = [name for name in first if name not in read]
    refused = [name for name in missing if not name.startswith(_PICTURES)]
    if other or refused:
        kinds = sorted({name.rstrip("0123456789 ") for name in (*other, *refused)})
        details = [f"{n}: {first.get(n, '')[:200]} → {read.get(n, '')[:200]}" for n in other[:2]]
        raise Implausible(
            f"{mutant.what}: other {', '.join(kinds)[:80]} read as if in order", str(details)
        )
    if missing:
        # Of a file that is read but for some of its steps.
        raise RunFileError(f"{mutant.path}: {len(missing)} arrays refused")


def decoy_of(original: Original) -> Path:
    """A file that nothing may open."""
    return original.path.with_name(f"decoy-{original.path.name}")
