"""Cases of which it is known what is conserved, and how the answer of a search compares.

A case is data: a map, functions to look in, samples, and the truth with its source. `outcome` runs
the search and names what it did, by one principle for all cases:

- "found": everything that is true was found, nothing else, without a warning.
- "undecided": the report warns that its answer is not to be relied on, or the case is refused
  with an error that says why.
- "missed": something true was not found, without a warning.
- "false": something was reported that is not true, without a warning.
"""

import traceback
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

SPAN = 1e-5
"""A function whose distance from a span is below this share of its size lies in it."""

GENERIC = 1e-4
"""Differentials whose smallest singular value is below this are dependent at a point."""

CLOSED, OPEN = 1e-9, 1e-3
"""Residuals of `solve_gauge` below the one are round-off, and above the other of order one."""


class Case(NamedTuple):
    """What is to be found by `discover_invariants`.

    - `kind`: "integrable", "neighbour", …: a row of the table. `source`: of the truth.
    - `samples`: a function of a NumPy generator that draws (qs, ps) or (qs, ps, ts).
    - `truth`: functions (q, p) or (q, p, t), each a combination of the basis: a largest set of
      independent invariants of the basis, for order > 0 the leading parts that reach that order.
    - `points`: like `samples`, for the comparison with the truth; None for the samples.
    - `options`: further arguments of the search.
    - `survivors`: how many leading parts have an invariant of order 0 … `order`, functions of
      one another included, a constant not; None where that is not compared.
    - `exact`: whether the series of order > 0 are conserved at every ε; None as above. `epsilon`:
      where a series that is reported as exact is tried, for a step of the map.
    """

    name: str
    kind: str
    source: str
    system: dvi.System
    basis: Any
    samples: Callable[[np.random.Generator], tuple]
    truth: tuple[Callable[..., Any], ...] = ()
    h: float = 0.1
    order: int = 0
    points: Callable[[np.random.Generator], tuple] | None = None
    options: Mapping[str, Any] = MappingProxyType({})
    survivors: tuple[int, ...] | None = None
    exact: bool | None = None
    epsilon: float = 1.0


class SymmetryCase(NamedTuple):
    """What is to be found by `find_symmetries`.

    - `truth`: generators that span all symmetries of the basis that do not depend on one
      another with invariants for coefficients; `variational`: how many of them are variational.
    - `survivors`: how many symmetries there are for order 0 … `order`, with those that depend on
      others; None where that is not compared.
    """

    name: str
    kind: str
    source: str
    system: dvi.System
    basis: Any
    samples: Callable[[np.random.Generator], tuple]
    truth: tuple[dvi.Generator, ...] = ()
    variational: int = 0
    h: float = 0.1
    order: int = 0
    options: Mapping[str, Any] = MappingProxyType({})
    survivors: tuple[int, ...] | None = None


class GaugeCase(NamedTuple):
    """What is to be found by `solve_gauge`.

    - `closes`: whether a gauge in the basis closes Noether's identity, for each order up to the
      first at which none does.
    """

    name: str
    kind: str
    source: str
    system: dvi.System
    generators: tuple[dvi.Generator, ...]
    basis: Any
    samples: Callable[[np.random.Generator], tuple]
    closes: tuple[bool, ...]
    h: float = 0.1


def search(case: Case | SymmetryCase | GaugeCase, seed: int = 0) -> Any:
    """The answer of the package, on samples drawn with this seed."""
    samples = case.samples(np.random.default_rng(seed))
    if isinstance(case, GaugeCase):
        return dvi.solve_gauge(
            case.system, list(case.generators), case.basis, h=case.h, samples=samples
        )
    run = dvi.find_symmetries if isinstance(case, SymmetryCase) else dvi.discover_invariants
    return run(case.system, case.basis, case.order, h=case.h, samples=samples, **case.options)


def outcome(case: Case | SymmetryCase | GaugeCase, answer: Any, seed: int = 0) -> str:
    """How the answer compares with the truth: "found", "undecided", "missed" or "false"."""
    if answer.warnings:
        return "undecided"
    if isinstance(case, GaugeCase):
        return _of_gauges(case, answer)
    if isinstance(case, SymmetryCase):
        return _of_symmetries(case, answer, seed)
    return _of_invariants(case, answer, seed)


def judged(case: Case | SymmetryCase, seed: int = 0) -> tuple[str, Any]:
    """The outcome, and the answer or the error by which the package refuses the case.

    A refusal names what would help, and no conclusion: it counts as "undecided".
    """
    try:
        answer = search(case, seed)
    except ValueError as error:
        line = traceback.extract_tb(error.__traceback__)[-1].line or ""
        if not line.startswith("raise "):  # a fault of the package, not its refusal
            raise
        return "undecided", error
    return outcome(case, answer, seed), answer


def _of_invariants(case: Case, answer: dvi.Discovery, seed: int) -> str:
    # An invariant that the report itself calls an expansion is not claimed to be one.
    claimed = [i for i, power in enumerate(answer.powers) if not power > 0]
    parts = np.asarray(answer.inner_coefficients)[claimed, 0]
    others = np.asarray(answer.inner_dependent)[:, 0]
    others = others if len(claimed) == answer.count else parts[:0]
    draw = case.points or case.samples
    at = [jnp.asarray(x) for x in draw(np.random.default_rng(seed + 1))]
    at = tuple(at) if len(at) == 3 else (*at, jnp.zeros(len(at[0])))

    def reported(q, p, t):
        return jnp.asarray(np.concatenate([parts, others])) @ answer.inner(q, p, t)

    def true(q, p, t):
        values = [f(q, p, t) if _timed(f) else f(q, p) for f in case.truth]
        return jnp.stack(values) if values else jnp.zeros(0)

    found, wanted = (_differentials(f, at) for f in (reported, true))
    if len(parts) and _rank(np.concatenate([wanted, found], axis=1)) > len(case.truth):
        return "false"
    if len(parts) > len(case.truth):
        return "false"
    if len(parts) < len(case.truth):
        return "missed"
    columns = np.asarray(jax.vmap(reported)(*at))
    columns = np.column_stack([columns, np.ones(len(columns))])
    for values in np.asarray(jax.vmap(true)(*at)).T:
        if _distance(columns, values) > SPAN:
            return "missed"
    if any(answer.exact) and not _exact_series_are_conserved(case, answer, at):
        return "false"
    if case.exact is not None and any(exact != case.exact for exact in answer.exact):
        return "missed" if case.exact else "false"
    return _of_counts(case.survivors, answer.survivors)


def _exact_series_are_conserved(case: Case, answer: dvi.Discovery, at: tuple) -> bool:
    """Whether the series that are reported as exact change by no more than rounding in a step."""

    def values(q, p, t):
        sol = dvi.integrate(
            case.system, q, p, t0=t, h=case.h, num_steps=1, epsilon=case.epsilon,
            method=case.options.get("method", dvi.TypeII()),
        )  # fmt: skip
        before = answer.evaluate(q, p, case.epsilon, t)
        return before, answer.evaluate(sol.qs[-1], sol.ps[-1], case.epsilon, t + case.h)

    before, after = (np.asarray(x)[:, list(answer.exact)] for x in jax.vmap(values)(*at))
    return bool(np.all(np.abs(after - before) <= 1e-9 * np.std(before, axis=0)))


def _of_counts(wanted: tuple[int, ...] | None, found: tuple[int, ...]) -> str:
    if wanted is None or found == wanted:
        return "found"
    more = any(f > w for f, w in zip(found, wanted, strict=True))
    return "false" if more else "missed"


def _of_symmetries(case: SymmetryCase, answer: dvi.Symmetries, seed: int) -> str:
    q, p = (jnp.asarray(x) for x in case.samples(np.random.default_rng(seed + 1))[:2])
    t = jnp.linspace(0.3, 1.7, len(q))

    def vectors(generator):
        def at_point(q, p, t):
            parts = generator(dvi.LatticePoint(t, q, p), None)
            return jnp.concatenate([jnp.ravel(jnp.asarray(x, float)) for x in parts])

        return np.asarray(jax.vmap(at_point)(q, p, t)).ravel()

    independent = [s for s in answer if not s.is_dependent]
    found = [vectors(s.generators[0]) for s in answer]
    wanted = [vectors(g) for g in case.truth]
    if len(independent) > len(wanted):
        return "false"
    if len(independent) < len(wanted):
        return "missed"
    if any(_distance(np.column_stack(found), w) > SPAN for w in wanted):
        return "missed"
    variational = sum(s.is_variational for s in independent)
    if variational != case.variational:
        return "false" if variational > case.variational else "missed"
    return _of_counts(case.survivors, answer.survivors)


def _of_gauges(case: GaugeCase, answer: Any) -> str:
    for closes, residual in zip(case.closes, answer.residuals, strict=False):
        if closes and not residual < max(CLOSED, answer.rounding):
            return "missed"
        if not closes and not residual > OPEN:
            return "false"
    return "found"


def _timed(function: Callable[..., Any]) -> bool:
    given = len(function.__defaults__ or ())
    return function.__code__.co_argcount - given == 3


def _differentials(functions, at) -> np.ndarray:
    """Of each function at each point, shape (points, count, 2n), each in units of the spread of
    the coordinates and of length one."""
    q, p = at[0], at[1]
    slopes = jax.vmap(jax.jacfwd(functions, argnums=(0, 1)))(*at)
    units = [np.maximum(np.std(np.asarray(x), axis=0).ravel(), 1e-300) for x in (q, p)]
    rows = [
        np.asarray(s).reshape(*s.shape[:2], len(u)) * u for s, u in zip(slopes, units, strict=True)
    ]
    rows = np.concatenate(rows, axis=2)
    return rows / np.maximum(np.linalg.norm(rows, axis=2, keepdims=True), 1e-300)


def _rank(differentials: np.ndarray) -> int:
    singular = np.linalg.svd(differentials, compute_uv=False)
    return int(np.median(np.sum(singular > GENERIC, axis=1)))


def _distance(columns: np.ndarray, values: np.ndarray) -> float:
    """Of values from the span of columns, as a share of how much they vary."""
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(sizes > 0, sizes, 1)
    found = np.linalg.lstsq(columns, values, rcond=1e-14)[0]
    size = np.linalg.norm(values - np.mean(values)) or np.linalg.norm(values) or 1.0
    return float(np.linalg.norm(columns @ found - values) / size)
