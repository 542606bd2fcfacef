"""What a way of compiling must do, and which one compiles a program."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np

from ..jaxprs.jaxapi import ClosedJaxpr
from ..llvm.ir import FasterInXlaError, NotCompilable
from ..native.handler import module_text


@dataclasses.dataclass(frozen=True)
class Code:
    """The kernel of a program, and what a call hands to it.

    - `text`: LLVM IR before optimisation.
    - `block`: trajectories that are computed at once.
    - `values`: whole numbers that are inputs of the code.
    - `operands`: constants that follow the operands of the call.
    - `operations`, `scratch`, `width`, `vectors`, `loops`, `stores`: see `Part`.
    """

    text: str
    block: int
    values: tuple[int, ...] = ()
    operands: tuple[np.ndarray, ...] = ()
    operations: int = 0
    scratch: int = 0
    width: int = 1
    vectors: int = 1
    loops: int = 0
    stores: int = 0

    @property
    def module(self) -> str:
        """The kernel with its handler, as it is compiled."""
        return module_text(self.text, self.block, self.scratch)

    def params(self, lanes: int | None, outs: Sequence[Any]) -> np.ndarray:
        """What the kernel reads: trajectories, cost of a block, bytes of a trajectory in each
        result, values (`HEAD` of them come before the results)."""
        # The operations of a block, times the rounds of its longest loop: with few of them the
        # threads of XLA's pool would take longer to start than to work.
        cost = max(self.operations * max([1, *self.values]), 1)
        sizes = [a.size * a.dtype.itemsize for a in outs]
        return np.asarray([lanes or 1, cost, *sizes, *self.values], np.int64)


class Target(Protocol):
    """A way of compiling a function of one trajectory for a batch of them."""

    @property
    def name(self) -> str:
        """Its name in reports."""
        ...

    def suits(self, function: ClosedJaxpr) -> bool:
        """Whether it is tried for a program. The answer must not depend on the batch."""
        ...

    def write(
        self, function: ClosedJaxpr, lane_flags: Sequence[bool], lanes: int, width: int | None
    ) -> Code:
        """The kernel for a batch of `lanes` trajectories; `lane_flags` says which inputs differ
        between them. `width`: see `Layout`.

        **Raises** `NotCompilable` with the reason if no code can be generated.
        """
        ...

    def register(self, code: Code) -> str:
        """The name by which XLA calls the code, compiled and registered at the first call."""
        ...

    def assembly(self, code: Code) -> str:
        """The machine code in the assembler's language."""
        ...


@dataclasses.dataclass(frozen=True)
class CompiledProgram:
    """A program's code, and why the targets that were tried before have none."""

    target: Target
    code: Code
    reasons: Mapping[str, str]

    def call(self, operands: Sequence[Any], program: Any, lanes: int | None) -> list[Any]:
        """The results of the program, as an operation of XLA."""
        params = self.code.params(lanes, program.trace.closed_jaxpr.out_avals)
        # Constants follow the operands, so that their text is not part of the code.
        run = jax.ffi.ffi_call(self.target.register(self.code), program.shape_of(lanes))
        return list(run(*operands, *self.code.operands, params=params))


def compiled_by(
    targets: Sequence[Target], program: Any, lane_flags: Sequence[bool], lanes: int | None
) -> CompiledProgram:
    """The code of the first target that has some. **Raises** `NotCompilable` with all reasons."""
    if program.layout.form == "arrays":
        raise NotCompilable('the layout has form="arrays"')
    function, reasons = program.trace.all_inputs, {}
    for target in targets:
        if not target.suits(function):
            continue
        # Only `write` decides, by what it cannot express: a second list of what a target supports
        # would have to be kept equal to its rules.
        try:
            code = target.write(function, lane_flags, lanes or 1, program.layout.width)
            return CompiledProgram(target, code, reasons)
        except NotCompilable as refusal:
            reasons[target.name] = str(refusal)
            # Other targets would be slower still.
            if isinstance(refusal, FasterInXlaError):
                break
    # Targets share rules, and give the same reason where a rule is missing.
    raise NotCompilable("; ".join(dict.fromkeys(reasons.values())))
