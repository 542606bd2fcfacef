"""One turn of one particle, its inverse, and its transposed derivative."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.jaxapi import is_traced, linear_map

from ...base.inputs import real_numbers
from ._maps import APERTURES, Particle, RingPart, forward, pull_back
from ._parts import pieces_of
from ._ring import Ring, RingStructure

LARGEST = 1.0
"""A particle with a larger coordinate than this (x, px, y, py, δ) is lost, as in pyAT."""


Rows = dict[str, Any]
"""Name of a parameter → its values, one for each part of the elements in the order of passage."""


class Flight(NamedTuple):
    """A particle, and where it was lost: part and turn (−1 if it was not) and coordinates."""

    z: Particle
    row: Array
    turn: Array
    last: Particle


def coordinates(name: str, z: Any) -> Array:
    """(x, px, y, py, ζ, δ) on the last axis of an array. **Raises** `ValueError` for others."""
    z = real_numbers(name, z)
    if z.shape[-1:] != (6,):
        raise ValueError(f"{name} must have 6 coordinates on its last axis, got shape {z.shape}.")
    return z


def start(z: Particle) -> Flight:
    none = jnp.asarray(-1, jnp.int32)
    return Flight(z, none, none, Particle(*[jnp.full((), jnp.nan)] * 6))


def _record(flight: Flight, z: Particle, passes: Any, number: Rows, turn: Any) -> Flight:
    """The flight with the particle after a part of an element, or with its loss there."""
    moduli = [jnp.abs(z[i]) for i in (0, 1, 2, 3, 5)]
    is_inside = functools.reduce(jnp.logical_and, [size <= LARGEST for size in moduli])
    # NaN in a coordinate fails the comparison. Within an element the limit does not hold.
    passes = passes & ((is_inside & jnp.isfinite(z.zeta)) | ~number["ends"])
    is_lost = ~passes & (flight.row < 0)

    def note():
        def select(new, old):
            return jax.tree.map(functools.partial(jnp.where, is_lost), new, old)

        nan = Particle(*[jnp.full((), jnp.nan)] * 6)
        return Flight(
            select(nan, z),
            select(number["row"], flight.row),
            select(jnp.asarray(turn, jnp.int32), flight.turn),
            select(z, flight.last),
        )

    # The branch keeps this work out of parts in which no particle is lost, which is nearly all.
    return lax.cond(lanewise.on_any(is_lost), note, lambda: flight._replace(z=z))


def parameters_of(columns: Rows, program: RingStructure, rows: Any) -> Rows:
    """The columns of elements as columns of `rows` of the parts."""
    element = np.asarray(program.rows, np.int32)[rows, 1]
    # In NumPy, if it is possible: JAX would compile each of them.
    return {
        name: (column if is_traced(column) else np.asarray(column))[element]
        for name, column in columns.items()
    }


def compiled(function: Callable, axes: Sequence[int | None], args: tuple) -> Any:
    """`function` of one particle for a batch, as machine code; its derivative in forward mode, too.

    `axes`: of each of its arguments. JAX and XLA compute the derivative in reverse mode, and those
    of the derivative.
    """
    operands, tree = jax.tree.flatten(args)
    pairs = zip(axes, args, strict=True)
    axes = [axis for axis, value in pairs for _ in jax.tree.leaves(value)]
    trees: list[Any] = []

    def values(*operands):
        out, out_tree = jax.tree.flatten(function(*jax.tree.unflatten(tree, operands)))
        trees.append(out_tree)
        return out

    def rule(operands, changes):
        moving = [place for place, change in changes.items() if change.dtype != jax.dtypes.float0]
        vectors = [changes[place] for place in moving]

        def change(operands, vectors):
            def of(*new):
                point = dict(enumerate(operands)) | dict(zip(moving, new, strict=True))
                return values(*point.values())

            return jax.jvp(of, [operands[place] for place in moving], vectors)[1]

        batch = axes, [axes[place] for place in moving]
        definition = jax.vmap(change, batch)

        def pull(operands, cotangents):
            of_vectors = functools.partial(definition, operands)
            return jax.linear_transpose(of_vectors, vectors)(cotangents)[0]

        push = jax.vmap(functools.partial(lanewise.call, change), batch)
        return linear_map(push, pull, definition, operands, vectors)

    machine = jax.vmap(functools.partial(lanewise.call, values), axes)
    outs = lanewise.with_derivative(machine, rule, operands)
    return jax.tree.unflatten(trees[0], outs)


class Passage(eqx.Module):
    """The parts of the elements of a ring in the order of passage.

    - `rows`: the parameters b of each part at ε = 0. `slopes`: their derivatives b' by ε, of the
      parameters that depend on it; see `parameters_at`.
    - `numbers`: of each part in `parts`, of its element and in the order of passage; whether the
      element ends there.
    - `key`: two words for the quantum noise of `fly`; None: without noise.
    """

    rows: Rows
    slopes: Rows
    numbers: Rows
    parts: tuple[RingPart, ...] = eqx.field(static=True)
    key: Array | None = None

    @classmethod
    def from_ring(cls, ring: Ring) -> "Passage":
        part, element = np.asarray(ring.program.rows, np.int32).T
        rows, slopes = (
            parameters_of(columns, ring.program, slice(None))
            for columns in (ring.columns, ring.extra)
        )
        ends = np.append(element[1:] != element[:-1], True)
        row = np.arange(len(part), dtype=np.int32)
        numbers = {"part": part, "element": element, "ends": ends, "row": row}
        return cls(rows, slopes, numbers, ring.program.parts)

    @property
    def tables(self) -> tuple[Rows, Rows, Rows]:
        """Numbers, rows and slopes, for a loop over the parts."""
        return self.numbers, self.rows, self.slopes

    def image(self, z: Particle, turn: Any, epsilon: Any, sign: int = 1) -> Particle:
        """The particle after all parts, or before them for sign −1; without apertures."""

        def row(z, columns):
            number, values, slopes = columns
            par = parameters_at(values, slopes, epsilon)

            def part_map(part):
                return lambda z: forward(pieces_of(part), z, par, turn, sign)

            return lax.switch(number["part"], [part_map(p) for p in self.parts], z), None

        return lax.scan(row, z, self.tables, reverse=sign < 0)[0]

    def fly(self, flight: Flight, turn: Any, epsilon: Any) -> Flight:
        """The flight after all parts, with losses. A particle that is lost becomes NaN."""

        def row(flight, columns):
            number, values, slopes = columns
            par = parameters_at(values, slopes, epsilon)
            par = par if self.key is None else {**par, "key": self.key}

            def part_map(part):
                is_inside = APERTURES.get(part.name)
                if is_inside is not None:
                    return lambda z: (z, is_inside(z, par))
                return lambda z: (forward(pieces_of(part), z, par, turn, 1), jnp.asarray(True))

            maps = [part_map(part) for part in self.parts]
            z, passes = lax.switch(number["part"], maps, flight.z)
            return _record(flight, z, passes, number, turn), None

        return lax.scan(row, flight, self.tables)[0]

    def pulled(
        self, moving: Sequence[str], z: Particle, cotangent: Particle, turn: Any, epsilon: Any
    ) -> tuple[Particle, Particle, Rows]:
        """The particle before all parts and its cotangent, from those after them; and the
        cotangents of the parameters `moving`, one for each part."""

        def row(state, columns):
            number, values, slopes = columns
            par = parameters_at(values, slopes, epsilon)
            parameters = {name: par[name] for name in moving}

            def part_map(part):
                return lambda z, c: pull_back(pieces_of(part), z, c, par, parameters, turn)

            z, cotangent, cotangents = lax.switch(
                number["part"], [part_map(p) for p in self.parts], *state
            )
            return (z, cotangent), cotangents

        (z, cotangent), cotangents = lax.scan(row, (z, cotangent), self.tables, reverse=True)
        return z, cotangent, cotangents


def parameters_at(values: Rows, slopes: Rows, epsilon: Any) -> Rows:
    """The parameters of a part at ε: b(ε) = b + ε b'."""
    return {**values, **{name: values[name] + epsilon * slopes[name] for name in slopes}}
