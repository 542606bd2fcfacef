"""`bound_drift`: a proved bound of how much invariants change, for all starts of a domain."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, positive, whole
from ..base.keywords import checked_keywords
from ..base.machine import processors
from ..base.precision import refuse_double_without_x64
from ..base.signature import accepts
from ..base.types import Interval
from ..discover.functions.basis import check_step_size
from ..discover.invariants.discovery import Discovery
from ..discover.invariants.series import InvariantSeries
from ..integration.arithmetic import Arithmetic, DoubleDouble, FixedPoint, FloatingPoint
from ..integration.integrator import Integrator, chosen, only
from ..methods import Method
from ..methods.step import Equations
from ..problem.system import System, check_system, of_problem
from .comparison import compare, random_points
from .components import NotAnalytic, program_of
from .confinement import confine
from .rational import ExactInvariant
from .result import DriftBound, tools
from .workers import Workers

_RESIDUAL = {"float64": 2.0**-49, "pairs of float64": 2.0**-94}
"""Residual of an implicit equation that a solver accepts, relative to the largest momentum: eight
units of round-off, and twice what `DoubleDouble` leaves out."""


class ProofError(Exception):
    """Nothing is proved: the message says what failed, and for which states."""


class BoundSettings(TypedDict, total=False):
    """Keywords of `bound_drift` that describe the map, and when the search ends."""

    h: Any
    args: Any
    method: Method | str | None
    arithmetic: Arithmetic | None
    integrator: Integrator | None
    ratio: float
    max_boxes: int
    max_seconds: float


@checked_keywords
def bound_drift(
    found: Discovery | InvariantSeries | Callable | Sequence[Any],
    system: Any,
    *,
    epsilon: Any,
    domain: Any,
    time: Any = None,
    inside: Callable | None = None,
    change: float = 1e-3,
    **settings: Unpack[BoundSettings],
) -> DriftBound:
    r"""Prove how little invariants of the map change in a step, for all states of a domain.

    The change I(Φ(x, ε), ε) − I(x, ε) of each invariant I = Σ ε^m I_m is expanded on boxes that
    cover the domain, in exact arithmetic and with a rigorous bound of the remainder, so that terms
    that cancel do so exactly. The rounding of a computed step is bounded as well. Then N steps
    change I by at most N (per_step + rounding) as long as the trajectory is in the domain; and
    where an invariant is larger all around the domain than inside, this is proved, too: such
    trajectories cannot leave it.

    **Arguments**

    - `found`: a `Discovery`, an `InvariantSeries`, an `ExactInvariant`, a function ``(q, p,
      epsilon)`` or ``(q, p, epsilon, t)`` → scalar, or a list of these. `system`: a `System` or a
      problem of the library.
    - `epsilon`: the largest ε of an interval from 0, or the pair (least, largest).
    - `domain`: an array of half-widths like q, |q_i|, |p_i| ≤ r_i, or one number r if `found` is a
      `Discovery`; or a pair for q and p, each half-widths or an array (lower, upper) of shape
      (2, *shape of q).
    - `inside`: function ``(q, p)`` → array; the domain has only states where no value is negative.
    - `time`: if the map or an invariant depends on the time, the interval (t_begin, t_end) in which
      steps begin, of the slow time τ = εt where the system has one (`slow_time`).
    - `h`, `args`: of the map. `method`: an explicit one, or `TypeII()`, whose implicit step is a
      function of (q0, p1). `arithmetic`: the one whose rounding is bounded, `FloatingPoint()`,
      `DoubleDouble()` or `FixedPoint(quantum)`; in the latter each increment is rounded by at most
      quantum/2. `integrator`: an object that contains these two.
    - `change`: of an invariant, for which a number of steps is stated.
    - `ratio`: the boxes are cut until no bound exceeds the largest change seen by this factor, by
      default 2, or the limits `max_boxes` (2000) or `max_seconds` (300) are reached. After one
      second the search continues in one process per processor. Their number has no effect on the
      result, unless `max_seconds` is reached.

    **Returns** a `DriftBound`; ``print`` shows what is proved.

    **Raises** `ProofError` if nothing is bounded on a part of the domain: a singularity, an ε that
    is too large. `ValueError` for a function that is not analytic, or depends on the time.
    `ImportError` without python-flint.

    **Assumes** that each operation of float64 is rounded to nearest, with or without contraction
    of products and sums, that elementary functions have errors of at most 4 ulp; and that the
    solver of an implicit step accepts residuals of at most 8 units of round-off of the momenta.
    For `DoubleDouble` these are relative errors of 2⁻¹⁰³ of sums, products and roots, 2⁻¹⁰² of
    quotients and 2⁻¹⁰⁰ of functions (proved by Joldes et al., functions measured), and 2⁻⁹⁴.

    **Source** Taylor models: Makino & Berz 2003, *Int. J. Pure Appl. Math.* 4, 379. Balls:
    Johansson 2017, *IEEE Trans. Computers* 66, 1281.

    **Example**

    ```python
    cubic = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                       force=lambda t0, t1, q0, p1, args: -q0**3)
    samples = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 400, 1))
    found = dvi.discover_invariants(cubic, dvi.Polynomials(8), order=2, h=0.1, samples=samples)
    bound = dvi.bound_drift(found, cubic, h=0.1, epsilon=0.01, domain=0.5)
    print(bound.per_step[0] < 2e-10, bound.num_steps(1e-3) > 5e6)
    # True True
    ```
    """
    exact, search = tools()
    # In float32 the bound of the rounding would be that of another program.
    refuse_double_without_x64("domain", np.dtype(float))
    positive("change", change)
    max_boxes = whole("max_boxes", settings.get("max_boxes", 2000))
    max_seconds = positive("max_seconds", settings.get("max_seconds", 300.0))
    ratio = finite("ratio", settings.get("ratio", 2.0))
    if not ratio > 1:
        raise ValueError(f"ratio must be larger than 1, got {ratio!r}.")
    h, args = settings.get("h"), settings.get("args")
    system, _, _, h, args = of_problem(system, None, None, h, args, has_start=True)
    check_system(system, "bound_drift")
    method, arithmetic = settings.get("method"), settings.get("arithmetic")
    options = chosen(settings.get("integrator"), method=method, arithmetic=arithmetic)
    integrator = only(options, "bound_drift", "method", "arithmetic")
    if not isinstance(integrator.arithmetic, FloatingPoint | DoubleDouble | FixedPoint):
        raise ValueError(
            "arithmetic must be dvi.FloatingPoint(), dvi.DoubleDouble() or "
            f"dvi.FixedPoint(quantum), got {integrator.arithmetic!r}."
        )
    h = check_step_size(h)
    shape, (lower, upper) = _domain(domain, found)
    strengths = _interval("epsilon", epsilon)
    times = None if time is None else _interval("time", time)
    functions = _functions(found, system, time is not None)
    points = _points_of(shape, (lower, upper), times, strengths, h, inside)
    step_map, programs = _step_of(system, integrator, shape, args, h, times, points)
    digits = "pairs of float64" if isinstance(integrator.arithmetic, DoubleDouble) else "float64"
    invariants = [_program(f"the invariant {name}", f, points[:5], 0) for f, name in functions]
    n, t = len(lower) // 2, ["input", len(lower)]
    certificate = {
        "format": exact.FORMAT,
        **programs,
        "h": h.hex(),
        "epsilon": [x.hex() for x in strengths],
        "time": [x.hex() for x in times or (0.0, 0.0)],
        "slow": system.slow_time,
        "timed": any(t in p["operations"] for p in (programs["step"], *invariants)),
        "domain": [[x.hex() for x in side] for side in (lower, upper)],
        "inside": _program("inside", inside or (lambda q, p: jnp.zeros(0)), points[:2], None),
        "invariants": invariants,
        "arithmetic": digits,
        "bits": 100,
        "orders": 24 if n < 2 else 10 if n < 3 else 8,  # of the expansion of a function
        "accepted": (_RESIDUAL[digits] * max(map(abs, (*lower[n:], *upper[n:])))).hex(),
        "spread": [(0.0).hex()] * n,
        "start": (times or (0.0, 0.0))[0].hex(),
        "example": [float(x).hex() for x in np.concatenate([np.ravel(x[0]) for x in points[:4]])],
    }
    if certificate["implicit"]:
        sides = lower, upper
        certificate["spread"] = _spread(step_map, shape, sides, strengths, times, h)
    checker = exact.Checker(certificate)
    estimates = search.estimate(checker)
    identities = frozenset(k for k, s in enumerate(estimates) if s == 0 and checker.is_identity(k))
    search.resolve(checker, estimates, ratio)
    certificate["bits"] = checker.bits
    checker = exact.Checker(certificate)
    with Workers(processors()) as workers:
        limits = {"max_boxes": max_boxes, "max_seconds": max_seconds, "workers": workers}
        try:
            result = search.subdivide(checker, identities, estimates, ratio=ratio, **limits)
        except exact.Failure as error:
            raise ProofError(f"{error}.") from None
        per_step = [exact.round_up(b) for b in result.bounds]
        certificate |= {
            "per_step": [b.hex() for b in per_step],
            "rounding": [r.hex() for r in result.rounding],
            "reach": [m.hex() for m in result.displacement],
            "boxes": result.tree,
            "steps": 0,
            "level": None,
            "shell": None,
        }
        level, start, reason, count = confine(
            checker, certificate, functions, inside, shape, change, limits
        )
    certificate["hash"] = exact.digest(certificate)
    return DriftBound(
        per_step=tuple(per_step),
        rounding=tuple(result.rounding),
        seen=tuple(result.extremes),
        level=level,
        steps=certificate["steps"],
        start=start,
        change=float(change),
        boxes=result.count + count,
        reason=reason,
        formulas=tuple(text for _, text in functions),
        certificate=certificate,
    )


class _WithErrors(Equations):
    """Equations of which each increment has an error."""

    error: Any = 0.0

    def increment(self, h: Any, rate: Any) -> Any:
        return h * rate + self.error


def _points_of(
    shape: Any, sides: tuple, times: tuple | None, strengths: tuple, h: float, inside: Any
) -> list[np.ndarray]:
    """Points (q, p, t, ε, h, error of an increment) of the domain for comparisons."""
    (q_low, p_low), (q_high, p_high) = (np.reshape(side, (2, *shape)) for side in sides)
    times = times or (0.0, 0.0)
    ends = [(q_low, q_high), (p_low, p_high), times, strengths, (h, h), (-1e-9, 1e-9)]
    if inside is None:
        return random_points(ends)
    points = random_points(ends, lambda q, p, *_: jnp.all(jnp.asarray(inside(q, p)) >= 0))
    if not len(points[0]):
        raise ProofError(
            "inside(q, p) must be ≥ 0 for some states of the domain, but is negative for all of "
            "4096 random ones. Use a smaller domain around them."
        )
    return points


def _step_of(
    system: System,
    integrator: Integrator,
    shape: Any,
    args: Any,
    h: float,
    times: tuple | None,
    points: list[np.ndarray],
) -> tuple[Callable, dict[str, Any]]:
    """The step, a function of (q, p, t, ε, h), and what the certificate has about it: the list of
    operations, of (q0, p0), or of (q0, p1) if it is implicit. Without `times` it is that at t = 0.
    """
    method = integrator.method_for(system)
    explicit = method.is_explicit(system, jnp.zeros(shape), args)
    if not (explicit or method.is_the_map):
        raise ValueError(
            f"method must be dvi.TypeII() or explicit for this system, got {method!r}."
        )
    plain = System(system.H_D, system.force, system.perturbation)
    start, number = jnp.full(shape, 0.1), jnp.asarray(0.1)
    equations = Equations(plain, number, args)
    first_interval = functools.partial(Interval, 0 * number, number, number)
    integrator.arithmetic.prepare(method, equations, first_interval, start, start)
    quantum = getattr(integrator.arithmetic, "quantum", 0.0)

    def step_map(q, p, t, epsilon, h, error=0.0):
        equations = _WithErrors(plain, epsilon, args, error=error)
        interval = Interval(t, t + (epsilon * h if system.slow_time else h), h)
        if explicit:
            return method.step(equations, interval, q, p)[:2]
        rate = h * equations.momentum_rate(interval, q, p)
        return rate, q + h * equations.position_rate(interval, q, p)

    step_of_states = jax.vmap(step_map, (0, 0, 0, 0, None))
    if times is None:
        q, p = np.random.default_rng(0).uniform(0.1, 0.2, (2, 8, *shape))
        epsilon, step = np.full(8, 0.1), jnp.asarray(h)
        first, later = (step_of_states(q, p, np.full(8, t), epsilon, step) for t in (0.0, 1.0))
        is_constant = np.allclose(first, later, rtol=1e-12, atol=1e-12, equal_nan=True)
        _require_time(is_constant, "the map")
    zero = jnp.zeros(())

    def step_at_zero(q, p, t, *numbers):
        return step_map(q, p, zero, *numbers)

    step = step_map if times else step_at_zero
    program = _program("the step of the system", step, points[: 6 if quantum else 5], None)
    return step_of_states, {
        "step": program,
        "implicit": not explicit,
        "quantum": float(quantum).hex(),
    }


def _spread(
    step_map: Callable, shape: Any, sides: tuple, strengths: tuple, times: tuple | None, h: float
) -> list[str]:
    """A guess of how far p1 is from p0 in an implicit step; the checker decides."""
    rng, size = np.random.default_rng(0), int(np.prod(shape))
    low, high = sides
    z = rng.uniform(low, high, (4000, 2 * size)).reshape(4000, 2, *shape)
    t, epsilon = rng.choice(times or (0.0, 0.0), 4000), rng.choice(strengths, 4000)
    moves = np.abs(step_map(z[:, 0], z[:, 1], t, epsilon, jnp.asarray(h))[0])
    return [float(m).hex() for m in 1.3 * np.nanmax(moves, axis=0).ravel() + 1e-12]


def _functions(invariants: Any, system: System, with_time: bool) -> list[tuple[Callable, str]]:
    """(function of (q, p, t, ε, h), formula) for each invariant."""
    if isinstance(invariants, Discovery):
        invariants = list(invariants.invariants)
    if isinstance(invariants, InvariantSeries):
        _require_time(with_time or not invariants.basis.uses_time, "an invariant")
        if invariants.basis.uses_time and invariants.slow_time != system.slow_time:
            raise ValueError(
                f"found and system must have one slow_time, got {invariants.slow_time} and "
                f"{system.slow_time}."
            )
        return [
            (
                lambda q, p, t, epsilon, h: invariants.evaluate(q, p, epsilon, t),
                invariants.formula(terms=8),
            )
        ]
    if isinstance(invariants, ExactInvariant):
        return [
            (lambda q, p, t, epsilon, h: invariants.evaluate(q, p, epsilon, h, t), str(invariants))
        ]
    if isinstance(invariants, str) or not (callable(invariants) or np.iterable(invariants)):
        raise TypeError(
            "found must be a Discovery, InvariantSeries, ExactInvariant, a function (q, p, "
            f"epsilon[, t]) or a list of these, got {invariants!r:.200}."
        )
    if callable(invariants):
        name = getattr(invariants, "__name__", type(invariants).__name__)
        if accepts(invariants, 4) and (with_time or not accepts(invariants, 3)):
            return [(lambda q, p, t, epsilon, h: invariants(q, p, epsilon, t), name)]
        return [(lambda q, p, t, epsilon, h: invariants(q, p, epsilon), name)]
    pairs = [pair for item in invariants for pair in _functions(item, system, with_time)]
    if not pairs:
        raise ValueError(
            "found must have at least one invariant, got none: use more functions or a lower order."
        )
    return pairs


def _require_time(fits: Any, subject: str) -> None:
    if not fits:
        raise ValueError(
            f"{subject} depends on the time: give time=(t_begin, t_end) of the steps, of τ = εt "
            "with slow_time=True."
        )


def _program(subject: str, function: Callable, points: list, ndim: int | None) -> dict[str, Any]:
    """The operations of a function, whose result must have so many axes (None: any), compared with
    the function at points."""
    shapes = [column.shape[1:] for column in points]
    structs = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
    result = jax.eval_shape(function, *structs)
    if ndim is not None and getattr(result, "ndim", None) != ndim:
        kind = f"a {type(result).__name__}"
        description = f"shape {result.shape}" if hasattr(result, "shape") else kind
        raise ValueError(f"{subject} must return one number, got {description}.")
    try:
        program = program_of(function, *shapes)
    except NotAnalytic as error:
        raise NotAnalytic(f"{subject}: {error}") from None
    compare(subject, function, program, points)
    return program


def _domain(
    domain: Any, invariants: Any
) -> tuple[tuple[int, ...], tuple[list[float], list[float]]]:
    """Shape of a state, and the lower and upper bounds of the raveled (q, p)."""
    parts = domain if isinstance(domain, tuple) else (domain, domain)
    if len(parts) != 2:
        raise ValueError(
            f"domain must be an array or a pair for q and p, got {len(parts)} entries: "
            f"{domain!r:.200}."
        )
    shapes = [np.shape(x)[1:] if np.ndim(x) > 1 else np.shape(x) for x in parts]
    discovery = invariants if isinstance(invariants, Discovery) else None
    shape = discovery.shape if discovery is not None else max(shapes, key=len)
    if not shape:
        raise ValueError(
            f"domain must be an array like q, unless found is a Discovery, got {domain!r}."
        )
    lower, upper = [], []
    for name, x in zip("qp", parts, strict=True):
        x = np.asarray(x, float)
        low, high = (x[0], x[-1]) if x.ndim > len(shape) else (-x, x)
        if np.shape(low) not in ((), shape) or (x.ndim > len(shape) and len(x) != 2):
            raise ValueError(
                f"domain of {name} must be half-widths of shape () or {shape}, or (lower, upper) "
                f"of shape {(2, *shape)}, got shape {x.shape}."
            )
        low, high = (np.broadcast_to(side, shape).ravel() for side in (low, high))
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise ValueError(
                f"domain of {name} must be finite, with lower < upper, got {low.tolist()} and "
                f"{high.tolist()}."
            )
        lower.extend(low.tolist())
        upper.extend(high.tolist())
    return shape, (lower, upper)


def _interval(name: str, ends: Any) -> tuple[float, float]:
    value, ends = ends, [finite(name, x) for x in (ends if np.ndim(ends) else (0.0, ends))]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(
            f"{name} must be a positive number, or a pair with least < largest, got {value!r}."
        )
    low, high = ends
    return low, high
