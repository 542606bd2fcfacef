"""Places of losses inside of elements, and beam pipes along a ring."""

import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ...base.checks import all_finite, array, in_order, in_range, known
from ...base.keywords import user_level
from ._frames import moved, placed, turned
from ._maps import APERTURES, LIMITS, Parameters, Particle, RingPart, forward, inside_pipe
from ._parts import pieces_of
from ._ring import READERS, Ring

_SAMPLES, _BISECTIONS = 64, 45
"""Places at which each part of an element is tested, and divisions of the interval by two."""
_TOLERANCE = 1e-6
"""Largest distance between a loss and what the motion back to the entrance and forward reaches."""
_EDGE = 1e-9
"""A distance [m] from the ends of elements, larger than round-off of s."""

Parts = tuple[RingPart, ...]


def partial_map(part: RingPart, z: Particle, par: Parameters, turn: Any, share: Any) -> Particle:
    """The particle after a share of the length of a thick part."""
    shares = {key: share * par[key] for key in ("length", "kick_x", "kick_y") if key in par}
    return forward(pieces_of(part), z, {**par, **shares}, turn, 1)


def spans(parts: Parts) -> dict[int, tuple[float, float]]:
    """Number of each thick part of an element → the shares of the element before it and in it."""
    width = {"half_drift": 0.5}
    thick = [i for i, part in enumerate(parts) if part.name in READERS["length"]]
    sizes = [width.get(parts[i].name, 1.0) for i in thick]
    return {i: (sum(sizes[:n]), sizes[n]) for n, i in enumerate(thick)}


def _outward(part: RingPart, z: Particle, par: Parameters, share: Any) -> Particle:
    """The particle at a share of a misaligned element, in the frame outside of one of its parts."""
    if part.name == "affine_out":
        # Of rigid bodies: the ends have different shifts, and the displacement is linear between.
        start = forward(pieces_of(part._replace(name="affine_in")), z, par, 0, -1)
        end = forward(pieces_of(part), z, par, 0, 1)
        return Particle(*((1 - share) * a + share * b for a, b in zip(start, end, strict=True)))
    if part.name == "placed_out":
        return placed(z, par, -1)
    if part.name == "tilted_out":
        return turned(z, -par["tilt"])
    return moved(z, par, share, -1) if part.name == "moved_out" else z


def _is_inside(parts: Parts, z: Particle, par: Parameters, share: Any) -> Any:
    """Whether a particle at a share of an element is inside of the apertures around it; `parts`:
    those of the element behind it."""
    result = functools.reduce(jnp.logical_and, [jnp.abs(z[i]) <= 1 for i in (0, 1, 2, 3, 5)])
    for part in parts:
        kind = part.name.removesuffix("_out")
        if part.name in APERTURES:
            is_pipe = part.name not in LIMITS
            result &= inside_pipe(kind, share, z, par) if is_pipe else APERTURES[kind](z, par)
        else:
            z = _outward(part, z, par, share)
    return result


@functools.partial(jax.jit, static_argnums=(0, 1))
def _shares(parts: Parts, end: int, table: Any, last: Array, turn: Array) -> Array:
    """The shares of an element before the losses behind part number `end`."""
    thick, count = spans(parts), _SAMPLES + _BISECTIONS
    first = next(iter(thick))
    order = [i for i in range(first, end + 1) if parts[i].name not in APERTURES]

    def share_of(par, last, turn):
        z = Particle(*last)
        for i in reversed(order):
            z = forward(pieces_of(parts[i]), z, par, turn, -1)
        total, is_found = 0.0, jnp.asarray(False)
        for i in order:
            if i not in thick:
                z = forward(pieces_of(parts[i]), z, par, turn, 1)
                continue
            begin, size = thick[i]

            def search(
                k: Array, state: tuple, i=i, begin=begin, size=size, entrance=z
            ) -> tuple[Any, ...]:
                # First along the part, then by bisection, and the end at last: one program.
                low, high, is_out, _ = state
                share = jnp.where(is_out, (low + high) / 2, jnp.minimum(k / _SAMPLES, 1.0))
                share = jnp.where(k == count, 1.0, share)
                point = partial_map(parts[i], entrance, par, turn, share)
                is_in = _is_inside(parts[i + 1 :], point, par, begin + size * share)
                is_last = k == count
                low = jnp.where(is_in & ~is_last, share, low)
                high = jnp.where(is_in | is_last, high, share)
                return low, high, is_out | (~is_in & ~is_last), point

            start = jnp.zeros(()), jnp.ones(()), jnp.asarray(False), z
            _, high, is_out, exit_state = lax.fori_loop(0, count + 1, search, start)
            z = Particle(*exit_state)
            total = jnp.where(is_found, total, begin + size * high)
            is_found |= is_out
        distance = jnp.max(jnp.abs(jnp.stack(z) - last))
        return jnp.where(distance < _TOLERANCE, total, jnp.nan)

    return jax.vmap(share_of)(table, last, turn)


def loss_places(ring: Ring, turn: Any, row: Any, last: Any) -> Array:
    """See `Tracked.places`."""
    turn, row, last = known("turn", turn), known("row", row), known("last", last)
    in_range("row", row, -1, len(ring.program.rows) - 1, "Give the ring that was tracked.")
    part, element = np.asarray(ring.program.rows).T
    first = np.searchsorted(element, np.arange(len(ring) + 1))
    result, flat = np.full(row.size, np.nan), row.ravel()
    groups: dict[Any, list[int]] = {}
    for i in np.flatnonzero(flat >= 0).tolist():
        begin, end = first[element[flat[i]] + np.arange(2)]
        parts = tuple(ring.program.parts[k] for k in part[begin:end])
        groups.setdefault((parts, int(flat[i] - begin)), []).append(i)
    columns = {key: np.asarray(column) for key, column in ring.columns.items()}
    for (parts, end), members in groups.items():
        owner, thick = element[flat[members]], spans(parts)
        if any(i <= end for i in thick):
            size = 1 << (len(members) - 1).bit_length()  # one program for similar numbers
            indices = np.resize(members, size)
            table = {k: column[element[flat[indices]]] for k, column in columns.items()}
            states = last.reshape(-1, 6)[indices], turn.ravel()[indices]
            share = np.asarray(_shares(parts, end, table, *states))[: len(members)]
        else:
            share = 0.0 if thick else float(2 * end + 1 >= len(parts))
        result[members] = np.asarray(ring.places)[owner] + share * columns["length"][owner]
    return jnp.asarray(result.reshape(row.shape))


def beam_pipe(ring: Ring, s: Any, *, ellipse: Any = None, rectangle: Any = None) -> Ring:
    """The ring inside of a pipe whose limits are given along s, with linear changes between.

    Particles are lost at the ends of elements that are outside; `Tracked.places` finds where they
    left the pipe. Inside of an element the limits are linear between its ends, with a warning if
    the pipe is narrower there. The pipe follows the design orbit, also at misaligned elements.

    **Arguments** `s`: ascending places from 0 to the end of the ring [m], shape (n,); equal ones
    for a step. `ellipse`: half axes (x, y) at these places [m], shape (n, 2). `rectangle`: x_min,
    x_max, y_min, y_max [m], shape (n, 4); one of them or both. For one aperture of each element
    use `Element.inside` and `Ring.elements`.

    **Raises** `ValueError` for other shapes, places that do not cover the ring, limits without
    space between, and elements that are in a pipe already.

    **Example**

    ```python
    ring = rings.beam_pipe(rings.Ring([rings.drift("D", 4.0)]), [0.0, 4.0],
                           ellipse=[[0.02, 0.01], [0.01, 0.01]])
    out = rings.track(ring, [0.0, 0.008, 0.0, 0.0, 0.0, 0.0])
    print(f"{out.places(ring):.6f}")
    # 1.904762
    ```
    """
    s = known("s", s, float)
    in_order("s", array("s", s, ("n",)))
    places, columns, parts = np.asarray(ring.places), {}, []
    in_range("places of the elements", places, s[0] - _EDGE, s[-1] + _EDGE, "s must cover them.")
    ends = {"in": places[:-1] + _EDGE, "out": places[1:] - _EDGE}
    for kind, limits in (("ellipse", ellipse), ("rectangle", rectangle)):
        if limits is None:
            continue
        keys = LIMITS[kind]
        limits = array(kind, known(kind, limits, float), (len(s), len(keys)))
        widths = limits if kind == "ellipse" else limits[:, 1::2] - limits[:, ::2]
        all_finite(f"widths of the {kind}", widths, positive=True, hint="The unit is m.")
        for key, column in zip(keys, limits.T, strict=True):
            pair = {f"{key}_{end}": np.interp(x, s, column) for end, x in ends.items()}
            columns |= pair
            owner = np.clip(np.searchsorted(places, s, side="right") - 1, 0, len(ring) - 1)
            share = (s - places[owner]) / np.maximum(np.diff(places)[owner], _EDGE)
            begin, end = (x[owner] for x in pair.values())
            excess = (1 - share) * begin + share * end - column
            excess = -excess if key.endswith("_min") else excess
            narrow = (share > 1e-6) & (share < 1 - 1e-6) & (excess > 1e-6)
            if narrow.any():
                i = np.argmax(np.where(narrow, excess, 0.0))
                warnings.warn(
                    f"at s = {s[i]:.6g} m, inside of element {ring.names[owner[i]]!r}, the pipe is "
                    f"narrower by {excess[i]:.2g} m than between its ends: a particle that is "
                    "outside only there is not lost. Divide the element.",
                    stacklevel=user_level(),
                )
        parts.append((RingPart(f"{kind}_in"), RingPart(f"{kind}_out"), keys))
    elements = []
    for i, element in enumerate(ring.elements):
        for first, last, keys in parts:
            values = {f"{k}_{end}": columns[f"{k}_{end}"][i] for k in keys for end in ("in", "out")}
            element = element.within(first, last, **values)
        elements.append(element)
    return Ring(elements, ring.energy, ring.periods)
