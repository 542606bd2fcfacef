"""Averaged drift laws of leading-order terms that have no invariant of higher order."""

from typing import NamedTuple

import numpy as np

from ...base.printing import printable
from ..algebra.block_triangular import TruncatedSVD, larger_than
from ..algebra.echelon import reduced_echelon
from ..algebra.nullspace import RANK, orthonormal_range
from ..algebra.weighing import of_orthonormal
from ..functions.basis import linear_text
from ..functions.families import power_text
from .search import NullSpaces
from .series import short_text

EXPLANATION = 1e-6  # A law is reported when it leaves less of the drift unexplained
_FORMULA_TERMS = 12  # Terms of a formula in a law
_DEGREE = 4  # A law is sought as a polynomial of the leading-order term up to this degree
_POWERS = ("1", *(power_text("I", k) for k in range(1, _DEGREE + 1)))


@printable
class DriftLaw(NamedTuple):
    """The averaged drift of a leading-order invariant I without a correction at some order.

    D(I) per step is ε^order times ``formula``, a function of what order 0 conserves.

    - `leading`: I as text; `leading_coefficients`, `coefficients`: of I and of the law.
    - `residual`: the share of the drift that the law does not explain.
    - `kind`: "dissipation" (the perturbation changes phase volume, as fast as I to 1e-4 or more),
      "slow time" (it does not, and the system changes with the slow time), "resonance" (neither,
      and the average over the unperturbed motion is not zero), or "unexplained": the drift is not
      a function of what order 0 conserves in this basis, which may be too small.
    - `powers`: a where the law is Σ_k a_k I^k, k from 0, when it is one; else empty.
    - `rest`: the fixed points I > 0 of that law (limit cycles).
    """

    order: int
    leading: str
    formula: str
    leading_coefficients: np.ndarray
    coefficients: np.ndarray
    residual: float
    kind: str
    powers: np.ndarray
    rest: np.ndarray

    def __str__(self) -> str:
        cause = "resonance or secular drift" if self.kind == "resonance" else self.kind
        head = f"lost at order {self.order} ({cause}): I = {self.leading}"
        if self.kind == "unexplained":
            drift = "its drift is not a function of what order 0 conserves in this basis"
            return f"{head}\n      {drift}"
        power = "ε" if self.order == 1 else f"ε^{self.order}"
        text = f"{head}\n      on average it changes by {power} ({self.formula}) in a step"
        if len(self.powers):
            text += f"\n      = {power} ({linear_text(self.powers, _POWERS[: len(self.powers)])})"
        if len(self.rest):
            text += f", at rest at I = {', '.join(f'{point:.4g}' for point in self.rest)}"
        return text


def drift_laws(null: NullSpaces, volume: np.ndarray, slow_time: bool, blur: float):
    """A `DriftLaw` for each of the leading-order terms that are lost at order 1, 2, ….

    For a series c that is invariant up to order m − 1 the condition of order m,
    Σ_k A_{m−k} c_k + A_0 c_m = 0, has no solution c_m; with a function of what order 0 conserves
    on the right it may: = φ·K d, K the null space of A_0. That is the averaged law.

    - `null`: the series. `volume`: how much phase volume changes at each order in ε · scale.
      `slow_time`: of the system. `blur`: see `Span`.
    """
    basis, rms, R, scale = null.basis, null.conditions.rms, null.conditions.R, null.conditions.scale
    spaces, values, terms = null.spaces, null.of_fit.values, null.rows
    kernel, size = spaces[0].leading, basis.size
    if kernel.shape[1] == 0:
        return ()
    functions = of_orthonormal(values, rms, R) @ kernel
    system = np.concatenate([-terms[:, 0], null.weights[:, None] * functions], axis=1)
    solver = TruncatedSVD.factor(system, larger_than(1e-10))

    def text(coefficients, shares):
        drop = max(0.1 * EXPLANATION, blur**2)
        return short_text(basis, coefficients, np.abs(shares), _FORMULA_TERMS, drop)

    laws = []
    for m in range(1, len(spaces)):
        lower = np.concatenate([spaces[m - 1].leading, spaces[m - 1].shifts], axis=1)
        alive, survivors = spaces[m - 1].leading[:size], spaces[m].leading[:size]
        drifts = terms[:, m:0:-1].reshape(len(terms), m * size) @ lower
        for shares in _without_correction(basis, R, alive, orthonormal_range(survivors), blur):
            c = shares / rms
            normal = 1 / (2 * c[np.argmax(np.abs(shares))])
            shares, c = shares * normal, c * normal
            drift = drifts @ np.linalg.lstsq(lower[:size], R @ shares, rcond=blur)[0]
            solution = solver.solve(drift[:, None])[:, 0]
            rate = max(np.linalg.norm(drift), np.finfo(float).tiny)
            residual = float(np.linalg.norm(system @ solution - drift) / rate)
            law = np.linalg.solve(R, kernel @ solution[size:]) / rms * scale**m
            is_explained = residual < max(EXPLANATION, blur)
            powers = _own_powers(values @ c, values @ law) if is_explained else np.zeros(0)
            dissipates = np.max(volume[1 : m + 1]) * np.linalg.norm(values @ c) > 1e-4 * rate
            kind = "dissipation" if dissipates else "slow time" if slow_time else "resonance"
            laws.append(
                DriftLaw(
                    order=m,
                    leading=text(c, shares),
                    formula=text(law, law * rms),
                    leading_coefficients=c,
                    coefficients=law,
                    residual=residual,
                    kind=kind if is_explained else "unexplained",
                    powers=powers,
                    rest=_zeros(powers, np.max(np.abs(values @ c))),
                )
            )
    return tuple(laws)


def _without_correction(basis, R, alive, survivors, blur) -> list[np.ndarray]:
    """The simplest of the leading-order terms `alive` that are outside of `survivors`."""
    count = alive.shape[1] - survivors.shape[1]
    candidates = reduced_echelon(np.linalg.solve(R, alive), np.array(basis.complexity), blur).T
    span, terms = survivors, []
    for threshold in (max(blur, 1e-4), RANK):  # what is clearly outside before what hardly is
        for c in candidates:
            leading = R @ c / np.linalg.norm(R @ c)
            remainder = leading - span @ (span.T @ leading)
            if len(terms) < count and np.linalg.norm(remainder) > threshold:
                span = np.column_stack([span, remainder / np.linalg.norm(remainder)])
                terms.append(c)
    return terms


def _own_powers(leading: np.ndarray, law: np.ndarray) -> np.ndarray:
    """a with law = Σ_k a_k I^k on the samples, of the lowest degree; empty without such a law."""
    scale = np.max(np.abs(leading))
    for degree in range(1, _DEGREE + 1):
        columns = (leading[:, None] / scale) ** np.arange(degree + 1)
        a = np.linalg.lstsq(columns, law, rcond=None)[0]
        if np.linalg.norm(columns @ a - law) <= EXPLANATION * np.linalg.norm(law):
            a[np.abs(a) < EXPLANATION * np.max(np.abs(a))] = 0.0
            return a / scale ** np.arange(degree + 1)
    return np.zeros(0)


def _zeros(powers: np.ndarray, largest: float) -> np.ndarray:
    """Positive zeros of the polynomial, not far outside what was sampled."""
    if len(powers) < 2:
        return np.zeros(0)
    roots = np.roots(powers[::-1])
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1)].real
    return np.sort(real[(real > 1e-9 * largest) & (real < 100 * largest)])
