"""Whether a damaged or misspelt file is read or refused as it should be.

    python -m benchmarks.fuzz [--count N] [--kind KIND] [--seed SEED] [--json]

Changes files that are in order (bytes, lines, values, keys, the parsed tree) and has the program
read them: protocols, benches, reeds, campaigns, tables of resonances, and run files. Each of the
changed files must be accepted with the meaning that a person reads in it, or refused in one line
with exit status 2. Prints how many were, and each distinct wrong outcome once, with an example;
exit status 1 if there is any. Unnoticed are run files in which a status, a verdict, a sentence or a
note of an interruption was changed; they have no checksum, because they change in files in order.
"""

import argparse
import json
import logging
import random
import sys
import tempfile
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.judging import Outcome, Tally, difference, judged
from benchmarks.fuzzing.mutations import Mutation, mutated
from benchmarks.fuzzing.readers import READERS, Reader
from benchmarks.fuzzing.runs import fuzz_runs

# How many are changed by default. Chosen: half an hour a kind on one of our processors;
# of 250 run files 8 went wrong in a first try.
TEXT_FILES, RUN_FILES = 20_000, 2_000

# --- Text files --------------------------------------------------------------------------------


def fuzz_text(kind: str, count: int, seed: int, folder: Path) -> Tally:
    """Read `count` mutated files of a kind.

    Parameters
    ----------
    kind : str
        Key of `READERS`.
    count, seed : int
    folder : Path
        Where the mutated files are written.
    """
    reader, tally = READERS[kind], Tally(kind)
    file = folder / reader.name
    for original in dict.fromkeys(reader.seeds):
        file.write_bytes(original)
        outcome = judged(partial(reader.read, file), reader.name)
        if outcome.kind != "accepted":
            raise SystemExit(f"fuzz: an original {kind} is {outcome}")
    rng, start = random.Random(f"{kind} {seed}"), time.perf_counter()
    for _ in range(count):
        _try_one(reader, file, tally, rng)
    tally.seconds = time.perf_counter() - start
    return tally


def _try_one(reader: Reader, file: Path, tally: Tally, rng: random.Random) -> None:
    original, mutations = rng.choice(reader.seeds), reader.mutations(rng)
    changed = mutated(original, mutations)
    file.write_bytes(changed)
    began = time.process_time()
    outcome = judged(partial(reader.read, file), reader.name)
    took_s = time.process_time() - began
    if took_s > tally.slowest_s:
        tally.slowest_s, tally.slowest = took_s, difference(original, changed)
    tally.add(outcome, lambda: _example(reader, file, original, mutations, outcome))


def _example(
    reader: Reader,
    file: Path,
    original: bytes,
    mutations: list[tuple[Mutation, int]],
    outcome: Outcome,
) -> str:
    """Lines that differ, with as few mutations as give the same outcome."""
    for mutation in list(mutations):
        fewer = [other for other in mutations if other is not mutation]
        file.write_bytes(mutated(original, fewer))
        if fewer and judged(partial(reader.read, file), reader.name).what == outcome.what:
            mutations = fewer
    return difference(original, mutated(original, mutations))


# --- All of it ---------------------------------------------------------------------------------


def print_report(tallies: list[Tally]) -> None:
    """Print a benchmark for people."""
    print(
        f"{'kind':10} {'cases':>6} {'accepted':>8} {'unnoticed':>9} {'refused':>7} {'wrong':>5} "
        f"{'distinct':>8} {'s':>6} {'slowest s':>9}"
    )
    for tally in tallies:
        print(
            f"{tally.kind:10} {tally.cases:6} {tally.accepted:8} {tally.unnoticed:9} "
            f"{tally.refused:7} {tally.wrong:5} {len(tally.distinct):8} {tally.seconds:6.0f} "
            f"{tally.slowest_s:9.2f}"
        )
    for tally in tallies:
        print(f"\n{tally.kind}: slowest:\n{tally.slowest}")
        for wrong in sorted(tally.distinct.values(), key=lambda each: -each.count):
            print(f"\n{tally.kind}: {wrong.what}: {wrong.count}")
            print(f"  {wrong.said!r}")
            print("".join(f"    {line}\n" for line in wrong.example.splitlines()), end="")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, help="files of each kind")
    parser.add_argument("--kind", choices=(*READERS, "run"), action="append")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for run files with a wrong outcome")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    asked = parser.parse_args()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tallies = [
            fuzz_runs(asked.count or RUN_FILES, asked.seed, folder, asked.keep)
            if kind == "run"
            else fuzz_text(kind, asked.count or TEXT_FILES, asked.seed, folder)
            for kind in asked.kind or (*READERS, "run")
        ]
    if asked.json:
        shown: list[dict[str, Any]] = [
            {**asdict(tally), "distinct": [asdict(w) for w in tally.distinct.values()]}
            for tally in tallies
        ]
        print(json.dumps(shown, indent=2))
    else:
        print_report(tallies)
    sys.exit(any(tally.wrong for tally in tallies))


if __name__ == "__main__":
    main()
