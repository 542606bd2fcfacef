"""A function of one trajectory as the LLVM IR of a kernel for blocks of them."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import elementary
from .evaluator import Evaluator
from .jaxprs.jaxapi import ClosedJaxpr
from .llvm.builder import Builder
from .llvm.ir import TYPES, Num, Unsupported, literal
from .llvm.memory import Buffer, contiguous, load, load_row, store, stored_type
from .llvm.values import SMALL, Value, objects
from .rules.elimination import with_exchanges

# Parameters in front of a kernel's own: trajectories, cost of a block; and for each result the
# bytes of one trajectory.
HEAD = 2

LARGEST_SCRATCH = 64 * 2**20  # bytes that a block may take for rows which are not results


class Module:
    """One LLVM module: a kernel, the functions that it calls, its constants."""

    def __init__(self, width: int, vectors: int):
        self.W, self.U = width, vectors
        self.b = Builder(width, vectors)
        self.values: list[int] = []
        self.globals: list[str] = []
        self.functions: dict[tuple[str, bool], str] = {}
        self.declared: set[str] = set()
        self.scratch_bytes = 0
        self._constants: dict[bytes, str] = {}

    # --- what an evaluation needs --------------------------------------------------------------

    def parameter(self, value: int) -> Num:
        """A whole number that is an input of the machine code: another one needs no new code."""
        # So a run of other length, or with longer arrays, finds its code in the cache.
        name = f"%par{len(self.values)}"
        self.values.append(int(value))
        return self.b.made([name], "int64", False)

    def scratch(self, shape: Sequence[int], dtype: str, on: bool, each: int = 1) -> Buffer:
        """Memory for an array of every trajectory of the block, next to each other; for one array
        that all share unless `on`."""
        size = int(np.prod(shape, dtype=np.int64))
        block = self.W * self.U if on else each
        start = self.scratch_bytes
        # Whole cache lines, so that no vector lies in two of them.
        self.scratch_bytes += (size * block * 8 + 63) // 64 * 64
        if self.scratch_bytes > LARGEST_SCRATCH:
            raise Unsupported(
                f"intermediate arrays must have at most {LARGEST_SCRATCH} bytes in all, got "
                f"{self.scratch_bytes} or more for a block of {self.W * self.U} trajectories"
            )
        item = np.dtype(dtype).itemsize
        bases = tuple(
            self.b.new(f"getelementptr i8, ptr %scratch, i64 {start + u * self.W * item}")
            for u in range(self.U if on else 1)
        )
        return Buffer(bases, dtype, tuple(shape), contiguous(shape, block), 1 if on else None)

    def constant(self, array: np.ndarray) -> Buffer:
        """A known array in the module."""
        array = np.ascontiguousarray(array)
        dtype = str(array.dtype)
        item = stored_type(dtype)
        key = dtype.encode() + str(array.shape).encode() + array.tobytes()
        if key not in self._constants:
            name = f"@data{len(self._constants)}"
            self._constants[key] = name
            stored = "int8" if dtype == "bool" else dtype
            numbers = ", ".join(
                f"{item} {literal(x, stored)}" for x in array.astype(stored).reshape(-1)
            )
            self.globals.append(
                f"{name} = private unnamed_addr constant [{array.size} x {item}] [{numbers}]"
            )
        name = self._constants[key]
        return Buffer((name,), dtype, array.shape, contiguous(array.shape), None)

    def elementary(self, name: str, args: Sequence[Num]) -> Num:
        """An elementary function of float64, as a call of a function of the module."""
        vec = any(a.vec for a in args)
        known: list[Any] = [a.known for a in args]
        if all(x is not None for x in known):
            return self.b.known(_at_known(name, tuple(float(x) for x in known)), "float64")
        called = self._function(name, len(args), vec)

        def write(t: str, *names: str) -> str:
            return f"call {t} {called}({', '.join(f'{t} {x}' for x in names)})"

        return self.b.op(f"call {name}", args, "float64", write)

    def sincos(self, x: Num) -> tuple[Num, Num]:
        """sin x and cos x in one call."""
        b = self.b
        if x.known is not None:
            return self.elementary("sin", [x]), self.elementary("cos", [x])

        def make() -> tuple[Num, ...]:
            called, t = self._function("sincos", 1, x.vec), b.type("float64", x.vec)
            pair = f"{{{t}, {t}}}"
            calls = [b.new(f"call {pair} {called}({t} {name})") for name in x.names]
            b.operations += 2
            return tuple(
                b.made([b.new(f"extractvalue {pair} {c}, {i}") for c in calls], "float64", x.vec)
                for i in range(2)
            )

        return b.once(("sincos", x.serial), make)

    def _function(self, name: str, count: int, vec: bool) -> str:
        wide = vec and self.W > 1
        called = f"@{name.replace(' ', '_').replace('-', 'm')}_{'v' if wide else 's'}"
        if (name, wide) not in self.functions:
            self.functions[name, wide] = ""  # its place: a function comes after those it calls
            text, declared, constants = _function_text(name, count, self.W if wide else 1, called)
            self.functions[name, wide] = text
            self.declared |= declared
            self.globals += [c for c in constants if c not in self.globals]
        return called

    def exchanged(self, numbers: Sequence[Num], vec: bool) -> list[Num]:
        """The solution of a linear system with exchanges of rows, of its numbers row by row (A, b).

        It is needed rarely and takes many operations: a function of the module, by way of memory.
        """
        b, dtype = self.b, numbers[0].dtype
        n = math.isqrt(len(numbers))
        wide = vec and self.W > 1
        called = f"@exchanged_{n}_{TYPES[dtype]}_{'v' if wide else 's'}"
        if (called, wide) not in self.functions:
            text, declared = _exchange_text(n, dtype, self.W if wide else 1, called)
            self.functions[called, wide] = text
            self.declared |= declared
        count, block = len(numbers) + n, (self.W if vec else 1)
        # One trajectory's vector after the other: each call has a piece of memory of its own.
        whole = self.scratch((count * (self.U if vec else 1),), dtype, False, block)
        item = np.dtype(dtype).itemsize * block * count
        pieces = [
            b.new(f"getelementptr i8, ptr {whole.base[0]}, i64 {u * item}")
            for u in range(self.U if vec else 1)
        ]
        place = Buffer(tuple(pieces), dtype, (count,), (block,), 1 if vec else None)
        for i, x in enumerate(numbers):
            store(b, place, x, i * block)
        for piece in pieces:
            b.emit(f"call void {called}(ptr {piece})")
        return [load(b, place, (len(numbers) + i) * block) for i in range(n)]

    # --- the kernel ----------------------------------------------------------------------------

    def kernel(self, closed: ClosedJaxpr, on: Sequence[bool]) -> str:
        """The text of the module; `on` says which inputs differ between trajectories."""
        b, jaxpr = self.b, closed.jaxpr
        for v in (*jaxpr.invars, *jaxpr.outvars):
            if str(v.aval.dtype) not in TYPES:
                raise Unsupported(
                    "arguments and results must be float64, float32, bool or integers of 8 to 64 "
                    f"bits, got {v.aval.dtype}"
                )
        operands = []
        for i, (v, o) in enumerate(zip(jaxpr.invars, on, strict=True)):
            b.emit(f"%ap{i} = getelementptr ptr, ptr %args, i64 {i}")
            b.emit(f"%a{i} = load ptr, ptr %ap{i}")
            operands.append((f"%a{i}", v.aval, o))
        results = []
        for i, v in enumerate(jaxpr.outvars):
            b.emit(f"%rp{i} = getelementptr ptr, ptr %rets, i64 {i}")
            b.emit(f"%r{i} = load ptr, ptr %rp{i}")
            results.append((f"%r{i}", v.aval))
        # Before the loop over blocks, so that they are read once.
        strides = [self._lane_stride(a) for _, a, o in operands if o]
        strides_out = [self._lane_stride(a) for _, a in results]
        evaluator = Evaluator(b, self)
        shared = {}
        # Operands that all trajectories share are read once, before the loop over blocks.
        for i, (pointer, aval, o) in enumerate(operands):
            if not o:
                buffer = Buffer(
                    (pointer,), str(aval.dtype), aval.shape, contiguous(aval.shape), None
                )
                shared[i] = self._operand(evaluator, buffer)

        consts = [evaluator.constant(c) for c in closed.consts]

        def block(_, i):
            first = b.new(f"add i64 %first, {i}")
            start = b.new(f"mul i64 {first}, {self.W * self.U}")
            # The last block ends with the last trajectory, and computes some of them again: there
            # is no code for a remainder, which could have other bits.
            fits = b.new(f"icmp slt i64 {start}, %last.start")
            start = b.new(f"select i1 {fits}, i64 {start}, i64 %last.start")
            own, of = iter(strides), []
            for k, (pointer, aval, o) in enumerate(operands):
                if o:
                    buffer = self._per_lane(pointer, aval, next(own), start)
                    of.append(self._operand(evaluator, buffer))
                else:
                    of.append(shared[k])
            places = [
                self._per_lane(pointer, aval, stride, start)
                for (pointer, aval), stride in zip(results, strides_out, strict=True)
            ]
            outs = evaluator.jaxpr(jaxpr, consts, of, places)
            for value, place in zip(outs, places, strict=True):
                evaluator.write(value, place)
            return []

        b.loop([], [], lambda _, i: b.new(f"icmp slt i64 {i}, %count"), block, count=True)
        prologue = [
            "  %lanes = load i64, ptr %params",
            "  %count = sub i64 %last, %first",
            f"  %last.start = sub i64 %lanes, {self.W * self.U}",
        ]
        for i in range(len(self.values)):
            prologue += [
                f"  %par{i}.at = getelementptr i64, ptr %params, i64 {HEAD + len(results) + i}",
                f"  %par{i} = load i64, ptr %par{i}.at",
            ]
        epilogue = []
        if self.scratch_bytes:
            # Not from the stack: that of a thread of XLA's pool may be small.
            b.declared |= {"declare ptr @malloc(i64)", "declare void @free(ptr)"}
            size = self.scratch_bytes + 64
            prologue += [
                f"  %memory = call ptr @malloc(i64 {size})",
                "  %address = ptrtoint ptr %memory to i64",
                "  %up = add i64 %address, 63",
                "  %aligned = and i64 %up, -64",
                "  %scratch = inttoptr i64 %aligned to ptr",
            ]
            epilogue.append("  call void @free(ptr %memory)")
        body = "\n".join([*prologue, *b.lines, *epilogue, "  ret void"])
        declared = "\n".join(sorted(self.declared | b.declared))
        functions = "\n".join(self.functions.values())
        head = (
            "define internal void @lanewise_kernel(ptr %args, ptr %rets, ptr %params, "
            "i64 %first, i64 %last) alignstack(64) align 64 {\nentry:"
        )
        return "\n".join(["\n".join(self.globals), declared, functions, head, body, "}\n"])

    def _lane_stride(self, aval: Any) -> int | str:
        """The distance between trajectories in elements; that of long arrays is an input."""
        if aval.size <= SMALL:
            return int(aval.size)
        return self.parameter(aval.size).names[0]

    def _per_lane(self, pointer: str, aval: Any, stride: int | str, start: str) -> Buffer:
        b, item = self.b, stored_type(str(aval.dtype))
        bases = []
        for u in range(self.U):
            at = start if u == 0 else b.new(f"add i64 {start}, {u * self.W}")
            if stride != 1:
                at = b.new(f"mul i64 {at}, {stride}")
            bases.append(b.new(f"getelementptr {item}, ptr {pointer}, i64 {at}"))
        return Buffer(tuple(bases), str(aval.dtype), aval.shape, contiguous(aval.shape), stride)

    def _operand(self, evaluator: Evaluator, buffer: Buffer) -> Value:
        value = Value(buffer.shape, buffer.dtype, buffer=buffer)
        if value.size <= SMALL:
            value.entries = objects(load_row(self.b, buffer), buffer.shape)
        return value


def _elementary(name: str) -> Callable:
    """An elementary function of scalars by name; that of a power has its argument in the name."""
    if name.startswith("half_integer_power"):
        return elementary.half_integer_power(int(name.split()[1]))
    return elementary.sincos if name == "sincos" else elementary.FUNCTIONS[name]


@functools.cache
def _traced(name: str, count: int) -> ClosedJaxpr:
    """An elementary function as a jaxpr of scalars."""
    with jax.enable_x64(True):
        return jax.make_jaxpr(_elementary(name))(*[jnp.zeros((), jnp.float64)] * count)


@functools.cache
def _function_text(
    name: str, count: int, width: int, called: str
) -> tuple[str, frozenset[str], tuple[str, ...]]:
    """An elementary function of vectors of `width`, with what it declares."""
    inner = Module(width, 1)
    # A module of its own: its numbers and scopes do not mix with those of the caller.
    closed = _traced(name, count)
    b = inner.b
    args = [b.made([f"%x{i}"], "float64", True) for i in range(count)]
    evaluator = Evaluator(b, inner)
    values = [Value((), "float64", objects([x], ())) for x in args]
    outs = evaluator.closed(closed, values)
    t = result_type = b.type("float64", True)
    results = [b.ref(evaluator.entries(out)[()], 0, True) for out in outs]
    result = results[0]
    if len(outs) == 2:
        result_type = f"{{{t}, {t}}}"
        half = b.new(f"insertvalue {result_type} poison, {t} {results[0]}, 0")
        result = b.new(f"insertvalue {result_type} {half}, {t} {results[1]}, 1")
    prefix = called[1:]
    text = "\n".join([*b.lines, f"  ret {result_type} {result}"])
    data = []
    for line in inner.globals:  # constants of each function have names of their own
        old = line.split(" ", 1)[0]
        new = f"@{prefix}.{old[1:]}"
        text, line = text.replace(old + ",", new + ","), line.replace(old, new, 1)
        data.append(line)
    parameters = ", ".join(f"{t} %x{i}" for i in range(count))
    body = f"define internal {result_type} {called}({parameters}) {{\nentry:\n{text}\n}}\n"
    return body, frozenset(b.declared | inner.declared), tuple(data)


@functools.cache
def _exchange_text(n: int, dtype: str, width: int, called: str) -> tuple[str, frozenset[str]]:
    """A function that solves the system at a pointer, n rows (A, b), and puts x after it."""
    inner = Module(width, 1)
    b = inner.b
    system = Buffer(("%p",), dtype, (n, n + 1), ((n + 1) * width, width), 1)
    solution = Buffer(("%p",), dtype, (n,), (width,), 1, (n * (n + 1) * width,))
    with_exchanges(b, system, solution)
    lines = "\n".join(b.lines)
    text = f"define internal void {called}(ptr %p) noinline {{\nentry:\n{lines}\n  ret void\n}}\n"
    return text, frozenset(b.declared)


@functools.lru_cache(maxsize=4096)
def _at_known(name: str, args: tuple[float, ...]) -> float:
    """The value at arguments that are known while the code is made, by XLA."""
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        return float(_elementary(name)(*(jnp.asarray(x, jnp.float64) for x in args)))
