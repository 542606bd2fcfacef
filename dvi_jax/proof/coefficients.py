"""`exact_coefficients`: those of a discovered invariant as small rational functions of h.

A coefficient c at one h has open_places forms (n_0 + n_1 h + n_2 h²)/d. If h is a fraction of small
numbers, such as 1/4, 1 and h and h² are dependent: all forms of c are the same number, and the
fraction n_0/d is taken. If h is near such a fraction, as 0.1 is, −7/10 and −7h are different
numbers that agree to 17 digits, more than c has. Then the map decides: conservation is linear in
the coefficients,

    Σ_{m ≤ k} Σ_j c_mj [φ_j(Φ(x, ε)) − φ_j(x)]_{k − m} = 0   for all states x and orders k,

where [ ]_k is the coefficient of ε^k. These equations at random states x, in hundreds of digits,
determine the coefficients that have more than one form.
"""

import itertools
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, instance
from ..discover.functions.basis import check_step_size
from ..discover.invariants.series import InvariantSeries
from ..integration.integrator import chosen, only
from ..methods import Method
from ..problem.system import check_system, of_problem
from .comparison import compare, random_points
from .components import program_of
from .programs import Region, programs_of
from .rational import ExactInvariant
from .result import tools
from .ways import MACHINE_CODE

_DROP = 1e-9  # Coefficients below this share of the largest are rounding
_ERROR = 1e-12  # Least relative error of a coefficient
_CHANCE = 1e-4  # Largest probability that a random number has such a form
_DIGITS = 600  # Binary digits of the equations of the map
_NOISE = 1e-60  # Largest change that is rounding at so many digits


def exact_coefficients(
    invariant: InvariantSeries,
    h: float,
    system: Any = None,
    *,
    args: Any = None,
    method: Method | str | None = None,
) -> ExactInvariant:
    """The coefficients of an invariant, relative to the largest one, as rational functions of h.

    Each ratio c is written as (n_0 + n_1 h + n_2 h²)/d with the smallest integers that agree with
    it within its error, by the reduction of a lattice (Lenstra, Lenstra & Lovász 1982). At an h
    that is a fraction of small numbers, such as 1/2, all forms are one number, and c is a fraction
    n_0/d, which is right for this h only. At an h near one, such as 0.1, the forms −7/10 and −7h
    of a number differ by less than its error: give `system`, and the form that its map conserves
    is taken.

    **Arguments** `invariant`: of a `Discovery`. `h`: the step with which it was found. `system`: a
    `System` or a problem of the library, with its `args` and `method` (as for `bound_drift`): the
    change in a step is evaluated in 600 binary digits at random states, and has to be zero at each
    order of ε that the invariant has.

    **Returns** an `ExactInvariant`, whose values were compared with those of `invariant` at random
    states. The form is a guess: `bound_drift` proves whether it is conserved exactly; then its
    `per_step` is 0.

    **Raises** `ValueError` if a coefficient has no such form, and, with a `system`, if the
    invariant with these coefficients changes in a step, with the first change that was seen.
    `ImportError` without python-flint.

    **Example**

    ```python
    oscillator = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))
    found = dvi.discover_invariants(oscillator, dvi.Polynomials(2), order=0, h=0.1, samples=samples)
    exact = dvi.exact_coefficients(found.invariants[0], 0.1, oscillator)
    bound = dvi.bound_drift(exact, oscillator, h=0.1, domain=np.array([0.5]))
    print(exact, bound.per_step)
    # 1 q² − 1 h q p + 1 p² (0.0,)
    ```
    """
    tools()
    instance("invariant", invariant, InvariantSeries, "an invariant of a Discovery")
    h = check_step_size(finite("h", h))
    c = np.asarray(invariant.coefficients, float)
    largest = np.max(np.abs(c))
    pivot = float(c.flat[np.flatnonzero(np.abs(c) > 0.999 * largest)[0]])
    ratios = np.where(np.abs(c) > _DROP * largest, c / pivot, 0.0)
    errors = np.zeros_like(c) if invariant.errors is None else np.asarray(invariant.errors, float)
    forms = {}
    for place in map(tuple, np.argwhere(ratios)):
        ratio, name = float(ratios[place]), invariant.basis.names[place[1]]
        error = float(max(3 * errors[place] / abs(pivot), _ERROR * abs(ratio)))
        forms[place] = [(1, 1, 0, 0)] if ratio == 1 else _forms(ratio, h, error)
        if not forms[place]:
            raise ValueError(
                f"the coefficient of ε^{place[0]} {name} over the largest, {ratio:.10g}, has no "
                f"form (n_0 + n_1 h + n_2 h²)/d at h={h!r}."
            )
    equations = None
    if system is not None:
        equations = _Equations(invariant, h, system, args, method)
        _decide(forms, Fraction(h), equations)
    numbers = np.zeros((*c.shape, 4), int)
    numbers[..., 0] = 1
    for place, choices in forms.items():
        numbers[place] = choices[0]
    exact_invariant = ExactInvariant(invariant.basis, numbers)
    _compare(exact_invariant, invariant, pivot, h)
    if equations is not None:
        equations.check({place: _value(form[0], Fraction(h)) for place, form in forms.items()})
    return exact_invariant


def _value(form: Sequence[int], h: Fraction) -> Fraction:
    """(n_0 + n_1 h + n_2 h²)/d."""
    d, *n = map(int, form)
    return (n[0] + n[1] * h + n[2] * h * h) / Fraction(d)


def _forms(ratio: float, h: float, error: float) -> list[tuple[int, ...]]:
    """The (d, n_0, n_1, n_2) that agree with a number within its error, the simplest one first.

    Few forms are simple: those with k integers of the size s are s^k. At a small fraction h, where
    all forms are one number, the form without h is the first.
    """
    subsets = [s for k in (1, 2, 3) for s in itertools.combinations(range(3), k)]
    forms = {}
    for powers in subsets:
        form = _relation(ratio, h, error, powers)
        if form[0]:
            terms = sum(n != 0 for n in form[1:])
            forms.setdefault(form, max(map(abs, form)) ** (terms + 1))
    choices = sorted(forms, key=lambda form: forms[form])
    if Fraction(h).denominator <= 64:
        choices.sort(key=lambda form: any(form[2:]))
    return choices


def _relation(ratio: float, h: float, error: float, powers: Sequence[int]) -> tuple[int, ...]:
    """(d, n_0, n_1, n_2) with d·ratio = Σ n_k h^k and these powers k; zeros if none is small."""
    from flint import fmpz_mat  # `tools` has explained how to install it

    columns = [round(x / error) for x in (ratio, *(-(h**k) for k in powers))]
    size = len(columns)
    rows = [[int(i == j) for j in range(size)] + [columns[i]] for i in range(size)]
    d, *n, remainder = (int(x) for x in fmpz_mat(rows).lll().tolist()[0])
    # A random number has a form of k integers of the size s with a probability of about s^k error.
    largest = max(map(abs, (d, *n)))
    if not d or abs(remainder) > 4 * largest or largest**size * error > _CHANCE:
        return 0, 0, 0, 0
    sign = 1 if d > 0 else -1
    form = [sign * d, 0, 0, 0]
    for k, value in zip(powers, n, strict=True):
        form[k + 1] = sign * value
    return tuple(form)


def _compare(
    exact_invariant: ExactInvariant, invariant: InvariantSeries, pivot: float, h: float
) -> None:
    """Compare the values of both at random states. **Raises** `ValueError` where they differ."""
    shape = invariant.basis.shape
    if shape is None:
        return
    ends = [(-np.ones(shape), np.ones(shape))] * 2 + [(0.0, 0.1), (0.0, 1.0)]
    # What `_forms` may change: a share of each coefficient, and its error.
    errors = 0.0 if invariant.errors is None else 3 * np.asarray(invariant.errors)
    limits = np.abs(10 * _DROP * np.asarray(invariant.coefficients)) + errors
    limits = np.sum(limits + _DROP * np.max(np.abs(invariant.coefficients)), axis=0) / abs(pivot)

    def pair(q, p, epsilon, t):
        limit = jnp.abs(invariant.basis(q, p, t)) @ limits
        values = invariant.evaluate(q, p, epsilon, t) / pivot
        return exact_invariant.evaluate(q, p, epsilon, h, t), values, limit

    for *x, value, discovered_value, limit in zip(
        *(points := random_points(ends)), *map(np.asarray, jax.vmap(pair)(*points)), strict=True
    ):
        if np.isfinite(limit) and not abs(value - discovered_value) <= limit:
            state = [np.asarray(part).tolist() for part in x]
            raise ValueError(
                f"the invariant with exact coefficients is {value:.17g} at (q, p, ε, t) = {state}, "
                f"but the discovered one is {discovered_value:.17g}. Please report this: they have "
                "to be the same."
            )


class _Equations:
    """The changes of the functions of a basis in a step, as series in ε at random states."""

    def __init__(
        self, invariant: InvariantSeries, h: float, system: Any, args: Any, method: Any
    ) -> None:
        basis = invariant.basis
        system, *_, args = of_problem(system, None, None, None, args, has_start=True)
        check_system(system, "exact_coefficients")
        integrator = only(chosen(None, method=method), "exact_coefficients", "method")
        shape = basis.shape
        if shape is None:
            raise ValueError("invariant must be of a Discovery, whose basis has the shape of q.")
        size = int(np.prod(shape))
        region = Region(
            shape, ([-1.0] * 2 * size, [1.0] * 2 * size), (0.0, 1.0), (0.0, 0.1), h, True
        )
        points = region.points(None)
        _, programs = programs_of(system, integrator, args, [], None, region, points, MACHINE_CODE)
        self.step, self.is_implicit = programs["step"], programs["implicit"]
        self.h, self.slow, self.size = Fraction(h), system.slow_time, size
        self.basis = program_of(basis, shape, shape, ())
        compare("the basis", basis, self.basis, points[:3])
        self.names, self.orders = basis.names, invariant.order + 1
        columns = [np.reshape(x, (len(x), -1)) for x in points[:3]]
        self.states = np.concatenate(columns, axis=1).tolist()
        self.changes = [y for y in map(self._change, self.states) if y is not None]
        if len(self.changes) < len(self.states) / 4:
            raise ValueError(
                f"system must have steps from most of {len(self.states)} random states with "
                f"|q|, |p| ≤ 1, got {len(self.changes)}: without them, do not give the system."
            )

    def _change(self, state: list[float]) -> tuple[list[float], np.ndarray] | None:
        """φ_j(Φ(x, ε)) − φ_j(x): an array of balls, functions by orders; None where singular."""
        exact, search = tools()
        from flint import arb_series

        exact.ctx.prec, exact.ctx.cap = _DIGITS, self.orders
        *x, t = (arb_series([exact.ball(Fraction(v))], self.orders) for v in state)
        epsilon = arb_series([0, 1], self.orders)
        h, n = _Series.constant(self.h), self.size
        try:
            end = exact.run(self.step, [*x, t, epsilon, h], _Series)
            if self.is_implicit:  # (q0, p1) → (h·rate, q1)
                moves, p1 = end[:n], x[n:]
                end = [*end[n:], *p1]
                x = [*x[:n], *(p - m for p, m in zip(p1, moves, strict=True))]
            t1 = t + (epsilon * h if self.slow else h)
            values = (exact.run(self.basis, z, _Series) for z in ([*end, t1], [*x, t]))
            rows = [end_value - start_value for end_value, start_value in zip(*values, strict=True)]
        except search.SINGULAR:
            return None
        table = [[row[k] for k in range(self.orders)] for row in rows]
        if not all(ball.is_finite() for row in table for ball in row):
            return None
        return state, np.array(table, object)

    def column(self, place: tuple[int, ...]) -> list[Any]:
        """What a coefficient of 1 adds to each equation."""
        m, j = place
        rows = [
            [0] * m + row[: self.orders - m] for row in (y[j].tolist() for _, y in self.changes)
        ]
        return [value for row in rows for value in row]

    def check(self, coefficients: dict[tuple[int, ...], Fraction]) -> None:
        """**Raises** `ValueError` if the invariant with these coefficients changes in a step."""
        exact, _ = tools()
        exact.ctx.prec = _DIGITS
        totals = [0] * (len(self.changes) * self.orders)
        for place, value in coefficients.items():
            factor = exact.ball(value)
            totals = [a + factor * b for a, b in zip(totals, self.column(place), strict=True)]
        for i, total in enumerate(totals):
            if not abs(exact.arb(total)) < _NOISE:
                number, order = divmod(i, self.orders)
                raise ValueError(
                    "the invariant with exact coefficients is not conserved: at (q, p, t) = "
                    f"{self.changes[number][0]} a step changes it by {float(exact.arb(total)):.3g} "
                    f"at the order ε^{order}. It is conserved approximately only, its coefficients "
                    "have other forms, or a constant of the system is rounded: 0.3 is not 3/10."
                )


class _Series:
    """The arithmetic of power series in ε for the `run` of the checker."""

    @staticmethod
    def constant(value: Any) -> Any:
        from flint import arb_series

        exact, _ = tools()
        return arb_series([exact.ball(Fraction(value))], exact.ctx.cap)

    @staticmethod
    def sum(*terms: Any) -> Any:
        return sum(terms[1:], terms[0])

    @staticmethod
    def multiply(a: Any, b: Any) -> Any:
        return a * b

    @staticmethod
    def apply(name: str, a: Any) -> Any:
        return 1 / a if name == "inverse" else getattr(a, name)()


def _decide(
    forms: dict[tuple[int, ...], list[tuple[int, ...]]], h: Fraction, equations: _Equations
) -> None:
    """Reduce the forms of each coefficient to one: of those that are different numbers at this h,
    the one that solves the equations. Where these have many solutions, the simplest one stays."""
    from flint import arb_mat

    exact, _ = tools()
    exact.ctx.prec = _DIGITS
    open_places = [x for x, choices in forms.items() if len({_value(f, h) for f in choices}) > 1]
    if not open_places:
        return
    columns = [equations.column(place) for place in open_places]
    right = [0] * len(columns[0])
    for place, choices in forms.items():
        if place not in open_places:
            factor = exact.ball(_value(choices[0], h))
            pairs = zip(right, equations.column(place), strict=True)
            right = [a - factor * b for a, b in pairs]
    matrix = arb_mat([list(row) for row in zip(*columns, strict=True)])
    try:
        solution = (matrix.transpose() * matrix).solve(
            matrix.transpose() * arb_mat([[x] for x in right])
        )
    except ZeroDivisionError:
        return
    for i, place in enumerate(open_places):
        root = solution[i, 0]
        fits = [f for f in forms[place] if abs(root - exact.ball(_value(f, h))) < _NOISE]
        forms[place] = fits or forms[place]
