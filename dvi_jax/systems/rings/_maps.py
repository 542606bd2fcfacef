"""Maps of the parts of an element: drifts, kicks, edges, cavities, and their inverses."""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import lanewise


class Particle(NamedTuple):
    """Coordinates relative to the reference particle: lengths in m, momenta over p₀, ζ = −c Δt."""

    x: Any
    px: Any
    y: Any
    py: Any
    zeta: Any
    delta: Any

    def plus(self, **changes: Any) -> "Particle":
        """The particle with these changes added to its coordinates."""
        return self._replace(**{name: getattr(self, name) + d for name, d in changes.items()})


Parameters = Mapping[str, Any]
"""The parameters of one element by name; see `Ring`."""


class RingPart(NamedTuple):
    """A part of an element: the name of its map, the order of its field, the order of the scheme
    in each of its slices, the potential of a lens."""

    name: str
    order: int = 0
    scheme: int = 4
    slices: int = 1
    potential: Callable[..., Any] | None = None


def distinct(parts: Iterable[RingPart]) -> list[RingPart]:
    """The different parts, sorted; lenses in the order in which they are given."""
    return sorted(dict.fromkeys(parts), key=lambda part: part[:4])


class Piece(NamedTuple):
    """A map ``apply(z, par, turn, sign)``, with its inverse for sign −1, `times` times."""

    apply: Callable[[Particle, Parameters, Any, int], Particle]
    times: int = 1


Pieces = Sequence[Piece]


def forward(pieces: Pieces, z: Particle, par: Parameters, turn: Any, sign: int) -> Particle:
    """The map of a part of an element, or its inverse for sign −1."""
    for piece in pieces[::sign]:

        def step(z, number, piece=piece):
            values = {**par, "slice": number} if "key" in par else par
            return piece.apply(z, values, turn, sign), None

        numbers = jnp.arange(piece.times) if "key" in par else None
        z, _ = step(z, 0) if piece.times == 1 else lax.scan(step, z, numbers, piece.times)
    return z


def pull_back(
    pieces: Pieces, z: Particle, cotangent: Particle, par: Parameters, moving: Any, turn: Any
) -> tuple[Particle, Particle, Any]:
    """The particle before a part of an element and its cotangent, from those after it, and the
    cotangent of the parameters `moving`."""
    state = z, cotangent, jax.tree.map(jnp.zeros_like, moving)
    for piece in reversed(pieces):

        def step(state, _, piece=piece):
            z, cotangent, total = state
            z = piece.apply(z, par, turn, -1)

            def image(z, moving):
                return piece.apply(z, {**par, **moving}, turn, 1)

            cotangent, slope = jax.vjp(image, z, moving)[1](cotangent)
            return (z, cotangent, jax.tree.map(jnp.add, total, slope)), None

        state, _ = (
            step(state, None) if piece.times == 1 else lax.scan(step, state, None, piece.times)
        )
    return state


def near_identity(change: Callable[[Particle, Parameters], dict[str, Any]]) -> Piece:
    """z + change(z), with an inverse by fixed-point iteration."""

    def apply(z, par, turn, sign):
        if sign > 0:
            return z.plus(**change(z, par))
        root = z
        for _ in range(8):  # a change of 1 % of the coordinates has converged to round-off
            root = z.plus(**{name: -shift for name, shift in change(root, par).items()})
        return root

    return Piece(apply)


# --- magnets in slices: drifts and kicks by turns ------------------------------------------------

# The kicks of a slice: Forest & Ruth 1990 for order 4, Yoshida 1990 (solution A) for order 6.
_FR = 1 / (2 - 2 ** (1 / 3))
_Y = (0.784513610477560, 0.235573213359357, -1.17767998417887)
KICKS = {2: (1.0,), 4: (_FR, 1 - 2 * _FR, _FR), 6: (*_Y, 1 - 2 * sum(_Y), *reversed(_Y))}


def drifts_and_kicks(coast: Callable, kick: Callable, part: RingPart) -> list[Piece]:
    """``coast(z, length, par)`` and ``kick(z, length, par, part, sign, number, turn)`` by turns in
    each slice. The two coasts between slices are one; half a coast before the first slice and after
    the last completes them."""
    kicks = KICKS[part.scheme]
    coasts = [(a + b) / 2 for a, b in zip(kicks, (*kicks[1:], kicks[0]), strict=True)]

    def end(c):
        c = c / part.slices
        return Piece(lambda z, par, turn, sign: coast(z, sign * c * par["length"], par))

    def one_slice(z, par, turn, sign):
        for i in range(2 * len(kicks))[::sign]:
            c = (coasts if i % 2 else kicks)[i // 2]
            length = c / part.slices * par["length"]
            if i % 2:
                z = coast(z, sign * length, par)
            else:
                z = kick(z, length, par, part, sign, i // 2, turn)
        return z

    return [end(kicks[0] / 2), Piece(one_slice, part.slices), end(-kicks[0] / 2)]


def drift(z: Particle, length: Any, par: Parameters) -> Particle:
    """The flow of (px² + py²)/(2 (1 + δ)) over a length [m]."""
    p = 1 + z.delta
    scale = length / p
    late = scale * (z.px * z.px + z.py * z.py) / (2 * p)
    return z.plus(x=scale * z.px, y=scale * z.py, zeta=-late)


def field(z: Particle, par: Parameters, order: int) -> tuple[Any, Any]:
    """Real and imaginary part of Σ (b_n + i a_n)(x + i y)^n, n = 0 … order."""
    re, im = par[f"b{order}"], par[f"a{order}"]
    for n in reversed(range(order)):
        re, im = re * z.x - im * z.y + par[f"b{n}"], im * z.x + re * z.y + par[f"a{n}"]
    return re, im


def kick(z: Particle, length: Any, par: Parameters, order: int) -> Particle:
    """The kick of multipoles over a length [m]."""
    re, im = field(z, par, order)
    return z.plus(px=-length * re, py=length * im)


def curved_kick(z: Particle, length: Any, par: Parameters, order: int) -> Particle:
    """The kick in a bend of curvature h: also h δ − h² x, from the field that bends by h."""
    h = par["h"]
    z = kick(z, length, par, order)
    return z.plus(px=length * h * (z.delta - h * z.x), zeta=-length * h * z.x)


# --- thin parts ----------------------------------------------------------------------------------


def edge(side: str, symplectic: bool, method: int) -> Piece:
    """The edge of a bend: px + h tan(e) x, py − f y with f = h tan(e − ψ/(1 + δ)) and the
    correction ψ = h G (1 + sin² e)/cos e for a fringe field, G the gap [m] times its integral;
    f/(1 + δ) for method 2. `symplectic`: with the change of ζ that belongs to the δ in f."""

    def change(z, par):
        h, e = par["h"], par[f"edge_{side}"]
        psi = h * par[f"fringe_{side}"] * (1 + jnp.sin(e) ** 2) / jnp.cos(e)

        def f(delta):
            f = h * jnp.tan(e - psi / (1 + delta))
            return f / (1 + delta) if method == 2 else f

        changes = {"px": h * jnp.tan(e) * z.x, "py": -f(z.delta) * z.y}
        if symplectic:
            changes["zeta"] = z.y * z.y / 2 * jax.grad(f)(z.delta)
        return changes

    return near_identity(change)


def quadrupole_fringe(side: int) -> Piece:
    """The hard edge of a quadrupole, symplectic up to order 5 in the coordinates."""

    def change(z, par):
        u = side * par["b1"] / (12 * (1 + z.delta))
        x2, y2, xy = z.x * z.x, z.y * z.y, z.x * z.y
        gx, gy = u * (x2 + 3 * y2) * z.x, u * (y2 + 3 * x2) * z.y
        return {
            "x": gx,
            "y": -gy,
            "px": 3 * u * (2 * xy * z.py - (x2 + y2) * z.px),
            "py": -3 * u * (2 * xy * z.px - (x2 + y2) * z.py),
            "zeta": (gy * z.py - gx * z.px) / (1 + z.delta),
        }

    return near_identity(change)


def thin_kick(z: Particle, par: Parameters, sign: int, order: int) -> Particle:
    return kick(z, sign, par, order)


def rescaled(z: Particle, scale: Any, sign: int) -> Particle:
    """Momenta relative to `scale` times the reference momentum, or back for sign −1."""
    factor = 1 / scale if sign > 0 else scale
    return z._replace(px=factor * z.px, py=factor * z.py, delta=z.delta * factor + (factor - 1))


def lens(z: Particle, par: Parameters, sign: int, potential: Callable) -> Particle:
    """The kick −∇V of a potential V(x, y, par)."""
    of_x, of_y = jax.grad(potential, argnums=(0, 1))(z.x, z.y, par)
    return z.plus(px=-sign * of_x, py=-sign * of_y)


def quarters(angle: Any) -> tuple[Any, Any, Any]:
    """Cosine and sine of quarters of a turn, which are integers, and the rest of the angle."""
    n = jnp.round(lax.stop_gradient(angle) / (np.pi / 2)) * (np.pi / 2)
    return jnp.round(jnp.cos(n)), jnp.round(jnp.sin(n)), angle - n


def cavity(z: Particle, par: Parameters, turn: Any, sign: int) -> Particle:
    """δ − V sin(k (−ζ − lag) − turn·slip − phase): V over the energy, k = 2π f/c."""
    # Without quarters of a turn: next to a phase of π a small ζ would lose its digits.
    c, s, rest = quarters(par["wave_number"] * par["lag"] + turn * par["slip"] + par["phase"])
    angle = par["wave_number"] * z.zeta + rest
    return z.plus(delta=sign * par["voltage"] * (c * jnp.sin(angle) + s * jnp.cos(angle)))


def corrector(z: Particle, par: Parameters, turn: Any, sign: int) -> Particle:
    """A constant field over a length, with the whole kick at the end of it."""
    kx, ky, p = sign * par["kick_x"], sign * par["kick_y"], 1 + z.delta
    scale = sign * par["length"] / p
    squares = (kx * kx + ky * ky) / 3 + z.px * (z.px + kx) + z.py * (z.py + ky)
    shift = {"x": scale * (z.px + kx / 2), "y": scale * (z.py + ky / 2)}
    return z.plus(px=kx, py=ky, zeta=-scale * squares / (2 * p), **shift)


def affine(side: str) -> Piece:
    """M z + v, given as ``matrix_…`` and ``shift_…``."""

    def apply(z, par, turn, sign):
        matrix, shift = par[f"matrix_{side}"], par[f"shift_{side}"]
        if sign > 0:
            return Particle(*(matrix @ jnp.stack(z) + shift))
        return Particle(*lanewise.solve(matrix, jnp.stack(z) - shift))

    return Piece(apply)


def inside_rectangle(z: Particle, par: Parameters) -> Any:
    horizontal = (z.x >= par["x_min"]) & (z.x <= par["x_max"])
    return horizontal & (z.y >= par["y_min"]) & (z.y <= par["y_max"])


def inside_ellipse(z: Particle, par: Parameters) -> Any:
    return (z.x / par["radius_x"]) ** 2 + (z.y / par["radius_y"]) ** 2 <= 1


LIMITS = {
    "rectangle": ("x_min", "x_max", "y_min", "y_max"),
    "ellipse": ("radius_x", "radius_y"),
}
"""The parameters of each kind of aperture."""


def inside_pipe(kind: str, share: Any, z: Particle, par: Parameters) -> Any:
    """The same in a pipe whose limits change linearly along the element, at a share of it."""
    limits = {k: (1 - share) * par[f"{k}_in"] + share * par[f"{k}_out"] for k in LIMITS[kind]}
    return APERTURES[kind](z, limits)


APERTURES: dict[str, Callable[[Particle, Parameters], Any]] = {
    "rectangle": inside_rectangle,
    "ellipse": inside_ellipse,
    **{
        f"{kind}_{end}": functools.partial(inside_pipe, kind, share)
        for kind in LIMITS
        for end, share in (("in", 0.0), ("out", 1.0))
    },
}
"""Parts that do not move a particle: whether it passes."""
