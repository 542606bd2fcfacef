"""A series in ε of combinations of basis functions: what discovery returns, as an observable."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._system import System
from .._types import Scalar, State
from ..symmetry.basis import BoundBasis
from ..symmetry.generators import Generator

_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class InvariantSeries(eqx.Module):
    r"""An invariant Σ_m ε^m c_m·φ(q, p, t), as an observable.

    - `coefficients`: c, shape (order + 1, basis size). `basis`: φ.
    - `slow_time`: whether φ is a function of the slow time τ = εt in place of t.

    Give it to `integrate` as it is; there it is bound to the run's ε. As a formula: `str`.
    """

    basis: BoundBasis
    coefficients: Float[Array, "orders functions"]
    slow_time: bool = eqx.field(static=True, default=False)
    epsilon: Any = None

    @property
    def order(self) -> int:
        """z, the order up to which the series goes."""
        return self.coefficients.shape[0] - 1

    def bind(self, system: System, epsilon: Any) -> "InvariantSeries":
        """The same series at this ε."""
        del system
        return InvariantSeries(self.basis, self.coefficients, self.slow_time, epsilon)

    def evaluate(self, q: State, p: State, epsilon: Any, t: Any = 0.0) -> Scalar:
        """The value at a point, a scalar; t is the slow time τ when `slow_time` is set."""
        powers = jnp.asarray(epsilon) ** jnp.arange(self.order + 1)
        return powers @ self.coefficients @ self.basis(q, p, t)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        if self.epsilon is None:
            raise ValueError(
                "an InvariantSeries has to know ε: call invariant.bind(system, epsilon)(...), or "
                "give it to dvi.integrate(observe=...)."
            )
        time = self.epsilon * t1 if self.slow_time else t1
        return self.evaluate(q1, p1, self.epsilon, time)

    @property
    def generators(self) -> list[Generator]:
        r"""The symplectic gradient, one generator for each order: ξ_m = ∂I_m/∂p, η_m = −∂I_m/∂q.

        Noether's theorem walked backwards. Where the map is symplectic (no force but a
        gradient), the series of an invariant satisfies the determining equations (24) on the
        solutions, to the order of the invariant: see `determining_residual`. Not to be had for
        functions of the slow time.
        """
        if self.slow_time and self.basis.uses_time:
            raise ValueError(
                "a generator is a function of the time t, and this invariant of the slow time εt."
            )
        return [_symplectic_gradient(self.basis, c) for c in self.coefficients]

    def __str__(self) -> str:
        return self.formula()

    def formula(self, terms: int | None = None, drop: float = 1e-9) -> str:
        """The series as text, with at most so many terms at each order, all above a share `drop`.

        How many are left out is said, unless they are below 1e-9 of the largest.
        """
        c = np.asarray(self.coefficients)
        largest = float(np.max(np.abs(c)))
        text = shortened(self.basis, c[0], terms, drop, largest)
        for m, block in enumerate(c[1:], 1):
            if np.any(np.abs(block) > 1e-9 * largest):
                power = "ε" if m == 1 else f"ε{m}".translate(_POWERS)
                text += f" + {power} ({shortened(self.basis, block, terms, drop, largest)})"
        return text


def shortened(
    basis: BoundBasis,
    c: np.ndarray,
    terms: int | None = None,
    drop: float = 1e-9,
    largest: float | None = None,
) -> str:
    """The combination as text: at most so many terms, all above the share `drop` of `largest`."""
    largest = float(np.max(np.abs(c))) if largest is None else largest
    shown = np.where(np.abs(c) > drop * largest, c, 0.0)
    if terms is not None:
        shown[np.argsort(-np.abs(c), kind="stable")[terms:]] = 0.0
    text = basis.formula(shown)
    hidden = np.sum(np.abs(c) > 1e-9 * largest) - np.count_nonzero(shown)
    return f"{text} + … ({hidden} smaller terms)" if hidden else text


def _symplectic_gradient(basis: BoundBasis, coefficients: Array) -> Generator:
    def value(t, q, p):
        return coefficients @ basis(q, p, t)

    return Generator(
        xi=lambda t, q, p, args: jax.grad(value, argnums=2)(t, q, p),
        eta=lambda t, q, p, args: -jax.grad(value, argnums=1)(t, q, p),
    )
