"""Why a leading part has no invariant of higher order: the averaged law of its drift."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .basis import BoundBasis
from .echelon import reduced
from .null_series import SeriesSpace
from .nullspace import RANK, orthonormal_range
from .series import shortened

EXPLAINED = 1e-6
"""A drift law is told when it leaves less than this share of the drift unexplained."""

_SHOWN = 12
"""Terms of a formula in a law."""

_DEGREE = 4
"""A law is looked for as a polynomial of the leading part itself up to this degree."""


class DriftLaw(NamedTuple):
    """Why a leading part I does not go on to an order: how I drifts on average.

    D(I) per step is ε^order times ``formula``, a function of what order 0 keeps.

    - `leading`: I as text; `leading_coefficients`, `coefficients`: of I and of the law.
    - `residual`: the share of the drift that the law leaves unexplained.
    - `kind`: "dissipation" (the disturbance changes phase volume, as fast as I to 1e-4 or more),
      "slow time" (it does not, and the system changes with the slow time), "resonance" (neither,
      and still the average over the undisturbed motion is not zero), or "unexplained": the
      drift is no function of what order 0 keeps in this basis, which may be too small.
    - `powers`: a where the law is Σ_k a_k I^k, k from 0, when it is one; else empty.
    - `rest`: the values I > 0 at which that law vanishes: where the amplitude stands still.
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
        head = f"lost at order {self.order} ({self.kind}): I = {self.leading}"
        if self.kind == "unexplained":
            return f"{head}\n      its drift is no function of what order 0 keeps in this basis"
        power = "ε" if self.order == 1 else f"ε^{self.order}"
        text = f"{head}\n      on average it changes by {power} ({self.formula}) in a step"
        if len(self.powers):
            text += f"\n      = {power} ({_polynomial(self.powers)})"
        if len(self.rest):
            text += f", at rest at I = {', '.join(f'{x:.4g}' for x in self.rest)}"
        return text


def drift_laws(
    basis: BoundBasis,
    rms: np.ndarray,
    R: np.ndarray,
    terms: np.ndarray,
    values: np.ndarray,
    weights: np.ndarray,
    spaces: Sequence[SeriesSpace],
    volume: np.ndarray,
    scale: float,
    slow_time: bool,
    blur: float,
) -> tuple[DriftLaw, ...]:
    """The laws of all leading parts that are lost at order 1, 2, ….

    For a series c that is invariant up to order m − 1 the condition of order m,
    Σ_k A_{m−k} c_k + A_0 c_m = 0, has no solution c_m; with a function of what order 0 keeps on
    the right it may: = φ·K d, K the null space of A_0. That is the averaged law.

    `terms`: A in the orthonormal basis, shape (rows, z + 1, size), times the `weights` of rows,
    shape (rows, 1); `values`: φ there, shape (rows, size);
    `rms`: their sizes; `R`: see `Span`; `spaces`: of order 0, 1, …; `volume`: per order,
    how much phase volume changes; `scale`: the unit of ε, in which all this is; `slow_time`: of
    the system.
    """
    if spaces[0].leading.shape[1] == 0:
        return ()
    laws = []
    orthonormal = np.linalg.solve(R.T, (values / rms).T).T
    kept = spaces[0].leading
    system = np.concatenate([-terms[:, 0], weights * orthonormal @ kept], axis=1)
    size, allowed = basis.size, max(EXPLAINED, blur)
    for m in range(1, len(spaces)):
        before = np.concatenate([spaces[m - 1].leading, spaces[m - 1].shifts], axis=1)
        alive, through = spaces[m - 1].leading[:size], spaces[m].leading[:size]
        drifts = terms[:, m:0:-1].reshape(len(terms), m * size) @ before
        for shares in _lost(basis, R, alive, orthonormal_range(through), blur):
            c = shares / rms
            normal = 1 / (2 * c[np.argmax(np.abs(shares))])
            shares, c = shares * normal, c * normal
            series = np.linalg.lstsq(before[:size], R @ shares, rcond=blur)[0]
            drift = drifts @ series
            solution = np.linalg.lstsq(system, drift, rcond=1e-10)[0]
            rate = max(np.linalg.norm(drift), np.finfo(float).tiny)
            left = float(np.linalg.norm(system @ solution - drift) / rate)
            law = np.linalg.solve(R, kept @ solution[size:]) / rms * scale**m
            explained = left < allowed
            powers = _own_powers(values @ c, values @ law) if explained else np.zeros(0)
            dissipates = np.max(volume[1 : m + 1]) * np.linalg.norm(values @ c) > 1e-4 * rate
            laws.append(
                DriftLaw(
                    m,
                    shortened(basis, c, np.abs(shares), _SHOWN, max(1e-9, blur**2)),
                    shortened(basis, law, np.abs(law * rms), _SHOWN, max(1e-9, blur**2)),
                    c,
                    law,
                    left,
                    _kind(explained, bool(dissipates), slow_time),
                    powers,
                    _zeros(powers, np.max(np.abs(values @ c))),
                )
            )
    return tuple(laws)


def _lost(basis, R, alive, through, blur) -> list[np.ndarray]:
    """The simplest of the leading parts `alive` that are outside of `through`."""
    count = alive.shape[1] - through.shape[1]
    candidates = reduced(np.linalg.solve(R, alive), np.array(basis.complexity), blur).T
    taken, lost = through, []
    for clear in (max(blur, 1e-4), RANK):  # what is clearly outside before what hardly is
        for c in candidates:
            leading = R @ c / np.linalg.norm(R @ c)
            rest = leading - taken @ (taken.T @ leading)
            if len(lost) < count and np.linalg.norm(rest) > clear:
                taken = np.column_stack([taken, rest / np.linalg.norm(rest)])
                lost.append(c)
    return lost


def _kind(explained: bool, dissipates: bool, slow_time: bool) -> str:
    if not explained:
        return "unexplained"
    if dissipates:
        return "dissipation"
    return "slow time" if slow_time else "resonance"


def _own_powers(leading: np.ndarray, law: np.ndarray) -> np.ndarray:
    """a with law = Σ_k a_k I^k on the samples, of the lowest degree; empty when there is none."""
    scale = np.max(np.abs(leading))
    for degree in range(1, _DEGREE + 1):
        columns = (leading[:, None] / scale) ** np.arange(degree + 1)
        a = np.linalg.lstsq(columns, law, rcond=None)[0]
        if np.linalg.norm(columns @ a - law) <= EXPLAINED * np.linalg.norm(law):
            a[np.abs(a) < EXPLAINED * np.max(np.abs(a))] = 0.0
            return a / scale ** np.arange(degree + 1)
    return np.zeros(0)


def _zeros(powers: np.ndarray, largest: float) -> np.ndarray:
    """Positive zeros of the polynomial, not far outside what was sampled."""
    if len(powers) < 2:
        return np.zeros(0)
    roots = np.roots(powers[::-1])
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1)].real
    return np.sort(real[(real > 1e-9 * largest) & (real < 100 * largest)])


def _polynomial(powers: np.ndarray) -> str:
    names = ["1", "I", "I²", "I³", "I⁴"]
    present = [(a, n) for a, n in zip(powers, names, strict=False) if a != 0]
    words = [
        f"{'−' if a < 0 else '+'} {abs(a):.6g}{'' if n == '1' else ' ' + n}" for a, n in present
    ]
    text = " ".join(words) or "0"
    return "−" + text[2:] if text.startswith("−") else text.removeprefix("+ ")
