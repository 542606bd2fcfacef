"""Misaligned elements: the frame of an element that is moved as a rigid body."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ._exact import pz_of
from ._maps import Parameters, Particle


def turned(z: Particle, angle: Any) -> Particle:
    """Coordinates relative to axes that are rotated about the s-axis, x towards y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y = c * z.x + s * z.y, c * z.y - s * z.x
    px, py = c * z.px + s * z.py, c * z.py - s * z.px
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
    # Differences from the identity: without misalignments nothing changes by round-off.
    K = _rotation(par["yaw"], par["pitch"], par["roll"]) - np.eye(3)
    axes = np.eye(3) + A.T @ K @ A
    origin = A.T @ (jnp.stack([par["dx"], par["dy"], par["ds"]]) + K @ p)
    r, u = jnp.stack([z.x, z.y, jnp.zeros_like(z.x)]), jnp.stack([z.px, z.py, pz_of(z)])
    r, u = (axes.T @ (r - origin), axes.T @ u) if sign > 0 else (axes @ r + origin, axes @ u)
    path = -r[2] / u[2]
    x, y = r[0] + path * u[0], r[1] + path * u[1]
    return Particle(x, u[0], y, u[1], z.zeta - path * (1 + z.delta), z.delta)


def _rotation(yaw: Any, pitch: Any, roll: Any) -> Any:
    """V = Θ Φ Ψ of MAD-X: s is turned towards x by `yaw` and towards y by `pitch`, x towards y by
    `roll`, which acts first."""
    (c, C, k), (s, S, n) = ([f(angle) for angle in (yaw, pitch, roll)] for f in (jnp.cos, jnp.sin))
    rows = (
        (c * k - s * S * n, -c * n - s * S * k, s * C),
        (C * n, C * k, S),
        (-s * k - c * S * n, s * n - c * S * k, c * C),
    )
    return jnp.stack([jnp.stack(row) for row in rows])


def _arc(par: Parameters, s: Any) -> tuple[Any, Any]:
    """Axes, as columns, and origin of the reference frame after a distance s [m] along the arc."""
    half = par.get("h", 0.0) * s / 2
    chord = s * jnp.sinc(half / np.pi)
    c, n = jnp.cos(par.get("tilt", 0.0)), jnp.sin(par.get("tilt", 0.0))
    # The arc bends towards −x of the axes that are tilted by the design.
    radial, across, ahead = jnp.stack([c, n, 0 * c]), jnp.stack([-n, c, 0 * c]), np.eye(3)[2]
    x = jnp.cos(2 * half) * radial + jnp.sin(2 * half) * ahead
    z = jnp.cos(2 * half) * ahead - jnp.sin(2 * half) * radial
    axes = jnp.outer(x, radial) + jnp.outer(across, across) + jnp.outer(z, ahead)
    return axes, chord * (jnp.cos(half) * ahead - jnp.sin(half) * radial)
