r"""Elliptic integrals and functions of Jacobi, by the arithmetic-geometric mean, as JAX arrays.

The parameter is m = k², 0 ≤ m < 1. All broadcast, to about 1e-15 where u and φ are not large.
**Source** Abramowitz & Stegun 1964, 16.4 and 17.6.
"""

import jax.numpy as jnp

_PASSES = 8
"""a_n and b_n agree to double precision after 7 passes up to m = 1 − 1e-15."""


def _means(m):
    """a_n, b_n, c_n for n = 0 … `_PASSES`."""
    a, b, c = jnp.ones_like(m), jnp.sqrt(1 - m), jnp.sqrt(m)
    table = [(a, b, c)]
    for _ in range(_PASSES):
        a, b, c = (a + b) / 2, jnp.sqrt(a * b), (a - b) / 2
        table.append((a, b, c))
    return table


def complete(m):
    """K(m) and E(m), the complete integrals of the first and second kind."""
    table = _means(jnp.asarray(m))
    K = jnp.pi / (2 * table[-1][0])
    # c_0² = m as it is: the slope of √m is infinite at 0
    lost = m / 2 + sum(2.0 ** (n - 1) * c**2 for n, (_, _, c) in enumerate(table) if n)
    return K, K * (1 - lost)


def first_kind(phi, m):
    """F(φ|m) = ∫_0^φ dθ/√(1 − m sin²θ), for every φ."""
    phi, m = jnp.asarray(phi), jnp.asarray(m)
    table = _means(m)
    for a, b, _ in table[:-1]:
        # atan((b/a) tan φ) on the branch that φ is on
        turns = jnp.round(phi / jnp.pi)
        rest = phi - jnp.pi * turns
        phi = phi + jnp.pi * turns + jnp.arctan2(b * jnp.sin(rest), a * jnp.cos(rest))
    return phi / (2.0**_PASSES * table[-1][0])


def jacobi(u, m):
    """sn(u|m), cn(u|m), dn(u|m) and the amplitude am(u|m) [rad], which grows with u."""
    u, m = jnp.asarray(u), jnp.asarray(m)
    table = _means(m)
    # Reduced to |u| ≤ K: 2^n a u would carry n bits of the rounding of u into the sine.
    K = jnp.pi / (2 * table[-1][0])
    turns = jnp.round(u / (2 * K))
    phi = 2.0**_PASSES * table[-1][0] * (u - 2 * K * turns)
    for a, _, c in reversed(table[1:]):
        phi = (phi + jnp.arcsin(c / a * jnp.sin(phi))) / 2
    sign = jnp.where(turns % 2 == 0, 1.0, -1.0)
    sn = sign * jnp.sin(phi)
    return sn, sign * jnp.cos(phi), jnp.sqrt(1 - m * sn**2), phi + jnp.pi * turns
