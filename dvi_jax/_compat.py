"""The few names of JAX that have moved between releases, or are not public: all of them, here."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive, jaxpr_as_fun, jaxprs_in_params
from jax.interpreters import ad, batching, mlir, partial_eval

__all__ = [
    "ClosedJaxpr",
    "Jaxpr",
    "Literal",
    "aval",
    "backends_are_initialized",
    "bind_parameters",
    "bodies",
    "drops_outputs",
    "identity",
    "is_traced",
    "jaxpr_as_fun",
    "jaxprs_in_params",
    "lower_on",
    "one_kernel",
    "primitive",
    "scan_counts",
    "with_outputs",
    "without_outputs",
    "x64_enabled",
]


def is_traced(x: object) -> bool:
    """Whether `x` stands for a value that is not known yet (inside jit, vmap, grad, …)."""
    return isinstance(x, Tracer)


def x64_enabled() -> bool:
    """Whether arrays made now are in double precision (the flag, or a context that sets it)."""
    return bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]


def bodies(eqn: Any) -> Iterator[ClosedJaxpr]:
    """The jaxprs among the parameters of an equation, closed: what it calls."""
    if "_prim" in eqn.params:  # from jax 0.12 on, custom_root and others
        yield _expanded(eqn)
    for value in eqn.params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, ClosedJaxpr):
                yield item
            elif isinstance(item, Jaxpr):
                yield ClosedJaxpr(item, ())


def _expanded(eqn: Any) -> ClosedJaxpr:
    """What an equation stands for that is itself no operation yet."""
    which = eqn.params["_prim"]

    def function(*leaves):
        return jax.tree.leaves(which.expand(*jax.tree.unflatten(which.in_tree, leaves)))

    return jax.make_jaxpr(function)(*(v.aval for v in eqn.invars))


def backends_are_initialized() -> bool:
    """Whether JAX has started, and read its environment variables."""
    from jax._src import xla_bridge  # no public name tells

    return xla_bridge.backends_are_initialized()


def aval(variable: Any) -> Any:
    """Shape and type of a variable of a jaxpr."""
    return variable.aval


def bind_parameters(eqn: Any) -> tuple[list[Any], dict[str, Any]]:
    """What a primitive is bound with besides its operands: (functions, parameters)."""
    found = eqn.primitive.get_bind_params(eqn.params)
    return ([], found) if isinstance(found, dict) else found


def scan_counts(params: dict[str, Any]) -> tuple[int, int]:
    """How many constants and how many parts of a carry a scan has, from its parameters."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carry))


def primitive(
    name: str, function: Callable, batched: Callable | None = None, multiple: bool = False
) -> Primitive:
    """A primitive of its own name that does what `function` (of arrays and parameters) does.

    `batched(arrays, axes, **params)` → (output, axis or None) is its rule under `vmap`, that of
    `function` if left out. `multiple` says that it gives a list of arrays. It has no derivative.
    """
    new = Primitive(name)
    new.multiple_results = multiple
    new.def_impl(function)
    new.def_abstract_eval(lambda *avals, **params: _abstract(function, avals, params))
    mlir.register_lowering(new, mlir.lower_fun(function, multiple_results=multiple))

    def as_function(arrays, axes, **params):
        return jax.vmap(lambda *a: function(*a, **params), axes, 0)(*arrays), 0

    batching.primitive_batchers[new] = batched or as_function
    return new


def lower_on(platform: str, primitive: Primitive, function: Callable) -> None:
    """Have a primitive of several outputs compiled for `platform` as what `function` does."""
    rule = mlir.lower_fun(function, multiple_results=True)
    mlir.register_lowering(primitive, rule, platform=platform)


def drops_outputs(primitive: Primitive, without: Callable) -> None:
    """Have unused outputs of a primitive dropped: `without(params, used)` → its new parameters."""

    def rule(used: list[bool], *more: Any):
        eqn = more[-1]  # newer releases put something in between
        if not any(used):
            return [False] * len(eqn.invars), None
        outvars = [v for v, u in zip(eqn.outvars, used, strict=True) if u]
        new = eqn.replace(outvars=outvars, params=without(eqn.params, used))
        return [True] * len(eqn.invars), new

    partial_eval.dce_rules[primitive] = rule


def _smaller_while(used: list[bool], eqn: Any) -> tuple[list[bool], Any]:
    """The loop without what it carries for unused outputs alone; JAX has this from 0.12 on."""
    params = eqn.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    of_test, of_body = params["cond_nconsts"], params["body_nconsts"]
    if eqn.effects:
        return [True] * len(eqn.invars), eqn
    if not any(used):
        return [False] * len(eqn.invars), None
    _, read = partial_eval.dce_jaxpr(test.jaxpr, [True])
    live = [a or b for a, b in zip(used, read[of_test:], strict=True)]
    while True:
        _, read = partial_eval.dce_jaxpr(body.jaxpr, live)
        more = [a or b for a, b in zip(live, read[of_body:], strict=True)]
        if more == live:
            break
        live = more
    less_test, read_by_test = partial_eval.dce_jaxpr(test.jaxpr, [True], [False] * of_test + live)
    less_body, read_by_body = partial_eval.dce_jaxpr(body.jaxpr, live, [False] * of_body + live)
    inputs = [*read_by_test[:of_test], *read_by_body[:of_body], *live]
    new = eqn.replace(
        invars=[v for v, u in zip(eqn.invars, inputs, strict=True) if u],
        outvars=[v for v, u in zip(eqn.outvars, live, strict=True) if u],
        params={
            "cond_nconsts": sum(read_by_test[:of_test]),
            "cond_jaxpr": ClosedJaxpr(less_test, test.consts),
            "body_nconsts": sum(read_by_body[:of_body]),
            "body_jaxpr": ClosedJaxpr(less_body, body.consts),
        },
    )
    return inputs, new


if lax.while_p not in partial_eval.dce_rules:
    partial_eval.dce_rules[lax.while_p] = _smaller_while


def without_outputs(closed: ClosedJaxpr, used: list[bool]) -> ClosedJaxpr:
    """The jaxpr that computes only some outputs, of the same inputs."""
    jaxpr = partial_eval.dce_jaxpr(closed.jaxpr, used, instantiate=True)[0]
    return ClosedJaxpr(jaxpr, closed.consts)


def with_outputs(jaxpr: Jaxpr, wanted: Sequence[bool]) -> tuple[Jaxpr, list[bool]]:
    """What it takes to compute these outputs, and which constants and inputs it has left."""
    less, consts, inputs = partial_eval.dce_jaxpr_consts(jaxpr, wanted)
    return less, [*consts, *inputs]


def identity(name: str, batched: Callable) -> Primitive:
    """A primitive that does nothing but under `vmap`, for which `batched` is its rule."""
    new = primitive(name, lambda x: x, batched)
    ad.deflinear2(new, lambda cotangent, _: [new.bind(cotangent)])
    return new


def _on_cpu(*arrays, closed: ClosedJaxpr):
    # XLA hoists loops over small arrays into a call that it compiles as one function. These marks
    # on a call of our own have the same effect; one that does not know them ignores them. XLA does
    # not survive an input of such a call that nothing in it reads: those that we know of are left
    # out, and a sum over first entries of the others is put out, so that it cannot find more.
    jaxpr, used = with_outputs(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    kept = [x for x, u in zip((*closed.consts, *arrays), used, strict=True) if u]
    count = len(jaxpr.constvars)
    less, inputs = ClosedJaxpr(jaxpr, kept[:count]), kept[count:]

    def function(*inputs):
        with set_xla_metadata(xla_cpu_small_call="false", inlineable="true"):
            first = [x.ravel()[0].real.astype("float32") for x in inputs if x.size]
            return jaxpr_as_fun(less)(*inputs), sum(first)

    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        outs, _ = jax.jit(function)(*inputs)
    return outs


def _elsewhere(*arrays, closed: ClosedJaxpr):
    return jaxpr_as_fun(closed)(*arrays)


one_kernel = primitive("one_kernel", _elsewhere, multiple=True)
"""``one_kernel.bind(*arrays, closed=jaxpr)``: the jaxpr, compiled as one function for the CPU."""

mlir.register_lowering(one_kernel, mlir.lower_fun(_on_cpu, multiple_results=True), platform="cpu")


def _abstract(function: Callable, avals: Any, params: dict[str, Any]) -> Any:
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals]
    shape_of = getattr(function, "shape_of", None)
    if shape_of is not None:
        out = shape_of(*shapes, **params)
    else:
        out = jax.eval_shape(lambda *a: function(*a, **params), *shapes)
    return jax.tree.map(lambda x: ShapedArray(x.shape, x.dtype), out)
