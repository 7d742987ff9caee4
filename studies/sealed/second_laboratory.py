"""Make sealed sets of campaigns of the second laboratory.

    python -m studies.sealed.second_laboratory make FOLDER KEY [--share SHARE]
    python -m studies.sealed.second_laboratory record FOLDER KEY [--jobs N] [--sensor SENSOR]

`make` draws the labels and seals them: ``FOLDER/sealed.json`` has the salted hash of each, KEY has
labels, salts and seeds. The whole set has 190 cases, SHARE of them are drawn if it is given.
`record` measures all cases that are not there yet. The seeds follow from nothing that is published.
"""

import argparse
import hashlib
import json
import secrets
import shutil
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from studies.second_laboratory.campaigns.case import Case, Kind, case_from_json, draw_case
from studies.second_laboratory.campaigns.recording import record

SEALED: Final = "sealed.json"
# Cases of a whole set, by kind and level of disorder.
COUNTS: Final[Mapping[tuple[Kind, str], int]] = {
    ("clean", "quiet"): 20,
    ("clean", "ordinary"): 40,
    ("clean", "rough"): 20,
    ("single", "quiet"): 20,
    ("single", "ordinary"): 20,
    ("single", "rough"): 20,
    ("unknown", "quiet"): 10,
    ("unknown", "ordinary"): 10,
    ("unknown", "rough"): 10,
    ("pair", "quiet"): 7,
    ("pair", "ordinary"): 7,
    ("pair", "rough"): 6,
}
_CUT = ".cut"


@dataclass(frozen=True)
class SealedCase:
    """A case with its salt."""

    level: str
    case: Case
    salt: str

    def to_json(self) -> dict[str, Any]:
        """Return plain values, which the key has."""
        return {"level": self.level, "case": self.case.to_json(), "salt": self.salt}

    @property
    def commitment(self) -> str:
        """Hash that fits this case only, and says nothing of it without the salt."""
        text = json.dumps([self.level, self.case.to_json()], sort_keys=True) + self.salt
        return hashlib.sha256(text.encode()).hexdigest()


def drawn_set(share: float = 1.0) -> dict[str, SealedCase]:
    """Draw a set, by the names of cases, which say nothing of them."""
    drawn: list[SealedCase] = []
    seeds = {kind: secrets.randbits(62) for kind, _ in COUNTS}
    numbers = dict.fromkeys(seeds, 0)
    for (kind, level), count in COUNTS.items():
        for _ in range(round(share * count)):
            case = draw_case(kind, level, seeds[kind], numbers[kind])
            drawn.append(SealedCase(level, case, secrets.token_hex(16)))
            numbers[kind] += 1
    names: set[str] = set()
    while len(names) < len(drawn):
        names.add(secrets.token_hex(4))
    # In the order of the names, which is no order of cases.
    return dict(sorted(zip(names, drawn, strict=True)))


def opened(sealed: Mapping[str, str], key: Mapping[str, Any]) -> dict[str, SealedCase]:
    """Return the cases of a key that fits what was sealed.

    Raises
    ------
    SystemExit
        If it does not.
    """
    cases = {
        name: SealedCase(entry["level"], case_from_json(entry["case"]), entry["salt"])
        for name, entry in key.items()
    }
    if {name: each.commitment for name, each in cases.items()} != sealed:
        raise SystemExit("second_laboratory: the key is not that of what was sealed; name its key")
    return cases


def read_cases(path: Path) -> dict[str, Any]:
    """Return what a file of sealed cases, or their key, has of each case."""
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["cases"]
    return found


def make(folder: Path, key: Path, share: float) -> None:
    """Draw and seal a set; nothing is replaced."""
    for path in (folder, key):
        if path.exists():
            raise SystemExit(f"second_laboratory: {path}: is there already; name another place")
    cases = drawn_set(share)
    # Sealed before anything is recorded.
    kept = {name: each.to_json() for name, each in cases.items()}
    key.write_text(json.dumps({"cases": kept}, indent=1), encoding="utf-8")
    folder.mkdir(parents=True)
    sealed = {name: each.commitment for name, each in cases.items()}
    (folder / SEALED).write_text(json.dumps({"cases": sealed}, indent=1), encoding="utf-8")
    print(f"{len(cases)} cases; commit {folder / SEALED}")


def record_all(folder: Path, key: Path, jobs: int, sensor: str) -> None:
    """Record all cases that are not there yet; each is there once it is whole."""
    cases = opened(read_cases(folder / SEALED), read_cases(key))
    todo = {name: each for name, each in cases.items() if not (folder / name).exists()}
    with ProcessPoolExecutor(jobs) as pool:
        waiting = [
            pool.submit(recorded, folder / name, each.case, sensor=sensor)
            for name, each in todo.items()
        ]
        for number, done in enumerate(as_completed(waiting)):
            print(f"{done.result()} ({number + 1} of {len(todo)})", flush=True)


def recorded(folder: Path, case: Case, **how: Any) -> str:
    """Record one case into a folder that is there once it is whole; return how it went.

    Parameters
    ----------
    folder : Path
    case : Case
    **how
        Further arguments of `record`.
    """
    begun = folder.with_name(f"{folder.name}{_CUT}")
    shutil.rmtree(begun, ignore_errors=True)
    said = f"{folder.name}: recorded"
    try:
        record(case, begun, **how)
    except RuntimeError as error:
        # What was measured before is what a technician would have.
        said = f"{folder.name}: {error}"
    begun.rename(folder)
    return said


def main() -> None:
    """Make or record a set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("make", "record"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("key", type=Path)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--sensor", choices=("small", "quarter", "full"), default="small")
    asked = parser.parse_args()
    if asked.what == "make":
        make(asked.folder, asked.key, asked.share)
    else:
        record_all(asked.folder, asked.key, asked.jobs, asked.sensor)


if __name__ == "__main__":
    main()
