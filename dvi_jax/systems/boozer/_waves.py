"""Basis of functions in which the momentum of a quasi-symmetric field has corrections in ε."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ...base.checks import instance, whole
from ...discover.functions.basis import AbstractBasis, Basis, BoundBasis
from ...discover.functions.families import Polynomials
from ._field import Field


class _Cosines(eqx.Module):
    m: tuple[int, ...] = eqx.field(static=True)
    n: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q, p, t):
        return jnp.cos(np.array(self.m) * q[0] - np.array(self.n) * q[1])


def _name(m: int, n: int) -> str:
    """Such as "cos(2q1 − 4q2)"."""
    terms = [(m, "q1"), (-n, "q2")]
    parts = [f"{'−' if c < 0 else '+'} {'' if abs(c) == 1 else abs(c)}{v}" for c, v in terms if c]
    text = " ".join(parts)
    return f"cos({text[2:] if text[0] == '+' else '−' + text[2:]})"


class Cosines(AbstractBasis):
    """cos(mθ − nζ) of the coordinates (θ, ζ) = q, for pairs (m, n)."""

    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def for_shape(self, shape):
        m, n = zip(*self.pairs, strict=True)
        names = tuple(_name(i, j) for i, j in self.pairs)
        return BoundBasis(_Cosines(m, n), names, tuple(abs(i) + abs(j) for i, j in self.pairs))


class _Momentum(eqx.Module):
    rate: int = eqx.field(static=True)

    def __call__(self, q, p):
        return p[1] + self.rate * p[0]


def momentum_basis(
    field: Field, degree: int = 3, poloidal: int = 4, toroidal: int = 2
) -> AbstractBasis:
    r"""Functions for `discover_invariants` in (θ, ζ, p_θ, p_ζ), ``coordinates="angles"``.

        P = p_ζ + N h p_θ   and   p_θ^a p_ζ^b cos(mθ − nζ),  a + b ≤ degree,  n = N (k + hm)

    with |m| ≤ poloidal, k ≤ toroidal, without m = k = 0. A field with n = N h m in all modes is
    symmetric under (θ, ζ) → (θ + N h δ, ζ + δ), and its guiding centres conserve P. Further modes
    change P by terms with k ≠ 0. The corrections are cosines if the field has no sine terms and the
    method is symmetric. Other functions of the momenta alone are left out, so that the energy is
    not represented: otherwise any function of it could be added to P.

    - `field`: whose N and h are taken. `degree`: of the polynomials.
    - `poloidal`, `toroidal`: as above. Corrections of order z need z times the k of the modes that
      break the symmetry.

    The polynomials approximate functions with the denominators mι(p) − n: take samples in a small
    region of the momenta, away from resonances, and a `tolerance` (1e-5, for example).

    **Source** the symmetry: Boozer 1983, *Phys. Fluids* 26, 496. The basis: our own.
    """
    instance("field", field, Field, "a Field, such as boozer.precise_qa()")
    M, K = whole("poloidal", poloidal), whole("toroidal", toroidal, 0)
    N, h = field.shape
    # m ≥ 1 for k = 0, since cos(−x) = cos x.
    pairs = [(m, N * (k + h * m)) for k in range(K + 1) for m in range(-M if k else 1, M + 1)]
    powers = Polynomials(degree, ("p1", "p2"), constant=True)
    rate = N * h
    momentum = Basis({f"p2 {'−' if rate < 0 else '+'} {abs(rate)} p1": _Momentum(rate)})
    first = Polynomials(1, ("p2",)) if rate == 0 else momentum
    return first + powers * Cosines(tuple(pairs))
