"""Multipoles of magnets about a displaced orbit."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.checks import array, instance
from ...base.inputs import real_numbers
from ._losses import Parts, partial_map
from ._maps import Parameters, Particle, forward
from ._optics import FRAMES, SLICED_PARTS, optics
from ._parts import pieces_of
from ._ring import Ring

_MAGNETS = (*SLICED_PARTS, "thin", "second_order_bend")


def feed_down(ring: Ring, orbit: Any = None) -> tuple[Array, Array]:
    r"""The multipoles of each magnet about an orbit, such as the dipole and the skew field of a
    quadrupole that is displaced: b and a of

        B_y + i B_x = Σ_m (b_m + i a_m)(X + iY)^m,   (b_m + i a_m) = ⟨Σ_n C(n, m) c_n w^{n−m}⟩,

    X and Y the distances from the orbit in axes that are not rolled, c_n = b_n + i a_n of the
    magnet, w = x + iy the orbit in its own frame, and the mean along the orbit in the magnet, so
    that displacements, rolls, and an orbit that crosses at an angle are included. The field that
    bends the reference orbit is not, and neither are the terms of the curvature of exact bends.

    **Arguments** `orbit`: (x, px, y, py, ζ, δ) at the entrance of each element, shape (elements, 6)
    or with one more row; None: the closed orbit of `optics`.

    **Returns** b, a of shape (elements, orders), from the dipole, in the units of the magnet: of
    thin ones integrated over the length, zero for elements that are not magnets. Differentiable by
    the parameters and the orbit. **Raises** `ValueError` for another shape; as `optics`.

    **Example**

    ```python
    ring = rings.Ring([rings.sextupole("S", 0.2, b2=5.0).placed(dx=1e-3, dy=2e-3),
                       rings.drift("D", 1.0)])
    b, a = rings.feed_down(ring, orbit=jnp.zeros((2, 6)))
    print(b[0].round(6), a[0].round(6))
    # [-1.500e-05 -9.999e-03  5.000e+00] [ 2.0000e-05 -1.9999e-02  0.0000e+00]
    ```
    """
    instance("ring", ring, Ring, "a rings.Ring")
    orbit = optics(ring, chromatic=False).orbit if orbit is None else real_numbers("orbit", orbit)
    array("orbit", orbit, (len(ring), 6), (len(ring) + 1, 6))
    groups: dict[Parts, list[int]] = {}
    for i, element in enumerate(ring.elements):
        if "b0" in element.values:
            groups.setdefault(element.parts, []).append(i)
    orders = 1 + max(part.order for part in ring.program.parts)
    result = jnp.zeros((len(ring), orders), complex)
    for parts, members in groups.items():
        table = {key: column[np.asarray(members)] for key, column in ring.columns.items()}
        expand = jax.vmap(functools.partial(_expansion, parts))
        values = expand(table, orbit[np.asarray(members)])
        names = [part.name.removesuffix("_in") for part in parts if part.name.endswith("_in")]
        angle = sum(
            (FRAMES[name](table) for name in names if name in FRAMES), jnp.zeros(len(values))
        )
        turns = jnp.exp(-1j * jnp.outer(angle, jnp.arange(1, values.shape[1] + 1)))
        result = result.at[np.asarray(members), : values.shape[1]].set(values * turns)
    return jnp.real(result), jnp.imag(result)


def _expansion(parts: Parts, par: Parameters, orbit: Array) -> Array:
    """b_m + i a_m about the orbit of a magnet, in its own frame."""
    z, points, weights = Particle(*orbit), *np.polynomial.legendre.leggauss(5)
    number = next(i for i, part in enumerate(parts) if part.name in _MAGNETS)
    for part in parts[:number]:
        z = forward(pieces_of(part), z, par, 0, 1)
    magnet = parts[number]
    if magnet.name == "thin":
        w = (z.x + 1j * z.y)[None]
        weights = np.full(1, 2.0)
    else:
        inner = jax.vmap(lambda share: partial_map(magnet, z, par, 0, share))((1 + points) / 2)
        w = inner.x + 1j * inner.y
    field = [par[f"b{n}"] + 1j * par[f"a{n}"] for n in range(magnet.order + 1)]
    return jnp.stack(
        [
            sum(
                math.comb(n, m) * field[n] * (weights / 2) @ w ** (n - m)
                for n in range(m, len(field))
            )
            for m in range(len(field))
        ]
    )
