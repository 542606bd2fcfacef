r"""Elliptic integrals and functions of Jacobi as JAX arrays.

The parameter is m = k², 0 ≤ m ≤ 1: K, F and the functions by the arithmetic-geometric mean, Π by
Carlson's duplication. All broadcast, to about 1e-15 where u and φ are not large and m is below
1 − 1e-15. Derivatives in u, φ, n and m are those of the integrals, for m < 1 (m = 0 too).
**Source** Abramowitz & Stegun 1964, 16.4 and 17.6; Carlson 1995, *Numer. Algorithms* 10, 13.
"""

import jax.numpy as jnp
from jax import lax

_PASSES = 8
"""a_n and b_n agree to double precision after 7 passes up to m = 1 − 1e-15."""

_DUPLICATIONS = 30
"""They bring arguments as far apart as 1 and 1e14 together to 1e-3, where the series begins."""


def _means(m):
    """a_n, b_n for n = 0 … `_PASSES` − 1, stacked, and the mean."""

    def better(means, _):
        a, b = means
        return ((a + b) / 2, jnp.sqrt(a * b)), means

    (mean, _), table = lax.scan(better, (jnp.ones_like(m), jnp.sqrt(1 - m)), None, _PASSES)
    return table, mean


def _complete(m):
    """K(m), where m < 1, and Σ_{n>0} 2^(n−1) c_n², with c_0² = m left out: E = K (1 − m/2 − Σ)."""
    (a, b), mean = _means(m)
    # c_n is half the difference of the pass before
    tail = sum(2.0 ** (n - 1) * ((a[n - 1] - b[n - 1]) / 2) ** 2 for n in range(1, _PASSES))
    return jnp.pi / (2 * mean), tail


def complete(m):
    """K(m) and E(m), the complete integrals of the first and second kind.

    At m = 1 they are ∞ and 1, beyond it NaN.
    """
    m = jnp.asarray(m)
    K, tail = _complete(m)
    end = jnp.where(m == 1, jnp.inf, jnp.nan)
    E = jnp.where(m < 1, K * (1 - m / 2 - tail), jnp.where(m == 1, 1.0, jnp.nan))
    return jnp.where(m < 1, K, end), E


def swing(m):
    """E(m) − (1 − m) K(m), to the last digits for small m too; 1 at m = 1, beyond it NaN."""
    m = jnp.asarray(m)
    K, tail = _complete(m)
    return jnp.where(m < 1, K * (m / 2 - tail), jnp.where(m == 1, 1.0, jnp.nan))


def first_kind(phi, m):
    """F(φ|m) = ∫_0^φ dθ/√(1 − m sin²θ), for every φ."""
    phi, m = jnp.broadcast_arrays(jnp.asarray(phi), jnp.asarray(m))
    (a, b), mean = _means(m)

    def double(phi, means):
        # φ + atan((b/a) tan φ) on the branch that φ is on
        a, b = means
        turns = jnp.round(phi / jnp.pi)
        angle = phi - jnp.pi * turns
        return phi + jnp.pi * turns + jnp.arctan2(b * jnp.sin(angle), a * jnp.cos(angle)), None

    return lax.scan(double, phi, (a, b))[0] / (2.0**_PASSES * mean)


def third_kind(phi, complement, m):
    """Π(n; φ|m) = ∫_0^φ dθ/((1 − n sin²θ) √(1 − m sin²θ)), for every φ and n ≤ 1.

    - `complement`: 1 − n > 0, which is what is small where the integrand has its peaks.
    """
    phi, complement, m = jnp.broadcast_arrays(*map(jnp.asarray, (phi, complement, m)))
    turns = jnp.round(phi / jnp.pi)

    def difference(s, c):
        """Beyond F, for a φ between −π/2 and π/2 of this sine and cosine."""
        weight = c**2 + complement * s**2
        three = _third(c**2, c**2 + (1 - m) * s**2, jnp.ones_like(c), weight)
        return (1 - complement) / 3 * s**3 * three

    angle = phi - jnp.pi * turns
    quarter = difference(jnp.ones_like(phi), jnp.zeros_like(phi))
    return first_kind(phi, m) + 2 * turns * quarter + difference(jnp.sin(angle), jnp.cos(angle))


def _third(x, y, z, p):
    """Carlson's R_J(x, y, z, p) for x, y, z ≥ 0, one of them 0 at most, and p ≥ x, (p−y)(p−z) ≥ 0.

    As it is for Π with n ≤ 0 and with m ≤ n < 1.
    """

    def duplicate(state, _):
        x, y, z, p, total, quarter = state
        a, b, c, r = jnp.sqrt(jnp.where(x > 0, x, 1.0)), *map(jnp.sqrt, (y, z, p))
        a = jnp.where(x > 0, a, 0.0)
        d = (r + a) * (r + b) * (r + c)
        e = (p - x) / (r + a) ** 2 * ((p - y) / (r + b) ** 2) * ((p - z) / (r + c) ** 2)
        shift = a * b + a * c + b * c
        total = total + 6 * quarter / d * _arc(e)
        x, y, z, p = ((v + shift) / 4 for v in (x, y, z, p))
        return (x, y, z, p, total, quarter / 4), None

    state = (x, y, z, p, jnp.zeros_like(p), jnp.ones_like(p))
    (x, y, z, p, total, quarter), _ = lax.scan(duplicate, state, None, _DUPLICATIONS)
    mean = (x + y + z + 2 * p) / 5
    X, Y, Z = ((mean - v) / mean for v in (x, y, z))
    P = -(X + Y + Z) / 2
    two, three = X * Y + X * Z + Y * Z - 3 * P**2, X * Y * Z
    three = three + 2 * two * P + 4 * P**3
    return quarter / mean**1.5 * (1 - 3 * two / 14 + three / 6) + total


def _arc(e):
    """atan(√e)/√e for e > −1e-3."""
    small = e < 1e-3
    root = jnp.sqrt(jnp.where(small, 1.0, e))
    series = 1 - e * (1 / 3 - e * (1 / 5 - e * (1 / 7 - e * (1 / 9 - e / 11))))
    return jnp.where(small, series, jnp.arctan(root) / root)


def jacobi(u, m):
    """sn(u|m), cn(u|m), dn(u|m) and the amplitude am(u|m) [rad], which grows with u."""
    u, m = jnp.broadcast_arrays(jnp.asarray(u), jnp.asarray(m))
    (a, b), mean = _means(m)
    # Reduced to |u| ≤ K: 2^n a u would carry n bits of the rounding of u into the sine.
    K = jnp.pi / (2 * mean)
    turns = jnp.round(u / (2 * K))

    def halve(phi, means):
        a, b = means  # of the pass before: c = (a − b)/2 belongs to their mean
        return (phi + jnp.arcsin((a - b) / (a + b) * jnp.sin(phi))) / 2, None

    phi, _ = lax.scan(halve, 2.0**_PASSES * mean * (u - 2 * K * turns), (a, b), reverse=True)
    sign = jnp.where(turns % 2 == 0, 1.0, -1.0)
    sn, cn = sign * jnp.sin(phi), sign * jnp.cos(phi)
    return sn, cn, jnp.sqrt(cn**2 + (1 - m) * sn**2), phi + jnp.pi * turns
