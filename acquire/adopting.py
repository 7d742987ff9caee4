"""Write the effects that a diagnosis has found into a bench file, under ``known:``."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from acquire.errors import UsageError
from diagnosis.campaign_diagnosis import Diagnosis
from diagnosis.inference.candidates import Candidate
from diagnosis.inference.problem import LocatedEffect
from physics.effects.effect import Parameter
from protocols.bench import BenchFile, find_bench
from protocols.bench_parameters import known_effects, sized_effects
from protocols.errors import ProtocolError
from protocols.yaml_files.insertion import Entry, with_entry
from protocols.yaml_files.strict_yaml import shipped_files
from reports.own_output import Output, OutputKind, require_writable, write_output
from reports.plain_text import visible

# Any file may be replaced that was read as a bench file a moment before.
_BENCH_FILE: Final = OutputKind("bench file", "text", "")
# Between these powers of ten a standard error is written without an exponent. Chosen: as many
# digits as a person counts at a glance.
_PLAIN = (-4, 3)


def require_adoptable(path: Path, used: BenchFile | None, measured: BenchFile | None) -> None:
    """Refuse, before a diagnosis, a bench file that what it finds cannot be written into.

    Parameters
    ----------
    path : Path
    used : BenchFile or None
        Bench file whose known effects the diagnosis uses.
    measured : BenchFile or None
        Bench file that the runs carry.

    Raises
    ------
    UsageError
        If it is a file of this program, of another bench, or not the one that is used.
    OutputRefusedError
        If it cannot be written.
    """
    file = Path(str(find_bench(str(path)))).resolve()
    if file in {
        Path(str(shipped)).resolve() for shipped in shipped_files(BenchFile.folder).values()
    }:
        raise UsageError(
            f"--adopt {path}: is a bench file of this program; copy it to a file of your own, "
            "change its name:, and measure with that"
        )
    described = BenchFile.from_file(path)
    if used is not None and known_effects(used) != known_effects(described):
        raise UsageError(
            f"--adopt {path}: has other known effects than {used.source}; give the same file to "
            "--bench"
        )
    if measured is not None and described.name != measured.name:
        raise UsageError(
            f"--adopt {path}: describes the bench {described.name!r}, but the runs are of the "
            f"bench {measured.name!r}; name the bench file with which they were measured"
        )
    require_writable([_output(path)])


def write_known(verdict: Diagnosis, path: Path, reed: str) -> dict[str, Entry]:
    """Write the effects that are named, with sizes and standard errors, into a bench file.

    Everything else in the file stays as it is.

    Parameters
    ----------
    verdict : Diagnosis
    path : Path
    reed : str
        Named in a comment, next to the probability.

    Returns
    -------
    dict
        What was written: sizes by the identifier of each effect. Empty if no effect is named.

    Raises
    ------
    ProtocolError
        If the file already has one of the effects, or cannot be added to.
    OutputRefusedError, OutputFailedError
        If it cannot be written.
    """
    name = "+".join(verdict.effects)
    candidate = verdict.selection.candidate(name)
    if candidate is None:
        return {}
    entries = {located.effect.id: _entry(candidate, located) for located in candidate.effects}
    probability = verdict.probability_of_what_shows.get(name, 0.0)
    # A name may hold line ends, which would end the comment.
    shown = " ".join(visible(reed).split())
    comment = f"found by a diagnosis of reed {shown} (probability {probability:.0%})"
    _write(path, entries, comment)
    return entries


def _entry(candidate: Candidate, located: LocatedEffect) -> Entry:
    """Return the sizes of a fitted effect, and where it is, as a bench file has them."""
    sizes = candidate.size_estimates[located.effect.id]
    return {
        **{p.name: size_text(p, p.scale * z, p.scale * error) for p, z, error in sizes},
        **{p.name: _number(located.location[p.name], p.unit) for p in located.effect.gridded},
    }


def size_text(size: Parameter, value: float, error: float) -> str:
    """Return a size as a bench file has it, such as ``0.310 ± 0.040 1/h``.

    The standard error has two digits, and the value as many decimals as the error.
    """
    if not (math.isfinite(error) and error > 0):
        return _number(value, size.unit)
    power = math.floor(math.log10(error))
    value = round(value, 1 - power)
    if _PLAIN[0] <= power <= _PLAIN[1]:
        decimals = max(1 - power, 0)
        numbers = f"{value:.{decimals}f} ± {error:.{decimals}f}"
    else:
        digits = max(math.floor(math.log10(abs(value))) - power, 0) + 1 if value else 1
        numbers = f"{value:.{digits}e} ± {error:.1e}"
    return f"{numbers} {size.unit}".strip()


def _number(value: float, unit: str) -> str:
    """Write a number exactly: one at the end of its range must not leave it."""
    return f"{value!r} {unit}".strip()


def _write(path: Path, entries: Mapping[str, Entry], comment: str) -> None:
    """Add the entries to the file as it is now, and read the result before it is written."""
    before = BenchFile.from_file(path)
    known = known_effects(before)
    if twice := [name for name in entries if name in known]:
        raise ProtocolError(
            f"{path}: known.{twice[0]} is there already, and the runs show more of it; "
            "measure a campaign with this bench file, or change its size by hand"
        )
    text = before.text
    for name, entry in entries.items():
        text = with_entry(text, "known", name, entry, comment)
    after = BenchFile.from_text(text, str(path))
    wanted = sized_effects({**known, **entries}, f"{path}: known")
    changed = after.content() | {"known": None} != before.content() | {"known": None}
    if changed or sized_effects(known_effects(after), f"{path}: known") != wanted:
        lines = "; ".join(f"{name}: {dict(entry)}" for name, entry in entries.items())
        raise ProtocolError(f"{path}: cannot be added to; write under known: by hand: {lines}")
    write_output(_output(path), text)


def _output(path: Path) -> Output:
    return Output(path, _BENCH_FILE, option="--adopt")
