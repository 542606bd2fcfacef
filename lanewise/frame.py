"""The text around the body of a kernel: its parameters, operands and results."""

from collections.abc import Sequence

from .llvm.builder import Builder
from .module import Module
from .native.handler import KERNEL

HEAD = 2
"""Parameters in front of a kernel's own: trajectories, cost of a block; and for each result the
bytes of one trajectory."""


def pointers(b: Builder, source: str, letter: str, count: int) -> list[str]:
    """The names of the pointers to operands (`%args`) or results (`%rets`)."""
    for i in range(count):
        b.emit(f"%{letter}p{i} = getelementptr ptr, ptr {source}, i64 {i}")
        b.emit(f"%{letter}{i} = load ptr, ptr %{letter}p{i}")
    return [f"%{letter}{i}" for i in range(count)]


def kernel_text(module: Module, results: int, entry: Sequence[str]) -> str:
    """The text of a module whose body is written. `entry`: lines that come first."""
    prologue = ["  %lanes = load i64, ptr %params", "  %count = sub i64 %last, %first", *entry]
    for i in range(len(module.values)):
        prologue += [
            f"  %par{i}.at = getelementptr i64, ptr %params, i64 {HEAD + results + i}",
            f"  %par{i} = load i64, ptr %par{i}.at",
        ]
    declarations = sorted(module.declarations | module.b.declarations)
    front = [*module.globals, *declarations, *module.functions.values()]
    return "\n".join([*front, KERNEL, *prologue, *module.b.lines, "  ret void", "}\n"])
