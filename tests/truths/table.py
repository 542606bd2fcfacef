"""All cases, searched: the table of the page on discovery.

    python tests/truths/table.py [--kind KIND] [--case PART_OF_NAME] [--seeds N] [--report]

prints how many of each kind are found, undecided, missed and false, and names what is not found.
With `--seeds` each case is searched on that many draws of its samples, with `--drawn` ten cases
only. `--report` prints what the package says of each case, and `--times` how long it takes.
"""

import argparse
import collections
import importlib
import pkgutil
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

import jax

jax.config.update("jax_enable_x64", True)

import truths  # noqa: E402

DRAWN = (
    "oscillator, symplectic Euler",
    "standard map at K = 0.5",
    "quartic oscillator with the constant 1 in the basis",
    "McMillan's map with a cubic force of 0.0001",
    "oscillator with a periodic force",
    "Lennard-Jones pair on a line",
    "oscillator about 100",
    "cubic spring, order 1",
    "linear friction",
    "central force with an axis stiffer by 1e-3",
)
"""Ten cases, one of each sort, that are searched on many draws of their samples."""

OUTCOMES = ("found", "undecided", "missed", "false")


def all_cases() -> list:
    """Of every module of this folder, in the order of their names."""
    names = sorted(module.name for module in pkgutil.iter_modules(truths.__path__))
    modules = [importlib.import_module(f"truths.{name}") for name in names if name != "table"]
    return [case for module in modules for case in getattr(module, "CASES", ())]


def table(outcomes: dict[str, list[str]]) -> str:
    """Rows of a table from the outcomes of each kind."""
    lines = [
        "| kind | cases | " + " | ".join(OUTCOMES) + " |",
        "|---|---|" + "---|" * len(OUTCOMES),
    ]
    every = [outcome for found in outcomes.values() for outcome in found]
    for kind, found in (*outcomes.items(), ("all", every)):
        counts = collections.Counter(found)
        cells = [kind, len(found), *(counts[outcome] for outcome in OUTCOMES)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> int:
    """Search, print, and return 1 if anything was missed or false."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", default="")
    parser.add_argument("--case", default="")
    parser.add_argument("--seeds", type=int, default=1)
    for flag in ("--drawn", "--report", "--times"):
        parser.add_argument(flag, action="store_true")
    chosen = parser.parse_args()
    outcomes: dict[str, list[str]] = {}
    for case in all_cases():
        named = chosen.kind in case.kind and chosen.case in case.name
        if not named or (chosen.drawn and case.name not in DRAWN):
            continue
        start, found = time.time(), []
        for seed in range(chosen.seeds):
            outcome, answer = truths.judged(case, seed)
            found.append(outcome)
            if outcome != "found" or chosen.report:
                print(f"{outcome}: {case.name} (samples of seed {seed})", flush=True)
            if chosen.report or isinstance(answer, ValueError):
                print(answer)
        outcomes.setdefault(case.kind, []).extend(found)
        if chosen.seeds > 1:
            print(f"{dict(collections.Counter(found))}: {case.name}", flush=True)
        if chosen.times:
            print(f"{time.time() - start:6.1f} s  {case.name}", flush=True)
        jax.clear_caches()
    print(table(outcomes))
    return int(any(o in ("missed", "false") for found in outcomes.values() for o in found))


if __name__ == "__main__":
    sys.exit(main())
