"""How a function is compiled: operations, vectors, blocks, and the parts that XLA computes."""

import dataclasses
import itertools
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .jaxprs.extent import functions_in
from .jaxprs.jaxapi import jaxprs_in_params
from .jaxprs.traced import Trace
from .llvm.ir import NotCompilable
from .native import machine
from .primitive import AUTO, SWITCH, Callee, Layout, generates, pieces_of
from .targets import CompiledProgram, compile_program


@dataclasses.dataclass(frozen=True)
class Part:
    """One call that is compiled as a whole.

    - `reason`: why XLA computes it, None where machine code is generated.
    - `operations`: on numbers of one trajectory, loops counted once; a fused multiply-add is one.
    - `width`, `vectors`: numbers in a vector, vectors in a block.
    - `target`: ``"numbers"`` if a vector holds one number of several trajectories,
      ``"elements"`` if it holds neighbouring elements of an array of one trajectory, ``"threads"``
      if a thread of a GPU computes a trajectory.
    - `loops`, `stores`: of ``"elements"``: loops over elements, and arrays that they write.
    - `scratch`: bytes of a block for rows that are not results, or of a trajectory for arrays.
    - `spills`: instructions of the machine code that move a register to or from the stack.
    - `architecture`, `registers`, `occupancy`: of ``"threads"``: the GPU's; registers of a thread,
      0 if the program ``ptxas`` of CUDA is not installed; the fraction of a multiprocessor's warps
      that can run at once, at least that of 255 registers.
    - `ir`: the module's LLVM IR, before optimisation.
    """

    reason: str | None
    operations: int = 0
    width: int = 0
    vectors: int = 0
    scratch: int = 0
    spills: int = 0
    ir: str = ""
    target: str = "numbers"
    loops: int = 0
    stores: int = 0
    architecture: int = 0
    registers: int = 0
    occupancy: float = 0.0

    @property
    def assembly(self) -> str:
        """The machine code in the assembler's language, of a GPU in PTX; empty without code."""
        if self.architecture:
            from .llvm.ptx import ptx_text

            return ptx_text(self.ir, self.architecture)
        return machine.assembly(self.ir) if self.ir else ""

    def __str__(self) -> str:
        if self.reason is not None:
            return f"left to XLA: {self.reason}"
        if self.target == "threads":
            registers = f"{self.registers} registers" if self.registers else "at most 255 registers"
            return (
                f"code for GPUs, sm_{self.architecture}: {self.operations} operations, one thread "
                f"a trajectory with {registers} and {self.scratch} bytes of local memory, "
                f"{100 * self.occupancy:.0f} % of the warps of a multiprocessor at once"
            )
        if self.target == "elements":
            return (
                f"machine code: {self.operations} operations in {self.loops} loops over the "
                f"elements of arrays, {self.stores} arrays written, vectors of {self.width} "
                f"neighbours, {self.scratch} bytes of memory a trajectory"
            )
        return (
            f"machine code: {self.operations} operations, blocks of {self.width * self.vectors} "
            f"trajectories ({self.vectors} vectors of {self.width}), {self.scratch} bytes of "
            f"memory a block, {self.spills} moves to or from the stack"
        )


@dataclasses.dataclass(frozen=True)
class Explanation:
    """Result of `explain`: one `Part` for each piece that is compiled by itself; `note` says which
    device they are for, if the one that was named does not exist."""

    parts: tuple[Part, ...]
    note: str = ""

    def __str__(self) -> str:
        if not self.parts:
            return "no call of lanewise: the function is compiled by XLA"
        lines = [f"{i + 1}. {part}" for i, part in enumerate(self.parts)]
        return "\n".join([self.note, *lines] if self.note else lines)


def explain(
    function: Callable,
    *args: Any,
    batch: int = 1024,
    layout: Layout = AUTO,
    device: str = "cpu",
) -> Explanation:
    """Report of how ``function(*args)``, of one trajectory, is compiled for a batch.

    Calls of `lanewise` in it are explained one by one, as in a function that calls
    ``dvi_jax.integrate``; a function without any is taken as the argument of `batched`.

    **Arguments**

    - `function`, `args`: as `batched` calls it for one trajectory.
    - `batch`: trajectories; all arguments are taken to differ between them.
    - `device`: ``"cpu"``, or ``"cuda:0"`` for the code of NVIDIA GPUs, which is used only if the
      environment variable ``LANEWISE_CUDA`` is ``on``. In a process without a GPU it is the code
      for the oldest one that is supported, and the report says so.

    **Returns** an `Explanation`: print it, or read its `parts`, each with `ir` and `assembly`.

    **Example**

    ```python
    print(lanewise.explain(lambda x: jnp.sin(x) / x, 1.0))
    ```
    """
    match = re.fullmatch(r"(cpu|cuda)(?::(\d+))?", str(device).lower())
    if match is None:
        raise ValueError(
            f'device must be "cpu" or "cuda", with or without a number, got {device!r}.'
        )
    platform, number = match[1], int(match[2] or 0)
    # Arrays: a number of Python would be traced with a weak type, which a batch does not have.
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, args))
    trace = Trace.from_function(function, leaves, tree)
    # Without a call in it, the function is explained as if it were called.
    programs = _calls(trace.closed_jaxpr.jaxpr) or [Callee(trace, layout)]
    parts = (part for program in programs for part in _parts(program, batch, platform))
    return Explanation(tuple(parts), _note(platform, number))


def _note(platform: str, number: int) -> str:
    """What is assumed if a device does not exist."""
    try:
        count = len(jax.devices(platform))
    except RuntimeError:  # JAX has no device of this kind
        count = 0
    if number < count:
        return ""
    from .llvm.ptx import ARCHITECTURES

    assumed = "those that exist" if count else f"an assumed GPU, sm_{min(ARCHITECTURES)}"
    return f"there is no device {platform}:{number} in this process: the report is for {assumed}"


def compiled_by(function: Callable, *args: Any, batch: int = 1024) -> tuple[set[str], str | None]:
    """The targets (see `Part`) that compile the calls of `lanewise` in ``function(*args)``, and why
    XLA computes one of them or a part of it, None if it does not. Nothing is compiled.
    """
    names: set[str] = set()
    if not generates():
        return names, f"the variable {SWITCH} is off, or LLVM did not start"
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    for program in _calls(jaxpr):
        # Without the pieces of `_parts`: a program that is cut is in part computed by XLA.
        flags = [True] * len(program.trace.all_inputs.jaxpr.invars)
        try:
            # This writes the code and does not compile it, which would take seconds.
            names.add(compile_program(program, flags, batch, "cpu").target.name)
        except NotCompilable as reason:
            return names, str(reason)
    return names, None


def _calls(jaxpr: Any) -> list[Any]:
    """The programs of the calls in a jaxpr, in order."""
    programs = []
    for eqn in jaxpr.eqns:
        if functions_in(eqn):
            programs.append(eqn.params["program"])
            continue
        for body in jaxprs_in_params(eqn.params):
            programs += _calls(body)
    return programs


def _parts(program: Any, batch: int, platform: str) -> list[Part]:
    """How a program is compiled; its pieces if it is not compiled as a whole."""
    count = len(program.trace.all_inputs.jaxpr.invars)
    try:
        result = compile_program(program, [True] * count, batch, platform)
    except NotCompilable as reason:
        parts = [
            [Part(piece.reason)]
            if piece.is_left_to_xla
            else _parts(Callee(Trace(piece.function), program.layout), batch, platform)
            for piece in pieces_of(program, batch, platform)
        ]
        return list(itertools.chain(*parts)) or [Part(str(reason))]
    code = result.code
    if platform == "cuda":
        return [_gpu_part(result)]
    # Registers that do not suffice show in moves to and from the stack; their number says whether a
    # block has too many vectors.
    assembly = result.target.assembly(code)
    spills = len(re.findall(r"\bv?mov[a-z0-9]*\s+.*\((?:%rsp|sp)\)", assembly))
    return [
        Part(
            None,
            code.operations,
            code.width,
            code.vectors,
            code.scratch,
            spills,
            code.module,
            result.target.name,
            code.loops,
            code.stores,
        )
    ]


def _gpu_part(result: CompiledProgram) -> Part:
    # Not imported for reports about CPUs.
    from .llvm.ptx import occupancy, registers_of
    from .targets.threads import Threads

    assert isinstance(result.target, Threads)
    kernel = result.target.kernel(result.code)
    registers = registers_of(kernel.text, kernel.architecture)  # only CUDA's assembler knows
    return Part(
        None,
        kernel.operations,
        scratch=kernel.local_bytes,
        ir=result.code.text,
        target=result.target.name,
        architecture=kernel.architecture,
        registers=registers or 0,
        occupancy=occupancy(registers or 255, kernel.architecture),
    )
