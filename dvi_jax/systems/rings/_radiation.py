"""Synchrotron radiation in magnets: the loss of energy in each kick, and its quantum noise."""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from ...problem.paths import normals
from ._maps import KICKS, Parameters, Particle, Piece, RingPart, near_identity

ELECTRON = 510998.95069
"""Rest energy of an electron [eV], CODATA 2022."""
RADIUS, _ACTION = 2.8179403205e-15, 1.973269804e-7
"""The classical radius of an electron [m], and ħc [eV m]."""
_ITERATIONS = 3
"""Of the inverse of a kick: each reduces the error by the relative loss of energy in the kick."""

Kick = Callable[[Particle, Any, Parameters, int], Particle]


def constants(energy: float, mass: float) -> dict[str, float]:
    """The parameters of a magnet that radiates: `loss` = 2rγ³/3 [m] with the classical radius r of
    the particle, and `excitation` [m], whose square 55 ƛ r γ⁵/(24 √3) is that of the diffusion."""
    gamma, radius = energy / mass, RADIUS * ELECTRON / mass
    diffusion = 55 / (24 * math.sqrt(3)) * _ACTION / mass * radius * gamma**5
    return {"loss": 2 / 3 * radius * gamma**3, "excitation": math.sqrt(diffusion)}


def radiant(kick: Kick) -> Callable[..., Particle]:
    r"""The kick of a magnet that radiates if it has a parameter `loss`, and its exact inverse.

    A photon leaves along the velocity: p → p − K p² for p = 1 + δ, and px/p, py/p do not change.
    K is the `loss` times \|e × B\|² ds, B the field over Bρ and e the direction of the velocity.
    The kick is that of the particle before its loss, as in pyAT's pass methods with radiation. The
    noise of the loss is in the middle of the kick, see `shaken`.
    """

    def move(z, length, par, part, sign, number, turn):
        if "loss" not in par:
            return kick(z, sign * length, par, part.order)

        def with_loss(z):
            change = _lose(z, _rate(kick, z, length, par, part), 1)
            return kick(z, length, par, part.order).plus(**change)

        if sign > 0:
            return shaken(kick, with_loss, z, length, par, part, number, turn)
        origin, change = z, {"delta": 0.0}
        for _ in range(_ITERATIONS):
            start = z.plus(delta=change["delta"])
            origin = kick(start, -length, par, part.order)._replace(delta=z.delta)
            change = _lose(origin, _rate(kick, origin, length, par, part), -1)
        return origin.plus(**change)

    return move


def emit(kick: Kick, z, length, par, part, sign) -> Particle:
    """The particle after the loss of a kick over a length [m], or before it for sign −1."""
    return z.plus(**_lose(z, _rate(kick, z, length, par, part), sign)) if "loss" in par else z


def shaken(kick: Kick, move, z, length, par, part, number, turn) -> Particle:
    """``move(z)`` of a kick, with half of the noise of its photons before and half after it.

    All of it at one end would be an error of order 1 in the length of a kick, whose coefficients
    add up to the sum of the squares of the kicks of a slice: a negative diffusion.
    """
    noise = _noise(par, part, number, turn)
    if noise is None:
        return move(z)
    squares, path = _brightness(kick, z, par, part)
    # Its square is the diffusion; without a derivative where there is no field.
    diffusion = squares**1.5 * path * jnp.abs(length)
    shines = diffusion > 0
    root = jnp.where(shines, jnp.sqrt(jnp.where(shines, diffusion, 1.0)), 0.0)
    half = -noise / 2 * par["excitation"] * root
    z = move(z.plus(**_lose(z, half, 1)))
    return z.plus(**_lose(z, half, 1))


def wedge(side: str) -> Piece:
    """The loss between the end of a bend and its pole face, at the distance x tan(e) from it: in
    I₄ these are the terms of the edges. pyAT's pass methods leave them out."""

    def change(z, par):
        if "loss" not in par:
            return {}
        return _lose(z, -par["loss"] * par["h"] ** 2 * z.x * jnp.tan(par[f"edge_{side}"]), 1)

    return near_identity(change)


def _lose(z: Particle, rate: Any, sign: int) -> dict[str, Any]:
    """The changes of px, py and δ by p → p − K p², or by its inverse for sign −1."""
    p = 1 + z.delta
    share = -rate * p if sign > 0 else 4 * rate * p / (1 + jnp.sqrt(1 - 4 * rate * p)) ** 2
    return {"px": share * z.px, "py": share * z.py, "delta": share * p}


def _rate(kick: Kick, z: Particle, length: Any, par: Parameters, part: RingPart) -> Any:
    """K of a kick over a length [m]."""
    squares, path = _brightness(kick, z, par, part)
    return par["loss"] * squares * path * length


def _brightness(kick: Kick, z: Particle, par: Parameters, part: RingPart) -> tuple[Any, Any]:
    """The square of e × B, and the length of the path over that of the reference orbit."""
    h = par["h"] if "bend" in part.name else 0.0
    p, wide = 1 + z.delta, 1 + h * z.x
    u, v = z.px / p, z.py / p
    # With this δ the terms of the reference orbit in the kick of a bend cancel.
    impulse = kick(z._replace(px=0 * p, py=0 * p, delta=h * z.x), 1.0, par, part.order)
    width = wide if part.name == "exact_bend" else 1.0
    vertical, radial = h - impulse.px / width, impulse.py / width
    if "exact" in part.name:
        squares = radial**2 + vertical**2 - (radial * u + vertical * v) ** 2
        path = wide / jnp.sqrt(1 - u * u - v * v)
    else:
        slopes = u * u + v * v
        squares = (radial**2 + vertical**2) * wide**2 + (radial * v - vertical * u) ** 2
        squares, path = squares / (wide * wide + slopes), wide + slopes / 2
    return squares, path


def _noise(par: Parameters, part: RingPart, number: int, turn: Any) -> Any:
    """The random number of a kick: that of the slice in its middle kick, which has its length."""
    if "noise" in par:
        return par["noise"][number]
    kicks = KICKS[part.scheme]
    if "key" not in par or number != len(kicks) // 2:
        return None
    node = par["counter"].astype(jnp.uint32) + jnp.asarray(par["slice"], jnp.uint32)
    words = jnp.asarray(turn, jnp.uint32)
    draw = normals(par["key"], words, 1, jnp.dtype(float), node)[0]
    return draw / math.sqrt(abs(kicks[number]))
