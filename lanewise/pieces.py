"""A function cut into pieces: those for which code is generated, and those left to XLA."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from .jaxprs.jaxapi import ClosedJaxpr, Literal, bodies
from .llvm.ir import TYPES
from .llvm.values import MADE
from .rules.elementwise import ELEMENTWISE
from .rules.moves import CALLS, MOVES


@dataclasses.dataclass(frozen=True)
class Piece:
    """Equations that follow each other, as a function of `reads` that gives `writes`.

    `reason` says why it is left to XLA, None where code is generated. A call that is a piece by
    itself is cut in turn: `is_call`.
    """

    closed: ClosedJaxpr
    reads: tuple[Any, ...]
    writes: tuple[Any, ...]
    reason: str | None
    is_call: bool

    @property
    def is_left_to_xla(self) -> bool:
        return self.reason is not None and not self.is_call


def pieces(closed: ClosedJaxpr, reason: Callable[[ClosedJaxpr], str | None]) -> list[Piece]:
    """The pieces of a function, in the order in which they are computed.

    `reason` returns why no code can be generated for a function, None if it can be. A loop, a
    branch or a linear solve is never cut: it is in one piece with all that it calls. Code is
    generated for pieces with a loop; what is between them belongs to the piece before it.
    """
    jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    groups = [_Group()]
    for eqn in jaxpr.eqns:
        why = None
        # An attempt takes a trace and an evaluation: only if names and types do not decide it.
        if not _is_simple(eqn):
            why = reason(_function_of([eqn], eqn.outvars, jaxpr, known)[0])
        # A function that is called, with a loop in it, is cut in turn.
        if why is not None and eqn.primitive.name in CALLS and _has_loop(eqn):
            groups += [_Group([eqn], why, is_call=True), _Group()]
            continue
        loops = why is None and _has_loop(eqn)
        group = groups[-1]
        # A loop that can be compiled does not share a piece with what cannot.
        if (loops and group.reason is not None) or (why is not None and group.loops):
            group = _Group()
            groups.append(group)
        group.eqns.append(eqn)
        group.loops = group.loops or loops
        group.reason = group.reason or why
    found: list[Piece] = []
    needed = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    # Backwards: what a piece has to give is what later ones read.
    for group in reversed(groups):
        writes = [v for eqn in group.eqns for v in eqn.outvars if v in needed]
        if not writes:
            continue
        eqns = _needed(group.eqns, writes)
        part, reads = _function_of(eqns, writes, jaxpr, known)
        needed |= set(reads)
        if group.is_call:
            (part,) = bodies(eqns[0])
            reads, writes = eqns[0].invars, eqns[0].outvars
            needed |= {v for v in reads if not isinstance(v, Literal)}
        # Without a loop XLA is as fast, and a call less is made.
        why = group.reason or (None if group.loops else "it has no loop")
        found.append(Piece(part, tuple(reads), tuple(writes), why, group.is_call))
    return found[::-1]


def in_pieces(
    found: Sequence[Piece],
    whole: ClosedJaxpr,
    operands: Sequence[Any],
    lanes: int | None,
    on: Sequence[bool],
    run: Callable[..., list[Any]],
) -> list[Any]:
    """The results of a function for a batch of `lanes`, its pieces one after the other.

    `on` says which operands have the batch in front; all results have it. ``run(piece, *arrays,
    on=…)`` computes one piece.
    """
    jaxpr = whole.jaxpr
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*whole.consts, *operands), strict=True))
    batched = dict(zip(jaxpr.invars, on, strict=True))

    def read(v: Any) -> Any:
        if not isinstance(v, Literal):
            return values[v]
        return jnp.asarray(v.val, v.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]

    def is_on(v: Any) -> bool:
        return not isinstance(v, Literal) and batched.get(v, False)

    for piece in found:
        flags = tuple(is_on(v) for v in piece.reads)
        outs = run(piece, *(read(v) for v in piece.reads), on=flags)
        values.update(zip(piece.writes, outs, strict=True))
        # `run` returns all results with the batch in front, those that it does not change included.
        batched.update(dict.fromkeys(piece.writes, lanes is not None))
    front = () if lanes is None else (lanes,)
    return [
        read(v) if is_on(v) else jnp.broadcast_to(read(v), (*front, *v.aval.shape))
        for v in jaxpr.outvars
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
    avals = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    return all(str(a.dtype) in TYPES and a.size <= MADE for a in avals)


def _has_loop(eqn: Any) -> bool:
    if eqn.primitive.name in ("scan", "while"):
        return True
    return any(_has_loop(e) for body in bodies(eqn) for e in body.jaxpr.eqns)


def _needed(eqns: Sequence[Any], writes: Sequence[Any]) -> list[Any]:
    """The equations that the variables `writes` need."""
    wanted, kept = set(writes), []
    for eqn in reversed(eqns):
        if any(v in wanted for v in eqn.outvars):
            kept.append(eqn)
            wanted |= {v for v in eqn.invars if not isinstance(v, Literal)}
    return kept[::-1]


def _function_of(
    eqns: Sequence[Any], writes: Sequence[Any], jaxpr: Any, known: dict[Any, Any]
) -> tuple[ClosedJaxpr, list[Any]]:
    """Some equations as a function, and the variables that are its arguments."""
    made = {v for eqn in eqns for v in eqn.outvars}
    used = dict.fromkeys(
        v for eqn in eqns for v in eqn.invars if not isinstance(v, Literal) and v not in made
    )
    reads = [v for v in used if v not in known]
    consts = [v for v in used if v in known]
    part = jaxpr.replace(
        constvars=consts,
        invars=reads,
        outvars=list(writes),
        eqns=list(eqns),
        # The names of the original arguments do not belong to these inputs.
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return ClosedJaxpr(part, [known[v] for v in consts]), reads
