"""The target for long arrays on CPUs: loops over their elements, one trajectory after the other."""

from collections.abc import Sequence

from ..elements.code import Kernel
from ..jaxprs.extent import has_long_arrays, operation_count, reason_for_xla
from ..jaxprs.jaxapi import ClosedJaxpr
from ..llvm.ir import FasterInXlaError, NotCompilable
from ..module import Module
from ..native import handler, machine
from .target import Code


class Elements:
    """Vectors of neighbours in an array, where a loop carries or computes long ones."""

    name = "elements"

    def suits(self, function: ClosedJaxpr) -> bool:
        return has_long_arrays(function.jaxpr)

    def write(
        self, function: ClosedJaxpr, lane_flags: Sequence[bool], lanes: int, width: int | None
    ) -> Code:
        return self.write_for(function, lane_flags, machine.width())

    def write_for(self, function: ClosedJaxpr, lane_flags: Sequence[bool], width: int) -> Code:
        """The code for vectors of `width` numbers."""
        if reason := reason_for_xla(function.jaxpr):
            raise FasterInXlaError(reason)
        module = Module(width, 1)
        try:
            kernel = Kernel(module, function, lane_flags)
        except RecursionError:
            raise NotCompilable("expressions of too many levels, for long arrays") from None
        return Code(
            kernel.text,
            block=1,
            values=tuple(module.values),
            operands=kernel.operands,
            operations=operation_count(function.jaxpr),
            scratch=kernel.scratch,
            width=width,
            loops=kernel.nests.loops,
            stores=kernel.nests.stores,
        )

    def register(self, code: Code) -> str:
        return handler.register(code.module)

    def assembly(self, code: Code) -> str:
        return machine.assembly(code.module)
