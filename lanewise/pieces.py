"""A function cut into pieces: those for which code is generated, and those left to XLA."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from .jaxprs.jaxapi import ClosedJaxpr, Literal, bodies, variables
from .llvm.ir import TYPES
from .llvm.values import MOST_ENTRIES
from .rules.elementwise import ELEMENTWISE
from .rules.moves import CALLS, MOVES


@dataclasses.dataclass(frozen=True)
class FunctionPiece:
    """Equations that follow each other, as a function of `reads` that gives `writes`.

    `reason` says why it is left to XLA, None where code is generated. A call that is a piece by
    itself is cut in turn: `is_call`.
    """

    function: ClosedJaxpr
    reads: tuple[Any, ...]
    writes: tuple[Any, ...]
    reason: str | None
    is_call: bool

    @property
    def is_left_to_xla(self) -> bool:
        return self.reason is not None and not self.is_call


def pieces(function: ClosedJaxpr, reason: Callable) -> list[FunctionPiece]:
    """The pieces of a function, in the order in which they are computed.

    ``reason(function)`` is why no code can be generated for a jaxpr, None if it can be. A loop, a
    branch or a linear solve is never cut: it is in one piece with all that it calls. Code is
    generated for pieces with a loop; what is between them belongs to the piece before it.
    """
    jaxpr = function.jaxpr
    constants = dict(zip(jaxpr.constvars, function.consts, strict=True))
    groups = [_Group()]
    for eqn in jaxpr.eqns:
        refusal = None
        # An attempt takes a trace and an evaluation: only if names and types do not decide it.
        if not _is_simple(eqn):
            refusal = reason(_function_of([eqn], eqn.outvars, jaxpr, constants)[0])
        # A function that is called, with a loop in it, is cut in turn.
        if refusal is not None and eqn.primitive.name in CALLS and _has_loop(eqn):
            groups += [_Group([eqn], refusal, is_call=True), _Group()]
            continue
        loops = refusal is None and _has_loop(eqn)
        group = groups[-1]
        # A loop that can be compiled does not share a piece with what cannot.
        if (loops and group.reason is not None) or (refusal is not None and group.loops):
            group = _Group()
            groups.append(group)
        group.eqns.append(eqn)
        group.loops = group.loops or loops
        group.reason = group.reason or refusal
    result: list[FunctionPiece] = []
    needs = set(variables(jaxpr.outvars))
    # Backwards: what a piece has to give is what later ones read.
    for group in reversed(groups):
        writes = [var for eqn in group.eqns for var in eqn.outvars if var in needs]
        if not writes:
            continue
        eqns = _equations_for(group.eqns, writes)
        part, reads = _function_of(eqns, writes, jaxpr, constants)
        needs |= set(reads)
        if group.is_call:
            (part,) = bodies(eqns[0])
            reads, writes = eqns[0].invars, eqns[0].outvars
            needs |= set(variables(reads))
        # Without a loop XLA is as fast, and a call less is made.
        refusal = group.reason or (None if group.loops else "it has no loop")
        result.append(FunctionPiece(part, tuple(reads), tuple(writes), refusal, group.is_call))
    return result[::-1]


def in_pieces(
    parts: Sequence[FunctionPiece],
    function: ClosedJaxpr,
    operands: Sequence[Any],
    lanes: int | None,
    lane_flags: Sequence[bool],
    run: Callable[..., list[Any]],
) -> list[Any]:
    """The results of a function for a batch of `lanes`, its pieces one after the other.

    `lane_flags` says which operands have the batch in front; all results have it.
    ``run(piece, *arrays, lane_flags=…)`` computes one piece.
    """
    jaxpr = function.jaxpr
    inputs = (*jaxpr.constvars, *jaxpr.invars)
    values = dict(zip(inputs, (*function.consts, *operands), strict=True))
    flag_of = dict(zip(jaxpr.invars, lane_flags, strict=True))

    def read(var: Any) -> Any:
        if not isinstance(var, Literal):
            return values[var]
        return jnp.asarray(var.val, var.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]

    def is_on(var: Any) -> bool:
        return not isinstance(var, Literal) and flag_of.get(var, False)

    for piece in parts:
        flags = tuple(is_on(var) for var in piece.reads)
        outs = run(piece, *(read(var) for var in piece.reads), lane_flags=flags)
        values.update(zip(piece.writes, outs, strict=True))
        # `run` returns all results with the batch in front, those that it does not change included.
        flag_of.update(dict.fromkeys(piece.writes, lanes is not None))
    front = () if lanes is None else (lanes,)
    return [
        read(var) if is_on(var) else jnp.broadcast_to(read(var), (*front, *var.aval.shape))
        for var in jaxpr.outvars
    ]


@dataclasses.dataclass
class _Group:
    eqns: list[Any] = dataclasses.field(default_factory=list)
    reason: str | None = None
    loops: bool = False
    is_call: bool = False


def _is_simple(eqn: Any) -> bool:
    """Whether code can be generated for an equation, seen without trying."""
    if eqn.primitive.name not in ELEMENTWISE and eqn.primitive.name not in MOVES:
        return False
    avals = [var.aval for var in (*eqn.invars, *eqn.outvars)]
    return all(str(aval.dtype) in TYPES and aval.size <= MOST_ENTRIES for aval in avals)


def _has_loop(eqn: Any) -> bool:
    if eqn.primitive.name in ("scan", "while"):
        return True
    return any(_has_loop(inner) for body in bodies(eqn) for inner in body.jaxpr.eqns)


def _equations_for(eqns: Sequence[Any], writes: Sequence[Any]) -> list[Any]:
    """The equations that the variables `writes` need."""
    needs, selection = set(writes), []
    for eqn in reversed(eqns):
        if any(var in needs for var in eqn.outvars):
            selection.append(eqn)
            needs |= set(variables(eqn.invars))
    return selection[::-1]


def _function_of(
    eqns: Sequence[Any], writes: Sequence[Any], jaxpr: Any, constants: dict[Any, Any]
) -> tuple[ClosedJaxpr, list[Any]]:
    """Some equations as a function, and the variables that are its arguments."""
    results = {var for eqn in eqns for var in eqn.outvars}
    operands = dict.fromkeys(var for eqn in eqns for var in variables(eqn.invars))
    operands = [var for var in operands if var not in results]
    reads = [var for var in operands if var not in constants]
    consts = [var for var in operands if var in constants]
    part = jaxpr.replace(
        constvars=consts,
        invars=reads,
        outvars=list(writes),
        eqns=list(eqns),
        # The names of the original arguments do not belong to these inputs.
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return ClosedJaxpr(part, [constants[var] for var in consts]), reads
