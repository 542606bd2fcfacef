"""Random programs of arrays, compiled, against the same operations one by one in NumPy.

    python tests/random_programs/arrays.py [--count 500] [--seed S] [--kind K]

A program is a loop over time that carries arrays of any rank; its body is drawn from the families
of `operations.py`, with branches, inner loops and derivatives. It is a function of its seed and its
kind. Each failure is printed with seed, kind and the jaxpr of a smaller program that still fails,
and the number of programs that each way of compiling computed. The exit status is 1 if one failed.
"""

import argparse
import collections
import contextlib
import dataclasses
import functools
import os
import sys
import time
from collections.abc import Iterator
from typing import Any

if __name__ == "__main__":  # before JAX starts
    from pathlib import Path

    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ["DVI_JAX_CACHE"] = "off"
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

import jax
import numpy as np

import lanewise
from lanewise import primitive
from lanewise.jaxprs.jaxapi import jaxpr_as_fun
from lanewise.targets.target import CompiledProgram
from random_programs.array_programs import KINDS, SMALL_KINDS, Program

TOLERANCE = 1e-12
"""Allowed difference in float64, relative to the largest number of an output.

An operation is rounded, contracted or summed in another order: some units of 1.1e-16. A body of ten
operations with slopes of about 1, taken up to eight times, lets such an error grow by a factor of
less than 1000; larger growth is measured, see `is_ill_conditioned`. A wrong element, an old value
instead of the new one or a missing term changes an output by 1e-6 or more."""

TOLERANCES = {"float64": TOLERANCE, "float32": TOLERANCE * 2.0**29}
"""The same number of units in the last place in float32."""

# Comparison


def difference(found: list[Any], expected: list[np.ndarray], tolerance: float) -> str:
    """The first output that differs, and how; empty if all agree."""
    for k, (y, z) in enumerate(zip(found, expected, strict=True)):
        y = np.asarray(y)
        if (y.shape, y.dtype) != (z.shape, z.dtype):
            return f"output {k}: {y.dtype}{y.shape} instead of {z.dtype}{z.shape}"
        if z.dtype.kind != "f":
            bad = y != z
        else:
            # The numbers of a program are of order 1: x·y − x·y, contracted, is round-off.
            size = np.max(np.abs(z), initial=1e-3, where=np.isfinite(z))
            with np.errstate(all="ignore"):
                near = (y == z) | (np.abs(y - z) <= tolerance * size)
            bad = ~np.where(np.isnan(z), np.isnan(y), near)
        if bad.any():
            place = tuple(int(i) for i in np.argwhere(bad)[0])
            return (
                f"output {k} of {len(expected)}, {z.dtype}{z.shape}: {bad.sum()} wrong, first at "
                f"{place}: {y[place]!r} instead of {z[place]!r}"
            )
    return ""


@dataclasses.dataclass
class Record:
    """What compiled the programs of a block: names of targets and XLA, reasons of refusals."""

    names: set[str] = dataclasses.field(default_factory=set)
    reasons: list[str] = dataclasses.field(default_factory=list)

    @property
    def way(self) -> str:
        return " + ".join(sorted(self.names)) or "nothing"


@contextlib.contextmanager
def recorded() -> Iterator[Record]:
    """Record how the programs of a block are compiled, without compiling them a second time."""
    record, call, through_xla = Record(), CompiledProgram.call, primitive._through_xla

    def recorded_call(self, *arguments):
        record.names.add(self.target.name)
        record.reasons += self.reasons.values()
        return call(self, *arguments)

    def recorded_xla(*operands, **params):
        record.names.add("XLA")
        return through_xla(*operands, **params)

    recorded_xla.shape_of = primitive._shape_of
    CompiledProgram.call, primitive._through_xla = recorded_call, recorded_xla
    try:
        yield record
    finally:
        CompiledProgram.call, primitive._through_xla = call, through_xla


@dataclasses.dataclass(frozen=True)
class Outcome:
    """`failure`: what differs, empty if nothing does; `way`: what compiled the program."""

    failure: str
    way: str
    reasons: tuple[str, ...] = ()
    ill: bool = False


def check(program: Program) -> Outcome:
    """Compile a program, run it, and compare all of its outputs."""
    function = jaxpr_as_fun(program.jaxpr)
    # One vector in a block takes less time to compile than several.
    one = functools.partial(lanewise.call, function, layout=lanewise.Layout(width=8))
    compiled = jax.jit(jax.vmap(one) if program.batch else one)
    single = "f32" in str(program.jaxpr)
    tolerance = TOLERANCES["float32" if single else "float64"]
    with recorded() as record:
        lowered = compiled.lower(*program.inputs)
        if record.names == {"XLA"}:  # nothing of it is of our making
            return Outcome("", record.way, tuple(record.reasons))
        found = lowered.compile()(*program.inputs)
        failure = difference(found, program.expected(), tolerance)
        if not failure and program.batch and program.bits and "XLA" not in record.names:
            for i in (0, program.batch - 1):
                alone = jax.jit(one)(*program.lane(i))
                failure = difference([x[i] for x in found], list(map(np.asarray, alone)), 0.0)
                failure = failure and f"trajectory {i} alone and in the batch: {failure}"
                if failure:
                    break
    ill = bool(failure) and "alone" not in failure and is_ill_conditioned(program, found, tolerance)
    return Outcome("" if ill else failure, record.way, tuple(record.reasons), ill)


def is_ill_conditioned(program: Program, found: list[Any], tolerance: float) -> bool:
    """Whether noise of some units in the last place changes the outputs by as much as they differ.

    So does a branch, or an index of a largest element, that depends on round-off.
    """
    unit = tolerance / 1000
    expected, noisy = program.expected(), program.expected(unit)
    for y, z, w in zip(map(np.asarray, found), expected, noisy, strict=True):
        own = difference([y], [z], tolerance)
        if own and not difference([w], [z], tolerance):
            return False
        is_number = z.dtype.kind == "f" and not np.isnan(y - z).any()
        if own and is_number and np.max(np.abs(w - z)) < 0.01 * np.max(np.abs(y - z)):
            return False
    return True


def smaller(program: Program) -> Program:
    """The program with as few operations as still fail."""
    removed, changed = set(program.removed), True
    while changed:
        changed = False
        for place in range(program.count):
            if place in removed:
                continue
            other = Program(program.seed, program.kind, frozenset({*removed, place}))
            if check(other).failure:
                removed, changed = {*removed, place}, True
    return Program(program.seed, program.kind, frozenset(removed))


def search(
    kinds: list[str], count: int, seed: int, out: Any = functools.partial(print, flush=True)
) -> int:
    """Check programs of all kinds in turn; the number of failures, which are printed."""
    ways, reasons, failures, ill = collections.Counter(), collections.Counter(), 0, 0
    began = time.process_time()
    for k in range(count):
        program = Program(seed + k // len(kinds), kinds[k % len(kinds)])
        try:
            outcome = check(program)
        except Exception as error:
            first = str(error).strip().splitlines() or [""]
            outcome = Outcome(f"{type(error).__name__}: {first[0][:300]}", "error")
        ways[outcome.way] += 1
        reasons.update(outcome.reasons)
        ill += outcome.ill
        if outcome.failure:
            failures += 1
            small = smaller(program) if outcome.way != "error" else program
            out(f"failure: seed {program.seed}, kind {program.kind!r}, {outcome.way}:")
            out(f"  {outcome.failure}\n  removed={set(small.removed)}, batch {small.batch}")
            out(str(small.jaxpr))
        if k % 20 == 19:  # compiled programs take memory maps, which are limited
            jax.clear_caches()
    spent = time.process_time() - began
    out(f"{count} programs, {failures} failures, {ill} ill-conditioned, {spent:.0f} s")
    for name, counter in (("compiled by", ways), ("refused:", reasons)):
        for what, number in counter.most_common():
            out(f"{number:6} {name} {what}")
    return failures


def main() -> int:
    parser = argparse.ArgumentParser(description="Random array programs against NumPy.")
    parser.add_argument("--count", type=int, default=500, help="programs (default 500)")
    parser.add_argument("--seed", type=int, default=0, help="the first one (default 0)")
    parser.add_argument("--kind", choices=list(KINDS), help="one kind (default: all but large)")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    return min(search([given.kind] if given.kind else SMALL_KINDS, given.count, given.seed), 1)


if __name__ == "__main__":
    sys.exit(main())
