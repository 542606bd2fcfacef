"""Rings that radiate: radiation in magnets, cavity phases, tapered magnets, radiation integrals."""

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import electronvolts, in_range, instance
from ._maps import RingPart
from ._optics import FRAMES, SLICED_PARTS, Optics, closed_orbit, one_turn, optics
from ._radiation import ELECTRON, constants
from ._ring import Ring, RingStructure, Where

MAGNETS = *SLICED_PARTS, "second_order_bend"
"""The parts that radiate: magnets that have a length."""


def radiating(ring: Ring, where: Where | None = "*", mass: float = ELECTRON) -> Ring:
    r"""The ring whose magnets radiate: each kick of a magnet takes energy from a particle.

        dδ/ds = −(2/3) r γ³ (1 + δ)² |e × B|² (1 + hx)/e_s

    with the field B over Bρ, the direction e of the velocity, r = e²/(4πε₀mc²), and γ of the
    reference particle; the direction of a particle does not change. On the orbit of a bend this is
    P = C_γ c E⁴/(2πρ²).

    The map is not symplectic. Functions that track, `optics` and `equilibrium` use it if the
    analysis is in 6D, so that the ring has a cavity. An analysis in 4D, with a constant δ, is that
    of the ring without radiation.

    **Arguments** `where`: the magnets that radiate, see `Ring.where`; None: none, so that the
    result is a ring without radiation. Only bends and multipoles with a length radiate, not
    solenoids, correctors and thin elements. `mass`: rest energy of the particle [eV].

    A magnet that radiates has the parameters `loss` = 2rγ³/3 [m] and `excitation` [m], the root of
    55 ƛ r γ⁵/(24 √3), which can be set.

    **Source** Sands 1970, SLAC-121; the same model as pass methods of pyAT that end with RadPass,
    which leave out the loss between the end of a bend and its inclined pole face.

    **Example** The loss of energy in a bend [eV]:

    ```python
    ring = rings.radiating(rings.Ring([rings.bend("B", 2.0, 0.1)], energy=3e9))
    print(f"{-3e9 * rings.one_turn(ring, jnp.zeros(6))[5]:.1f}")
    # 5702.1
    ```
    """
    instance("ring", ring, Ring, "a rings.Ring")
    names = "loss", "excitation"
    columns = {n: column for n, column in ring.columns.items() if n not in names}
    parameters = tuple(p - {*names} for p in ring.program.parameters)
    if where is not None:
        numbers = np.intersect1d(ring.where(where), _elements(ring, MAGNETS))
        in_range("number of magnets that radiate", len(numbers), 1, len(ring))
        values = constants(ring.energy, electronvolts("mass", mass, 1e5))
        for name, value in values.items():
            columns[name] = jnp.zeros(len(ring)).at[numbers].set(value)
        parameters = tuple(p | {*names} if i in numbers else p for i, p in enumerate(parameters))
    return _variant(ring, columns, parameters=parameters)


def _elements(ring: Ring, names: tuple[str, ...]) -> np.ndarray:
    """The numbers of the elements that have one of these parts."""
    return np.unique([i for k, i in ring.program.rows if ring.program.parts[k].name in names])


def _variant(ring: Ring, columns: dict[str, Array], **changes: Any) -> Ring:
    other = copy.copy(ring)
    program: RingStructure = dataclasses.replace(ring.program, **changes)
    object.__setattr__(other, "columns", columns)
    object.__setattr__(other, "program", program)
    return other


def in_phase(ring: Ring, where: Where = "cavity") -> Ring:
    """The ring whose cavities give the energy that a particle loses in a turn, at ζ = 0: all of
    them have the phase asin(U/V), with the sum V of their voltages and the loss U on the closed
    orbit for a constant δ = 0. This phase is stable above the transition energy.

    `where`: the cavities; others, such as harmonic ones, are not changed. **Raises** `ValueError`
    if the loss exceeds the voltage.
    """
    cavities = ring.where(where).tolist()
    orbit = closed_orbit(ring, 0.0)
    quiet = ring.set(_elements(ring, ("cavity",)).tolist(), voltage=0.0)
    share = (orbit - one_turn(quiet, orbit))[5] / jnp.sum(ring.get(cavities, "voltage"))
    if not is_traced(share):
        hint = "Use cavities with a higher voltage."
        in_range("loss of a turn over the voltage of the cavities", share, 0.0, 1.0, hint)
    angle = jnp.arcsin(share) - ring.get(cavities, "phase")
    return ring.set(cavities, lag=angle / ring.get(cavities, "wave_number"))


def tapered(ring: Ring, where: Where = "*") -> Ring:
    """The ring whose magnets have fields in proportion to the local momentum 1 + δ of the closed
    orbit, so that the orbit is that of the ring without radiation, but for δ.

    All fields of a magnet and its loss of energy are scaled, by the mean of δ at its ends; the
    change of δ within a magnet remains. pyAT's `tapering` does the same, except for a factor
    (1 + δ)³ in the loss of energy in a magnet. **Raises** as `optics`.

    A magnet has the new parameter `scale`.
    """
    columns, program = dict(ring.columns), ring.program
    magnets = np.intersect1d(ring.where(where), _elements(ring, MAGNETS))
    delta = optics(ring, chromatic=False).orbit[:, 5]
    scale = jnp.ones(len(ring)).at[magnets].set((1 + (delta[:-1] + delta[1:]) / 2)[magnets])
    old = columns.get("scale", jnp.ones(len(ring)))
    scale = jnp.where(np.isin(np.arange(len(ring)), magnets), scale, old)
    columns["scale"] = scale
    for name, power in (("loss", 3), ("excitation", 2.5)):
        if name in columns:
            columns[name] = columns[name] * (scale / old) ** power
    new = [i for i in magnets if "scale" not in program.parameters[i]]
    first, parts, ends = len(program.parts), program.parts, ("scaled_in", "scaled_out")
    if new and RingPart(ends[0]) in parts:
        first = parts.index(RingPart(ends[0]))
    elif new:
        parts = *parts, *map(RingPart, ends)
    rows = []
    for i in range(len(ring)):
        lines = [row for row in program.rows if row[1] == i]
        rows += [(first, i), *lines, (first + 1, i)] if i in new else lines
    parameters = tuple(p | {"scale"} if i in new else p for i, p in enumerate(program.parameters))
    return _variant(ring, columns, parts=parts, rows=tuple(rows), parameters=parameters)


def radiation_integrals(ring: Ring) -> Array:
    r"""The integrals I₁, …, I₅ of one passage of the ring, shape (5,) [m, 1/m, 1/m², 1/m, 1/m].

        I₁ = ∮ D h ds,  I₂ = ∮ h² ds,  I₃ = ∮ |h|³ ds,  I₄ = ∮ D h (h² + 2b₁) ds,  I₅ = ∮ H |h|³ ds

    over the bends, with the horizontal dispersion D and H = γD² + 2αDD' + βD'². I₄ includes the
    edges. They are exact for the linear motion inside a bend, from the optics at its ends, in 4D.
    Quadrupoles and the vertical plane do not contribute; for these there is `equilibrium`.

    The loss of energy is U = C_γ E⁴ I₂/(2π), the damping partition numbers are 1 − I₄/I₂, 1 and
    2 + I₄/I₂, the emittance is C_q γ² I₅/(I₂ − I₄), and the relative energy spread has the square
    C_q γ² I₃/(2I₂ + I₄), with C_q = 55 ƛ/(32 √3).

    **Raises** `ValueError` for bends that are rolled; as `optics`.

    **Source** Helm, Lee, Morton & Sands 1973; the same formulas as in pyAT.
    """
    instance("ring", ring, Ring, "a rings.Ring")
    i = np.flatnonzero(["h" in p for p in ring.program.parameters])
    for frame, angle in FRAMES.items():
        tilts = np.intersect1d(i, _elements(ring, (f"{frame}_in",)))
        if len(tilts) and not is_traced(rolls := angle(ring.columns)[tilts]):
            hint = "The radiation integrals are those of a flat ring: use rings.equilibrium."
            in_range("roll of a bend", rolls, -0.01, 0.01, hint)
    names = "length", "h", "b1", "edge_in", "edge_out"
    return _integrals([ring.columns[name] for name in names], optics(ring, 0.0, chromatic=False), i)


@jax.jit
def _integrals(columns: list[Array], o: Optics, i: Any) -> Array:
    """`radiation_integrals` of the elements i, in one program."""
    L, h, b1, edge_in, edge_out = (column[i] for column in columns)
    edge_in, edge_out = h * jnp.tan(edge_in), h * jnp.tan(edge_out)
    # Inside of the edges.
    beta, (d, slope), (d_out, slope_out) = (
        o.beta[i, 0],
        o.dispersion[i, :2].T,
        o.dispersion[i + 1, :2].T,
    )
    alpha, slope = o.alpha[i, 0] - beta * edge_in, slope + d * edge_in
    gamma, k = (1 + alpha**2) / beta, b1 + h * h
    f1, f2, f3, f5 = _moments(k * L * L)
    # The mean of D'' = h − k D: with the slope at the end it is that of the map that tracks.
    mean = d + slope * L * f2 + (h - d * k) * L * L * f1
    is_flat = jnp.abs(k * L * L) < 1e-6
    ends = h * L - (slope_out - d_out * edge_out - slope)
    mean = jnp.where(is_flat, mean, ends / jnp.where(is_flat, 1.0, k * L))
    H = gamma * d**2 + 2 * alpha * d * slope + beta * slope**2
    H += 2 * h * L * ((alpha * d + beta * slope) * f2 - (alpha * slope + gamma * d) * L * f1)
    H += (h * L) ** 2 * (beta * f5 - alpha * L * f2**2 + gamma * L * L * f3)
    edges = h * (d * edge_in + d_out * edge_out)
    cubes = jnp.abs(h) ** 3 * L
    terms = h * mean * L, h * h * L, cubes, h * mean * L * (2 * b1 + h * h) - edges, H * cubes
    return jnp.sum(jnp.stack(terms), 1)


def _moments(u: Array) -> tuple[Array, ...]:
    """Means of powers of the sine-like and cosine-like solutions over a magnet with u = k L²."""
    small = jnp.abs(u) < 0.03
    w = jnp.where(small, 1.0, u)
    root = jnp.sqrt(jnp.abs(w))
    s = jnp.where(w > 0, jnp.sin(root), jnp.sinh(root)) / root
    c = jnp.where(w > 0, jnp.cos(root), jnp.cosh(root))
    series = np.array([
        [1 / 6, -1 / 120, 1 / 5040, -1 / 362880],
        [1 / 2, -1 / 24, 1 / 720, -1 / 40320],
        [1 / 20, -1 / 168, 1 / 2880, -17 / 1330560],
        [1 / 3, -1 / 15, 2 / 315, -1 / 2835],
    ])  # fmt: skip
    exact = (1 - s) / w, (1 - c) / w, (3 - 4 * s + s * c) / (2 * w * w), (1 - s * c) / (2 * w)
    powers = u[None] ** np.arange(4)[:, None]
    return tuple(jnp.where(small[None], series @ powers, jnp.stack(exact)))
