"""`bound_drift`: a proved bound of how much invariants change, for all starts of a domain."""

import functools
import json
import math
import operator
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._arithmetic import FloatingPoint
from .._checks import finite, positive, whole
from .._files import publish
from .._integrator import Integrator, chosen, only
from .._precision import refuse_double_without_x64
from .._step import Equations
from .._system import System, check_system, of_problem
from .._types import Interval
from ..discover.found import Discovery
from ..discover.series import InvariantSeries
from .components import program_of
from .confinement import confine
from .tools import tools

_ACCEPTED = 8.0
"""Residual of an implicit equation that a solver accepts, in units of round-off of the momenta."""


class ProofError(Exception):
    """Nothing is proved: the message says what failed, and for which states."""


class DriftBound(eqx.Module):
    """Result of `bound_drift`: what is proved about the change of invariants in each step.

    For all states (q, p) of the domain and all ε of the interval, in one step of the map

        |I_k(q1, p1) − I_k(q0, p0)| ≤ per_step[k]                 in exact arithmetic,
                                    ≤ per_step[k] + rounding[k]   as computed in float64.

    - `per_step`, `rounding`: [unit of the invariant]. `seen`: the largest change found at sample
      points of the boxes, a lower estimate of the least possible `per_step`.
    - `level`: (k, sign, c): trajectories that start in the domain with sign·I_k ≤ c stay in it for
      `steps` steps, exact or computed; None if that is not shown, and `reason` says why.
    - `start`: factor by which the domain is scaled about its middle so that all its states satisfy
      that. `change`: the change of I_k that `steps` steps exclude.
    - `boxes`: number of boxes of the proof. `formulas`: the invariants as text.
    - `certificate`: all that `dvi-jax verify` checks, see `save`.
    """

    per_step: tuple[float, ...] = eqx.field(static=True)
    rounding: tuple[float, ...] = eqx.field(static=True)
    seen: tuple[float, ...] = eqx.field(static=True)
    level: tuple[int, int, float] | None = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    start: float = eqx.field(static=True)
    change: float = eqx.field(static=True)
    boxes: int = eqx.field(static=True)
    reason: str = eqx.field(static=True)
    formulas: tuple[str, ...] = eqx.field(static=True)
    certificate: dict[str, Any] = eqx.field(static=True)

    def num_steps(self, change: float, invariant: int = 0) -> int | float:
        """The number of computed steps within which I_k changes by less than `change`, as long as
        the trajectory is in the domain; inf if it is conserved exactly, without rounding."""
        each = self.per_step[invariant] + self.rounding[invariant]
        return math.floor(change / each) if each else math.inf

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the certificate, a JSON file that ``dvi-jax verify`` checks."""
        publish(Path(path), (json.dumps(self.certificate, indent=1) + "\n").encode())

    def __repr__(self) -> str:
        return self.report()

    def report(self) -> str:
        """What is proved, as text."""
        c = self.certificate
        low, high = (float.fromhex(x) for x in c["epsilon"])
        n = len(c["domain"][0]) // 2
        names = [f"{x}{i + 1 if n > 1 else ''}" for x in "qp" for i in range(n)]
        sides = ", ".join(
            f"{name} in [{float.fromhex(a):.6g}, {float.fromhex(b):.6g}]"
            for name, a, b in zip(names, *c["domain"], strict=True)
        )
        lines = [
            f"proved for each step from a state with {sides}"
            + (" and inside(q, p) ≥ 0" if c["inside"]["outputs"] else "")
            + f", for all ε in [{low:.6g}, {high:.6g}], h = {float.fromhex(c['h']):.6g}:",
            f"{'':4}{'change ≤':>10} {'seen':>9} {'rounding ≤':>10} "
            f"{'steps for ' + format(self.change, 'g'):>18}",
        ]
        for k, b in enumerate(self.per_step):
            lines.append(
                f"I_{k:<2}{b:10.2g} {self.seen[k]:9.2g} {self.rounding[k]:10.2g} "
                f"{self.num_steps(self.change, k):18.3g}"
            )
        if self.level is None:
            lines.append(f"it is not shown that trajectories stay in the domain: {self.reason}")
        else:
            k, sign, value = self.level
            lines.append(
                f"no trajectory that starts in the domain with {'−' if sign < 0 else ''}I_{k} ≤ "
                f"{value:.6g} leaves it in {self.steps:.3g} steps; all states of the domain scaled "
                f"by {self.start:.3g} are such"
            )
        lines.extend(f"I_{k} = {text}" for k, text in enumerate(self.formulas))
        return "\n".join(lines)


def bound_drift(
    found: Discovery | InvariantSeries | Callable | Sequence[Any],
    system: Any,
    *,
    epsilon: Any,
    domain: Any,
    h: Any = None,
    inside: Callable | None = None,
    args: Any = None,
    method: Any = None,
    integrator: Integrator | None = None,
    change: float = 1e-3,
    ratio: float = 2.0,
    max_boxes: int = 2000,
    max_seconds: float = 300.0,
) -> DriftBound:
    r"""Prove how little invariants of the map change in a step, for all states of a domain.

    The change I(Φ(x, ε), ε) − I(x, ε) of each invariant I = Σ ε^m I_m is expanded on boxes that
    cover the domain, in exact arithmetic and with a rigorous bound of the remainder, so that terms
    that cancel do so exactly. The rounding of one step in float64 is bounded as well. Then N steps
    change I by at most N (per_step + rounding) as long as the trajectory is in the domain; and
    where an invariant is larger all around the domain than inside, this is proved, too: such
    trajectories cannot leave it.

    **Arguments**

    - `found`: a `Discovery`, an `InvariantSeries`, a function ``(q, p, epsilon)`` → scalar, or a
      list of these. `system`: a `System` or a problem of the library.
    - `epsilon`: the largest ε of an interval from 0, or the pair (least, largest).
    - `domain`: half-width r of |q_i|, |p_i| ≤ r; or a pair for q and p, each a half-width, an array
      of half-widths like q, or an array (lower, upper) of shape (2, *shape of q).
    - `inside`: function ``(q, p)`` → array; the domain has only states where no value is negative.
    - `h`, `args`: of the map. `method`, `integrator`: explicit methods, or `TypeII()`, whose
      implicit step is a function of (q0, p1). The map must not depend on the time.
    - `change`: of an invariant, for which a number of steps is stated.
    - `ratio`: the boxes are cut until no bound exceeds the largest change seen by this factor, or
      the limits `max_boxes` or `max_seconds` are reached.

    **Returns** a `DriftBound`; ``print`` shows what is proved.

    **Raises** `ProofError` if nothing is bounded on a part of the domain: a singularity, an ε that
    is too large. `ValueError` for a function that is not analytic, or depends on the time.
    `ImportError` without python-flint.

    **Assumes** that each operation of float64 is rounded to nearest, with or without contraction
    of products and sums, that elementary functions have errors of at most 4 ulp; and that the
    solver of an implicit step accepts residuals of at most 8 units of round-off of the momenta.

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
    whole("max_boxes", max_boxes)
    positive("max_seconds", max_seconds)
    if not finite("ratio", ratio) > 1:
        raise ValueError(f"ratio must be larger than 1, got {ratio!r}.")
    system, _, _, h, args = of_problem(system, None, None, h, args, has_start=True)
    check_system(system)
    how = only(chosen(integrator, method=method), "bound_drift", "method", "arithmetic")
    if how.arithmetic != FloatingPoint():
        raise ValueError(f"bound_drift bounds the rounding of float64, not of {how.arithmetic!r}.")
    h = finite("h", h)
    shape, (lower, upper) = _domain(domain, found)
    strengths = _interval(epsilon)
    functions = _functions(found)
    certificate = {
        "format": exact.FORMAT,
        **_step_of(system, how.method_for(system), shape, args, h),
        "h": h.hex(),
        "epsilon": [x.hex() for x in strengths],
        "domain": [[x.hex() for x in side] for side in (lower, upper)],
        "inside": program_of(inside or (lambda q, p: jnp.zeros(0)), shape, shape),
        "invariants": [program_of(f, shape, shape, ()) for f, _ in functions],
        "unit": (2.0**-53).hex(),
        "bits": 100,
        "tiny": (2.0**-60).hex(),
    }
    certificate |= _solving(certificate, lower, upper, strengths)
    checker = exact.Checker(certificate)
    limits = {"max_boxes": max_boxes, "max_seconds": max_seconds}
    search.resolve(checker)
    certificate |= {"bits": checker.bits, "tiny": float(checker.tiny).hex()}
    checker = exact.Checker(certificate)
    try:
        identities = search.identities(checker)
        result = search.subdivide(checker, identities, ratio=ratio, **limits)
    except exact.Failed as error:
        raise ProofError(f"{error}. Take a smaller domain, ε or h.") from None
    per_step = [exact.up(b) for b in result.bounds]
    certificate |= {
        "per_step": [b.hex() for b in per_step],
        "rounding": [r.hex() for r in result.rounding],
        "reach": [m.hex() for m in result.moved],
        "boxes": result.tree,
        "steps": 0,
        "levels": [[None, None] for _ in per_step],
        "shell": None,
    }
    level, start, reason, count = confine(
        checker, certificate, functions, inside, shape, change, limits
    )
    certificate["hash"] = exact.digest(certificate)
    return DriftBound(
        per_step=tuple(per_step),
        rounding=tuple(result.rounding),
        seen=tuple(result.seen),
        level=level,
        steps=certificate["steps"],
        start=start,
        change=float(change),
        boxes=result.count + count,
        reason=reason,
        formulas=tuple(text for _, text in functions),
        certificate=certificate,
    )


def _step_of(system: System, method: Any, shape: Any, args: Any, h: float) -> dict[str, Any]:
    """The step at t0 = 0 as a list of operations: of (q0, p0), or of (q0, p1) if it is implicit."""
    run = tools()[0].run
    explicit = method.is_explicit(system, jnp.zeros(shape), args)
    if not (explicit or method.is_the_map):
        raise ValueError(
            f"{method!r} is implicit for this system. Use dvi.TypeII(), whose step is an explicit "
            "function of (q0, p1), or a method that is explicit for this system."
        )

    def stepped(t0, q, p, epsilon, h):
        equations, interval = Equations(system, epsilon, args), Interval(t0, t0 + h, h)
        if explicit:
            return method.step(equations, interval, q, p)[:2]
        rate = h * equations.momentum_rate(interval, q, p)
        return rate, q + h * equations.position_rate(interval, q, p)

    programs = [
        program_of(lambda *x, t=t: stepped(t, *x), shape, shape, (), ()) for t in (0.0, 1.0)
    ]
    if programs[0] != programs[1]:  # or the step is a difference of two times
        rng, size = np.random.default_rng(0), int(np.prod(shape))
        inputs = [rng.uniform(0.1, 0.2, 8) for _ in range(2 * size + 1)] + [np.full(8, h)]
        first, later = (np.asarray(run(p, inputs, _Floats)) for p in programs)
        if not np.allclose(first, later, rtol=1e-12, atol=1e-12, equal_nan=True):
            raise ValueError(
                "the map depends on the time, and bound_drift needs one map for all steps: write "
                "it as a system with one more degree of freedom, the angle of the time."
            )
    return {"step": programs[0], "implicit": not explicit}


def _solving(
    certificate: dict[str, Any], lower: list[float], upper: list[float], strengths: tuple
) -> dict[str, Any]:
    """How far p1 may be from p0 in an implicit step, and the residual that its solver accepts."""
    n, exact = len(lower) // 2, tools()[0]
    largest = max(abs(x) for x in (*lower[n:], *upper[n:]))
    accepted = {"accepted": (_ACCEPTED * 2.0**-52 * largest).hex()}
    if not certificate["implicit"]:
        return {"spread": [(0.0).hex()] * n, **accepted}
    rng, h = np.random.default_rng(0), float.fromhex(certificate["h"])
    points = [rng.uniform(a, b, 4000) for a, b in zip(lower, upper, strict=True)]
    inputs = [*points, rng.choice(strengths, 4000), np.full(4000, h)]
    with np.errstate(all="ignore"):
        moves = exact.run(certificate["step"], inputs, _Floats)[:n]
    # A guess; the checker decides.
    return {"spread": [float(1.3 * np.nanmax(np.abs(m)) + 1e-12).hex() for m in moves], **accepted}


class _Floats:
    """The arithmetic of float64 for the `run` of the checker."""

    constant, multiply, divide = staticmethod(float), operator.mul, operator.truediv

    @staticmethod
    def sum(*terms: Any) -> Any:
        return functools.reduce(operator.add, terms)

    @staticmethod
    def apply(name: str, a: Any) -> Any:
        return getattr(jnp, name)(a)


def _functions(found: Any) -> list[tuple[Callable, str]]:
    """(function of (q, p, ε), formula) for each invariant."""
    if isinstance(found, Discovery):
        if not found.count:
            raise ValueError("the Discovery has found no invariant: there is nothing to bound.")
        return _functions(list(found.invariants))
    if isinstance(found, InvariantSeries):
        if found.slow_time and found.basis.uses_time:
            raise ValueError("an invariant that is a function of the slow time cannot be bounded.")
        return [(found.evaluate, found.formula(terms=8))]
    if callable(found):
        return [(found, getattr(found, "__name__", "a function"))]
    pairs = [pair for one in found for pair in _functions(one)]
    if not pairs:
        raise ValueError("found is empty: give an invariant, or a list of at least one.")
    return pairs


def _domain(domain: Any, found: Any) -> tuple[tuple[int, ...], tuple[list[float], list[float]]]:
    """Shape of a state, and the lower and upper bounds of the raveled (q, p)."""
    parts = domain if isinstance(domain, tuple) else (domain, domain)
    if len(parts) != 2:
        raise ValueError(f"domain must be a number or a pair for q and p, got {domain!r}.")
    shapes = [np.shape(x)[1:] if np.ndim(x) > 1 else np.shape(x) for x in parts]
    one = found if isinstance(found, Discovery) else None
    shape = one.shape if one is not None else max(shapes, key=len)
    if not shape:
        raise ValueError(
            f"domain={domain!r} does not contain the number of coordinates of q: give half-widths "
            "as an array like q, for example domain=np.full(2, 0.5)."
        )
    lower, upper = [], []
    for name, x in zip("qp", parts, strict=True):
        x = np.asarray(x, float)
        low, high = x if x.ndim > len(shape) else (-x, x)
        low, high = (np.broadcast_to(side, shape).ravel() for side in (low, high))
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise ValueError(
                f"the domain of {name} must have finite lower bounds below its upper bounds, got "
                f"{low.tolist()} and {high.tolist()}."
            )
        lower.extend(low.tolist())
        upper.extend(high.tolist())
    return shape, (lower, upper)


def _interval(epsilon: Any) -> tuple[float, float]:
    ends = epsilon if np.ndim(epsilon) else (0.0, epsilon)
    ends = [finite("epsilon", float(x)) for x in ends]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(
            "epsilon must be the largest value, above 0, or a pair with a least value below its "
            f"largest, got {epsilon!r}."
        )
    low, high = ends
    return low, high
