"""The few names of JAX that have moved between releases, or are not public: all of them, here."""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer
from jax.extend.core import (
    ClosedJaxpr as ClosedJaxpr,
    Jaxpr as Jaxpr,
    Literal as Literal,
    Primitive,
    jaxpr_as_fun as jaxpr_as_fun,
    jaxprs_in_params as jaxprs_in_params,
    set_current_trace,
)
from jax.extend.core.primitives import closed_call_p
from jax.extend.random import threefry2x32_p as _threefry2x32
from jax.interpreters import ad, batching, mlir, partial_eval
from jax.sharding import NamedSharding, PartitionSpec


def is_traced(x: object) -> bool:
    """Whether the value of `x` is not known yet (inside jit, vmap, grad, …)."""
    return isinstance(x, Tracer)


_ONCE = "_written_once"


def once(function: Callable) -> Callable:
    """`function`, compiled by JAX, and written once in machine code for its calls of one kind.

    For functions of at least some hundreds of operations. No product of it is contracted with a sum
    outside of it, called once or more often.
    """

    @functools.wraps(function)
    def marked(*arguments: Any) -> Any:
        return function(*arguments)

    # The name is what the derivatives and batches that JAX makes of the function keep.
    marked.__name__ = function.__name__ + _ONCE
    return jax.jit(marked)


def is_once(eqn: Any) -> bool:
    """Whether an equation is the call of a function marked by `once`, or of a derivative of it."""
    return str(eqn.params.get("name", "")).endswith(_ONCE)


def batch_size(values: Iterable[Any]) -> tuple[int, bool, bool]:
    """The number of elements of all batches of `vmap` around these values; whether they are values
    of a function that is compiled, around which there may be more batches; and whether they are
    differentiated."""
    sizes: dict[Any, int] = {}
    is_compiled = is_differentiated = False
    for x in values:
        # Transformations nest: a tracer may hold the tracer of another transformation.
        while isinstance(x, Tracer):
            inner: Any = x
            if isinstance(axis := getattr(inner, "batch_dim", None), int):
                # The key is the trace, so that values of one batch count once.
                sizes[id(getattr(inner, "_trace", None))] = inner.val.shape[axis]
                x = inner.val
            elif hasattr(inner, "primal"):
                x, is_differentiated = inner.primal, True
            else:
                is_compiled = True
                break
    return math.prod(sizes.values()), is_compiled, is_differentiated


def threefry2x32(key: jax.Array, first: jax.Array, second: jax.Array) -> list[jax.Array]:
    """The generator of `jax.random` on words of 32 bits, for a key of two words."""
    # The functions of `jax.random` take keys of a type for which no code is generated.
    words = jnp.broadcast_arrays(key[0], key[1], jnp.uint32(first), jnp.uint32(second))
    return _threefry2x32.bind(*words)


def x64_enabled() -> bool:
    """Whether arrays made now are in double precision (the flag, or a context that sets it)."""
    return bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]


def backends_are_initialized() -> bool:
    """Whether JAX has started, and read its environment variables."""
    from jax._src import xla_bridge  # there is no public name

    return xla_bridge.backends_are_initialized()


def bodies(eqn: Any) -> Iterator[ClosedJaxpr]:
    """The jaxprs among the parameters of an equation, closed: what it calls."""
    if "_prim" in eqn.params:  # from jax 0.12 on, custom_root and others
        yield _expansion(eqn)
    for value in eqn.params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, ClosedJaxpr):
                yield item
            elif isinstance(item, Jaxpr):
                yield ClosedJaxpr(item, ())


def _expansion(eqn: Any) -> ClosedJaxpr:
    """The jaxpr of an equation that is expanded late."""
    operation = eqn.params["_prim"]

    def function(*leaves):
        return jax.tree.leaves(operation.expand(*jax.tree.unflatten(operation.in_tree, leaves)))

    return jax.make_jaxpr(function)(*(var.aval for var in eqn.invars))


def variables(atoms: Iterable[Any]) -> list[Any]:
    """Those of the operands of an equation that are no literals."""
    return [atom for atom in atoms if not isinstance(atom, Literal)]


def scan_counts(params: dict[str, Any]) -> tuple[int, int]:
    """How many constants and how many parts of a carry a scan has, from its parameters."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carry))


def manual_axes(*values: Any) -> frozenset[str]:
    """The mesh axes of `jax.shard_map` along which one of some values or types varies."""
    types = [jax.typeof(value) if not isinstance(value, ShapedArray) else value for value in values]
    return frozenset().union(*(kind.manual_axis_type.varying for kind in types))


def without_manual_axes(x: Any) -> Any:
    """The type of an array that varies along axes of `jax.shard_map`, without them; else x.

    A function is traced for one device: constants in it need no such axes then.
    """
    return jax.ShapeDtypeStruct(x.shape, x.dtype) if manual_axes(x) else x


def with_equal_axes(values: Any) -> Any:
    """Floating-point values that all vary along the axes of `jax.shard_map` along which one of them
    varies, so that their derivatives are summed over devices where they must be."""
    axes = manual_axes(*jax.tree.leaves(values))

    def varying(x: Any) -> Any:
        missing = axes - manual_axes(x)
        if not missing or not jnp.issubdtype(jax.typeof(x).dtype, jnp.floating):
            return x
        return jax.lax.pcast(x, tuple(missing), to="varying")

    return jax.tree.map(varying, values)


def _lowering(function: Callable, multiple: bool) -> Callable:
    """The lowering of a primitive as what `function` does on one device."""
    rule = mlir.lower_fun(function, multiple_results=multiple)

    def for_one_device(ctx: Any, *operands: Any, **params: Any) -> Any:
        plain = {
            name: [ShapedArray(aval.shape, aval.dtype) for aval in getattr(ctx, name)]
            for name in ("avals_in", "avals_out")
            if manual_axes(*getattr(ctx, name))
        }
        return rule(ctx.replace(**plain) if plain else ctx, *operands, **params)

    return for_one_device


def primitive(
    name: str, function: Callable, batch_rule: Callable | None = None, multiple: bool = False
) -> Primitive:
    """A primitive of its own name that does what `function` (of arrays and parameters) does.

    `batch_rule(arrays, axes, **params)` → (output, axis or None) is its rule under `vmap`, that of
    `function` if left out. `multiple` says that it gives a list of arrays. It has no derivative.
    """
    new = Primitive(name)
    new.multiple_results = multiple
    # jax 0.12 would refuse functions in the parameters that contain, say, jnp.searchsorted; here
    # they are traced again when they are lowered.
    new.is_high = lambda *avals, **params: False
    new.def_impl(function)
    new.def_abstract_eval(lambda *avals, **params: _abstract(function, avals, params))
    mlir.register_lowering(new, _lowering(function, multiple))

    def as_function(arrays, axes, **params):
        return jax.vmap(lambda *operands: function(*operands, **params), axes, 0)(*arrays), 0

    batching.primitive_batchers[new] = batch_rule or as_function
    return new


def batch_in_front(arrays: Sequence[Any], axes: Sequence[Any]) -> tuple[int, list, list]:
    """The size of a batch, the arrays with its axis in front, and the axis of each: 0 or None."""
    pairs = list(zip(arrays, axes, strict=True))
    (size,) = {x.shape[axis] for x, axis in pairs if axis is not None}
    in_front = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in pairs]
    return size, in_front, [None if axis is None else 0 for axis in axes]


def broadcast_in_front(arrays: Sequence[Any], axes: Sequence[Any]) -> tuple[int, list]:
    """The number of elements of a batch, and all arrays with its axis in front."""
    size, in_front, axes = batch_in_front(arrays, axes)
    pairs = zip(in_front, axes, strict=True)
    return size, [jnp.broadcast_to(x, (size, *x.shape)) if a is None else x for x, a in pairs]


def lower_on(platform: str, operation: Primitive, function: Callable) -> None:
    """Have a primitive of several outputs compiled for `platform` as what `function` does."""
    mlir.register_lowering(operation, _lowering(function, True), platform=platform)


def drops_outputs(operation: Primitive, new_params: Callable) -> None:
    """Have unused outputs of a primitive dropped; `new_params(params, flags)`: its parameters."""

    def rule(flags: list[bool], *arguments: Any):
        eqn = arguments[-1]  # newer releases put something in between
        # JAX drops the equation then.
        if not any(flags):
            return [False] * len(eqn.invars), None
        outvars = [v for v, u in zip(eqn.outvars, flags, strict=True) if u]
        new = eqn.replace(outvars=outvars, params=new_params(eqn.params, flags))
        # All inputs stay: which of them are needed would take a further trace.
        return [True] * len(eqn.invars), new

    partial_eval.dce_rules[operation] = rule


def has_derivative(operation: Primitive, rule: Callable) -> None:
    """Give a primitive of several outputs a derivative: ``rule(primals, changes, **params)`` →
    (outputs, their changes), where `changes` has those of the operands that change, by position,
    and None for an output that does not change."""

    def outputs_and_tangents(primals, tangents, **params):
        changes = {i: t for i, t in enumerate(tangents) if not isinstance(t, ad.Zero)}
        outs, out_tangents = rule(primals, changes, **params)
        zeros = [ad.Zero(jax.typeof(out).to_tangent_aval()) for out in outs]
        pairs = zip(zeros, out_tangents, strict=True)
        return outs, [zero if tangent is None else tangent for zero, tangent in pairs]

    ad.primitive_jvps[operation] = outputs_and_tangents


def is_split(operation: Primitive, apart: Callable, values: Callable) -> None:
    """Have reverse mode compute a primitive in two parts where its last operands, vectors, are not
    known yet: ``values(**params)`` → the jaxpr of the first outputs, a function of the first
    operands alone; ``apart(*operands, **params)`` computes everything in two parts."""

    def split(trace, *tracers, **params):
        if all(tracer.is_known() for tracer in tracers):
            return trace.default_process_primitive(operation, tracers, params)
        with set_current_trace(trace):
            return apart(*tracers, **params)

    def split_equation(_, unknown, available, eqn):
        function, outs = values(**eqn.params), eqn.outvars
        count, number = len(function.in_avals), len(function.out_avals)
        residuals = [x for x, is_there in zip(eqn.invars, available, strict=True) if not is_there]
        yes, no = [True] * len(outs), [False] * len(outs)
        if any(unknown[:count]):
            return None, eqn, yes, yes, residuals
        if not any(unknown):
            return eqn, eqn, no, yes, residuals
        part = {"primitive": closed_call_p, "params": {"call_jaxpr": function}}
        known = eqn.replace(invars=eqn.invars[:count], outvars=outs[:number], **part)
        # In the reverse pass the equation is computed again, as in a checkpoint.
        return known, eqn, [*no[:number], *yes[number:]], yes, residuals

    partial_eval.custom_partial_eval_rules[operation] = split
    partial_eval.partial_eval_jaxpr_custom_rules[operation] = split_equation


def without_outputs(function: ClosedJaxpr, flags: list[bool]) -> ClosedJaxpr:
    """The jaxpr that computes only some outputs, of the same inputs."""
    jaxpr = partial_eval.dce_jaxpr(function.jaxpr, flags, instantiate=True)[0]
    return ClosedJaxpr(jaxpr, function.consts)


def linear_map(push: Callable, pull: Callable, definition: Callable, residuals: Any, x: Any) -> Any:
    """``push(residuals, x)``, linear in x, with the transpose ``pull(residuals, y)`` in reverse
    mode; x and y are pytrees of floating-point arrays.

    `definition` is the same function as `push` in operations that JAX can transpose: derivatives by
    the residuals are taken of it, so that neither `push` nor `pull` need have any.
    """
    # Residuals first, then the vector: only its part of the operands is transposed.
    known, known_tree = jax.tree.flatten(residuals)
    leaves, tree = jax.tree.flatten(x)
    trees: list[Any] = []

    def flat(function: Callable, of_tree: Callable) -> Callable:
        def of(*arrays):
            r, x = arrays[: len(known)], arrays[len(known) :]
            y = function(jax.tree.unflatten(known_tree, r), jax.tree.unflatten(of_tree(), x))
            out, out_tree = jax.tree.flatten(y)
            trees.append(out_tree)
            return out

        return of

    of_x, of_y = (lambda: tree), (lambda: trees[0])
    functions = _Linear(flat(push, of_x), flat(pull, of_y), flat(definition, of_x), False)
    out = _linear.bind(*known, *leaves, functions=functions, count=len(known))
    return jax.tree.unflatten(trees[0], out)


class _Linear(NamedTuple):
    """A linear map and its transpose, of residuals and a vector in a row of arrays; the definition
    of the map, or of its transpose where that is `transposed`."""

    push: Callable
    pull: Callable
    definition: Callable
    transposed: bool


def _push(*arrays, functions: _Linear, count: int) -> list[Any]:
    return functions.push(*arrays)


def _linear_batched(arrays, axes, *, functions: _Linear, count: int):
    size, residuals, residual_axes = batch_in_front(arrays, axes)
    _, vector = broadcast_in_front(arrays, axes)

    def in_batches(function: Callable) -> Callable:
        def batched_function(*arrays):
            all_axes = [*residual_axes[:count], *[0] * (len(arrays) - count)]
            return jax.vmap(function, all_axes, 0, axis_size=size)(*arrays)

        return batched_function

    push, pull, definition, transposed = functions
    new = _Linear(in_batches(push), in_batches(pull), in_batches(definition), transposed)
    operands = [*residuals[:count], *vector[count:]]
    outs = _linear.bind(*operands, functions=new, count=count)
    return outs, [0] * len(outs)


def _linear_transposed(cotangents, *arrays, functions: _Linear, count: int):
    push, pull, definition, transposed = functions
    types = [x.aval if ad.is_undefined_primal(x) else jax.typeof(x) for x in arrays]
    like = jax.eval_shape(
        push, *(jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in types)
    )
    vector = [
        jnp.zeros(a.shape, a.dtype) if isinstance(c, ad.Zero) else c
        for c, a in zip(cotangents, like, strict=True)
    ]
    new = _Linear(pull, push, definition, not transposed)
    return [None] * count + list(_linear.bind(*arrays[:count], *vector, functions=new, count=count))


def _linear_derivative(primals, tangents, *, functions: _Linear, count: int):
    outs = _linear.bind(*primals, functions=functions, count=count)
    known, x = primals[:count], primals[count:]
    change = [ad.instantiate_zeros(t) for t in tangents[count:]]
    # Linear in x: the map of the change.
    total = _linear.bind(*known, *change, functions=functions, count=count)
    indices = [i for i, t in enumerate(tangents[:count]) if not isinstance(t, ad.Zero)]
    # In the residuals the map is not linear: its definition is differentiated by them.
    if indices:

        def of(*moving):
            values = dict(zip(indices, moving, strict=True))
            residuals = [values.get(i, r) for i, r in enumerate(known)]
            if not functions.transposed:
                return functions.definition(*residuals, *x)
            back = jax.linear_transpose(lambda *y: functions.definition(*residuals, *y), *outs)
            return list(back(list(x)))

        _, residual_part = jax.jvp(of, [known[i] for i in indices], [tangents[i] for i in indices])
        total = [a + b for a, b in zip(total, residual_part, strict=True)]
    return outs, total


_linear = primitive("linear_map", _push, _linear_batched, multiple=True)
ad.primitive_transposes[_linear] = _linear_transposed
ad.primitive_jvps[_linear] = _linear_derivative


def _abstract(function: Callable, avals: Any, params: dict[str, Any]) -> Any:
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals]
    shape_of = getattr(function, "shape_of", None)
    if shape_of is not None:
        out = shape_of(*shapes, **params)
    else:
        out = jax.eval_shape(lambda *aval: function(*aval, **params), *shapes)
    # Inside of `jax.shard_map` the types of results have to say along which axes they vary.
    axes = manual_axes(*avals)
    if not axes:
        return jax.tree.map(lambda x: ShapedArray(x.shape, x.dtype), out)
    varying = type(avals[0].manual_axis_type)(varying=axes)
    mesh = next(aval.sharding.mesh for aval in avals if manual_axes(aval))

    def result_type(x: Any) -> ShapedArray:
        sharding = NamedSharding(mesh, PartitionSpec(*[None] * len(x.shape)))
        return ShapedArray(x.shape, x.dtype, sharding=sharding, manual_axis_type=varying)

    return jax.tree.map(result_type, out)


def of_one_equation(jaxpr: Jaxpr, eqn: Any, inputs: Sequence[Any]) -> ClosedJaxpr:
    """The jaxpr of one equation of a jaxpr, a function of these variables."""
    alone = jaxpr.replace(
        constvars=[],
        invars=list(inputs),
        outvars=eqn.outvars,
        eqns=[eqn],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return ClosedJaxpr(alone, ())
