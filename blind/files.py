"""Sets of sealed cases as folders: recordings and commitments in one, the key elsewhere."""

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, FiniteFloat, ValidationError

from blind.cases import (
    CUT,
    TIERS,
    Label,
    commitment,
    drawn_label,
    hidden_seed,
    record_case,
    seal,
)
from blind.scoring import Case

SEALED: Final = "sealed.json"


class BlindError(ValueError):
    """A set of cases that cannot be made, or answers that cannot be scored."""


class BlindDiskError(BlindError):
    """A disk that refused what was written to it."""


class _Size(BaseModel):
    value: FiniteFloat
    error: FiniteFloat


class _Effect(BaseModel):
    d_prime: FiniteFloat
    detectable: dict[str, FiniteFloat | None]
    sizes: dict[str, _Size]


class _Closed(BaseModel):
    before: FiniteFloat | None
    after: FiniteFloat | None


class _Explained(BaseModel):
    by: dict[str, _Closed]


class _Answer(BaseModel):
    """What scores read of an answer: the rest of it is of no matter here."""

    verdict: str
    effects_named: list[str]
    probability: dict[str, FiniteFloat]
    likely: list[list[str]]
    effects: dict[str, _Effect]
    explained_fraction: _Explained


def make_set(
    folder: Path,
    key: Path,
    tier: int,
    count: int,
    seed: int,
    jobs: int = 1,
    progress: Callable[[float], None] | None = None,
) -> str:
    """Record a set of sealed cases; returns the SHA-256 of ``sealed.json``.

    Parameters
    ----------
    folder : Path
        Gets one folder of run files for each case, and ``sealed.json``. Must not exist.
    key : Path
        Gets labels, salts, and what was mixed into the seed. Must not exist.
    tier : int
        See `blind.cases.drawn_label`.
    count, seed, jobs : int
        The seed alone does not suffice to draw the labels again.
    progress : callable, optional
        Called with the fraction that is done.

    Raises
    ------
    BlindError
        If there is no such tier, folder or key are there already, or there is no folder for them.
    BlindDiskError
        If they, or a case, cannot be written.
    KeyboardInterrupt
        Once the cases under way have ended or been interrupted as well: whole ones stay.
    """
    if tier not in TIERS:
        raise BlindError(f"there is no tier {tier}; choose one of {', '.join(map(str, TIERS))}")
    _require_places(folder, key)
    nonce = secrets.token_hex(16)
    mixed = hidden_seed(seed, nonce)
    published, kept = seal([drawn_label(tier, number, mixed) for number in range(count)])
    labels = {name: _label(entry["label"]) for name, entry in _plain(kept)["cases"].items()}
    # Committed before anything is recorded, let alone answered.
    sealed = json.dumps(published, indent=1).encode()
    _write_new(key, json.dumps({"nonce": nonce, **kept}, indent=1).encode())
    try:
        _begin(folder, sealed)
    except BlindDiskError:
        # A key of nothing would only be in the way of the next try.
        key.unlink()
        raise
    _record(folder, labels, jobs, progress or (lambda _fraction: None))
    return hashlib.sha256(sealed).hexdigest()


def _record(
    folder: Path, labels: Mapping[str, Label], jobs: int, report: Callable[[float], None]
) -> None:
    """Record all cases of a set; cases that are complete stay if one fails."""
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        waiting = [pool.submit(record_case, folder, name, label) for name, label in labels.items()]
        try:
            for number, done in enumerate(as_completed(waiting)):
                done.result()
                report((number + 1) / len(labels))
        except OSError as error:
            raise BlindDiskError(f"{folder}: a case cannot be recorded ({error})") from None
        finally:
            pool.shutdown(cancel_futures=True)
            for cut in folder.glob(f"*{CUT}"):
                shutil.rmtree(cut, ignore_errors=True)


def _require_places(folder: Path, key: Path) -> None:
    """Refuse to replace anything, and places that cannot be written."""
    for path in (folder, key):
        # Also of a link that leads nowhere.
        if os.path.lexists(path):
            raise BlindError(f"{path}: is there already; name another place")
    if not key.parent.is_dir():
        raise BlindError(
            f"{key}: cannot be written (there is no folder {key.parent}); name another place"
        )
    above = next(path for path in folder.absolute().parents if path.exists())
    if not above.is_dir():
        raise BlindError(
            f"{folder}: cannot be written ({above} is not a folder); name another place"
        )
    if os.path.realpath(folder) == os.path.realpath(key):
        raise BlindError(f"{key}: is the name of the folder of cases too; name another key")


def _write_new(path: Path, content: bytes) -> None:
    """Write a file that is not there yet; it is on the disk when this returns, or not there."""
    try:
        with path.open("xb") as file:
            try:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            except BaseException:
                path.unlink()
                raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise BlindDiskError(f"{path}: cannot be written ({reason}); name another place") from None


def _begin(folder: Path, sealed: bytes) -> None:
    """Make the folder of a set, with its commitments; nothing is left if that fails."""
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise BlindDiskError(
            f"{folder}: cannot be written ({reason}); name another place"
        ) from None
    try:
        _write_new(folder / SEALED, sealed)
    except BlindDiskError:
        folder.rmdir()
        raise


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
    if not answers.is_dir():
        raise BlindError(f"{answers}: there is no folder of that name; name that of the answers")
    cases = []
    for name, label in labels_of(folder / SEALED, key).items():
        path = answers / f"{name}.json"
        cases.append(Case(name, label, _answer(path) if path.exists() else None))
    if all(case.answer is None for case in cases):
        raise BlindError(f"{answers}: has no answer to any case; name NAME.json for each")
    return cases


def labels_of(sealed: Path, key: Path) -> dict[str, Label]:
    """Labels by the cases' names, of a key that fits what was sealed.

    Raises
    ------
    BlindError
        If it does not.
    """
    published, kept = (_cases(path) for path in (sealed, key))
    if set(published) != set(kept):
        raise BlindError(f"{key}: is the key of other cases than {sealed}")
    labels = {}
    for name, entry in kept.items():
        try:
            labels[name] = _label(entry["label"])
            fits = commitment(labels[name], entry["salt"]) == published[name]
        except (KeyError, TypeError, ValueError):
            raise BlindError(f"{key}: is no key, as `acquire blind make` writes it") from None
        if not fits:
            raise BlindError(f"{key}: case {name} is not what was sealed")
    return labels


def _label(entry: dict[str, Any]) -> Label:
    effects, told = (
        tuple((str(name), float(size)) for name, size in entry[key]) for key in ("effects", "told")
    )
    label = Label(entry["tier"], effects, entry["known"], entry["seed"], told)
    if _plain(asdict(label)) != entry:
        raise BlindError("a label has entries that labels do not have")
    return label


def _cases(path: Path) -> dict[str, Any]:
    """What a file of sealed cases, or their key, has of each case."""
    found = _read(path).get("cases")
    if not isinstance(found, dict):
        raise BlindError(f"{path}: has no cases, as `acquire blind make` writes them")
    return found


def _answer(path: Path) -> dict[str, Any]:
    found = _read(path)
    try:
        _Answer.model_validate(found, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise BlindError(
            f"{path}: is no answer, as `acquire diagnose RUN … --json` prints it ({place}: "
            f"{first['msg']})"
        ) from None
    return found


def _plain(value: Any) -> Any:
    """What JSON makes of a value."""
    return json.loads(json.dumps(value))


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BlindError(f"{path}: cannot be read ({error.strerror}); check the name") from None
    except ValueError as error:
        raise BlindError(f"{path}: is no JSON ({error})") from None
    if not isinstance(found, dict):
        raise BlindError(f"{path}: is no JSON object")
    return found
