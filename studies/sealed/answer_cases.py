"""Answer sealed cases: `acquire diagnose` on each, in a process that knows nothing of the key.

    python -m studies.sealed.answer_cases CASES ANSWERS [--jobs N]

CASES is what `acquire blind make` made, ANSWERS a folder that gets NAME.json for each case; those
that are there already stay. Prints how long each took; `acquire blind score` scores them.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any


def answer(case: Path, answers: Path) -> str:
    """Answer one case; return how it went."""
    begun = time.perf_counter()
    done = _diagnose([case])
    took_s = time.perf_counter() - begun
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or ["nothing said"]
        return f"{case.name}: not answered after {took_s:.0f} s: {last[0]}"
    _keep(answers / f"{case.name}.json", done.stdout)
    return f"{case.name}: answered after {took_s:.0f} s"


def diagnosed(kept: Path, campaigns: Sequence[Path], *options: str) -> dict[str, Any]:
    """Return the answer to campaigns, which is kept in a file, and read from it another time.

    Raises
    ------
    SystemExit
        If there is no answer.
    """
    if not kept.exists():
        done = _diagnose(campaigns, *options)
        if done.returncode:
            raise SystemExit(f"answer_cases: {campaigns[0]}: {done.stderr.strip()}")
        _keep(kept, done.stdout)
    found: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
    return found


def _diagnose(campaigns: Sequence[Path], *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "acquire", "diagnose", *map(str, campaigns), *options]
    return subprocess.run([*command, "--json"], capture_output=True, text=True, check=False)


def _keep(path: Path, text: str) -> None:
    """Write an answer whole or not at all: one that was begun would stay."""
    begun = path.with_name(f"{path.stem}.begun")
    begun.write_text(text, encoding="utf-8")
    begun.rename(path)


def main() -> None:
    """Answer all cases of a folder that have no answer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path)
    parser.add_argument("answers", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    try:
        sealed = json.loads((asked.cases / "sealed.json").read_text(encoding="utf-8"))["cases"]
    except (OSError, ValueError, KeyError, TypeError):
        raise SystemExit(f"blind: {asked.cases}: is no folder of sealed cases") from None
    asked.answers.mkdir(parents=True, exist_ok=True)
    todo = [
        asked.cases / name
        for name in sorted(sealed)
        if not (asked.answers / f"{name}.json").exists()
    ]
    with ThreadPoolExecutor(asked.jobs) as pool:
        for said in pool.map(lambda case: answer(case, asked.answers), todo):
            print(said, flush=True)
    if not all((asked.answers / f"{case.name}.json").exists() for case in todo):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
