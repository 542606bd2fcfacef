"""Cases of which it is known what is conserved, and how the answer of a search compares.

A case is data: a map, functions to look in, samples, and the truth, with its source in a comment.
`outcome` names what the search did, by one principle for all cases:

- "found": everything that is true was found, nothing else, without a warning.
- "undecided": the report warns that its answer is not reliable, or the case is refused with an
  error that says why.
- "missed": something true was not found, without a warning.
- "false": something was reported that is not true, without a warning.
"""

import functools
import traceback
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from .maps import formula

SPAN = 1e-5
"""A function whose distance from a span is below this share of its size lies in it."""

GENERIC = 1e-4
"""Differentials whose smallest singular value is below this are dependent at a point."""

CLOSED, OPEN = 1e-9, 1e-3
"""Residuals of `solve_gauge` below the one are round-off, and above the other of order one."""


class Case(NamedTuple):
    """What a search is to find.

    - `samples`: a function of a NumPy generator that draws (qs, ps) or (qs, ps, ts).
    - `truth`: of "invariants", functions (q, p, t), each a combination of the basis: a largest set
      of independent invariants of the basis, for order > 0 the leading-order terms that reach that
      order. Of "symmetries", generators that span all symmetries of the basis that do not depend
      on one another with invariants for coefficients; `variational`: how many of them are. Of
      "gauges", the generators, one for each order; `closes`: whether a gauge in the basis closes
      Noether's identity, for each order up to the first at which none does.
    - `points`: like `samples`, for the comparison with the truth; None for the samples.
    - `options`: further arguments of the search.
    - `survivors`: how many leading-order terms have an invariant, or symmetries go on, for order
      0 … `order`, those that depend on others included, a constant not; None where not compared.
    - `exact`: whether the series of order > 0 are conserved at every ε; None as above. `epsilon`:
      where a series that is reported as exact is tried, for a step of the map.
    - `name`, `kind`: "integrable", "neighbours", …: a row of the table.
    """

    sought: str
    system: dvi.System
    basis: Any
    samples: Callable[[np.random.Generator], tuple]
    truth: tuple[Any, ...]
    options: Mapping[str, Any]
    h: float = 0.1
    order: int = 0
    points: Callable[[np.random.Generator], tuple] | None = None
    survivors: tuple[int, ...] | None = None
    exact: bool | None = None
    epsilon: float = 1.0
    variational: int = 0
    closes: tuple[bool, ...] = ()
    name: str = ""
    kind: str = ""


def case(where: tuple, truth: Any = (), sought: str = "invariants", **more: Any) -> Case:
    """A case; `where`: system, basis, samples and the step size if it is not 0.1; `truth`: one or
    several; invariants may be formulas as text. What is no field is an option of the search."""
    several = truth if isinstance(truth, Iterable) and not isinstance(truth, str) else (truth,)
    several = tuple(formula(x) if isinstance(x, str) else x for x in several)
    fields = {name: more.pop(name) for name in Case._fields if name in more}
    system, basis, samples, *h = where
    return Case(sought, system, basis, samples, several, more, *h, **fields)


symmetry = functools.partial(case, sought="symmetries")
gauge = functools.partial(case, sought="gauges")


def named(kind: str, cases: dict[str, Case]) -> tuple[Case, ...]:
    """The cases with their names, and of one kind."""
    return tuple(case._replace(name=name, kind=kind) for name, case in cases.items())


def search(case: Case, seed: int = 0) -> Any:
    """The answer of the package, on samples drawn with this seed."""
    given = {"h": case.h, "samples": case.samples(np.random.default_rng(seed)), **case.options}
    if case.sought == "gauges":
        return dvi.solve_gauge(case.system, list(case.truth), case.basis, **given)
    run = dvi.find_symmetries if case.sought == "symmetries" else dvi.discover_invariants
    return run(case.system, case.basis, case.order, **given)


def outcome(case: Case, answer: Any, seed: int = 0) -> str:
    """How the answer compares with the truth: "found", "undecided", "missed" or "false"."""
    if answer.warnings:
        return "undecided"
    if case.sought == "gauges":
        return _of_gauges(case, answer)
    return (_of_symmetries if case.sought == "symmetries" else _of_invariants)(case, answer, seed)


def judged(case: Case, seed: int = 0) -> tuple[str, Any]:
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
        return jnp.stack([f(q, p, t) for f in case.truth]) if case.truth else jnp.zeros(0)

    found, wanted = (differentials(f, at) for f in (reported, true))
    if len(parts) and rank(np.concatenate([wanted, found], axis=1)) > len(case.truth):
        return "false"
    if len(parts) != len(case.truth):
        return "false" if len(parts) > len(case.truth) else "missed"
    columns = np.asarray(jax.vmap(reported)(*at))
    columns = np.column_stack([columns, np.ones(len(columns))])
    for values in np.asarray(jax.vmap(true)(*at)).T:
        if distance(columns, values) > SPAN:
            return "missed"
    if any(answer.exact) and not _exact_series_are_conserved(case, answer, at):
        return "false"
    if case.exact is not None and any(exact != case.exact for exact in answer.exact):
        return "missed" if case.exact else "false"
    return _of_counts(case.survivors, answer.survivors)


def _exact_series_are_conserved(case: Case, answer: dvi.Discovery, at: tuple) -> bool:
    """Whether the series that are reported as exact change by no more than rounding in a step."""
    method = case.options.get("method", dvi.TypeII())
    run = {"h": case.h, "num_steps": 1, "epsilon": case.epsilon, "method": method}

    def values(q, p, t):
        sol = dvi.integrate(case.system, q, p, t0=t, **run)
        before = answer.evaluate(q, p, case.epsilon, t)
        return before, answer.evaluate(sol.qs[-1], sol.ps[-1], case.epsilon, t + case.h)

    before, after = (np.asarray(x)[:, list(answer.exact)] for x in jax.vmap(values)(*at))
    return bool(np.all(np.abs(after - before) <= 1e-9 * np.std(before, axis=0)))


def _of_counts(wanted: tuple[int, ...] | None, found: tuple[int, ...]) -> str:
    if wanted is None or found == wanted:
        return "found"
    more = any(f > w for f, w in zip(found, wanted, strict=True))
    return "false" if more else "missed"


def components(generator, q, p, t):
    """Of a generator at each of many points, shape (points, 1 + 2n)."""

    def at_point(q, p, t):
        parts = generator(dvi.LatticePoint(t, q, p), None)
        return jnp.concatenate([jnp.ravel(jnp.asarray(x, float)) for x in parts])

    return np.asarray(jax.vmap(at_point)(q, p, t))


def _of_symmetries(case: Case, answer: dvi.Symmetries, seed: int) -> str:
    q, p = (jnp.asarray(x) for x in case.samples(np.random.default_rng(seed + 1))[:2])
    at = q, p, jnp.linspace(0.3, 1.7, len(q))
    independent = [s for s in answer if not s.is_dependent]
    found = [components(s.generators[0], *at).ravel() for s in answer]
    wanted = [components(g, *at).ravel() for g in case.truth]
    if len(independent) != len(wanted):
        return "false" if len(independent) > len(wanted) else "missed"
    if any(distance(np.column_stack(found), w) > SPAN for w in wanted):
        return "missed"
    variational = sum(s.is_variational for s in independent)
    if variational != case.variational:
        return "false" if variational > case.variational else "missed"
    return _of_counts(case.survivors, answer.survivors)


def _of_gauges(case: Case, answer: Any) -> str:
    for closes, residual in zip(case.closes, answer.residuals, strict=False):
        if closes and not residual < max(CLOSED, answer.rounding):
            return "missed"
        if not closes and not residual > OPEN:
            return "false"
    return "found"


def differentials(functions, at) -> np.ndarray:
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


def rank(differentials: np.ndarray) -> int:
    """The rank that most points agree on."""
    singular = np.linalg.svd(differentials, compute_uv=False)
    return int(np.median(np.sum(singular > GENERIC, axis=1)))


def distance(columns: np.ndarray, values: np.ndarray) -> float:
    """Of values from the span of columns, as a share of how much they vary."""
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(sizes > 0, sizes, 1)
    found = np.linalg.lstsq(columns, values, rcond=1e-14)[0]
    size = np.linalg.norm(values - np.mean(values)) or np.linalg.norm(values) or 1.0
    return float(np.linalg.norm(columns @ found - values) / size)
