"""Seconds of `import dvi_jax` and `dvi-jax --help`, compared with `import jax`.

    python benchmarks/import_time.py [--rounds 7] [--check]

Each is a process of its own, interleaved with the others; medians, with byte code compiled and
files in the cache of the disk. For an import the first column is the statement alone, for a command
the whole process; the others are the whole process, the interpreter's start and end included.
`--check`: exit status 1 if `import dvi_jax` takes more than 1.1 times `import jax, equinox` and
0.15 s more, or help more than 0.5 s.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

TIMED = "import time; began = time.perf_counter(); {}; print(time.perf_counter() - began)"

ROWS = {
    "pass": (["-c", TIMED.format("pass")], None),
    "import jax, equinox": (["-c", TIMED.format("import jax, equinox")], None),
    "import dvi_jax": (["-c", TIMED.format("import dvi_jax")], "1.1 × import jax, equinox + 0.15"),
    "dvi-jax --help": (["-m", "dvi_jax_cli", "--help"], 0.5),
    "dvi-jax run --help": (["-m", "dvi_jax_cli", "run", "--help"], 0.5),
}


def seconds(arguments: list[str], cache: str) -> tuple[float, float, float]:
    """(measured quantity, wall, processor) of one process that must succeed."""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    env |= {"PYTHONPYCACHEPREFIX": cache, "JAX_PLATFORMS": "cpu"}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    out = subprocess.run(
        [sys.executable, *arguments], check=True, stdout=subprocess.PIPE, text=True, env=env
    )
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    asked = float(out.stdout) if arguments[0] == "-c" else wall
    return asked, wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> int:
    """Measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in ROWS}
    with tempfile.TemporaryDirectory() as cache:
        for arguments, _ in ROWS.values():
            seconds(arguments, cache)
        for _ in range(options.rounds):
            for name, (arguments, _) in ROWS.items():
                taken[name].append(seconds(arguments, cache))
    late = []
    print("| | s | at most | process, wall s | processor s |\n| --- | --- | --- | --- | --- |")
    for name, (_, most) in ROWS.items():
        asked, *whole = (statistics.median(column) for column in zip(*taken[name], strict=True))
        if isinstance(most, str):  # relative to what the package itself imports
            reference = statistics.median(first for first, *_ in taken["import jax, equinox"])
            most = 1.1 * reference + 0.15
        limit = "" if most is None else f"{most:.2f}"
        print(f"| `{name}` | {asked:.2f} | {limit} | {whole[0]:.2f} | {whole[1]:.2f} |")
        if most is not None and asked > most:
            late.append(name)
    return 1 if late and options.check else 0


if __name__ == "__main__":
    sys.exit(main())
