"""One turn of one particle, its inverse, and its transposed derivative."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise

from ._maps import APERTURES, Part, Particle, forward, pull_back
from ._parts import pieces_of
from ._ring import Ring

LARGEST = 1.0
"""A particle with a larger coordinate than this (x, px, y, py, δ) is lost, as in pyAT."""


Rows = dict[str, Any]
"""Parameters of each part of the elements of a ring, in the order of passage."""


class Flight(NamedTuple):
    """A particle, and where it was lost: element and turn (−1 if it was not) and coordinates."""

    z: Particle
    element: Array
    turn: Array
    last: Particle


def start(z: Particle) -> Flight:
    none = jnp.asarray(-1, jnp.int32)
    return Flight(z, none, none, Particle(*[jnp.full((), jnp.nan)] * 6))


def _noted(flight: Flight, z: Particle, passes: Any, number: Rows, turn: Any) -> Flight:
    """The flight with the particle after a part of an element, or with its loss there."""
    inside = functools.reduce(jnp.logical_and, [jnp.abs(z[i]) <= LARGEST for i in (0, 1, 2, 3, 5)])
    # NaN in a coordinate fails the comparison. Within an element the limit does not hold.
    passes = passes & ((inside & jnp.isfinite(z.zeta)) | ~number["ends"])
    is_lost = ~passes & (flight.element < 0)

    def note():
        def chosen(new, old):
            return jax.tree.map(lambda a, b: jnp.where(is_lost, a, b), new, old)

        nan = Particle(*[jnp.full((), jnp.nan)] * 6)
        return Flight(
            chosen(nan, z),
            chosen(number["element"], flight.element),
            chosen(jnp.asarray(turn, jnp.int32), flight.turn),
            chosen(z, flight.last),
        )

    # The branch keeps this work out of parts in which no particle is lost, which is nearly all.
    return lax.cond(lanewise.on_any(is_lost), note, lambda: flight._replace(z=z))


def rows_of(ring: Ring, first: int = 0, last: int | None = None) -> tuple[Rows, Rows]:
    """The parameters of the parts of the elements `first` … `last` − 1, and the numbers of the
    parts and of the elements, with whether an element ends there."""
    last = len(ring) if last is None else last
    which = [row for row in ring.program.rows if first <= row[1] < last]
    part, element = np.asarray(which, np.int32).reshape(-1, 2).T
    rows = {name: column[element] for name, column in ring.columns.items()}
    rows |= {f"ε {name}": column[element] for name, column in ring.extra.items()}
    ends = np.append(element[1:] != element[:-1], True)
    return rows, {"part": part, "element": element, "ends": ends}


def perturbed(par: Rows, epsilon: Any) -> Rows:
    """The parameters of a part, with what ε is multiplied by added."""
    extra = {name[2:]: value for name, value in par.items() if name.startswith("ε ")}
    return {**par, **{name: par[name] + epsilon * value for name, value in extra.items()}}


def moved(
    parts: Sequence[Part], numbers: Rows, rows: Rows, z: Particle, turn: Any, epsilon: Any, sign=1
) -> Particle:
    """The particle after the parts in `rows`, or before them for sign −1; without apertures."""

    def row(z, x):
        number, par = x
        par = perturbed(par, epsilon)

        def through(part):
            return lambda z: forward(pieces_of(part), z, par, turn, sign)

        return lax.switch(number["part"], [through(p) for p in parts], z), None

    return lax.scan(row, z, (numbers, rows), reverse=sign < 0)[0]


def flown(
    parts: Sequence[Part], numbers: Rows, rows: Rows, flight: Flight, turn: Any, epsilon: Any
) -> Flight:
    """The flight after the parts in `rows`, with losses. A particle that is lost becomes NaN."""

    def row(flight, x):
        number, par = x
        par = perturbed(par, epsilon)

        def through(part):
            inside = APERTURES.get(part.name)
            if inside is not None:
                return lambda z: (z, inside(z, par))
            return lambda z: (forward(pieces_of(part), z, par, turn, 1), jnp.asarray(True))

        z, passes = lax.switch(number["part"], [through(p) for p in parts], flight.z)
        return _noted(flight, z, passes, number, turn), None

    return lax.scan(row, flight, (numbers, rows))[0]


def pulled(
    parts: Sequence[Part],
    numbers: Rows,
    rows: Rows,
    moving: Sequence[str],
    z: Particle,
    cotangent: Particle,
    turn: Any,
    epsilon: Any,
) -> tuple[Particle, Particle, Rows]:
    """The particle before the parts in `rows` and its cotangent, from those after them; and the
    cotangents of the parameters `moving`, one for each part."""

    def row(state, x):
        number, par = x
        par = perturbed(par, epsilon)
        known = {name: par[name] for name in moving}

        def back(part):
            return lambda z, c: pull_back(pieces_of(part), z, c, par, known, turn)

        z, cotangent, found = lax.switch(number["part"], [back(p) for p in parts], *state)
        return (z, cotangent), found

    (z, cotangent), found = lax.scan(row, (z, cotangent), (numbers, rows), reverse=True)
    return z, cotangent, found
