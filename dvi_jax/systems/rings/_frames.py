"""Misaligned elements: the frame of an element that is moved as a rigid body."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ._exact import pz_of, rotation
from ._maps import Parameters, Particle, quarters


def turned(z: Particle, angle: Any) -> Particle:
    """Coordinates relative to axes that are rotated about the s-axis, x towards y."""
    x, y = rotation(z.x, z.y, angle)
    py, px = rotation(z.py, z.px, -angle)  # the shears of the momenta are the transposed ones
    return z._replace(x=x, px=px, y=y, py=py)


def placed(z: Particle, par: Parameters, sign: int) -> Particle:
    """As `moved`, for a straight element that is only shifted by (dx, dy) and rolled."""
    if sign > 0:
        return turned(z.plus(x=-par["dx"], y=-par["dy"]), par["roll"])
    return turned(z, -par["roll"]).plus(x=par["dx"], y=par["dy"])


def moved(z: Particle, par: Parameters, share: float, sign: int) -> Particle:
    """The particle in the plane of the frame of a misaligned element, from that of the design, or
    back for sign −1. Both frames are at the share of the length of the element.

    The design has the axes A and the origin p there, relative to the anchor, about which the
    element is moved by r → V r + d. In coordinates of the design its frame has the axes AᵀVA and
    the origin Aᵀ(V p + d − p). The particle moves freely from one plane to the other.
    """
    A, p = _arc(par, (share - par["anchor"]) * par["length"])
    # Differences from the identity: rounding is a part of the misalignments, and without any
    # nothing changes.
    K = _rotation(par["yaw"], par["pitch"], par["roll"])
    change, d = A.T @ K @ A, jnp.stack([par["dx"], par["dy"], par["ds"]])
    origin = A.T @ (d + K @ p)
    r, u = jnp.stack([z.x, z.y, jnp.zeros_like(z.x)]), jnp.stack([z.px, z.py, pz_of(z)])
    r = r - origin if sign > 0 else r
    change = change.T if sign > 0 else change
    r, u = r + change @ r, u + change @ u
    r = r if sign > 0 else r + origin
    path = -r[2] / u[2]
    x, y = r[0] + path * u[0], r[1] + path * u[1]
    return Particle(x, u[0], y, u[1], z.zeta - path * (1 + z.delta), z.delta)


def _rotation(yaw: Any, pitch: Any, roll: Any) -> Any:
    """V − 1 with V = Θ Φ Ψ of MAD-X: s is turned towards x by `yaw` and towards y by `pitch`, x
    towards y by `roll`, which acts first."""
    total = np.zeros((3, 3))
    for angle, end, axis in ((roll, 1, 0), (pitch, 1, 2), (yaw, 0, 2)):
        unit = np.eye(3)
        planes = np.outer(unit[end], unit[axis])
        diagonal = np.diag(unit[end] + unit[axis])
        turn = jnp.sin(angle) * (planes - planes.T) - 2 * jnp.sin(angle / 2) ** 2 * diagonal
        total = turn + total + turn @ total
    return total


def _arc(par: Parameters, s: Any) -> tuple[Any, Any]:
    """Axes, as columns, and origin of the reference frame after a distance s [m] along the arc."""
    half = par.get("h", 0.0) * s / 2
    chord = s * jnp.sinc(half / np.pi)
    c, n = jnp.cos(par.get("tilt", 0.0)), jnp.sin(par.get("tilt", 0.0))
    # The arc bends towards −x of the axes that are tilted by the design.
    radial, lateral, ahead = jnp.stack([c, n, 0 * c]), jnp.stack([-n, c, 0 * c]), np.eye(3)[2]
    x = jnp.cos(2 * half) * radial + jnp.sin(2 * half) * ahead
    z = jnp.cos(2 * half) * ahead - jnp.sin(2 * half) * radial
    axes = jnp.outer(x, radial) + jnp.outer(lateral, lateral) + jnp.outer(z, ahead)
    return axes, chord * (jnp.cos(half) * ahead - jnp.sin(half) * radial)


def solenoid(z: Particle, par: Parameters, turn: Any, sign: int) -> Particle:
    """A constant longitudinal field B with hard edges, ks = B/(Bρ): a rotation of the motion in two
    planes with the focusing k², both of determinant 1."""
    length, p = sign * par["length"], 1 + z.delta
    k = par["ks"] / (2 * p)
    u, v, x, y = z.px / p, z.py / p, z.x, z.y
    late = length * (k * k * (x * x + y * y) + 2 * k * (u * y - v * x) + u * u + v * v) / 2
    c, s, rest = quarters(length * k)
    no_quarter = c == 1
    safe = jnp.where(no_quarter, 1.0, k)
    # sin(rest)/k, also for k = 0.
    drift = jnp.where(no_quarter, length * jnp.sinc(length * k / np.pi), jnp.sin(rest) / safe)
    kick = k * jnp.tan(rest / 2)

    def focused(x, u):
        x, u = c * x + s * (u / safe), c * u - s * (k * x)
        u = u - kick * x
        x = x + drift * u
        return x, u - kick * x

    (x, u), (y, v) = focused(x, u), focused(y, v)
    return turned(Particle(x, p * u, y, p * v, z.zeta - late, z.delta), length * k)
