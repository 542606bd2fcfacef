"""A series in ε of combinations of basis functions: what discovery returns, as an observable."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.printing import printable
from ...base.types import Scalar, State
from ...problem.system import System
from ..functions.basis import BoundBasis
from ..functions.families import power_text
from ..functions.generators import Generator, require_bound, symplectic_gradient
from .digits import closed_form, digits_of

_DROP = 1e-9  # Formulas leave out terms below this share of the largest


@printable
class InvariantSeries(eqx.Module):
    r"""An invariant Σ_m ε^m c_m·φ(q, p, t), as an observable.

    - `coefficients`: c, shape (order + 1, basis size). `basis`: φ.
    - `slow_time`: whether φ is a function of the slow time τ = εt in place of t.
    - `sizes`: size of each basis function on the samples of the search, shape of `coefficients`.
      The formula leaves out terms that are small on the samples. None: equal sizes.
    - `errors`: estimated errors of `coefficients`, same shape. The formula has only the digits that
      they allow. None: unknown.

    Pass it to `integrate` in ``observe=``; the run supplies its ε. `str` gives the formula, and
    ``evaluate(q, p, epsilon)`` the value at one state.
    """

    basis: BoundBasis
    coefficients: Float[Array, "orders functions"]
    slow_time: bool = eqx.field(static=True, default=False)
    epsilon: Any = None
    sizes: Any = None
    errors: Any = None

    @property
    def order(self) -> int:
        """z, the order up to which the series goes."""
        return self.coefficients.shape[0] - 1

    def bind(self, system: System, epsilon: Any) -> "InvariantSeries":
        """The same series at this ε."""
        del system
        return replace(self, epsilon=epsilon)

    def evaluate(self, q: State, p: State, epsilon: Any, t: Any = 0.0) -> Scalar:
        """The value at a point, a scalar; t is the slow time τ when `slow_time` is set."""
        powers = jnp.asarray(epsilon) ** jnp.arange(self.order + 1)
        return powers @ self.coefficients @ self.basis(q, p, t)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        require_bound(self, "value of ε", self.epsilon)
        time = self.epsilon * t1 if self.slow_time else t1
        return self.evaluate(q1, p1, self.epsilon, time)

    @property
    def generators(self) -> list[Generator]:
        r"""The symplectic gradient, one generator for each order: ξ_m = ∂I_m/∂p, η_m = −∂I_m/∂q.

        The converse of Noether's theorem. Where the map is symplectic (no force but a gradient),
        the series of an invariant satisfies the determining equations (24) on the solutions, to
        the order of the invariant: see `determining_residual`. **Raises** `ValueError` for
        functions of the slow time.
        """
        if self.slow_time and self.basis.uses_time:
            raise ValueError(
                "generators require functions of q and p, but this basis has functions of the slow "
                "time εt: search without them."
            )

        def generator(c):
            return symplectic_gradient(lambda t, q, p, args: c @ self.basis(q, p, t))

        return [generator(c) for c in self.coefficients]

    def __str__(self) -> str:
        return self.formula()

    @property
    def recognised(self) -> dict[str, str]:
        """Coefficients that agree to all their digits with a small fraction, or with such a
        multiple of √2, √3, √5, π or 1/π: printed number → closed form. Empty without `errors`.

        A random number is recognised with a probability below 1e-3.
        """
        if self.errors is None:
            return {}
        c, errors = np.asarray(self.coefficients), np.asarray(self.errors)
        forms = {}
        for m, j in np.argwhere(self._shares() > _DROP * np.max(self._shares())):
            value, error = float(abs(c[m, j])), float(errors[m, j])
            if error > 0 and (text := closed_form(value, error)):
                forms[f"{value:.{digits_of(c[m, j], errors[m, j])}g}"] = text
        return forms

    def _shares(self) -> np.ndarray:
        c = np.asarray(self.coefficients)
        return np.abs(c if self.sizes is None else c * np.asarray(self.sizes))

    def formula(self, terms: int | None = None, drop: float = _DROP, digits: int = 6) -> str:
        """The series as text: at each order at most so many terms, all above a fraction `drop`,
        with at most so many digits, and no more than their errors leave.

        The number of terms left out is printed, unless they are round-off.
        """
        c, shares = np.asarray(self.coefficients), self._shares()
        precision = digits_of(c, None if self.errors is None else np.asarray(self.errors), digits)
        return in_powers_of_epsilon(
            short_text(self.basis, block, share, terms, drop, block_digits)
            if m == 0 or np.max(share) > _DROP * np.max(shares)
            else ""
            for m, (block, share, block_digits) in enumerate(zip(c, shares, precision, strict=True))
        )


def in_powers_of_epsilon(texts: Iterable[str]) -> str:
    """c_0 + ε (c_1) + … from the texts of the orders; empty ones are left out."""
    parts = enumerate(texts)
    return " + ".join(f"{power_text('ε', m)} ({x})" if m else x for m, x in parts if x) or "0"


def short_text(
    basis: BoundBasis,
    c: np.ndarray,
    shares: np.ndarray,
    terms: int | None = None,
    drop: float = _DROP,
    digits: int | np.ndarray = 6,
) -> str:
    """The combination as text: at most so many terms, all above the share `drop` of the largest."""
    terms_in_text = np.where(shares > drop * np.max(shares), c, 0.0)
    if terms is not None:
        terms_in_text[np.argsort(-shares, kind="stable")[terms:]] = 0.0
    text = basis.formula(terms_in_text, digits, drop=0.0)
    omissions = np.sum(shares > drop * np.max(shares)) - np.count_nonzero(terms_in_text)
    return f"{text} + … ({omissions} smaller terms)" if omissions else text
