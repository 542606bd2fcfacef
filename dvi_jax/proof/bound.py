"""`bound_drift`: a proved bound of how much invariants change, for all starts of a domain."""

from collections.abc import Callable, Sequence
from typing import Any, TypedDict, Unpack

import jax.numpy as jnp
import numpy as np

from lanewise import Layout

from ..base.checks import finite, positive, whole
from ..base.keywords import checked_keywords
from ..base.machine import processors
from ..base.precision import refuse_double_without_x64
from ..discover.functions.basis import check_step_size
from ..discover.invariants.discovery import Discovery
from ..discover.invariants.series import InvariantSeries
from ..integration.arithmetic import Arithmetic, DoubleDouble, FixedPoint, FloatingPoint
from ..integration.integrator import Integrator
from ..methods import Method
from ..problem.system import System, check_system, of_problem
from .angles import angles_of, circles, largest_angles
from .confinement import confine
from .programs import Region, functions_of, programs_of
from .result import DriftBound, tools
from .ways import MACHINE_CODE, XLA, integrator_of, way_of_running
from .workers import Workers

_RESIDUAL = {"float64": 2.0**-49, "pairs of float64": 2.0**-94}
"""Residual of an implicit equation that a solver accepts, relative to the largest momentum: eight
units of round-off, and twice what `DoubleDouble` leaves out."""


class ProofError(Exception):
    """Raised if nothing can be proved; the message says what failed, and for which states."""


class BoundSettings(TypedDict, total=False):
    """Keywords of `bound_drift` that describe the map, and when the search ends."""

    h: Any
    args: Any
    method: Method | str | None
    arithmetic: Arithmetic | None
    integrator: Integrator | None
    layout: Layout | None
    periodic: Any
    ratio: float
    max_boxes: int
    max_seconds: float


@checked_keywords
def bound_drift(
    found: Discovery | InvariantSeries | Callable | Sequence[Any],
    system: Any,
    *,
    domain: Any,
    epsilon: Any = None,
    time: Any = None,
    inside: Callable | None = None,
    change: float = 1e-3,
    **settings: Unpack[BoundSettings],
) -> DriftBound:
    r"""Prove an upper bound of the change of invariants in a step, for all states of a domain.

    The change I(Φ(x, ε), ε) − I(x, ε) of each invariant I = Σ ε^m I_m is expanded on boxes that
    cover the domain, in exact arithmetic and with a rigorous bound of the remainder, so that terms
    that cancel do so exactly. The rounding of a computed step is bounded as well. Then N steps
    change I by at most N (per_step + rounding) as long as the trajectory is in the domain; and
    where an invariant is larger all around the domain than inside, this is proved, too: such
    trajectories cannot leave it.

    **Arguments**

    - `found`: a `Discovery`, an `InvariantSeries`, an `ExactInvariant`, a function ``(q, p)``,
      ``(q, p, epsilon)`` or ``(q, p, epsilon, t)`` → scalar, or a list of these. `system`: a
      `System` or a problem of the library.
    - `epsilon`: the largest ε of an interval from 0, or the pair (least, largest), or 0.0 for
      ε = 0 alone. Not necessary for a system without force, perturbation and slow time: ε is 0.
    - `domain`: an array of half-widths like q, |q_i|, |p_i| ≤ r_i, or one number r if `found` is a
      `Discovery`; or a pair for q and p, each half-widths or an array (lower, upper) of shape
      (2, *shape of q).
    - `periodic`: True, or a boolean array like q: which q_i are angles. Their domain is the circle,
      given as an interval of a whole turn, such as the half-width np.pi, so that a trajectory that
      rotates stays in it. Step, `found` and `inside` must be unchanged by a turn, which adds one
      to q_i: q_i is an argument of sin and cos, times an integer. The proof is for all turns, and
      for computed steps while |q_i| is at most a bound that is chosen for `change` and printed.
    - `inside`: function ``(q, p)`` → array; the domain has only states where no value is negative.
    - `time`: if the map or an invariant depends on the time, the interval (t_begin, t_end) in which
      steps begin, of the slow time τ = εt where the system has one (`slow_time`).
    - `h`, `args`: of the map. `method`: an explicit one, or `TypeII()`, whose implicit step is a
      function of (q0, p1). `arithmetic`: the one whose rounding is bounded, `FloatingPoint()`,
      `DoubleDouble()` or `FixedPoint(quantum)`; in the latter each increment is rounded by at most
      quantum/2. `layout`: as for `integrate`. The rounding is that of the way in which `integrate`
      runs the system in this process, machine code or XLA, which the certificate names.
      `integrator`: an object that contains these three.
    - `change`: of an invariant, for which a number of steps is stated.
    - `ratio`: the boxes are cut until no bound exceeds the largest change seen by this factor, by
      default 2, or the limits `max_boxes` (2000) or `max_seconds` (300) are reached. After one
      second the search continues in one process per processor. Their number has no effect on the
      result, unless `max_seconds` is reached.

    **Returns** a `DriftBound`; ``print`` shows what is proved.

    **Raises** `ProofError` if nothing is bounded on a part of the domain: a singularity, an ε that
    is too large. `ValueError` for a function that is not analytic, or depends on the time,
    and if JAX does not compute on a CPU.
    `ImportError` without python-flint.

    **Assumes** that each operation of float64 is rounded to nearest, with or without contraction
    of products and sums, that elementary functions have errors of at most 4 ulp; and that the
    solver of an implicit step accepts residuals of at most 8 units of round-off of the momenta. For
    XLA larger errors of some functions are assumed, and those of the operations that it rewrites
    (page "Proved bounds").
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
    integrator = integrator_of(settings, "bound_drift")
    if not isinstance(integrator.arithmetic, FloatingPoint | DoubleDouble | FixedPoint):
        raise ValueError(
            "arithmetic must be dvi.FloatingPoint(), dvi.DoubleDouble() or "
            f"dvi.FixedPoint(quantum), got {integrator.arithmetic!r}."
        )
    h = check_step_size(h)
    shape, (lower, upper) = _domain(domain, found)
    angles = angles_of(settings.get("periodic"), shape)
    lower, upper = circles((lower, upper), angles)
    strengths = _strengths(epsilon, system)
    times = None if time is None else _interval("time", time)
    region = Region(shape, (lower, upper), times or (0.0, 0.0), strengths, h, time is not None)
    functions = functions_of(found, system, region.is_timed)
    points = region.points(inside)
    if not len(points[0]):
        raise ProofError(
            "inside(q, p) must be ≥ 0 somewhere in the domain, but is negative for all of 4096 "
            "random states. Use a smaller domain around those that you mean."
        )
    way, reason = way_of_running(system, integrator, shape, h, args)
    if way not in (MACHINE_CODE, XLA):
        raise ValueError(f"the rounding is known for machine code and XLA on a CPU, but {reason}.")
    step_map, programs = programs_of(
        system, integrator, args, functions, inside, region, points, way
    )
    n, t = len(lower) // 2, ["input", len(lower)]
    certificate = {
        "format": exact.FORMAT,
        **programs,
        "h": h.hex(),
        "epsilon": [x.hex() for x in strengths],
        "time": [x.hex() for x in times or (0.0, 0.0)],
        "slow": system.slow_time,
        "timed": any(t in p["operations"] for p in (programs["step"], *programs["invariants"])),
        "domain": [[x.hex() for x in side] for side in (lower, upper)],
        "bits": 100,
        "orders": 24 if n < 2 else 10 if n < 3 else 8,  # of the expansion of a function
        "accepted": (
            _RESIDUAL[programs["arithmetic"]] * max(map(abs, (*lower[n:], *upper[n:])))
        ).hex(),
        "spread": [(0.0).hex()] * n,
        "start": (times or (0.0, 0.0))[0].hex(),
        "example": [float(x).hex() for x in np.concatenate([np.ravel(x[0]) for x in points[:4]])],
    }
    if certificate["implicit"]:
        certificate["spread"] = _spread(step_map, region)
    checker = exact.Checker(certificate)
    estimates = search.estimate(checker)
    if any(angles):
        certificate["angles"] = largest_angles(checker, angles, estimates, change)
        try:
            checker = exact.Checker(certificate)
        except exact.Failure as error:
            raise ValueError(
                f"periodic must be False unless q and q + 2π are the same state: {error}. The "
                "step, the invariants and `inside` must not change with such a turn."
            ) from None
    identities = frozenset(k for k, s in enumerate(estimates) if s == 0 and checker.is_identity(k))
    search.resolve(checker, estimates, ratio)
    certificate["bits"] = checker.bits
    checker = exact.Checker(certificate)
    with Workers(processors()) as workers:
        limits = {"max_boxes": max_boxes, "max_seconds": max_seconds, "workers": workers}
        try:
            result = search.subdivide(checker, identities, estimates, ratio=ratio, **limits)
        except exact.Failure as error:
            hints = {
                "log": " Powers such as x**-0.3 and cbrt(x) contain log(x): x must be positive.",
                "sqrt": " It may be a condition: x > 1 is in the list as sqrt(x - 1), and must not "
                "change in the domain.",
            }
            shown = (text for name, text in hints.items() if f": {name} is singular" in str(error))
            raise ProofError(f"{error}.{next(shown, '')}") from None
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


def _spread(step_map: Callable, region: Region) -> list[str]:
    """A guess of how far p1 is from p0 in an implicit step; the checker decides."""
    rng, size = np.random.default_rng(0), int(np.prod(region.shape))
    low, high = region.sides
    z = rng.uniform(low, high, (4000, 2 * size)).reshape(4000, 2, *region.shape)
    t, epsilon = rng.choice(region.times, 4000), rng.choice(region.strengths, 4000)
    moves = np.abs(step_map(z[:, 0], z[:, 1], t, epsilon, jnp.asarray(region.h))[0])
    return [float(m).hex() for m in 1.3 * np.nanmax(moves, axis=0).ravel() + 1e-12]


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


def _strengths(epsilon: Any, system: System) -> tuple[float, float]:
    """The interval of ε; 0 alone for the number 0, and where a map has no perturbation."""
    if epsilon is None and not system.depends_on_epsilon:
        return 0.0, 0.0
    hint = "Only systems without force, perturbation and slow time need no epsilon."
    is_pair = epsilon is not None and np.ndim(epsilon) > 0
    if not is_pair and finite("epsilon", epsilon, hint) == 0:
        return 0.0, 0.0
    return _interval("epsilon", epsilon)


def _interval(name: str, ends: Any) -> tuple[float, float]:
    value, ends = ends, [finite(name, x) for x in (ends if np.ndim(ends) else (0.0, ends))]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(
            f"{name} must be a positive number, or a pair with least < largest, got {value!r}."
        )
    low, high = ends
    return low, high
