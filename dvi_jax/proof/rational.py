"""Exact coefficients: those of a discovered invariant as small rational functions of h."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, instance
from ..base.types import Scalar, State
from ..discover.functions.basis import BoundBasis
from ..discover.invariants.series import InvariantSeries
from .result import tools

_DROP = 1e-9  # Coefficients below this share of the largest are rounding
_ERROR = 1e-12  # Least relative error of a coefficient
_CHANCE = 1e-4  # Largest probability that a random number has such a form


class ExactInvariant(eqx.Module):
    r"""An invariant Σ_m ε^m Σ_j c_mj φ_j(q, p, t) with exact c = (n_0 + n_1 h + n_2 h²)/d.

    - `basis`: φ. `numbers`: the integers (d, n_0, n_1, n_2), shape (order + 1, functions, 4).

    Give it to `bound_drift`, which proves that it is conserved exactly, or how little it changes.
    """

    basis: BoundBasis
    numbers: np.ndarray = eqx.field(converter=np.asarray)

    def evaluate(self, q: State, p: State, epsilon: Any, h: Any, t: Any = 0.0) -> Scalar:
        """The value at a point, a scalar."""
        values, total = self.basis(q, p, t), jnp.zeros(())
        for m, row in enumerate(self.numbers):
            for j in np.flatnonzero(row[:, 1:].any(axis=1)):
                d, *n = (float(x) for x in row[j])
                total = total + epsilon**m * (n[0] + n[1] * h + n[2] * h * h) * values[j] / d
        return total

    def __str__(self) -> str:
        parts = []
        for m, row in enumerate(self.numbers):
            for name, (d, *n) in zip(self.basis.names, row, strict=True):
                powers = ["", "h", "h²"]
                terms = [f"{int(k)} {x}".strip() for k, x in zip(n, powers, strict=True) if k]
                if terms:
                    text = " + ".join(terms)
                    text = f"({text})" if len(terms) > 1 else text
                    parts.append(f"{text}{f'/{int(d)}' if d > 1 else ''} {'ε ' * m}{name}")
        return " + ".join(parts).replace("+ -", "− ").replace("-", "−")


def exact_coefficients(invariant: InvariantSeries, h: float) -> ExactInvariant:
    """The coefficients of an invariant, relative to the largest one, as rational functions of h.

    Each ratio c is written as (n_0 + n_1 h + n_2 h²)/d with the smallest integers that agree with
    it within its error, by the reduction of a lattice (Lenstra, Lenstra & Lovász 1982).

    **Arguments** `invariant`: of a `Discovery`. `h`: the step with which it was found.

    **Returns** an `ExactInvariant`. The form is a guess: `bound_drift` proves whether it is
    conserved exactly; then its `per_step` is 0.

    **Raises** `ValueError` if a coefficient has no such form; `ImportError` without python-flint.

    **Example**

    ```python
    oscillator = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))
    found = dvi.discover_invariants(oscillator, dvi.Polynomials(2), order=0, h=0.1, samples=samples)
    exact = dvi.exact_coefficients(found.invariants[0], 0.1)
    bound = dvi.bound_drift(exact, oscillator, h=0.1, epsilon=0.1, domain=np.array([0.5]))
    print(exact, bound.per_step)
    # 1 q² − 1 h q p + 1 p² (0.0,)
    ```
    """
    tools()
    instance("invariant", invariant, InvariantSeries, "an invariant of a Discovery")
    h = finite("h", h)
    c = np.asarray(invariant.coefficients, float)
    largest = np.max(np.abs(c))
    pivot = c.flat[np.flatnonzero(np.abs(c) > 0.999 * largest)[0]]
    ratios = np.where(np.abs(c) > _DROP * largest, c / pivot, 0.0)
    errors = np.zeros_like(c) if invariant.errors is None else np.asarray(invariant.errors, float)
    numbers = np.zeros((*c.shape, 4), int)
    for place, ratio in np.ndenumerate(ratios):
        error = float(max(3 * errors[place] / abs(pivot), _ERROR * abs(ratio)))
        numbers[place] = _relation(ratio, h, error) if ratio else (1, 0, 0, 0)
        if not numbers[place][0]:
            raise ValueError(
                f"the coefficient of ε^{place[0]} {invariant.basis.names[place[1]]} over the "
                f"largest, {ratio:.10g}, has no form (n_0 + n_1 h + n_2 h²)/d at h={h!r}."
            )
    return ExactInvariant(invariant.basis, numbers)


def _relation(ratio: float, h: float, error: float) -> tuple[int, ...]:
    """(d, n_0, n_1, n_2) with d·ratio = n_0 + n_1 h + n_2 h²; zeros if none is small enough."""
    from flint import fmpz_mat  # `tools` has explained how to install it

    columns = [round(x / error) for x in (ratio, -1.0, -h, -h * h)]
    rows = [[int(i == j) for j in range(4)] + [columns[i]] for i in range(4)]
    d, *n, remainder = (int(x) for x in fmpz_mat(rows).lll().tolist()[0])
    # A random number has a form with integers of the size s with a probability of about s⁴ error.
    size = max(map(abs, (d, *n)))
    if not d or abs(remainder) > 4 * size or size**4 * error > _CHANCE:
        return 0, 0, 0, 0
    sign = 1 if d > 0 else -1
    return sign * d, *(sign * x for x in n)
