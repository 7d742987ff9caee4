"""Commit to answers before the key of a set is opened.

    python -m studies.sealed.commitments ANSWERS > studies/sealed/SET/answered.json

ANSWERS is the folder of NAME.json, as `acquire diagnose --json` prints them. Commit the file that
this prints; `committed_answers` gives the scores of a set its answers only if they are those. What
was committed once stays: a file may get more entries in later commits, but none may change.
"""

import argparse
import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any


def hashes_of(answers: Path) -> dict[str, str]:
    """Return the SHA-256 of each answer of a folder, by its case's name."""
    return {path.stem: _sha256(path) for path in sorted(answers.glob("*.json"))}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def committed(path: Path) -> Any:
    """Return what the last commit has of a JSON file.

    Raises
    ------
    SystemExit
        If it is not committed, or if it was committed before with an entry that is now another.
    """
    # A commit that has removed the file shows nothing of it.
    shown = [_git(path, "show", f"{one}:./{path.name}").stdout for one in _commits(path)]
    now, *before = (json.loads(text) if text else None for text in shown)
    if not all(_stays(then, now) for then in before):
        raise SystemExit(
            f"commitments: {path}: an earlier commit has other entries; make another set"
        )
    return now


def require_earlier(path: Path, other: Path) -> None:
    """Check that a file was committed before another one.

    Raises
    ------
    SystemExit
        If it was not.
    """
    first, then = _commits(path)[-1], _commits(other)[-1]
    leads_to = _git(path, "merge-base", "--is-ancestor", first, then).returncode == 0
    if first == then or not leads_to:
        raise SystemExit(f"commitments: {path}: was not committed before {other}; make another set")


def _commits(path: Path) -> list[str]:
    """Return the commits that changed a file, the last first."""
    folder = path.absolute().parent
    if not folder.is_dir():
        raise SystemExit(f"commitments: {folder}: is no folder; name that of the set")
    found = _git(path, "log", "--format=%H", "--", path.name).stdout.split()
    if not found:
        raise SystemExit(f"commitments: {path}: is not committed; commit it before you go on")
    return found


def _git(path: Path, *asked: str) -> subprocess.CompletedProcess[str]:
    """Let git answer in the folder of a file; it may refuse."""
    folder = path.absolute().parent
    return subprocess.run(["git", *asked], cwd=folder, capture_output=True, text=True, check=False)


def _stays(then: Any, now: Any) -> bool:
    """Whether all entries of a mapping, and of mappings in it, are still there."""
    if isinstance(then, dict) and isinstance(now, dict):
        return all(name in now and _stays(entry, now[name]) for name, entry in then.items())
    return bool(then == now)


def committed_answers(answers: Path, hashes: Path) -> dict[str, dict[str, Any]]:
    """Return the answers of a folder, by their cases' names, if their hashes are committed.

    Parameters
    ----------
    answers : Path
    hashes : Path
        What this program has printed of them.

    Raises
    ------
    SystemExit
        If the hashes are not committed, or an answer is not one of those, or one is not there.
    """
    expected, found = committed(hashes), hashes_of(answers)
    others = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
    if others:
        raise SystemExit(
            f"commitments: {answers}: {len(others)} answers are not those of {hashes} "
            f"(such as {others[0]}); give the answers that were committed"
        )
    read = {name: answers / f"{name}.json" for name in expected}
    return {name: json.loads(path.read_text(encoding="utf-8")) for name, path in read.items()}


def main() -> None:
    """Print the hashes of a folder of answers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("answers", type=Path)
    asked = parser.parse_args()
    found = hashes_of(asked.answers)
    if not found:
        raise SystemExit(f"commitments: {asked.answers}: has no answers; name their folder")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
