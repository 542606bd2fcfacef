"""A function traced to a jaxpr, with what it closes over as its first operands."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax

from .jaxapi import ClosedJaxpr, is_traced, jaxpr_as_fun, without_manual_axes, without_outputs


@dataclasses.dataclass(frozen=True, eq=False)
class Trace:
    """A function as a jaxpr; traced values that it closes over are its first operands, `outer`."""

    closed_jaxpr: ClosedJaxpr
    out_tree: Any = None

    @classmethod
    def from_function(cls, function: Callable, leaves: Sequence[Any], tree: Any) -> "Trace":
        # The structure of the result is known only once the function has run.
        trees: list[Any] = []

        def flat(*leaves):
            out, out_tree = jax.tree.flatten(function(*jax.tree.unflatten(tree, leaves)))
            trees.append(out_tree)
            return out

        # Traced for one device: its own constants need not vary along the axes of a mesh. The mesh
        # is named although it stays: JAX traces what is jitted once with a mesh and once without.
        with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
            return cls(jax.make_jaxpr(flat)(*map(without_manual_axes, leaves)), trees[-1])

    @functools.cached_property
    def outer(self) -> list[Any]:
        return [const for const in self.closed_jaxpr.consts if is_traced(const)]

    def __call__(self, *operands: Any) -> list[Any]:
        outer = iter(operands[: len(self.outer)])
        consts = [next(outer) if is_traced(const) else const for const in self.closed_jaxpr.consts]
        function = ClosedJaxpr(self.closed_jaxpr.jaxpr, consts)
        return jaxpr_as_fun(function)(*operands[len(self.outer) :])

    def with_outputs(self, flags: list[bool]) -> "Trace":
        """The function that gives some of the outputs only, as a flat list."""
        return Trace(without_outputs(self.closed_jaxpr, flags))

    @functools.cached_property
    def all_inputs(self) -> ClosedJaxpr:
        """The jaxpr with what is closed over and traced in front of its inputs."""
        jaxpr, consts = self.closed_jaxpr.jaxpr, self.closed_jaxpr.consts
        if not self.outer:
            return self.closed_jaxpr
        flags = [is_traced(const) for const in consts]
        # Constants whose values are known stay constants, which may be folded.
        others = [not is_outer for is_outer in flags]
        new = jaxpr.replace(
            constvars=list(itertools.compress(jaxpr.constvars, others)),
            invars=[*itertools.compress(jaxpr.constvars, flags), *jaxpr.invars],
            debug_info=jaxpr.debug_info.with_unknown_names(),
        )
        return ClosedJaxpr(new, list(itertools.compress(consts, others)))
