"""A function of one lane on many lanes: in component form, in tiles that stay in cache."""

import copy
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._compat import (
    ClosedJaxpr,
    drops_outputs,
    identity,
    is_traced,
    jaxpr_as_fun,
    lower_on,
    primitive,
    without_outputs,
)
from .elementary import VECTORISED, pow
from .lanes import Evaluator, Value, operation_count
from .lanes._value import on_lanes, whole

LARGEST = 20_000
"""A function of more operations than this, loops counted once, is left in arrays."""

SHORTEST = 100_000
"""What has fewer lanes × steps than this is left in arrays: it is compiled in a third of the time,
and over in some ten milliseconds."""

FEWEST_FOR_OWN = 8
"""Lanes from which on elementary functions of our own are faster than the library's."""

TILE_ENTRIES = 4096
"""Numbers of all lanes of a tile that a step works with: what a first-level cache holds."""


Form = Literal["auto", "components", "arrays"]


def _form(form: Any) -> Any:
    """The form, with the name of the removed kernel replaced by what runs instead."""
    if form != "kernel":
        return form
    warnings.warn(
        'The GPU kernel was removed from dvi_jax: Layout(form="kernel") is now the same as '
        'Layout(form="auto"). On a GPU the default is jax.lax.scan under jax.vmap.',
        DeprecationWarning,
        stacklevel=3,
    )
    return "auto"


class Layout(eqx.Module):
    """How the arithmetic of a run is laid out; the numbers are the same to round-off.

    **Arguments**

    - `form`: ``"components"``: every element of an array is a number of its own, and a batch under
      `vmap` goes in tiles of such numbers, which stay in registers and cache; ``"arrays"``: as the
      functions were written, batched by `vmap`; ``"auto"``: components, but for short runs (fewer
      than 100 000 lanes × steps), which they make longer by the time of their compilation, and
      for functions of very many operations; on a GPU ``"auto"`` means ``"arrays"``.
      ``"kernel"`` is a deprecated name of ``"auto"``.
    - `width`: lanes of a tile; None means by the size of the state.
    - `library`: take sin, cos and their like from the library, as arrays do, also where components
      go in batches of float64 and arithmetic of our own is several times as fast.

    **Raises** `ValueError` for another form, or a width that is not positive.
    """

    form: Form = eqx.field(static=True, default="auto", converter=_form)
    width: int | None = eqx.field(static=True, default=None)
    library: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.form not in ("auto", "components", "arrays"):
            raise ValueError(f'form must be "auto", "components" or "arrays", got {self.form!r}.')
        width = self.width
        if width is not None and (
            isinstance(width, bool) or not isinstance(width, int) or width < 1
        ):
            raise ValueError(f"width must be a positive integer or None, got {width!r}.")


def lanewise(
    function: Callable,
    *args: Any,
    layout: Layout,
    steps: int,
    entries: int,
    plain: Callable | None = None,
) -> Any:
    """``function(*args)``, for one lane; and how it is to be batched by `vmap`.

    `function` takes and returns pytrees of arrays. It is evaluated in component form, under `vmap`
    in tiles of lanes, where `layout` says so for `steps` steps that work with so many `entries` of
    a lane; elsewhere `plain` is called, which gives the same numbers. Derivatives are those of
    `plain`; it is `function` if left out.
    """
    plain = function if plain is None else plain
    leaves, tree = jax.tree.flatten(args)
    ordinary = _Traced(plain, leaves, tree)
    if plain is function:
        special = _known(ordinary)
    elif ordinary.outer or not all(map(eqx.is_array, leaves)):
        special = _known(_Traced(function, leaves, tree))
    else:  # nothing is closed over that ceases to exist: it is traced when it is needed, if ever
        shapes = [jax.typeof(x) for x in leaves]
        special = functools.cache(lambda: _Traced(function, shapes, tree))
    program = _Program(ordinary, special, layout, steps, entries)
    # What is traced outside and closed over is an input like the others.
    outer = ordinary.outer

    @jax.custom_jvp
    def call(*operands):
        on = (False,) * len(operands)
        return _lanewise.bind(*operands, program=program, lanes=None, on=on)

    @call.defjvp
    def _(primals, tangents):
        return jax.jvp(lambda *x: _all_alike(ordinary(*x), x), primals, tangents)

    return jax.tree.unflatten(ordinary.out_tree, call(*outer, *leaves))


def _known(traced: "_Traced") -> Callable[[], "_Traced"]:
    return lambda: traced


def functions_in(eqn: Any) -> list[ClosedJaxpr]:
    """The jaxprs of what `lanewise` was given, if an equation of a jaxpr is its call: they are not
    among those that the equation shows."""
    program = eqn.params.get("program")
    if not isinstance(program, _Program):
        return []
    return [program.ordinary.closed, program.special.closed]


def _all_alike(outputs: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    """The outputs, batched under `vmap` as those of the primitive are: all of them, in front.

    JAX takes for granted that a function and its derivative's rule batch their values alike.
    """
    parts = [x.ravel()[:0] for x in inputs if eqx.is_inexact_array(x)]
    nothing = sum((jnp.sum(x) for x in parts), start=jnp.zeros(()))  # it depends on all inputs

    def alike(x):
        if eqx.is_inexact_array(x):
            x = x + nothing.astype(x.dtype)
        else:
            x = jnp.where(nothing == 0, x, x)
        return _lanes_in_front.bind(x)

    return [alike(x) for x in outputs]


_lanes_in_front = identity(
    "lanes_in_front",
    lambda arrays, axes: (_lanes_in_front.bind(jnp.moveaxis(arrays[0], axes[0], 0)), 0),
)


class _Traced:
    """A function of one lane as a jaxpr, what it closes over as its first operands."""

    def __init__(self, function: Callable, leaves: Sequence[Any], tree: Any):
        trees: list[Any] = []

        def flat(*leaves):
            out, out_tree = jax.tree.flatten(function(*jax.tree.unflatten(tree, leaves)))
            trees.append(out_tree)
            return out

        self.closed = jax.make_jaxpr(flat)(*leaves)
        self.out_tree = trees[-1]
        self.outer = [c for c in self.closed.consts if is_traced(c)]

    def __call__(self, *operands: Any) -> list[Any]:
        outer = iter(operands[: len(self.outer)])
        consts = [next(outer) if is_traced(c) else c for c in self.closed.consts]
        closed = ClosedJaxpr(self.closed.jaxpr, consts)
        return jaxpr_as_fun(closed)(*operands[len(self.outer) :])

    def giving(self, used: list[bool]) -> "_Traced":
        """The function that gives some of the outputs only, as a flat list."""
        fewer = copy.copy(self)
        fewer.closed = without_outputs(self.closed, used)
        return fewer

    def in_components(
        self, operands: Sequence[Any], on: Sequence[bool], lanes: int | None, own: dict
    ) -> list[Value]:
        """The outputs in component form; the last axis of an operand is the lanes where `on`.

        `own` are the elementary functions that are not the library's.
        """
        values = [whole(x, o) for x, o in zip(operands, on, strict=True)]
        outer = iter(values[: len(self.outer)])
        consts = [next(outer) if is_traced(c) else whole(c, False) for c in self.closed.consts]
        evaluator = Evaluator(lanes, own)
        return evaluator.jaxpr(self.closed.jaxpr, consts, values[len(self.outer) :])


class _Program:
    """Two ways to compute the same, and which is taken on how many lanes."""

    def __init__(
        self,
        ordinary: _Traced,
        special: Callable[[], _Traced],
        layout: Layout,
        steps: int,
        entries: int,
    ):
        self.ordinary, self._special = ordinary, special
        self.layout, self.steps, self.entries = layout, steps, entries

    @property
    def special(self) -> _Traced:
        return self._special()

    def giving(self, used: list[bool]) -> "_Program":
        """The program that gives some of the outputs only."""
        ordinary = self.ordinary.giving(used)
        special = functools.cache(lambda: self.special.giving(used))
        return _Program(ordinary, special, self.layout, self.steps, self.entries)

    def takes_components(self, lanes: int | None, is_gpu: bool = False) -> bool:
        if self.layout.form in ("arrays", "components"):
            return self.layout.form == "components"
        if is_gpu:  # no speed of the other form was measured there
            return False
        if (lanes or 1) * self.steps < SHORTEST:
            return False
        if len(self.special.outer) != len(self.ordinary.outer):
            return False
        return operation_count(self.special.closed.jaxpr) <= LARGEST

    @property
    def width(self) -> int:
        if self.layout.width is not None:
            return self.layout.width
        best = TILE_ENTRIES / max(self.entries, 1)
        return min(max(2 ** round(math.log2(best)), 64), 1024)


def _run(
    *operands, program: _Program, lanes: int | None, on: tuple[bool, ...], is_gpu: bool = False
) -> list[Any]:
    """The program on so many lanes: the first axis of operands where `on`, and of all outputs."""
    if not program.takes_components(lanes, is_gpu):
        if lanes is None:
            outs = program.ordinary(*operands)
        else:
            axes = [0 if o else None for o in on]
            outs = jax.vmap(program.ordinary, axes, 0)(*operands)
    elif lanes is None:
        values = program.special.in_components(operands, on, None, {})
        outs = [jnp.asarray(v.array()[0]) for v in values]
    else:
        outs = _in_tiles(program, operands, on, lanes, is_gpu)
    return outs


def _run_on_gpu(*operands, **params) -> list[Any]:
    return _run(*operands, is_gpu=True, **params)


def _shape_of(*operands, program: _Program, lanes: int | None, on: tuple[bool, ...]) -> list[Any]:
    front = () if lanes is None else (lanes,)
    avals = program.ordinary.closed.out_avals
    return [jax.ShapeDtypeStruct((*front, *a.shape), a.dtype) for a in avals]


_run.shape_of = _shape_of  # pyright: ignore[reportFunctionMemberAccess]


def _batched(operands, axes, *, program: _Program, lanes: int | None, on: tuple[bool, ...]):
    """One more axis of lanes: all of them become one."""
    batched = [axis is not None for axis in axes]
    moved = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes, strict=True)
    ]
    (size,) = {x.shape[0] for x, b in zip(moved, batched, strict=True) if b}
    if lanes is None:
        flags = tuple(batched)
        outs = _lanewise.bind(*moved, program=program, lanes=size, on=flags)
        return outs, [0] * len(outs)
    merged = [_merge(x, b, o, size, lanes) for x, b, o in zip(moved, batched, on, strict=True)]
    either = tuple(b or o for b, o in zip(batched, on, strict=True))
    size_of_all = size * lanes
    outs = _lanewise.bind(*merged, program=program, lanes=size_of_all, on=either)
    outs = [x.reshape(size, lanes, *x.shape[1:]) for x in outs]
    return outs, [0] * len(outs)


_lanewise = primitive("lanewise", _run, _batched, multiple=True)
lower_on("cuda", _lanewise, _run_on_gpu)


def _without(params: dict[str, Any], used: list[bool]) -> dict[str, Any]:
    return dict(params, program=params["program"].giving(used))


drops_outputs(_lanewise, _without)


def _merge(x: Any, has_outer: bool, has_inner: bool, size: int, lanes: int) -> Any:
    """Two axes of lanes in front as one; one that is missing is filled with copies."""
    if not (has_outer or has_inner):
        return x
    if not has_outer:
        x = jnp.broadcast_to(x[None], (size, *x.shape))
    elif not has_inner:
        x = jnp.broadcast_to(x[:, None], (size, lanes, *x.shape[1:]))
    return x.reshape(size * lanes, *x.shape[2:])


def _in_tiles(
    program: _Program, operands: Sequence[Any], on: Sequence[bool], lanes: int, is_gpu: bool
) -> list[jax.Array]:
    """The outputs on all lanes, tile by tile; a GPU takes them all at once."""
    count = 1 if is_gpu else -(-lanes // program.width)
    width = lanes if count == 1 else -(-lanes // (8 * count)) * 8
    own = VECTORISED if width >= FEWEST_FOR_OWN and not program.layout.library else {}
    if is_gpu:  # whose library has sin and its like for all lanes at once
        own = {"pow": pow}

    def cut(x):
        missing = count * width - lanes
        if missing:
            x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (missing, *x.shape[1:]))])
        return jnp.moveaxis(x.reshape(count, width, *x.shape[1:]), 1, -1)

    def tile(*mine):
        of = iter(mine)
        parts = [next(of) if o else x for x, o in zip(operands, on, strict=True)]
        values = program.special.in_components(parts, on, width, own)
        return [_on_lanes(v, width) for v in values]

    mine = [cut(x) for x, o in zip(operands, on, strict=True) if o]
    if count == 1:
        outs = tile(*(x[0] for x in mine))
    else:
        traced = jax.make_jaxpr(tile)(*(x[0] for x in mine))

        def step(i, outs):
            # Into the result as it will be: large arrays are written once.
            rows = jaxpr_as_fun(traced)(*(x[i] for x in mine))
            return [
                lax.dynamic_update_slice_in_dim(out, row, i * width, row.ndim - 1)
                for out, row in zip(outs, rows, strict=True)
            ]

        begin = [jnp.zeros((*a.shape[:-1], count * width), a.dtype) for a in traced.out_avals]
        outs = lax.fori_loop(0, count, step, begin)
    # Lanes were last: a `vmap` which wants them there finds nothing to transpose.
    return [jnp.moveaxis(x[..., :lanes], -1, 0) for x in outs]


def _on_lanes(value: Value, width: int) -> jax.Array:
    """A value as one array, the lanes last."""
    array, has_lanes = value.array()
    array = jnp.asarray(array)
    return array if has_lanes else on_lanes(array, width, array.ndim)
