"""Random programs: generated code against XLA, operation by operation.

A random program returns all of its intermediate numbers. Each of them is compared with what XLA
computes, compiled for that operation alone, from the operands that the generated code had. So no
error accumulates, and a comparison or an index has one right value. Contraction is what remains:
a product that was contracted into a sum has another rounding there than in the output.
"""

import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lanewise
from lanewise import primitive
from lanewise.evaluator import RULES
from lanewise.rules import elementary, elimination

LANES = 9
ULPS = 16
"""Allowed error of one operation, in ulp of the largest number that enters or leaves it. XLA's own
elementary functions have errors of up to some 8 ulp."""

SPECIAL = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-300, -1e-300, 1e300, -1e300, 1.0, -2.5]
FLOATS = ("float64", "float32")
SHAPES = [(), (2,), (3,), (2, 3)]


@dataclasses.dataclass(frozen=True)
class Node:
    """One operation of a program: `args` are places in the list of all values so far."""

    key: str
    args: tuple[int, ...]
    kind: str
    """"exact", "near" (rounded once or by a few ulp), "sum", "product", "loop"."""
    inner: Any = None

    @property
    def function(self) -> Callable:
        return FUNCTIONS[self.key]


FUNCTIONS: dict[str, Callable] = {}
"""The function of a key, of one trajectory; which gives an array or a tuple."""


def same_shape(*xs):
    shape = max((x.shape for x in xs), key=len)
    return [jnp.broadcast_to(x, shape) for x in xs]


def elementwise(function):
    return lambda *xs: function(*same_shape(*xs))


def of_lax(names, kind):
    return {name: (getattr(lax, name), kind) for name in names.split()}


UNARY = {
    **of_lax("neg abs sign floor ceil is_finite", "exact"),
    "round to even": (lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), "exact"),
    "round away": (lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO), "exact"),
    **of_lax("sqrt rsqrt sin cos exp log log1p expm1 tanh atan square", "near"),
    "scaled by 2": (lambda x: x * 2, "near"),
    "scaled by 1/8": (lambda x: x * 0.125, "near"),
    "scaled by 3": (lambda x: 3 * x, "near"),
    "divided by 2": (lambda x: x / 2, "near"),
    "divided by 3": (lambda x: x / 3, "near"),
    "2 divided": (lambda x: 2 / x, "near"),
    "plus 1": (lambda x: x + 1, "sum"),
    "1 minus": (lambda x: 1 - x, "sum"),
    **{
        f"power {n}": (functools.partial(lax.integer_pow, y=n), "product")
        for n in (-3, -1, 0, 2, 3, 5)
    },
    **{
        f"pow {y}": (lambda x, y=y: lax.pow(x, jnp.asarray(y, x.dtype)), "product")
        for y in (0.5, -1.5, 2.0, 0.3)
    },
}
BINARY = {
    **of_lax("add sub", "sum"),
    **of_lax("mul div atan2", "near"),
    **of_lax("max min rem", "exact"),
    "pow": (lambda x, y: lax.pow(lax.abs(x), y), "near"),
}
COMPARED = {name: getattr(lax, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")}
OF_INTEGERS = {
    name: getattr(lax, name)
    for name in ("add", "sub", "mul", "div", "rem", "max", "min", "bitwise_and", "bitwise_or",
                 "bitwise_xor", "shift_left", "shift_right_logical", "shift_right_arithmetic")
}  # fmt: skip
OF_AN_INTEGER = {
    **{name: getattr(lax, name) for name in ("neg", "abs", "sign", "bitwise_not")},
    "times 3": lambda i: 3 * i,
    "power 3": lambda i: lax.integer_pow(i, 3),
    "by 4": lambda i: i // 4,
    "rem 5": lambda i: i % 5,
}
OF_TRUTH = {"and": jnp.logical_and, "or": jnp.logical_or, "xor": jnp.logical_xor}
AS = ("float64", "float32", "int32", "int64", "uint32", "int8", "bool")

MODES = ("fill", "clip", "promise_in_bounds")


def inside(i, mode, length=3):
    return i % length if mode == "promise_in_bounds" else i


def _update_of_a_matrix(x, u, i):
    return lax.dynamic_update_slice(x, u[None], (i, i - i))


ARRAYS: dict[str, tuple[str, str, Callable]] = {
    # name: (what it takes, kind, function); F float of some shape, f float, i int32, b bool
    "slice": ("f3 i", "exact", lambda x, i: lax.dynamic_slice(x, (i,), (2,))),
    "slice at 1": ("f3", "exact", lambda x: lax.dynamic_slice(x, (1,), (2,))),
    "slice of a matrix": ("f23 i i", "exact", lambda x, *i: lax.dynamic_slice(x, i, (1, 2))[0]),
    "update": ("f3 f2 i", "exact", lambda x, u, i: lax.dynamic_update_slice(x, u, (i,))),
    "update at 0": ("f3 f2", "exact", lambda x, u: lax.dynamic_update_slice(x, u, (0,))),
    "update of a matrix": ("f23 f3 i", "exact", _update_of_a_matrix),
    "element": ("f3 i", "exact", lambda x, i: lax.dynamic_index_in_dim(x, i, keepdims=False)),
    **{
        f"take {m}": ("f3 i3", "exact", lambda x, i, m=m: x.at[inside(i, m)].get(mode=m))
        for m in MODES
    },
    **{
        f"take a row {m}": ("f23 i", "exact", lambda x, i, m=m: x.at[inside(i, m, 2)].get(mode=m))
        for m in MODES
    },
    "pairs": ("f23 i3", "exact", lambda x, i: x[(i % 2, i % 3)]),
    "wrap": ("f3 i3", "exact", lambda x, i: x[i]),
    "known places": ("f3", "exact", lambda x: x[np.array([2, 0])]),
    "of integers": ("i3 i3", "exact", lambda x, i: x.at[i].get(mode="fill")),
    "of truth": ("b3 i3", "exact", lambda x, i: x.at[i].get(mode="fill")),
    **{
        f"set {m}": ("f3 i f", "exact", lambda x, i, u, m=m: x.at[inside(i, m)].set(u, mode=m))
        for m in MODES
    },
    "add at": ("f3 i3 f3", "sum", lambda x, i, u: x.at[i].add(u, mode="fill")),
    "add at known": ("f3 f2", "sum", lambda x, u: x.at[np.array([2, 2])].add(u)),
    "mul at": ("f3 i f", "near", lambda x, i, u: x.at[i].mul(u, mode="fill")),
    "max at": ("f23 i f3", "exact", lambda x, i, u: x.at[i].max(u, mode="fill")),
    "min at": ("i3 i3 i3", "exact", lambda x, i, u: x.at[i].min(u, mode="fill")),
    "add integers at": ("i3 i3 i3", "exact", lambda x, i, u: x.at[i].add(u, mode="fill")),
    "dot": ("f3 f3", "dot", lax.dot),
    "matrix vector": ("f23 f3", "dot", lambda x, y: x @ y),
    "matrix matrix": ("f23 f23", "dot", lambda x, y: (x @ y.T)[0]),
    "outer": ("f2 f3", "near", jnp.outer),
    "batch of products": ("f23 f23", "dot", lambda x, y: jnp.einsum("ij,ij->i", x, y)),
    "integer dot": ("i3 i3", "exact", lax.dot),
    "sum": ("f3", "sum", jnp.sum),
    "sum of rows": ("f23", "sum", lambda x: jnp.sum(x, 1)),
    "sum of columns": ("f23", "sum", lambda x: jnp.sum(x, 0)),
    "prod": ("f3", "product", jnp.prod),
    "largest": ("f23", "exact", jnp.max),
    "least": ("f3", "exact", jnp.min),
    "integer sum": ("i3", "exact", lambda i: jnp.sum(i, dtype=jnp.int32)),
    "all": ("b3", "exact", jnp.all),
    "any": ("b3", "exact", jnp.any),
    "argmax": ("f3", "exact", lambda x: lax.argmax(x, 0, jnp.int32)),
    "argmin": ("f23", "exact", lambda x: lax.argmin(x, 1, jnp.int32)),
    "cumsum": ("f3", "sum", lax.cumsum),
    "cumsum backwards": ("f23", "sum", lambda x: lax.cumsum(x, 1, reverse=True)),
    "cumprod": ("f3", "product", lax.cumprod),
    "cummax": ("f3", "exact", lax.cummax),
    "cummin": ("i3", "exact", lax.cummin),
    "concatenate": ("f2 f3", "exact", lambda x, y: jnp.concatenate([x, y])[1:4]),
    "concatenate rows": ("f23 f3", "exact", lambda x, y: jnp.concatenate([y[None], x])[1:]),
    "reshape": ("f23", "exact", lambda x: x.reshape(3, 2)[1]),
    "transpose": ("f23", "exact", lambda x: x.T.reshape(2, 3)),
    "rev": ("f23", "exact", lambda x: lax.rev(x, (1,))),
    "pad": ("f2 f", "exact", lambda x, u: lax.pad(x, u, [(1, 1, 1)])[:3]),
    "crop": ("f3", "exact", lambda x: lax.pad(x, jnp.zeros((), x.dtype), [(-1, 0, 0)])),
    "stack": ("f f", "exact", lambda x, y: jnp.stack([x, y])),
    "row": ("f23", "exact", lambda x: x[1]),
    "stride": ("f3", "exact", lambda x: x[::2]),
    "iota": ("f3", "sum", lambda x: x + lax.iota(x.dtype, 3)),
    "clamp": ("f F f", "exact", lax.clamp),
    "clamp integers": ("i i3 i", "exact", lax.clamp),
    "select": ("b3 f3 f3", "exact", lax.select_n),
    "select all": ("b f23 f23", "exact", lax.select_n),
    "select integers": ("b3 i3 i3", "exact", lax.select_n),
    "select truth": ("b3 b3 b3", "exact", lax.select_n),
}


def bounded(x):
    """Of any number one in [−1, 1], so that loops are well-conditioned; of an infinite one NaN."""
    return x / (1 + jnp.abs(x))


def mixed(x, y):
    return 0.5 * jnp.sin(x) + 0.3 * y + 0.1 * x * y


def _scan(reverse):
    def function(x, m):
        x, m = bounded(x), bounded(m)

        def step(c, row):
            c = mixed(c, row[:2])
            return c, (c, row[2] + c[0])

        c, (rows, ends) = lax.scan(step, x, m, reverse=reverse)
        return c, rows, ends

    return function


def _two_carries(x, i, xs):
    def step(c, z):
        a, n, _ = c
        return (mixed(a, z), n + 1, a > z), (a, n)

    init = (bounded(x), i & 3, jnp.asarray(False))
    (a, n, last), (rows, counts) = lax.scan(step, init, bounded(xs))
    return a, n, last, rows, counts


def _nested(x, m):
    def outer(c, row):
        c, inside = lax.scan(lambda c, z: (mixed(c, z),) * 2, c, row)
        return c, inside

    return lax.scan(outer, bounded(x), bounded(m))


def _still(x, y):
    def step(c, _):
        a, fixed = c
        return (mixed(a, fixed), fixed), None

    (a, fixed), _ = lax.scan(step, (bounded(x), bounded(y)), None, length=4)
    return a, fixed


def _counted(x, i):
    def body(c):
        k, a = c
        return k - 1, mixed(a, k * 0.1)

    k, a = lax.while_loop(lambda c: c[0] > 0, body, (i & 7, bounded(x)))
    return k, a


def _halved(x):
    """Exact: which trajectory goes on when has one right answer."""

    def goes_on(c):
        return jnp.any(jnp.abs(c[1]) > 0.3) & (c[0] < 12)

    return lax.while_loop(goes_on, lambda c: (c[0] + 1, c[1] / 2), (0, x))


def _while_in_scan(x, j):
    def step(c, k):
        _, c = lax.while_loop(lambda s: s[0] < k, lambda s: (s[0] + 1, mixed(s[1], s[1])), (0, c))
        return c, c

    return lax.scan(step, bounded(x), j & 3)


def _fixed_while(x):
    start = 0, bounded(x)
    return lax.while_loop(lambda c: c[0] < 4, lambda c: (c[0] + 1, mixed(c[1], c[1])), start)


def _cond(b, x, y):
    return lax.cond(b, mixed, lambda x, y: jnp.cos(x) - y, bounded(x), bounded(y))


def _switch(i, x):
    branches = [
        jnp.sin,
        lambda x: x + 1,
        lambda x: lax.scan(lambda c, _: (mixed(c, c), None), x, None, length=3)[0],
    ]
    return lax.switch(i, branches, bounded(x))


def _cond_in_scan(x, b):
    def step(c, b):
        c = lax.cond(b, jnp.sin, lambda c: 0.5 * c + 1, c)
        return c, c

    return lax.scan(step, bounded(x), b)


def _nested_call(x, y):
    return lanewise.call(lambda x, y: (mixed(x, y), x * y), bounded(x), bounded(y))


LOOPS = {
    "scan": ("f2 f23", _scan(False)),
    "reversed scan": ("f2 f23", _scan(True)),
    "scan of two": ("f i f3", _two_carries),
    "scan in scan": ("f f23", _nested),
    "scan with a constant": ("f3 f3", _still),
    "counted while": ("f2 i", _counted),
    "halved while": ("f3", _halved),
    "while in scan": ("f i3", _while_in_scan),
    "fixed while": ("f3", _fixed_while),
    "cond": ("b f3 f3", _cond),
    "switch": ("i f2", _switch),
    "cond in scan": ("f b3", _cond_in_scan),
    "call": ("f3 f3", _nested_call),
    "jit": ("f3 f3", jax.jit(lambda x, y: mixed(bounded(x), bounded(y)))),
    "checkpoint": ("f3 f3", jax.checkpoint(lambda x, y: mixed(bounded(x), bounded(y)))),
}  # fmt: skip

SHAPE_OF = {"": (), "2": (2,), "3": (3,), "23": (2, 3)}


class Generator:
    """Random nodes for a list of values, of which shapes and types are known."""

    def __init__(self, rng, avals):
        self.rng, self.avals = rng, list(avals)
        self.nodes: list[Node] = []

    def choice(self, items):
        items = list(items)
        return items[self.rng.integers(len(items))]

    def some(self, dtypes, shapes):
        """The place of a value; recent ones more often, so that programs are deep."""
        avals = enumerate(self.avals)
        found = [k for k, a in avals if str(a.dtype) in dtypes and a.shape in shapes]
        if not found:
            return None
        return self.choice(found[-4:] if self.rng.random() < 0.5 else found)

    def append(self, key, function, args, kind, inner=None):
        if None in args:
            return
        FUNCTIONS.setdefault(key, function)
        outs = shapes_of(key, tuple(as_key(self.avals[a]) for a in args))
        self.nodes.append(Node(key, tuple(args), kind, inner))
        self.avals += outs

    def add(self):
        getattr(self, self.choice(["floats"] * 7 + ["integers"] * 2 + ["truth", "converted"]
                                  + ["arrays"] * 6 + ["loops"] * 2))()  # fmt: skip

    def floats(self):
        if self.rng.random() < 0.45:
            name = self.choice(UNARY)
            function, kind = UNARY[name]
            x = self.some(FLOATS, SHAPES)
            return self.append(f"float {name}", function, [x], kind)
        x = self.some(FLOATS, SHAPES)
        aval = self.avals[x]
        y = self.some([str(aval.dtype)], [aval.shape, ()])
        if self.rng.random() < 0.2:
            name = self.choice(COMPARED)
            return self.append(f"float {name}", elementwise(COMPARED[name]), [x, y], "exact")
        name = self.choice(["add", "sub", "mul"] * 2 + list(BINARY))
        function, kind = BINARY[name]
        args = [x, y] if y is None or self.rng.random() < 0.5 else [y, x]
        return self.append(f"float {name}", elementwise(function), args, kind)

    def integers(self):
        if self.rng.random() < 0.3:
            name = self.choice(OF_AN_INTEGER)
            x = self.some(["int32"], SHAPES)
            return self.append(f"int {name}", OF_AN_INTEGER[name], [x], "exact")
        x = self.some(["int32"], SHAPES)
        y = self.some(["int32"], [self.avals[x].shape, ()])
        table = COMPARED if self.rng.random() < 0.3 else OF_INTEGERS
        name = self.choice(table)
        return self.append(f"int {name}", elementwise(table[name]), [x, y], "exact")

    def truth(self):
        if self.rng.random() < 0.3:
            return self.append("not", jnp.logical_not, [self.some(["bool"], SHAPES)], "exact")
        x = self.some(["bool"], SHAPES)
        y = self.some(["bool"], [self.avals[x].shape])
        name = self.choice(OF_TRUTH)
        return self.append(f"truth {name}", OF_TRUTH[name], [x, y], "exact")

    def converted(self):
        x = self.some([*FLOATS, "int32", "bool"], SHAPES)
        new = self.choice(AS)
        near = "near" if new == "float32" else "exact"
        self.append(f"as {new}", lambda x: lax.convert_element_type(x, new), [x], near)

    def operands(self, needed):
        dtype = self.choice(["float64"] * 4 + ["float32"])
        args = []
        for one in needed.split():
            dtypes = {"f": [dtype], "F": [dtype], "i": ["int32"], "b": ["bool"]}[one[0]]
            args.append(self.some(dtypes, SHAPES if one == "F" else [SHAPE_OF[one[1:]]]))
        return args

    def arrays(self):
        name = self.choice(ARRAYS)
        needed, kind, function = ARRAYS[name]
        self.append(f"array {name}", function, self.operands(needed), kind)

    def loops(self):
        if self.rng.random() < 0.3:
            return self.random_scan() if self.rng.random() < 0.6 else self.random_cond()
        name = self.choice(LOOPS)
        needed, function = LOOPS[name]
        return self.append(f"loop {name}", function, self.operands(needed), "loop")

    def inner(self, avals, count):
        """The generator of a random body of `count` operations."""
        generator = Generator(self.rng, avals)
        for _ in range(count):
            kinds = ["floats", "floats", "arrays", "integers", "converted"]
            getattr(generator, self.choice(kinds))()
        return generator

    def random_scan(self):
        """A scan of a random body, which puts out all of its intermediate numbers."""
        carry = self.some(FLOATS, SHAPES)
        xs = self.some(FLOATS, [(3,)])
        others = [self.some(kind, SHAPES) for kind in (FLOATS, ["int32"], ["bool"])]
        if carry is None or xs is None or None in others:
            return
        row = jax.ShapeDtypeStruct((), self.avals[xs].dtype)
        inner = self.inner([self.avals[carry], row, *(self.avals[o] for o in others)], 6)
        alike = [k for k, a in enumerate(inner.avals) if as_key(a) == as_key(inner.avals[0])]
        back, reverse = alike[-1], bool(self.rng.integers(2))
        nodes = tuple(inner.nodes)

        def function(c, xs, *others):
            def step(c, x):
                values = evaluate(nodes, [c, x, *others])
                return values[back], values

            c, rows = lax.scan(step, c, xs, reverse=reverse)
            return [c, *rows]

        key = f"random scan {nodes} {back} {reverse}"
        self.append(key, function, [carry, xs, *others], "scan", (nodes, back, reverse))

    def random_cond(self):
        """A branch of a random body, which puts out all of its intermediate numbers."""
        which = self.some(["bool"], [()])
        kinds = (FLOATS, SHAPES), (FLOATS, [(3,)]), (["int32"], SHAPES)
        others = [self.some(*kind) for kind in kinds]
        if which is None or None in others:
            return
        inner = self.inner([self.avals[o] for o in others], 5)
        nodes, count = tuple(inner.nodes), len(others)
        avals = inner.avals[count:]

        def function(which, *others):
            return lax.cond(
                which,
                lambda *others: evaluate(nodes, others)[count:],
                lambda *others: [jnp.zeros(a.shape, a.dtype) for a in avals],
                *others,
            )

        key = f"random cond {nodes} {[as_key(a) for a in avals]}"
        self.append(key, function, [which, *others], "cond", nodes)


def as_key(aval):
    return tuple(aval.shape), str(aval.dtype)


@functools.cache
def shapes_of(key, avals):
    avals = [jax.ShapeDtypeStruct(*a) for a in avals]
    return jax.tree.leaves(jax.eval_shape(FUNCTIONS[key], *avals))


def evaluate(nodes, values):
    values = list(values)
    for node in nodes:
        values += jax.tree.leaves(node.function(*(values[a] for a in node.args)))
    return values


COMMON = [(shape, dtype) for dtype in ("int32", "bool") for shape in ((), (3,))]
INPUTS = [*((shape, dtype) for dtype in FLOATS for shape in SHAPES), *COMMON]
ALIKE = [*((shape, "float64") for shape in ((), (3,), (2, 3))), ((3,), "float32"), *COMMON]
"""The same on all trajectories: once as constants, once as operands without an axis for them."""

ALL = [*INPUTS, *ALIKE, *ALIKE]


def inputs(seed):
    """A batch with special numbers on all trajectories but the first three; `ALIKE` on one."""
    rng, values = np.random.default_rng([seed, 1]), []
    for shape, dtype in ALL:
        full = (LANES, *shape)
        if dtype == "bool":
            values.append(rng.integers(2, size=full).astype(bool))
        elif dtype == "int32":
            x = rng.integers(-4, 6, size=full)
            x[-2:] = rng.choice([0, 2**31 - 1, -(2**31), -1], size=x[-2:].shape)
            values.append(x.astype(dtype))
        else:
            x = rng.normal(size=full) * 10.0 ** rng.integers(-2, 3, size=full)
            special = rng.random(full) < 0.35
            special[:3] = False
            x = np.where(special, rng.choice(SPECIAL, size=full), x)
            if dtype == "float32":
                with np.errstate(all="ignore"):
                    x = np.where(np.abs(x) == 1e300, np.sign(x) * 1e30, x)
                    x = np.where(np.abs(x) == 1e-300, np.sign(x) * 1e-30, x)
            values.append(x.astype(dtype))
    alike = range(len(INPUTS), len(ALL))
    return [v[rng.integers(LANES)] if k in alike else v for k, v in enumerate(values)]


def programs(seed, count, length):
    """Random programs on the same inputs."""
    rng, found = np.random.default_rng([seed, 2]), []
    for _ in range(count):
        generator = Generator(rng, [jax.ShapeDtypeStruct(*a) for a in ALL])
        while len(generator.nodes) < length:
            generator.add()
        found.append(tuple(generator.nodes))
    return found


_FLAT = 6 * LANES


OF_NUMPY = {"float log1p": np.errstate(all="ignore")(np.log1p)}
"""Where XLA:CPU is no reference: its log1p is wrong by 128 ulp at −0.414."""


@functools.cache
def reference(key):
    return OF_NUMPY.get(key) or jax.jit(jax.vmap(FUNCTIONS[key]))


def by_xla(node, args):
    """The outputs as XLA computes them of these operands."""
    if not node.key.startswith(("float ", "int ", "truth ", "as ", "not")):
        return [np.asarray(x) for x in jax.tree.leaves(reference(node.key)(*args))]
    # One compilation for all shapes.
    rank = max(a.ndim for a in args)
    wide = [a.reshape(a.shape + (1,) * (rank - a.ndim)) for a in args]
    shape = np.broadcast_shapes(*(a.shape for a in wide))
    flat = [np.resize(np.broadcast_to(a, shape).reshape(-1), _FLAT) for a in wide]
    (out,) = jax.tree.leaves(reference(node.key)(*flat))
    return [np.asarray(out)[: math.prod(shape)].reshape(shape)]


def per_lane(x):
    return np.asarray(x, float).reshape(LANES, -1)


def agree(node, args, found, expected, of_products, counts):
    """Which elements of an output agree."""
    if not np.issubdtype(expected.dtype, np.floating):
        return found == expected
    tiny, eps = (float(v) for v in (np.finfo(found.dtype).tiny, np.finfo(found.dtype).eps))
    shape = (LANES,) + (1,) * (found.ndim - 1)
    floats = [per_lane(a) for a in args if np.issubdtype(a.dtype, np.floating)]
    floats = [np.where(np.isnan(a), 0.0, a) for a in floats]
    floats = floats or [np.ones((LANES, 1))]
    with np.errstate(all="ignore"):
        y, z = found.astype(float), expected.astype(float)
        equal = (y == z) | (np.isnan(y) & np.isnan(z))
        if node.kind == "exact":
            return equal
        scale = np.abs(z)
        largest = np.max([np.max(np.abs(a), 1) for a in floats], 0).reshape(shape)
        if node.kind in ("sum", "dot"):
            sums = [np.sum(np.abs(a), 1).reshape(shape) for a in floats]
            scale = scale + (math.prod(sums) if node.kind == "dot" else sum(sums))
        if node.kind == "loop":
            scale = 20 * np.maximum(scale, 1)
        near = equal | (np.abs(y - z) <= ULPS * eps * scale + 4 * tiny)
        # The largest number and the smallest, where another order or a contraction leaves the
        # range earlier or later.
        most = float(np.finfo(found.dtype).max)
        smallest = np.min([np.min(np.abs(a), 1) for a in floats], 0).reshape(shape)
        edge = np.isfinite(largest) & (scale > most / 4)
        if node.kind in ("product", "dot"):
            edge = edge | ~((largest < most**0.2) & (smallest > tiny**0.2))
        if any(of_products):
            edge = edge | np.isinf(largest) | (smallest < tiny)
        counts.update(elements=near.size, left_out=int(np.sum(edge & ~near)))
        return near | edge


MULTIPLIED = "mul square scaled power pow prod dot product outer divided".split()  # noqa: SIM905


class Checker:
    """Compares all numbers of programs; `wrong` names the operations that disagree."""

    def __init__(self):
        self.wrong: Counter[str] = Counter()
        self.first: dict[str, str] = {}
        self.compared: Counter[str] = Counter()
        self.elements: Counter[str] = Counter(elements=0, left_out=0)

    def report(self, node, args, found, expected, bad):
        self.wrong[node.key[:60]] += 1
        lane = int(np.argwhere(bad)[0][0])
        text = ", ".join(f"{a.dtype}{a[lane]}" for a in args)
        self.first.setdefault(
            node.key[:60], f"{text} -> {found.dtype}{found[lane]}, expected {expected[lane]}"
        )

    def check(self, nodes, values, mask, of_products):
        """The values of nodes, where trajectories are marked."""
        values, of_products = list(values), list(of_products)
        count = len(of_products)
        for node in nodes:
            args = [values[a] for a in node.args]
            mine = [of_products[a] for a in node.args]
            makes = any(word in node.key for word in MULTIPLIED) and node.kind != "exact"
            if node.kind == "scan":
                outs = self.scan(node, args, values[count:], mask, mine)
            elif node.kind == "cond":
                outs = self.cond(node, args, values[count:], mask, mine)
            else:
                expected = by_xla(node, args)
                outs = values[count : count + len(expected)]
                for y, z in zip(outs, expected, strict=True):
                    assert y.shape == z.shape, (node.key, y.shape, z.shape)
                    assert y.dtype == z.dtype, (node.key, y.dtype, z.dtype)
                    good = agree(node, args, y, z, mine, self.elements)
                    bad = ~good & mask.reshape((LANES,) + (1,) * (y.ndim - 1))
                    self.compared[node.key[:60]] += 1
                    if np.any(bad):
                        self.report(node, args, y, z, bad)
            count += len(outs)
            of_products += [any(mine) or makes or node.kind in ("scan", "cond", "loop")] * len(outs)

    def scan(self, node, args, values, mask, of_products):
        nodes, back, reverse = node.inner
        carry, xs, *others = args
        avals = [a.shape[1:] for a in (carry, xs[:, 0], *others)]
        length, state = xs.shape[1], carry
        size = 1 + len(avals) + sum(
            len(shapes_of(n.key, key)) for n, key in with_avals(nodes, [
                (a.shape[1:], str(a.dtype)) for a in (carry, xs[:, 0], *others)])
        )  # fmt: skip
        end, *rows = outs = values[:size]
        for k in reversed(range(length)) if reverse else range(length):
            now = [r[:, k] for r in rows]
            for found, expected in zip(now, [state, xs[:, k], *others], strict=False):
                self.same(node, found, expected, mask)
            self.check(nodes, now, mask, [True] * len(avals))
            state = now[back]
        self.same(node, end, state, mask)
        return outs

    def same(self, node, found, expected, mask):
        nan = found != found
        bad = (found != expected) & ~(nan & (expected != expected))
        bad &= mask.reshape((LANES,) + (1,) * (found.ndim - 1))
        if np.any(bad):
            self.report(node, [], found, expected, bad)

    def cond(self, node, args, values, mask, of_products):
        which, *others = args
        keys = [(a.shape[1:], str(a.dtype)) for a in others]
        size = sum(len(shapes_of(n.key, key)) for n, key in with_avals(node.inner, keys))
        outs = values[:size]
        for y in outs:
            self.same(node, y, np.zeros_like(y), mask & ~which)
        self.check(node.inner, [*others, *outs], mask & which, [True] * len(others))
        return outs


def with_avals(nodes, avals):
    """(node, avals of its operands) for each node, given those of the inputs."""
    avals = list(avals)
    for node in nodes:
        key = tuple(avals[a] for a in node.args)
        yield node, key
        avals += [as_key(a) for a in shapes_of(node.key, key)]


def run(seed, count=25, length=16):
    """Run programs in one call, and compare all numbers in them."""
    values, some, checker = inputs(seed), programs(seed, count, length), Checker()

    first, second = len(INPUTS), len(INPUTS) + len(ALIKE)
    constants = [jax.device_put(c) for c in values[first:second]]  # JAX folds those of NumPy

    def function(own, alike):
        return [evaluate(nodes, [*own, *constants, *alike])[len(ALL) :] for nodes in some]

    found = jax.jit(lanewise.batched(function, (0, None)))(values[:first], values[second:])
    values = [np.broadcast_to(v, (LANES, *a[0])) for v, a in zip(values, ALL, strict=True)]
    per_program = []
    for nodes, outs in zip(some, found, strict=True):
        before = sum(checker.wrong.values())
        outs = [np.asarray(x) for x in outs]
        checker.check(nodes, [*values, *outs], np.ones(LANES, bool), [False] * len(values))
        per_program.append(sum(checker.wrong.values()) - before)
    return checker, per_program


@pytest.fixture(autouse=True)
def nothing_is_left_to_xla(monkeypatch):
    def through_xla(*operands, **params):
        raise AssertionError("left to XLA")

    monkeypatch.setattr(primitive, "_through_xla", through_xla)


SHORT = 6
"""Operations of a program; a loop of a random body counts as one."""


def assert_all_agree(checker):
    assert not checker.wrong, "\n".join(f"{k}: {v}" for k, v in checker.first.items())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_random_programs(seed):
    checker, per_program = run(seed, 50, SHORT)
    assert_all_agree(checker)
    assert len(per_program) == 50
    assert sum(checker.compared.values()) > 300
    assert len(checker.compared) > 100
    assert checker.elements["left_out"] < 0.02 * checker.elements["elements"]


def test_a_few_random_programs():
    checker, _ = run(100, 3, SHORT)
    assert_all_agree(checker)


def swapped(rule):
    return lambda e, eqn, values, places: rule(e, eqn, values[::-1], places)


@pytest.fixture
def nothing_is_stored():
    """Programs that are compiled in a test are compiled again in others."""
    yield
    jax.clear_caches()
    for module in (elementary, elimination, primitive):
        for stored in vars(module).values():
            if hasattr(stored, "cache_clear"):
                stored.cache_clear()


@pytest.mark.slow
def test_a_wrong_rule_is_found(nothing_is_stored, monkeypatch):
    """Control: a difference with its operands exchanged, among 20 programs."""
    monkeypatch.setitem(RULES, "sub", swapped(RULES["sub"]))
    checker, per_program = run(0, 20, SHORT)
    assert sum(map(bool, per_program)) >= 3
    assert any("sub" in key for key in checker.wrong)
