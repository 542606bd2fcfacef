"""The target of NVIDIA GPUs: one thread for each trajectory, one kernel for a run.

The numbers and operations are those of `numbers` for vectors of one element and blocks of one
trajectory, so that results have the same bits; only what surrounds them differs.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ..evaluator import Evaluator
from ..jaxprs.extent import calls_of_marked, has_long_arrays, operation_count
from ..jaxprs.jaxapi import ClosedJaxpr
from ..llvm.ir import Num, check_size, check_that, check_type
from ..llvm.memory import Buffer, contiguous, stored_type
from ..llvm.ptx import (
    ARCHITECTURES,
    THREADS,
    PtxKernel as PtxKernel,
    architecture_for,
    local_bytes,
    ptx_text,
)
from ..module import Module
from .numbers import array_at, lane_stride, operand_value
from .target import Code

NAME = "lanewise_kernel"

MOST_OPERATIONS = 8_000
"""Longer programs leave the caches of instructions, and their numbers the registers."""

MOST_PARAMETERS = 512
"""Of 8 bytes each: 4 KiB. Only newer drivers take more."""

SHORT_LOOP = 8
"""Loops of at most so many rounds are unrolled."""


class ThreadModule(Module):
    """The code of one thread, and a kernel that calls it."""

    # The driver reserves this memory for every thread that can run at once: here 4 GiB on a GPU
    # with 270 000 threads.
    largest = 16 * 2**10
    platform = "cuda"

    def __init__(self):
        super().__init__(1, 1)  # a thread has one trajectory, in scalars
        self.arrays: list[str] = []

    def parameter(self, value: int) -> Num:
        # The arrays of a short loop become registers once it is unrolled.
        if value <= SHORT_LOOP:
            return self.b.number([str(int(value))], "int64", False)
        return super().parameter(value)

    def scratch(self, shape: Sequence[int], dtype: str, has_lanes: bool, copies: int = 1) -> Buffer:
        count, name = math.prod(shape), f"%scratch{len(self.arrays)}"
        self.scratch_bytes += count * np.dtype(dtype).itemsize
        check_size(self.scratch_bytes, self.largest, "bytes of intermediate arrays of a thread")
        # One for each array, so that LLVM sees which accesses cannot overlap. It keeps those in
        # registers whose indices it knows; the hardware interleaves the rest, thread by thread.
        self.arrays.append(f"  {name} = alloca [{max(count, 1)} x {stored_type(dtype)}], align 8")
        lane = 1 if has_lanes else None
        return Buffer((name,), dtype, tuple(shape), contiguous(shape), lane)

    # A thread has 255 registers: a carry stays in them.

    def set_aside(self, x: Num, pointers: Sequence[str], vec: bool) -> None:
        pass

    def taken_back(self, x: Num, pointers: Sequence[str], vec: bool) -> Num:
        return x  # it is in a register still

    def parameters(self, operands: int, results: int, pointer: str = "ptr") -> str:
        """What the kernel and the function of one trajectory take, as text."""
        pointers = [f"%a{i}" for i in range(operands)] + [f"%r{i}" for i in range(results)]
        numbers = ["%lanes", *(f"%par{i}" for i in range(len(self.values)))]
        return ", ".join([f"{pointer} {p}" for p in pointers] + [f"i64 {n}" for n in numbers])


def function_text(module: ThreadModule, function: ClosedJaxpr, lane_flags: Sequence[bool]) -> str:
    """The text of `@lanewise_one`, which computes trajectory `%lane`."""
    b, jaxpr = module.b, function.jaxpr
    for v in (*jaxpr.invars, *jaxpr.outvars):
        check_type(v.aval.dtype, "arguments and results")
    evaluator = Evaluator(module)

    # An array without trajectories has one address, which all threads read at once.
    def array(pointer: str, aval: Any, has_lanes: bool) -> Buffer:
        lane = lane_stride(module, aval) if has_lanes else None
        return array_at(module, pointer, aval, lane, "%lane")

    operands = [
        operand_value(evaluator, array(f"%a{i}", v.aval, has_lanes))
        for i, (v, has_lanes) in enumerate(zip(jaxpr.invars, lane_flags, strict=True))
    ]
    places = [array(f"%r{i}", v.aval, True) for i, v in enumerate(jaxpr.outvars)]
    for value, place in zip(evaluator.evaluate(function, operands, places), places, strict=True):
        evaluator.write(value, place)
    # Functions with a reason of their own not to be part of others stay calls: they are rare.
    functions = "\n".join(module.functions.values())
    functions = functions.replace(") {\nentry:", ") alwaysinline {\nentry:")
    parameters = module.parameters(len(operands), len(places), "ptr noalias")
    return "\n".join(
        [
            *module.globals,
            *sorted(module.declarations | b.declarations),
            functions,
            f"define internal void @lanewise_one({parameters}, i64 %lane) alwaysinline {{\nentry:",
            *module.arrays,
            *b.lines,
            "  ret void\n}\n",
        ]
    )


def kernel_text(module: ThreadModule, operands: int, results: int) -> str:
    """The text of the kernel, which calls `@lanewise_one` for the trajectory of a thread."""
    names = [f"%a{i}" for i in range(operands)] + [f"%r{i}" for i in range(results)]
    registers = ("tid", "ntid", "ctaid")
    outer = module.parameters(operands, results, "ptr addrspace(1) noalias")
    inner = module.parameters(operands, results)
    for name in names:
        outer = outer.replace(f"noalias {name},", f"noalias %global.{name[1:]},")
    # Operands and results are in global memory, and do not overlap: an operand may be read through
    # the cache of constants. A thread beyond the last trajectory does nothing.
    lines = [
        *(f"declare i32 @llvm.nvvm.read.ptx.sreg.{r}.x()" for r in registers),
        f"define ptx_kernel void @{NAME}({outer}) {{",
        *(f"  %{r}.32 = call i32 @llvm.nvvm.read.ptx.sreg.{r}.x()" for r in registers),
        *(f"  %{r} = zext i32 %{r}.32 to i64" for r in registers),
        "  %first = mul i64 %ctaid, %ntid",
        "  %lane = add i64 %first, %tid",  # in 64 bits: a batch may have more than 2³² numbers
        "  %is.inside = icmp ult i64 %lane, %lanes",
        "  br i1 %is.inside, label %run, label %over",
        "run:",
        *(f"  {n} = addrspacecast ptr addrspace(1) %global.{n[1:]} to ptr" for n in names),
        f"  call void @lanewise_one({inner}, i64 %lane)",
        "  br label %over",
        "over:",
        "  ret void\n}\n",
    ]
    return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class ThreadCode(Code):
    """The kernel of a GPU, with how many operands and results it has."""

    pointers: tuple[int, int] = (0, 0)

    @property
    def module(self) -> str:
        return self.text  # its handler calls the driver, and is the same for all kernels


@dataclasses.dataclass(frozen=True)
class Threads:
    """One thread for each trajectory, for an architecture or for the GPUs of this process."""

    architecture: int | None = None

    name = "threads"

    def suits(self, function: ClosedJaxpr) -> bool:
        return True

    def write(
        self, function: ClosedJaxpr, lane_flags: Sequence[bool], lanes: int, width: int | None
    ) -> ThreadCode:
        jaxpr = function.jaxpr
        self._known_architecture()
        # Before code is written, as for CPUs: it would take long.
        count = operation_count(jaxpr)
        check_size(count, MOST_OPERATIONS, "the number of operations of a GPU thread")
        check_that(not has_long_arrays(jaxpr), "arrays of a loop are too long for a GPU thread")
        module = ThreadModule()
        module.calls = calls_of_marked(jaxpr)
        text = function_text(module, function, lane_flags)
        pointers = len(jaxpr.invars), len(jaxpr.outvars)
        parameters = sum(pointers) + 1 + len(module.values)
        check_size(parameters, MOST_PARAMETERS, "the number of parameters of a GPU kernel")
        text += kernel_text(module, *pointers)
        values, operations = tuple(module.values), module.b.operations
        scratch = module.scratch_bytes
        return ThreadCode(text, THREADS, values, (), operations, scratch, pointers=pointers)

    def _known_architecture(self) -> int:
        if self.architecture is not None:
            return self.architecture
        # Code for the oldest one runs on all of them.
        capabilities = (round(10 * float(gpu.compute_capability)) for gpu in gpus())
        capability = min(capabilities, default=min(ARCHITECTURES))
        architecture = architecture_for(capability)
        check_that(architecture is not None, f"the GPU is too old: sm_{capability}, not sm_80")
        assert architecture is not None
        return architecture

    def kernel(self, code: Code) -> PtxKernel:
        """The PTX of some code, and what a launch needs."""
        assert isinstance(code, ThreadCode)
        architecture = self._known_architecture()
        # Not in `write`, which is called for pieces of programs that are never compiled.
        text = ptx_text(code.text, architecture)
        sizes = THREADS, local_bytes(text), code.operations
        return PtxKernel(text, NAME, *code.pointers, code.values, *sizes, architecture)

    def register(self, code: Code) -> str:
        from ..native import cuda

        # Without a GPU a program is lowered for another machine, and not run.
        kernel, own = self.kernel(code), jax.process_index()
        # Those that JAX uses: the driver may have others, which are too old, say.
        numbers = [gpu.local_hardware_id for gpu in gpus() if gpu.process_index == own]
        return cuda.register(kernel, numbers) if numbers else cuda.name_of(kernel)

    def assembly(self, code: Code) -> str:
        return self.kernel(code).text


def gpus() -> list[Any]:
    """The NVIDIA GPUs of JAX, also those of other processes."""
    try:
        return jax.devices("cuda")
    except RuntimeError:  # code is made for another machine
        return []


def ptx_of(function: ClosedJaxpr, lane_flags: Sequence[bool], architecture: int) -> PtxKernel:
    """The kernel of a function for a GPU; `lane_flags` says which inputs differ between
    trajectories, `architecture` is one of `ARCHITECTURES`.

    **Raises** `NotCompilable` with the reason if no code can be generated.
    """
    target = Threads(architecture)
    return target.kernel(target.write(function, lane_flags, 1, None))
