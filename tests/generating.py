"""The generating function of an exact flow by the Hamilton–Jacobi recursion: a reference."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dvi_jax.base.types import Args, Scalar, State
from dvi_jax.discover.algebra.taylor import taylor_coefficients


def generating_terms(
    hamiltonian: Callable[..., Any], order: int, t0: Scalar, q: State, P: State, args: Args = None
) -> Float[Array, " order"]:
    r"""The terms G_1, …, G_order of the type II generating function of an exact flow.

        S(q, P; t0, s) = q·P + Σ_j s^j G_j(t0, q, P),    p = ∂S/∂q,    Q = ∂S/∂P

    takes (q, p) at t0 to (Q, P) at t0 + s. The Hamilton–Jacobi equation
    ∂S/∂s = H(t0 + s, ∂S/∂P, P) gives one term after the other:

        j G_j = [s^{j−1}] H(t0 + s, q + Σ_{i<j} s^i ∂G_i/∂P, P)

    so that G_1 = H and G_2 = (∂H/∂t + ∂H/∂q·∂H/∂p)/2. As a discrete Hamiltonian the exact flow is
    Σ_j h^{j−1} G_j(t0, q0, p1); its first r terms define a map of order r.

    **Arguments**

    - `hamiltonian`: H, smooth function ``(t, q, p, args)`` → scalar [energy].
    - `order`: how many terms, at least 1.
    - `t0`: scalar; `q`, `P`: arrays of one shape.

    **Returns** shape (order,); G_j in [energy / time^{j−1}].

    **Accuracy** round-off. Forward over reverse mode, nested: the work, and the time to compile,
    grow three- to fourfold with each order. Gradients in all inputs.

    **Source** Hairer, Lubich & Wanner 2006, *Geometric Numerical Integration*, VI.5 (there with
    the generating function of another type).
    """
    if order == 1:
        return jnp.asarray(hamiltonian(t0, q, P, args), P.dtype)[None]

    def lower_terms(P):
        terms = generating_terms(hamiltonian, order - 1, t0, q, P, args)
        return terms, terms

    slopes, terms = jax.jacrev(lower_terms, has_aux=True)(P)

    def rate(s):
        Q = q + sum(s**i * slopes[i - 1] for i in range(1, order))
        return jnp.asarray(hamiltonian(t0 + s, Q, P, args), P.dtype)

    last = taylor_coefficients(rate, jnp.zeros((), P.dtype), order - 1)[-1] / order
    return jnp.append(terms, last)
