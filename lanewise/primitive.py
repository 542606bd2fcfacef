"""The primitive of JAX for a function of one trajectory; under `vmap` it becomes machine code."""

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp

from .jaxprs.jaxapi import (
    ClosedJaxpr,
    batch_in_front,
    drops_outputs,
    has_derivative,
    linear_map,
    lower_on,
    manual_axes,
    primitive,
    with_equal_axes,
)
from .jaxprs.traced import Traced
from .llvm.ir import Unsupported
from .native import handler, machine
from .pieces import Piece, in_pieces, pieces
from .targets import TARGETS, compiled

FORMS = ("auto", "arrays")

SWITCH = "LANEWISE"  # the variable that switches the generator off: ``LANEWISE=off``


@dataclasses.dataclass(frozen=True)
class Layout:
    """Options of compilation of a run; they change results by round-off at most.

    **Arguments**

    - `form`: ``"auto"``: machine code of our own on a CPU, XLA's loops elsewhere and for functions
      that hold something for which no code is generated (see `explain`); ``"arrays"``: XLA's
      loops, batched by `vmap`.
    - `width`: trajectories of a block, rounded to a power of two that suits the processor; None
      means by the size of the state. No result depends on it.

    **Raises** `ValueError` for another form, or a width that is not positive.
    """

    form: Literal["auto", "arrays"] = "auto"
    width: int | None = None

    def __post_init__(self):
        if self.form not in FORMS:
            raise ValueError(f'form must be "auto" or "arrays", got {self.form!r}.')
        width = self.width
        if width is not None and (
            isinstance(width, bool) or not isinstance(width, int) or width < 1
        ):
            raise ValueError(f"width must be None or a positive int, got {width!r}.")


AUTO = Layout()


def call(function: Callable, *args: Any, layout: Layout = AUTO) -> Any:
    """``function(*args)`` for one trajectory, compiled to machine code, also under `vmap`.

    `function` takes and returns pytrees of arrays. Forward and reverse derivatives are those of
    `function` and are computed by XLA; write them with a `call` of their own to have them compiled
    too.
    """
    leaves, tree = jax.tree.flatten(args)
    # Traced here, for one trajectory: `vmap` outside only reaches the primitive.
    traced = Traced.of(function, leaves, tree)
    program = Program(traced, layout)
    # A value that is traced outside and closed over is an input like the others.
    operands = [*traced.outer, *leaves]
    on = (False,) * len(operands)
    outs = _lanewise.bind(*operands, program=program, lanes=None, on=on)
    return jax.tree.unflatten(traced.out_tree, outs)


def batched(function: Callable, in_axes: Any = 0, layout: Layout = AUTO) -> Callable:
    """`function` of one trajectory as a function of a batch, compiled to machine code.

    ``lanewise.batched(f)(x)`` gives what ``jax.vmap(f)(x)`` does, to round-off. It may be called
    under `jit` and `vmap`; a result does not depend on the batch that a trajectory belongs to.

    **Arguments**

    - `function`: takes and returns pytrees of arrays.
    - `in_axes`: the batch axis of each argument, as `jax.vmap` takes it.
    - `layout`: see `Layout`.

    **Example**

    ```python
    import jax, jax.numpy as jnp, lanewise

    def pendulum(angle, momentum):
        def step(state, _):
            q, p = state
            p = p - 0.1 * jnp.sin(q)
            return (q + 0.1 * p, p), None
        return jax.lax.scan(step, (angle, momentum), None, length=1000)[0]

    angles, momenta = jax.jit(lanewise.batched(pendulum))(jnp.linspace(0.0, 1.0, 1000),
                                                          jnp.zeros(1000))
    ```
    """
    if not callable(function):
        raise TypeError(
            "function must be a function of one trajectory, got an object of the type "
            f"{type(function).__name__}. Write batched(f), not batched(f(x))."
        )
    if not isinstance(layout, Layout):
        raise TypeError(
            f"layout must be a lanewise.Layout, got {layout!r}. Write Layout(form=...)."
        )
    one = functools.partial(call, function, layout=layout)
    return jax.vmap(one, in_axes)


def generates() -> bool:
    """Whether machine code is generated in this process; otherwise XLA compiles everything."""
    if os.environ.get(SWITCH, "").strip().lower() in ("off", "0", "no", "false"):
        return False
    return _can_start()


@functools.cache
def _can_start() -> bool:
    try:
        machine.started()
        handler.runtime()
    except Exception as error:
        warnings.warn(
            "No machine code can be generated. XLA compiles the batches: they run several times "
            "slower, results agree to round-off. To suppress this warning set the environment "
            f"variable {SWITCH}=off. Reason: {type(error).__name__}: {error}",
            stacklevel=2,
        )
        return False
    return True


# Compared by identity: JAX takes two calls of one program for the same, and hashes its parameters.
@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """The function of a call, and the options of its compilation."""

    traced: Traced
    layout: Layout = AUTO

    def shape_of(self, lanes: int | None) -> list[Any]:
        """The shapes and types of the outputs for a batch."""
        front = () if lanes is None else (lanes,)
        avals = self.traced.closed.out_avals
        return [jax.ShapeDtypeStruct((*front, *a.shape), a.dtype) for a in avals]


def _in_jax(program: Program, lanes: int | None, on: tuple[bool, ...]) -> Callable:
    """The program as a function of JAX: the batch in front of operands where `on`, and of all
    outputs."""
    if lanes is None:
        return program.traced
    return jax.vmap(program.traced, [0 if o else None for o in on], 0, axis_size=lanes)


def _through_xla(*operands, program: Program, lanes: int | None, on: tuple[bool, ...]):
    """The program as XLA compiles it."""
    return _in_jax(program, lanes, on)(*operands)


def _lowered(*operands, program: Program, lanes: int | None, on: tuple[bool, ...], platform: str):
    """The program as machine code, through XLA where none can be generated."""
    try:
        if not generates():
            raise Unsupported(
                "no machine code is generated in this process: the environment variable "
                f"{SWITCH} switches it off, or a warning reported the reason"
            )
        if lanes == 0:
            raise Unsupported("the batch has no trajectories")
        return compiled(program, on, lanes, platform).call(operands, program, lanes)
    except Unsupported as reason:
        # This is for developers of the compiler; users have `explain`.
        if os.environ.get("LANEWISE_LOG"):
            print("left to XLA:", reason, flush=True)
        found = pieces_of(program, lanes or 1, platform) if lanes != 0 else []
        if not found:
            return _through_xla(*operands, program=program, lanes=lanes, on=on)

        def run(piece: Piece, *arrays: Any, on: tuple[bool, ...]) -> list[Any]:
            part = Program(Traced(piece.closed), program.layout)
            compute = _through_xla if piece.is_left_to_xla else _lanewise.bind
            return compute(*arrays, program=part, lanes=lanes, on=on)

        return in_pieces(found, program.traced.all_inputs, operands, lanes, on, run)


def pieces_of(program: Program, lanes: int, platform: str) -> list[Piece]:
    """The pieces of a program that is not compiled as a whole; none if XLA computes all of it."""
    if program.layout.form == "arrays" or not generates():
        return []

    def reason(closed: ClosedJaxpr) -> str | None:
        try:
            part = Program(Traced(closed), program.layout)
            compiled(part, [True] * len(closed.jaxpr.invars), lanes, platform)
        except Unsupported as why:
            return str(why)
        return None

    found = pieces(program.traced.all_inputs, reason)
    # One piece is all of it, and too large as a whole: it cannot be cut any further.
    is_whole = len(found) == 1 and not found[0].is_call
    return [] if is_whole or all(piece.is_left_to_xla for piece in found) else found


def _shape_of(*operands, program: Program, lanes: int | None, on: tuple[bool, ...]) -> list[Any]:
    return program.shape_of(lanes)


# The shapes are known: JAX need not trace the function again to find them.
_through_xla.shape_of = _shape_of  # pyright: ignore[reportFunctionMemberAccess]


def _batched(operands, axes, *, program: Program, lanes: int | None, on: tuple[bool, ...]):
    """One more axis of trajectories: all of them become one."""
    batched = [axis is not None for axis in axes]
    size, moved, _ = batch_in_front(operands, axes)
    if lanes is None:
        outs = _lanewise.bind(*moved, program=program, lanes=size, on=tuple(batched))
        return outs, [0] * len(outs)
    # One batch of all trajectories: nested batches need no rule of their own.
    merged = [_merge(x, b, o, size, lanes) for x, b, o in zip(moved, batched, on, strict=True)]
    either = tuple(b or o for b, o in zip(batched, on, strict=True))
    outs = _lanewise.bind(*merged, program=program, lanes=size * lanes, on=either)
    outs = [x.reshape(size, lanes, *x.shape[1:]) for x in outs]
    return outs, [0] * len(outs)


_lanewise = primitive("lanewise", _through_xla, _batched, multiple=True)
for _platform in TARGETS:
    lower_on(_platform, _lanewise, functools.partial(_lowered, platform=_platform))


def _derivative(primals, changes: dict[int, Any], **params):
    """The derivative of the function, computed by XLA."""
    moving = list(changes.values())
    function = _in_jax(**params)

    def moved(primals, *moving):
        values = dict(zip(changes, moving, strict=True))
        return function(*(values.get(i, x) for i, x in enumerate(primals)))

    def is_real(x: Any) -> bool:
        return jnp.issubdtype(x.dtype, jnp.inexact)

    # Outside of `jax.shard_map` JAX's own rules do everything.
    if not manual_axes(*primals, *moving):
        of = functools.partial(moved, primals)
        outs, tangents = jax.jvp(of, [primals[i] for i in changes], moving)
        return outs, [t if is_real(x) else None for x, t in zip(outs, tangents, strict=True)]

    # In jax.shard_map the derivative is taken for one device, like the function itself.
    def real(primals, *moving):
        return [x for x in moved(primals, *moving) if is_real(x)]

    def push(primals, moving):
        of = functools.partial(real, primals)
        return jax.jvp(of, [primals[i] for i in changes], moving)[1]

    def pull(primals, ys):
        _, back = jax.vjp(functools.partial(real, primals), *(primals[i] for i in changes))
        return list(back(ys))

    outs = _lanewise.bind(*primals, **params)
    tangents = iter(linear_map(push, pull, push, list(primals), with_equal_axes(moving)))
    return outs, [next(tangents) if is_real(x) else None for x in outs]


has_derivative(_lanewise, _derivative)


def _eagerly(*operands, **params):
    """Outside of `jit`: as under it, where that is not switched off."""
    # A user who switches compilation off wants to see the operations of the function.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return _through_xla(*operands, **params)
    key = tuple(sorted(params.items(), key=lambda item: item[0]))
    return _compiled_call(key)(*operands)


@functools.lru_cache(maxsize=64)
def _compiled_call(params: tuple) -> Callable:
    return jax.jit(lambda *operands: _lanewise.bind(*operands, **dict(params)))


_lanewise.def_impl(_eagerly)


def _without(params: dict[str, Any], used: list[bool]) -> dict[str, Any]:
    program = params["program"]
    return dict(params, program=Program(program.traced.giving(used), program.layout))


drops_outputs(_lanewise, _without)


def _merge(x: Any, has_outer: bool, has_inner: bool, size: int, lanes: int) -> Any:
    """Join two leading axes of trajectories; the array is repeated along a missing one."""
    if not (has_outer or has_inner):
        return x
    if not has_outer:
        x = jnp.broadcast_to(x[None], (size, *x.shape))
    elif not has_inner:
        x = jnp.broadcast_to(x[:, None], (size, lanes, *x.shape[1:]))
    return x.reshape(size * lanes, *x.shape[2:])
