"""Search for random programs that fail.

    python tests/random_programs/search.py [--count 2000] [--minutes M] [--seed S] [--out FOLDER]

Programs are drawn and checked in child processes, by portions with seeds S, S + 1, …, until the
count or the time is reached. A failure is shrunk by hypothesis, and its program is written into
FOLDER as a script that can be run. A child that dies or that takes too long is a failure as well:
the program that it was at is written, not shrunk. The exit status is 1 if anything was found.
"""

import argparse
import collections
import gc
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

TESTS = Path(__file__).parents[1]
PORTION = 60
"""Programs of a child process."""

LONGEST = 600
"""Seconds after which a child that is at the same program is taken for stuck."""

FOOTER = """

if __name__ == "__main__":  # run with the folder `tests` in PYTHONPATH
    from pathlib import Path

    from random_programs.checks import check

    print(check(Path(__file__).read_text()))
"""


def portion(seed: int, count: int, out: Path) -> None:
    """Draw and check `count` programs; the one that is being checked is in out/current.py."""
    import jax
    from hypothesis import HealthCheck, Phase, given, seed as seeded, settings

    from random_programs.checks import Ill, check
    from random_programs.programs import programs

    warnings.simplefilter("ignore")
    # Traces are made of millions of objects, most of which stay: do not search them for cycles.
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)
    jax.config.update("jax_enable_x64", True)
    counted = collections.Counter()
    failed: list[tuple[str, Exception]] = []
    seen: set[str] = set()

    def check_one(program):
        if program.text in seen:
            return
        seen.add(program.text)
        (out / "current.py").write_text(program.text + FOOTER)
        counted["programs"] += 1
        if counted["programs"] % 50 == 0:  # compiled programs take memory maps, which are limited
            jax.clear_caches()
        try:
            counted[check(program.text, alone=i % 2 == 0)] += 1
        except Ill:
            counted["refused by dvi_jax"] += 1
        except Exception as error:
            failed.append((program.text, error))
            raise

    # Of a run hypothesis makes most examples by changing earlier ones a little: a run for each
    # program. The first example of a run is always the simplest one.
    of = settings(
        max_examples=2,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
    )
    for i in range(count):
        try:
            seeded(seed * PORTION + i)(of(given(programs())(check_one)))()
        except Exception as error:  # the last one that failed is the smallest
            text, error = failed[-1] if failed else ("", error)
            place = out / f"failure_{seed}_{i}.py"
            place.write_text(text + FOOTER)
            first = str(error).strip().splitlines() or [""]
            print(f"failure: seed {seed}: {type(error).__name__}: {first[0][:300]}\n  {place}")
            failed.clear()
    for what, number in sorted(counted.items()):
        print(f"count: {number} {what}")


def _finished(command: list[str], env: dict[str, str], current: Path) -> tuple[int, list[str], str]:
    """Exit status, output, and last line of the errors of a child, which is ended where it does not
    begin another program for a long time."""
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        child = subprocess.Popen(command, env=env, stdout=output, stderr=errors)
        seen, since = 0.0, time.monotonic()
        while child.poll() is None:
            time.sleep(0.2)
            changed = current.stat().st_mtime if current.exists() else 0.0
            if changed != seen:
                seen, since = changed, time.monotonic()
            if time.monotonic() - since > LONGEST:
                child.kill()
                child.wait()
                return -1, [], f"no end of a program after {LONGEST} s"
        output.seek(0)
        errors.seek(0)
        lines, said = output.read().splitlines(), errors.read().strip().splitlines()
        return child.returncode, lines, (said or [""])[-1]


def search(count: int, minutes: float, seed: int, out: Path) -> int:
    out.mkdir(parents=True, exist_ok=True)
    # One seed draws the same programs everywhere: hypothesis reads CI, and a fixed hash seed
    # orders sets.
    env = {k: v for k, v in os.environ.items() if k not in ("CI", "GITHUB_ACTIONS")}
    env["PYTHONPATH"] = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    env["PYTHONHASHSEED"] = "0"
    began, total, found = time.monotonic(), collections.Counter(), 0
    while total["programs"] < count and time.monotonic() - began < 60 * minutes:
        size = min(PORTION, count - total["programs"])
        command = [sys.executable, __file__, "--child", str(size), "--seed", str(seed)]
        code, lines, last = _finished([*command, "--out", str(out)], env, out / "current.py")
        for line in lines:
            if line.startswith("count: "):
                number, _, what = line.removeprefix("count: ").partition(" ")
                total[what] += int(number)
            else:
                found += line.startswith("failure: ")
                print(line, flush=True)
        if code:
            found += 1
            place = out / f"crash_{seed}.py"
            (out / "current.py").replace(place)
            total["programs"] += size
            print(f"failure: seed {seed}: exit status {code}: {last}\n  {place}", flush=True)
        seed += 1
        spent = time.monotonic() - began
        print(f"{total['programs']} programs, {found} failures, {spent:.0f} s", flush=True)
    for what, number in total.most_common():
        print(f"{number:6} {what}")
    return 1 if found else 0


def arguments(description: str, count: int) -> argparse.ArgumentParser:
    """The parser of the arguments that both searches have; `count`: the default."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--count", type=int, default=count, help=f"programs (default {count})")
    parser.add_argument("--seed", type=int, default=0, help="the first one (default 0)")
    return parser


def main() -> int:
    parser = arguments("Search for random programs that fail.", 2000)
    parser.add_argument("--minutes", type=float, default=1e9, help="at most (default: no limit)")
    parser.add_argument("--out", type=Path, default=Path("random-programs"), help="folder")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        portion(given.seed, given.child, given.out)
        return 0
    return search(given.count, given.minutes, given.seed, given.out)


if __name__ == "__main__":
    sys.exit(main())
