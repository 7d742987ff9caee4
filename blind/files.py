"""Sets of sealed cases as folders: recordings and commitments in one, the key elsewhere."""

import hashlib
import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from blind.cases import TIERS, Label, commitment, drawn_label, record_case, seal
from blind.scoring import Case

SEALED: Final = "sealed.json"


class BlindError(ValueError):
    """A set of cases that cannot be made, or answers that cannot be scored."""


def make_set(
    folder: Path,
    key: Path,
    tier: int,
    count: int,
    seed: int,
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
) -> str:
    """Record a set of sealed cases; tells the SHA-256 of ``sealed.json``.

    Parameters
    ----------
    folder : Path
        Gets one folder of run files for each case, and ``sealed.json``. Must not exist.
    key : Path
        Gets labels and salts. Must not exist.
    tier : int
        See `blind.cases.drawn_label`.
    count, seed, jobs : int
    progress : callable, optional
        Told the share that is done.

    Raises
    ------
    BlindError
        If there is no such tier, or folder or key are there already.
    """
    if tier not in TIERS:
        raise BlindError(f"there is no tier {tier}; choose one of {', '.join(map(str, TIERS))}")
    for path in (folder, key):
        if path.exists():
            raise BlindError(f"{path}: is there already; name another place")
    labels = [drawn_label(tier, number, seed) for number in range(count)]
    told, kept = seal(labels, seed)
    folder.mkdir(parents=True)
    # Committed before anything is recorded, let alone answered.
    sealed = json.dumps(told, indent=1).encode()
    (folder / SEALED).write_bytes(sealed)
    key.write_text(json.dumps(kept, indent=1), encoding="utf-8")
    report = progress or (lambda _share: None)
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        waiting = [
            pool.submit(record_case, folder, name, label)
            for name, label in zip(told["cases"], labels, strict=True)
        ]
        for number, done in enumerate(as_completed(waiting)):
            done.result()
            report((number + 1) / count)
    return hashlib.sha256(sealed).hexdigest()


def answered_cases(folder: Path, answers: Path, key: Path) -> list[Case]:
    """Put labels and answers together.

    Parameters
    ----------
    folder : Path
        Of the sealed cases.
    answers : Path
        Folder with what ``acquire diagnose --json`` printed of each case, as ``NAME.json``.
    key : Path

    Raises
    ------
    BlindError
        If the key does not fit what was sealed, or nothing was answered.
    """
    told, kept = (_read(path)["cases"] for path in (folder / SEALED, key))
    if set(told) != set(kept):
        raise BlindError(f"{key}: is the key of other cases than {folder / SEALED}")
    cases = []
    for name, entry in kept.items():
        label = _label(entry["label"])
        if commitment(label, entry["salt"]) != told[name]:
            raise BlindError(f"{key}: case {name} is not what was sealed")
        path = answers / f"{name}.json"
        cases.append(Case(name, label, _read(path) if path.exists() else None))
    if all(case.answer is None for case in cases):
        raise BlindError(f"{answers}: has no answer to any case; name NAME.json for each")
    return cases


def _label(entry: dict[str, Any]) -> Label:
    effects, told = (
        tuple((str(name), float(size)) for name, size in entry[key]) for key in ("effects", "told")
    )
    label = Label(entry["tier"], effects, entry["known"], entry["seed"], told)
    if json.loads(json.dumps(asdict(label))) != entry:
        raise BlindError("a label has entries that labels do not have")
    return label


def _read(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BlindError(f"{path}: cannot be read ({error.strerror}); check the name") from None
    except json.JSONDecodeError as error:
        raise BlindError(f"{path}: is no JSON (line {error.lineno})") from None
    return found
