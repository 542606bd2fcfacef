"""The primitive of JAX for a function of one trajectory; under `vmap` it becomes machine code."""

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp

from .jaxprs import jaxapi
from .jaxprs.jaxapi import ClosedJaxpr, linear_map, manual_axes, with_equal_axes
from .jaxprs.traced import Trace
from .llvm.ir import NotCompilable
from .native import handler, machine
from .native.switches import is_on
from .pieces import FunctionPiece, in_pieces, pieces
from .targets import TARGETS, compile_program

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
    trace = Trace.from_function(function, leaves, tree)
    program = Callee(trace, layout)
    # A value that is traced outside and closed over is an input like the others.
    operands = [*trace.outer, *leaves]
    lane_flags = (False,) * len(operands)
    outs = _lanewise.bind(*operands, program=program, lanes=None, lane_flags=lane_flags)
    return jax.tree.unflatten(trace.out_tree, outs)


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
            f"function must be callable, got an object of type {type(function).__name__}. Write "
            "batched(f), not batched(f(x))."
        )
    if not isinstance(layout, Layout):
        raise TypeError(f"layout must be a lanewise.Layout, got {layout!r}.")
    of_trajectory = functools.partial(call, function, layout=layout)
    return jax.vmap(of_trajectory, in_axes)


def generates() -> bool:
    """Whether machine code is generated in this process; otherwise XLA compiles everything."""
    return is_on(SWITCH, default=True) and _can_start()


@machine.once
def _can_start() -> bool:
    try:
        machine.start_llvm()
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
class Callee:
    """The function of a call, and the options of its compilation."""

    trace: Trace
    layout: Layout = AUTO

    def shape_of(self, lanes: int | None) -> list[Any]:
        """The shapes and types of the outputs for a batch."""
        front = () if lanes is None else (lanes,)
        avals = self.trace.closed_jaxpr.out_avals
        return [jax.ShapeDtypeStruct((*front, *aval.shape), aval.dtype) for aval in avals]


def _in_jax(program: Callee, lanes: int | None, lane_flags: tuple[bool, ...]) -> Callable:
    """The program as a function of JAX; operands with a flag and outputs begin with the batch."""
    if lanes is None:
        return program.trace
    if lanes == 0:  # batched operations such as a minimum would have no value
        return lambda *_: [jnp.zeros(x.shape, x.dtype) for x in program.shape_of(lanes)]
    axes = [0 if has_lanes else None for has_lanes in lane_flags]
    return jax.vmap(program.trace, axes, 0, axis_size=lanes)


def _through_xla(*operands, **params):
    """The program as XLA compiles it."""
    return _in_jax(**params)(*operands)


def _lower(*operands, platform: str, program: Callee, lanes: int | None, lane_flags):
    """The program as machine code, through XLA where none can be generated."""
    try:
        if not generates():
            raise NotCompilable(f"the variable {SWITCH} is off, or LLVM did not start")
        if lanes == 0:
            raise NotCompilable("the batch has no trajectories")
        return compile_program(program, lane_flags, lanes, platform).call(operands, program, lanes)
    except NotCompilable as reason:
        # This is for developers of the compiler; users have `explain`.
        if os.environ.get("LANEWISE_LOG"):
            print("left to XLA:", reason, flush=True)
        parts = pieces_of(program, lanes or 1, platform) if lanes != 0 else []
        if not parts:
            return _through_xla(*operands, program=program, lanes=lanes, lane_flags=lane_flags)

        def run(piece: FunctionPiece, *arrays: Any, lane_flags: tuple[bool, ...]) -> list[Any]:
            part = Callee(Trace(piece.function), program.layout)
            compute = _through_xla if piece.is_left_to_xla else _lanewise.bind
            return compute(*arrays, program=part, lanes=lanes, lane_flags=lane_flags)

        return in_pieces(parts, program.trace.all_inputs, operands, lanes, lane_flags, run)


def pieces_of(program: Callee, lanes: int, platform: str) -> list[FunctionPiece]:
    """The pieces of a program that is not compiled as a whole; none if XLA computes all of it."""
    if program.layout.form == "arrays" or not generates():
        return []

    def reason(function: ClosedJaxpr) -> str | None:
        try:
            part = Callee(Trace(function), program.layout)
            compile_program(part, [True] * len(function.jaxpr.invars), lanes, platform)
        except NotCompilable as refusal:
            return str(refusal)
        return None

    parts = pieces(program.trace.all_inputs, reason)
    # One piece is all of it, and too large as a whole: it cannot be cut any further.
    is_whole = len(parts) == 1 and not parts[0].is_call
    return [] if is_whole or all(piece.is_left_to_xla for piece in parts) else parts


def _shape_of(*_operands, program: Callee, lanes: int | None, **_params) -> list[Any]:
    return program.shape_of(lanes)


# The shapes are known: JAX need not trace the function again to find them.
_through_xla.shape_of = _shape_of  # pyright: ignore[reportFunctionMemberAccess]


def _batch_rule(operands, axes, *, program: Callee, lanes: int | None, lane_flags):
    """One more axis of trajectories: all of them become one."""
    size, arrays, axes_in_front = jaxapi.batch_in_front(operands, axes)
    outer = [axis is not None for axis in axes_in_front]
    if lanes is None:
        outs = _lanewise.bind(*arrays, program=program, lanes=size, lane_flags=tuple(outer))
        return outs, [0] * len(outs)
    # One batch of all trajectories: nested batches need no rule of their own.
    flags = list(zip(outer, lane_flags, strict=True))
    arrays = [_merge(x, *pair, size, lanes) for x, pair in zip(arrays, flags, strict=True)]
    new_flags = tuple(any(pair) for pair in flags)
    outs = _lanewise.bind(*arrays, program=program, lanes=size * lanes, lane_flags=new_flags)
    return [x.reshape(size, lanes, *x.shape[1:]) for x in outs], [0] * len(outs)


_lanewise = jaxapi.primitive("lanewise", _through_xla, _batch_rule, multiple=True)
for _platform in TARGETS:
    jaxapi.lower_on(_platform, _lanewise, functools.partial(_lower, platform=_platform))


def _derivative(primals, changes: dict[int, Any], **params):
    """The derivative of the function, computed by XLA."""
    vectors = list(changes.values())
    function = _in_jax(**params)

    def outputs(primals, *vectors):
        values = dict(zip(changes, vectors, strict=True))
        return function(*(values.get(i, x) for i, x in enumerate(primals)))

    def is_real(x: Any) -> bool:
        return jnp.issubdtype(jnp.result_type(x), jnp.inexact)  # a constant may be a number

    # Outside of `jax.shard_map` JAX's own rules do everything.
    if not manual_axes(*primals, *vectors):
        of_vectors = functools.partial(outputs, primals)
        outs, tangents = jax.jvp(of_vectors, [primals[i] for i in changes], vectors)
        return outs, [t if is_real(x) else None for x, t in zip(outs, tangents, strict=True)]

    # In jax.shard_map the derivative is taken for one device, like the function itself.
    def real_outputs(primals):
        def real(*vectors):
            return [x for x in outputs(primals, *vectors) if is_real(x)]

        return real, [primals[i] for i in changes]

    def push(primals, vectors):
        return jax.jvp(*real_outputs(primals), vectors)[1]

    def pull(primals, ys):
        real, point = real_outputs(primals)
        return list(jax.vjp(real, *point)[1](ys))

    outs = _lanewise.bind(*primals, **params)
    tangents = iter(linear_map(push, pull, push, list(primals), with_equal_axes(vectors)))
    return outs, [next(tangents) if is_real(x) else None for x in outs]


jaxapi.has_derivative(_lanewise, _derivative)


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


def _with_outputs(params: dict[str, Any], flags: list[bool]) -> dict[str, Any]:
    program = params["program"]
    return dict(params, program=Callee(program.trace.with_outputs(flags), program.layout))


jaxapi.drops_outputs(_lanewise, _with_outputs)


def _merge(x: Any, has_outer: bool, has_inner: bool, size: int, lanes: int) -> Any:
    """Join two leading axes of trajectories; the array is repeated along a missing one."""
    if not (has_outer or has_inner):
        return x
    if not has_outer:
        x = jnp.broadcast_to(x[None], (size, *x.shape))
    elif not has_inner:
        x = jnp.broadcast_to(x[:, None], (size, lanes, *x.shape[1:]))
    return x.reshape(size * lanes, *x.shape[2:])
