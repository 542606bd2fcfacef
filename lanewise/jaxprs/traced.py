"""A function traced to a jaxpr, with what it closes over as its first operands."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax

from .jaxapi import ClosedJaxpr, is_traced, jaxpr_as_fun, without_manual_axes, without_outputs


@dataclasses.dataclass(frozen=True, eq=False)
class Traced:
    """A function of one trajectory as a jaxpr; the values of a trace outside that it closes over
    (`outer`) are its first operands."""

    closed: ClosedJaxpr
    out_tree: Any = None

    @classmethod
    def of(cls, function: Callable, leaves: Sequence[Any], tree: Any) -> "Traced":
        # The structure of the result is known only once the function has run.
        trees: list[Any] = []

        def flat(*leaves):
            out, out_tree = jax.tree.flatten(function(*jax.tree.unflatten(tree, leaves)))
            trees.append(out_tree)
            return out

        # Traced for one device: its own constants need not vary along the axes of a mesh.
        return cls(jax.make_jaxpr(flat)(*map(without_manual_axes, leaves)), trees[-1])

    @functools.cached_property
    def outer(self) -> list[Any]:
        return [c for c in self.closed.consts if is_traced(c)]

    def __call__(self, *operands: Any) -> list[Any]:
        outer = iter(operands[: len(self.outer)])
        consts = [next(outer) if is_traced(c) else c for c in self.closed.consts]
        closed = ClosedJaxpr(self.closed.jaxpr, consts)
        return jaxpr_as_fun(closed)(*operands[len(self.outer) :])

    def giving(self, used: list[bool]) -> "Traced":
        """The function that gives some of the outputs only, as a flat list."""
        return Traced(without_outputs(self.closed, used))

    @functools.cached_property
    def all_inputs(self) -> ClosedJaxpr:
        """The jaxpr with what is closed over and traced in front of its inputs."""
        jaxpr, consts = self.closed.jaxpr, self.closed.consts
        if not self.outer:
            return self.closed
        traced = [is_traced(c) for c in consts]
        # Constants whose values are known stay constants, which may be folded.
        front = [v for v, t in zip(jaxpr.constvars, traced, strict=True) if t]
        known = [(v, c) for v, c, t in zip(jaxpr.constvars, consts, traced, strict=True) if not t]
        new = jaxpr.replace(
            constvars=[v for v, _ in known],
            invars=[*front, *jaxpr.invars],
            debug_info=jaxpr.debug_info.with_unknown_names(),
        )
        return ClosedJaxpr(new, [c for _, c in known])
