"""Whether a diagnosis depends on anything but what was measured.

    python -m studies.sealed.leaks [CAMPAIGN]

Diagnoses a folder of run files, of a campaign recorded for it if none is named, and again copies of
them that have other names and another order, other names of reed, campaign and bench, other
identifiers and seeds, another day, and nothing about who made them; and once more with the parts of
the campaign renamed. Prints whether the answers are the same, to the last digit; exit status 1 if
not.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from studies.campaigns import campaigns

_SEED = 260_614
_TIMES = "entry/start_time", "entry/end_time"
_LATER = timedelta(days=4321)
# When copies seem to have been written, in no order.
_BEFORE_S = 1e9
_NAMES = "entry/sample/name", "entry/acquisition/campaign"
# Who made a file, and of what; optional.
_STRIPPED = (
    "entry/title", "entry/program_name", "entry/user/name", "entry/sample/note",
    "entry/provenance/git_revision", "entry/provenance/bench_fingerprint",
    "entry/provenance/protocol", "entry/provenance/protocol_sha256",
    "entry/instrument/name", "entry/instrument/camera/identity",
    "entry/instrument/generator/identity", "entry/instrument/synthesizers/identity",
)  # fmt: skip


def diagnosed(folder: Path) -> dict[str, Any]:
    """What `acquire diagnose --json` says of a folder."""
    command = [sys.executable, "-m", "acquire", "diagnose", str(folder), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"leaks: {folder}: {done.stderr.strip()}")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def disguised(folder: Path, into: Path, *, parts: bool) -> None:
    """Copy run files, with all changed that a diagnosis must not depend on."""
    rng = np.random.default_rng(_SEED)
    files = sorted(folder.glob("*.h5"))
    for number, file in zip(rng.permutation(len(files)), files, strict=True):
        copy = into / f"{number:02d}-{rng.integers(2**31):08x}.h5"
        shutil.copy(file, copy)
        with h5py.File(copy, "r+") as run:
            _disguise(run, rng)
            if parts:
                _put(run, "entry/acquisition/part", f"p{number:02d}")
        os.utime(copy, (_BEFORE_S + number, _BEFORE_S + number))


def _disguise(run: h5py.File, rng: np.random.Generator) -> None:
    for path in _TIMES:
        _put(run, path, (datetime.fromisoformat(_text(run, path)) + _LATER).isoformat())
    for path in _NAMES:
        _put(run, path, "Q99")
    for path in _STRIPPED:
        _put(run, path, "")
    _put(run, "entry/provenance/package_versions", "{}")
    _put(run, "entry/entry_identifier_uuid", rng.bytes(16).hex())
    bench = re.sub(r"^name:.*$", "name: other", _text(run, "entry/provenance/bench"), flags=re.M)
    _put(run, "entry/provenance/bench", bench)
    del run["entry/provenance/seed"]
    run["entry/provenance/seed"] = int(rng.integers(2**31))


def _text(run: h5py.File, path: str) -> str:
    text: str = run[path].asstr()[()]
    return text


def _put(run: h5py.File, path: str, text: str) -> None:
    del run[path]
    run[path] = text


def main() -> None:
    """Diagnose three times, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("campaign", nargs="?", type=Path)
    asked = parser.parse_args().campaign
    with campaigns([asked] if asked else []) as (folder,):
        sys.exit(leaks(folder))


def leaks(folder: Path) -> bool:
    """Whether what must not matter does; prints what."""
    usual, leaked = diagnosed(folder), False
    for parts, keys in ((False, list(usual)), (True, ["verdict", "probability", "likely"])):
        with tempfile.TemporaryDirectory() as place:
            disguised(folder, Path(place), parts=parts)
            other = diagnosed(Path(place))
        apart = [key for key in keys if json.dumps(usual[key]) != json.dumps(other[key])]
        leaked |= bool(apart)
        what = "renamed, re-seeded, stripped" + (", parts renamed" if parts else "")
        print(f"{what}: {'differs in ' + ', '.join(apart) if apart else 'identical'}", flush=True)
    return leaked


if __name__ == "__main__":
    main()
