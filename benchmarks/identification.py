"""Equations identified from the data sets of pysindy's documentation, by pysindy and this package.

    python benchmarks/identification.py [--rows 'Lorenz*'] [--seed 0]

The equations are those of `pysindy.utils`, most initial states and steps those of its examples.
Both packages receive the same noisy values, without their errors, and the same monomials; of the
2000 times of the Lorenz equations `identify` receives every fifth, which takes less time.

- `default`: pysindy as its first example uses it, finite differences and a threshold of 0.1.
- `best`: the best of pysindy with smoothed or plain differences and seven thresholds. It is chosen
  by comparison with the true equations, which is not possible in an application.
- `identify`: this package, without any choice that depends on the truth.

A row has the numbers of missing and of superfluous terms, and the largest relative error of a true
coefficient (100 % for a missing one); for `identify` also the largest error in standard errors.
"""

import argparse
import fnmatch
import itertools
import time
import warnings
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.integrate import solve_ivp

import dvi_jax as dvi

jax.config.update("jax_enable_x64", True)

THRESHOLDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
POWERS = str.maketrans("23456789", "²³⁴⁵⁶⁷⁸⁹")


class Case(NamedTuple):
    """A data set: equations of `pysindy.utils`, their terms, and what was observed."""

    equations: str
    terms: dict[str, float]
    start: tuple[float, ...]
    end: float
    step: float
    noise: float
    degree: int
    segments: int = 0
    every: int = 1


SPRING = {"x1 e1": -0.1, "x2 e1": 2.0, "x1 e2": -2.0, "x2 e2": -0.1}
CUBIC = {"x1³ e1": -0.1, "x2³ e1": 2.0, "x1³ e2": -2.0, "x2³ e2": -0.1}
OSCILLATOR = {"x2 e1": 1.0, "x1 e2": -1.0, "x2 e2": 0.5, "x1² x2 e2": -0.5}
DUFFING = {"x2 e1": 1.0, "x2 e2": -0.2, "x1 e2": -0.05, "x1³ e2": -1.0}
PREDATOR = {"x1 e1": 1.0, "x1 x2 e1": -10.0, "x1 x2 e2": 10.0, "x2 e2": -2.0}
LINEAR = SPRING | {"x3 e3": -0.3}
LORENZ = {
    **{"x1 e1": -10.0, "x2 e1": 10.0, "x1 e2": 28.0, "x2 e2": -1.0, "x1 x3 e2": -1.0},
    **{"x1 x2 e3": 1.0, "x3 e3": -2.66667},
}
CASES = {
    "Linear, 2D": Case("linear_damped_SHO", SPRING, (2.0, 0.0), 10, 0.01, 0.1, 2),
    "Linear, 3D": Case("linear_3D", LINEAR, (2.0, 0.0, 1.0), 10, 0.01, 0.02, 2),
    "Cubic, 2D": Case("cubic_damped_SHO", CUBIC, (2.0, 0.0), 10, 0.01, 0.05, 3),
    "Van der Pol": Case("van_der_pol", OSCILLATOR, (2.0, 0.0), 20, 0.05, 0.05, 3),
    "Duffing": Case("duffing", DUFFING, (2.0, 0.0), 20, 0.05, 0.05, 3),
    "Lotka–Volterra": Case("lotka", PREDATOR, (0.5, 0.1), 10, 0.02, 0.01, 2),
    "Lorenz": Case("lorenz", LORENZ, (-8.0, 8.0, 27.0), 4, 0.002, 0.1, 2, 10, 5),
}


def observed(case: Case, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times, and noisy states at them."""
    import pysindy.utils

    ts = np.arange(0, case.end, case.step)
    options = {"method": "LSODA", "rtol": 1e-12, "atol": 1e-12, "t_eval": ts}
    field = getattr(pysindy.utils, case.equations)
    states = solve_ivp(field, (0, case.end), case.start, **options).y.T
    return ts, states + case.noise * np.random.default_rng(seed).normal(size=states.shape)


def by_pysindy(case: Case, states: np.ndarray, threshold: float, smooth: bool) -> dict[str, float]:
    """The terms that pysindy finds, by the names of this package."""
    import pysindy as ps

    differences = ps.SmoothedFiniteDifference() if smooth else ps.FiniteDifference()
    model = ps.SINDy(
        optimizer=ps.STLSQ(threshold=threshold),
        feature_library=ps.PolynomialLibrary(degree=case.degree),
        differentiation_method=differences,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of thresholds that remove all terms
        model.fit(states, t=case.step)
    terms = {}
    for k, row in enumerate(model.coefficients()):
        for name, value in zip(model.get_feature_names(), row, strict=True):
            if value:
                terms[f"{in_our_words(name)} e{k + 1}"] = float(value)
    return terms


def in_our_words(name: str) -> str:
    """``x0^2 x1`` as ``x1² x2``."""
    factors = [factor.partition("^") for factor in name.split() if factor != "1"]
    words = [f"x{int(base[1:]) + 1}{power.translate(POWERS)}" for base, _, power in factors]
    return " ".join(words) or "1"


def by_identify(case: Case, ts: np.ndarray, states: np.ndarray) -> dvi.Identification:
    """The terms that this package finds, with their standard errors."""
    library = dvi.ForceLibrary.monomials(case.degree, len(case.start), "x", constant=True)
    model = dvi.Model.first_order(h=case.step * case.every)
    shooting: Any = dvi.SingleShooting()
    if case.segments:
        shooting = dvi.MultipleShooting(case.segments)
    data = dvi.Observations(ts[:: case.every], states[:: case.every])
    return dvi.identify(model, data, library, shooting=shooting, progress=False, throw=False)


def score(case: Case, terms: dict[str, float]) -> tuple[int, int, float]:
    """Missing and superfluous terms, and the largest relative error."""
    errors = [abs(terms.get(name, 0.0) / value - 1) for name, value in case.terms.items()]
    return len(case.terms.keys() - terms), len(terms.keys() - case.terms), max(errors)


def compare(case: Case, seed: int) -> dict[str, Any]:
    """The three scores of a data set, and the identification."""
    ts, states = observed(case, seed)
    choices = itertools.product(THRESHOLDS, (True, False))
    trials = [score(case, by_pysindy(case, states, *choice)) for choice in choices]
    found = by_identify(case, ts, states)
    terms = dict(zip(found.terms, found.coefficients, strict=True))
    return {
        "default": score(case, by_pysindy(case, states, 0.1, False)),
        "best": min(trials, key=lambda trial: (trial[0] + trial[1], trial[2])),
        "identify": score(case, terms),
        "found": found,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default="*")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| data set | noise | pysindy, default | pysindy, best | `identify` | in errors | time |")
    print("|---|---|---|---|---|---|---|")
    for name, case in CASES.items():
        if not fnmatch.fnmatch(name, options.rows):
            continue
        began = time.perf_counter()
        scores = compare(case, options.seed)
        found = scores["found"]
        words = [
            f"{missing}, {surplus}, {100 * error:.2g} %"
            for missing, surplus, error in (scores[key] for key in ("default", "best", "identify"))
        ]
        pairs = zip(found.terms, found.coefficients, found.sigma, strict=True)
        z = [abs(c - case.terms[n]) / s for n, c, s in pairs if n in case.terms]
        seconds = time.perf_counter() - began
        columns = [name, f"{case.noise:g}", *words, f"{max(z):.1f}", f"{seconds:.0f} s"]
        print("| " + " | ".join(columns) + " |", flush=True)


if __name__ == "__main__":
    main()
