"""Instructions of machine code on x86-64: parsed, counted in a run, and their longest chain.

The code is assembled with a probe at the begin of each basic block, which writes the number of the
block to a buffer. A run of it leaves the sequence of its basic blocks.
"""

import collections
import functools
import re
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from _baseline import SOURCE, Baseline, find_compiler

from lanewise.native import machine

WINDOW = 512
"""Instructions that a processor begins before the first of them is complete: 512 in Golden Cove,
448 in Zen 5."""


class Instruction(NamedTuple):
    """An instruction on floating numbers: its unit of the processor ("none": it only moves them),
    how many numbers it computes at once, bytes from and to memory, and the registers and places on
    the stack that it reads and writes."""

    unit: str
    kind: str
    elements: int
    read: int
    written: int
    sources: tuple[str, ...]
    target: str


UNITS = {
    "fma": r"vfn?m(add|sub)",
    "mul": r"vmul[ps]d",
    "add": r"v(add|sub)[ps]d",
    "div": r"vdiv",
    "sqrt": r"vsqrt",
    "max": r"v(max|min|cmp|u?comi)[ps]?",
    "none": r"v?mov(?!m|dd)|k|vp?broadcast.*\(",
    "other": r"",
}
"""The first pattern that fits the name of an instruction and its operands."""

CALLS = ("sin", "cos")
SIZES = {"xmm": 16, "ymm": 32, "zmm": 64}


def place_of(operand: str) -> str:
    """The register or the place on the stack of an operand, empty for others."""
    register = re.match(r"%(?:[xyz]mm|(?=k\d))(\w+)", operand)
    return register[1] if register else operand if "(%rsp)" in operand else ""


@functools.cache
def parsed(text: str) -> Instruction | None:
    """An instruction of the assembler's language (AT&T); None if it concerns no such number."""
    name, _, rest = text.partition("\t") if "\t" in text else text.partition(" ")
    if name in ("call", "callq") and (called := re.search("|".join(CALLS), rest)):
        kind, elements = ("vector", 8) if "_ZGV" in rest else ("single", 1)
        return Instruction(called[0], kind, elements, 0, 0, ("0",), "0")
    operands = re.split(r",\s*(?![^(]*\))", rest.split("#")[0].strip())
    sizes = [SIZES[size] for size in re.findall(r"%([xyz]mm)", rest)]
    if not sizes and not name.startswith("k"):
        return None
    is_single = not sizes or (
        "broadcast" not in name and bool(re.search(r"[sh][ds]$|s[ds]2|2s[ds]|vmovq|vmovd$", name))
    )
    size = 8 if is_single else max(sizes)
    *before, last = operands
    unit = next(unit for unit, pattern in UNITS.items() if re.match(pattern, f"{name} {rest}"))
    mask = re.search(r"\{%(k\d)\}(\{z\})?", last)
    is_zero = re.match(r"vp?xor", name) and len(set(operands[:2])) == 1
    read_too = unit == "fma" or (mask and not mask[2])
    sources = {place_of(operand) for operand in [*before, last][: len(before) + bool(read_too)]}
    loaded = 8 if "{1to" in rest or "broadcast" in name else size
    return Instruction(
        "none" if is_zero else unit,
        "vector" if size > 16 else "single",
        size // 8,
        loaded if any("(" in operand for operand in before) else 0,
        size if "(" in last else 0,
        () if is_zero else tuple(sources | ({mask[1]} if mask else set())),
        place_of(last),
    )


class Probes:
    """Code with a probe at each basic block, which writes the block's number to a buffer."""

    capacity = 1 << 23

    def __init__(self):
        self.blocks: list[list[Instruction]] = []
        self._buffer = np.zeros(self.capacity + 2, np.uint32)

    def into(self, assembly: str) -> str:
        """The assembly with probes; it must not use memory below the stack pointer."""
        lines, is_code, is_start = [], True, True
        for line in assembly.splitlines():
            text = line.strip()
            if text.startswith((".section", ".text", ".data", ".bss")):
                is_code = "text" in text
            if re.match(r"[\w.$]+:", text):
                is_start = True
            elif is_code and text and text[0] not in ".#":
                if is_start:
                    lines.append(self._probe(len(self.blocks)))
                    self.blocks.append([])
                if instruction := parsed(text):
                    self.blocks[-1].append(instruction)
                is_start = text[0] == "j"
            lines.append(line)
        return "\n".join(lines) + "\n"

    def _probe(self, number: int) -> str:
        return (
            f"pushfq; pushq %rax; pushq %rcx; movabsq ${self._buffer.ctypes.data}, %rax; "
            f"movq (%rax), %rcx; cmpq ${self.capacity}, %rcx; jae 77f; "
            f"movl ${number}, 8(%rax,%rcx,4); incq (%rax); 77: popq %rcx; popq %rax; popfq"
        )

    def trace(self, call: Callable[[], Any]) -> list[int]:
        """The numbers of the blocks that `call` runs, in order."""
        self._buffer[:2] = 0
        jax.block_until_ready(call())
        count = int(self._buffer[:2].view(np.uint64)[0])
        if count >= self.capacity:
            raise RuntimeError(f"the run has more than {self.capacity} basic blocks.")
        return self._buffer[2 : count + 2].tolist()

    def counts(self, trace: list[int]) -> collections.Counter:
        """Instructions by kind and unit, operations on numbers by unit, and bytes."""
        result = collections.Counter()
        for block, number in collections.Counter(trace).items():
            for x in self.blocks[block]:
                result["read"] += number * x.read
                result["written"] += number * x.written
                if x.unit != "none":
                    result[f"{x.kind} {x.unit}"] += number
                    result[x.unit] += number * x.elements
        return result

    def chain(self, trace: list[int], latency: dict[str, float]) -> float:
        """The time of the instructions of a trace if each only waits for the results that it reads
        and for the end of the one that is WINDOW instructions earlier."""
        places: dict[str, int] = collections.defaultdict(lambda: len(places))
        blocks = {
            number: [_for_chain(x, latency, places) for x in self.blocks[number]]
            for number in set(trace)
        }
        ready, ends, last, i = [0.0] * (len(places) + 1), [0.0] * WINDOW, 0.0, 0
        for number in trace:
            for time, sources, target in blocks[number]:
                end = ends[i]
                for source in sources:
                    if ready[source] > end:
                        end = ready[source]
                end += time
                if end > last:
                    last = end
                ready[target] = end
                ends[i] = last
                i = (i + 1) % WINDOW
        return last


def _for_chain(
    x: Instruction, latency: dict[str, float], places: dict[str, int]
) -> tuple[float, list[int], int]:
    """The latency of an instruction, and the places that it reads and writes (-1: not known)."""
    unit = "memory" if x.written else x.unit
    sources = [places[source] for source in x.sources if source]
    return latency.get(f"{x.kind} {unit}", 0.0), sources, places[x.target] if x.target else -1


def with_probes(probes: Probes, ir: str) -> bytes:
    """The object file of a module of lanewise, with probes."""
    ir = re.sub(r"(?m)^(define .*?)(\s*\{)$", r"\1 noredzone\2", ir)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "code.s", Path(folder) / "code.o"
        source.write_text(probes.into(machine.assembly(ir)), encoding="utf-8")
        subprocess.run([*find_compiler(), "-c", source, "-o", target], check=True)
        return target.read_bytes()


def baseline_with_probes(probes: Probes, command: list[str]) -> Baseline:
    """baseline.c, compiled by a command, with probes."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "baseline.s"
        subprocess.run([*command, "-mno-red-zone", "-S", SOURCE, "-o", source], check=True)
        source.write_text(probes.into(source.read_text(encoding="utf-8")), encoding="utf-8")
        return Baseline(source)
