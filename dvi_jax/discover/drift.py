"""The order in ε to which something is conserved, measured."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._inputs import as_parameter, as_scalar, start_state
from .._integrate import integrate
from .._integrator import Integrator, chosen
from .._results import status_name
from .._solution import Save
from .._system import System, check_system
from .._types import Args
from ..engine.names import both_names
from ..engine.newton import RootSolver
from ..engine.reads import Reads, reads
from ..methods import Method
from ..observe import MaxDrift
from .exponents import (
    ENOUGH,
    Exponent,
    line,
    line_interval,
    plateau_level,
    resolving_range,
    small_epsilon_exponent,
)

_ABOVE_FLOOR = 10
"""A point counts when its drift is this many times the one that ε has no part in."""

_MEANINGS = {
    "failed": "too many of the starts failed",
    "no floor": "the undisturbed run failed, so that nothing can be told from its drift",
    "round-off": "within ten times of round-off",
    "mesh": "within ten times of the drift at ε = 0",
    "flat": "within ten times of a plateau at the smallest ε",
}


class DriftOrder(NamedTuple):
    """The measured order in ε of a drift; print it for a report.

    - `epsilons`, `drifts`: shape (E,); a drift is the largest over the starts that count, NaN
      where they failed.
    - `floor`: the drift at ε = 0; `floor_cause`: "round-off", "mesh" (the observable is not kept
      by the undisturbed map), or "failed" (then it is NaN).
    - `used`: which points the fit takes, shape (E,). `excluded`: why not the others: "failed",
      "no floor", "round-off", "mesh", "flat"; "" where used.
    - `slope`: the order s of drift ∝ ε^s for ε → 0 if it is `resolved`, else the slope of the
      straight line by least squares; NaN with fewer than three points. `stderr`: half of the
      95 % interval, divided by Student's t.
    - `kept`: the initial conditions that count, shape (S,). `start_drifts`, `statuses`: of every
      trajectory, shape (E + 1, S), the last row at ε = 0. A status is one of `RESULTS` by name,
      or "observable_not_finite".
    - `fit`: the comparison of models, an `Exponent`: probabilities, crossover, straight line.
    """

    epsilons: np.ndarray
    drifts: np.ndarray
    floor: float
    floor_cause: str
    used: np.ndarray
    excluded: np.ndarray
    slope: float
    stderr: float
    kept: np.ndarray
    start_drifts: np.ndarray
    statuses: np.ndarray
    fit: Exponent

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the order for ε → 0, from the scatter and from the choice of the law.

        If the order is not `resolved`, it also contains `slope`, the slope of the straight line.
        """
        return self.fit.interval

    @property
    def resolved(self) -> bool:
        """Whether the 95 % interval of the order for ε → 0 is at most 0.6 long."""
        return self.fit.resolved

    @property
    def model(self) -> str:
        """The most probable law: "power", "sum of two powers", …; see `Exponent`."""
        return self.fit.model

    @property
    def curvature(self) -> float:
        """d² log(drift) / d log(ε)² of a parabola through the points used, 0 for a power law.

        NaN with fewer than four points used.
        """
        return self.fit.curvature

    @property
    def limit(self) -> float:
        """The order for ε → 0 if it is `resolved`, else NaN."""
        return self.slope if self.resolved else np.nan

    @property
    def resolving_range(self) -> tuple[float, float]:
        """The smallest and the largest ε of a sweep that would resolve the order.

        NaN if smaller ε are required and the drift at ε = 0 hides them, or with fewer than three
        points used. See `small_epsilon_exponent`.
        """
        return resolving_range(
            self.fit, self.epsilons[self.used], self.drifts[self.used], _ABOVE_FLOOR * self.floor
        )

    @property
    def successful(self) -> np.ndarray:
        """At which ε no trajectory failed, shape (E,)."""
        return (self.statuses[:-1] == "successful").all(axis=1)

    @property
    def slope_of_all(self) -> float:
        """The slope through all points, plateaus included: near 0 where ε has no part."""
        good = self.drifts > 0
        return line(np.log(self.epsilons[good]), np.log(self.drifts[good]))[0]

    def __str__(self) -> str:
        points, used = len(self.epsilons), int(self.used.sum())
        if used >= ENOUGH:
            lines = self.fit.report(points, self.resolving_range)
        else:
            lines = [
                f"no order: {used} of {points} points can be used, {ENOUGH} are needed (through "
                f"all of them the slope is {self.slope_of_all:.2g})"
            ]
        lines.append(f"  drift at ε = 0: {self.floor:.2g} ({self.floor_cause})")
        for reason, meaning in _MEANINGS.items():
            where = self.epsilons[self.excluded == reason]
            if len(where):
                lines.append(f"  excluded: {len(where)} at ε = {_span(where)}, {meaning}")
        return "\n".join(lines + _starts_left_out(self.kept, self.statuses))


class DriftSurface(NamedTuple):
    """Drifts over ε and h, with their orders; print it for a table.

    - `epsilons`: shape (E,); `hs`: step sizes, shape (H,); `num_steps`: steps at each, (H,).
    - `orders`: a `DriftOrder` for each h, over the same starts.
    - `mesh_used`: at which h the drift at ε = 0 is above round-off, shape (H,); `mesh_slope`,
      `mesh_stderr`: its order in h there, d log(drift) / d log(h); NaN with fewer than three.
    """

    epsilons: np.ndarray
    hs: np.ndarray
    num_steps: np.ndarray
    orders: tuple[DriftOrder, ...]
    mesh_used: np.ndarray
    mesh_slope: float
    mesh_stderr: float

    @property
    def drifts(self) -> np.ndarray:
        """Shape (E, H); NaN where the trajectories failed."""
        return np.stack([o.drifts for o in self.orders], axis=1)

    @property
    def floors(self) -> np.ndarray:
        """The drifts at ε = 0, shape (H,)."""
        return np.array([o.floor for o in self.orders])

    @property
    def used(self) -> np.ndarray:
        """Which points the fits in ε take, shape (E, H)."""
        return np.stack([o.used for o in self.orders], axis=1)

    @property
    def excluded(self) -> np.ndarray:
        """Why not the others, shape (E, H); "" where used."""
        return np.stack([o.excluded for o in self.orders], axis=1)

    @property
    def statuses(self) -> np.ndarray:
        """Of every trajectory, shape (E + 1, H, S), the last row at ε = 0."""
        return np.stack([o.statuses for o in self.orders], axis=1)

    @property
    def slopes(self) -> np.ndarray:
        """The order in ε at each h, shape (H,); of the straight line where it is not resolved."""
        return np.array([o.slope for o in self.orders])

    @property
    def intervals(self) -> np.ndarray:
        """Their 95 % intervals, shape (H, 2)."""
        return np.array([o.interval for o in self.orders])

    @property
    def mesh_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the order in h of the drift at ε = 0."""
        return line_interval(self.mesh_slope, self.mesh_stderr, int(self.mesh_used.sum()))

    def __str__(self) -> str:
        def row(name, cells):
            return f"{name:>10}" + "".join(f"{cell:>11}" for cell in cells)

        marks = np.where(self.used, " ", "*")
        lines = [row("ε \\ h", [f"{h:.3g} " for h in self.hs])]
        for epsilon, drifts, mark in zip(self.epsilons, self.drifts, marks, strict=True):
            cells = [f"{d:.2e}{m}" for d, m in zip(drifts, mark, strict=True)]
            lines.append(row(f"{epsilon:.3g}", cells))
        lines.append(row("0", [f"{floor:.2e} " for floor in self.floors]))
        unclear = [np.isfinite(o.slope) and not o.resolved for o in self.orders]
        cells = [
            f"{o.slope:.3f}{'?' if u else ' '}" for o, u in zip(self.orders, unclear, strict=True)
        ]
        lines.append(row("slope", cells))
        half = (self.intervals[:, 1] - self.intervals[:, 0]) / 2
        lines.append(row("±", [f"{x:.3f} " for x in half]))
        if any(unclear):
            lines.append("? no order resolved in this range of ε: slope of the straight line")
        for reason, meaning in _MEANINGS.items():
            count = int(np.sum(self.excluded == reason))
            if count:
                lines.append(f"* {count} excluded: {meaning}")
        count = int(self.mesh_used.sum())
        if count >= ENOUGH:
            low, high = self.mesh_interval
            lines.append(
                f"drift at ε = 0 ∝ h^{self.mesh_slope:.4g}, 95 % interval {low:.4g} … {high:.4g}, "
                f"by {count} of {len(self.hs)} step sizes"
            )
        else:
            lines.append(f"drift at ε = 0: above round-off at {count} of {len(self.hs)} step sizes")
        kept, statuses = self.orders[0].kept, self.statuses.reshape(-1, len(self.orders[0].kept))
        return "\n".join(lines + _starts_left_out(kept, statuses))


@both_names
def drift_order(
    system: System,
    invariant: Callable[..., Any],
    q0: Any,
    p0: Any,
    *,
    epsilons: Any,
    h: Any,
    num_steps: int,
    batched: bool = False,
    t0: float = 0.0,
    args: Args = None,
    method: Method | None = None,
    newton: RootSolver | None = None,
    integrator: Integrator | None = None,
) -> DriftOrder:
    r"""The exponent of ε in the largest drift of a scalar along trajectories.

        max_starts max_k |I_ε(k) − I_ε(1)| ∝ ε^slope      (z + 1 for an invariant of order z)

    One batched sweep over ε and the initial conditions, reduced on the device: memory does not
    grow with num_steps. The same runs at ε = 0 give the floor, by the mesh or by round-off. The
    order is fitted to the points that are more than ten times above it, and above a plateau at
    the smallest ε if there is one; the others are excluded and reported.

    Several laws are compared: one power, the sum or the difference of two, saturation at large
    ε, a resonance. The report gives the order for ε → 0 only where the points determine it to
    ± 0.3 whichever of these laws holds. Otherwise it says that no order is resolved, and which ε
    would resolve it.

    An ε at which more than half of the starts fail is excluded. A start that fails at one of the
    others is left out at all of them, so that every point is the largest over the same starts.

    **Arguments**

    - `invariant`: an observable: a function of one step, an `InvariantSeries`, an
      `AdiabaticInvariant`.
    - `q0`, `p0`: one start; with ``batched=True`` many, along the first axis: (S, *state).
    - `epsilons`: strengths, shape (E,), positive, no two the same, in any order.
    - `h`, `num_steps`, `t0`, `args`, `method`, `newton`, `integrator`: as for `integrate`.

    **Returns** a `DriftOrder`; its slope is NaN when fewer than three points are left.

    **Raises** `ValueError` for epsilons that are not positive, finite and distinct, starts that
    are not of one shape, or an observable that is not a scalar.

    **Accuracy** among 400 synthetic curves (powers, sums, saturation, next orders, drifts at
    ε = 0, noise of 0.1 to 20 %) the 95 % interval contains the true order in 93 to 97 % of those
    that are resolved (tests/test_drift.py). The order is that of the smallest ε in the sweep: no
    measurement excludes another power below it. A logarithm, ε log(1/ε), is fitted by a power.

    **Example**

    ```python
    cubic = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                       force=lambda t0, t1, q0, p1, args: -q0**3)
    def energy_of_the_map(t0, t1, q0, p0, q1, p1, args):
        return (p1 @ p1 + q1 @ q1 - 0.1 * (q1 @ p1)) / 2
    order = dvi.drift_order(cubic, energy_of_the_map, [0.4], [0.3], h=0.1, num_steps=1000,
                            epsilons=[1e-3, 1e-2, 3e-2, 1e-1])
    print(round(float(order.slope), 2))
    # 1.0
    ```
    """
    _check_observable(invariant)
    epsilons = _positive("epsilons", epsilons)
    q0, p0 = _starts(q0, p0, batched)
    h = float(as_scalar("h", h, q0.dtype, zero_allowed=False))
    settings = _settings(t0, args, method, newton, integrator)
    lanes = _sweep(system, invariant, q0, p0, epsilons, h, num_steps, settings)
    return _order(epsilons, lanes, _kept(lanes.good))


@both_names
def drift_surface(
    system: System,
    invariant: Callable[..., Any] | Sequence[Callable[..., Any]],
    q0: Any,
    p0: Any,
    *,
    epsilons: Any,
    hs: Any,
    duration: float,
    batched: bool = False,
    t0: float = 0.0,
    args: Args = None,
    method: Method | None = None,
    newton: RootSolver | None = None,
    integrator: Integrator | None = None,
) -> DriftSurface:
    r"""The largest drift of a scalar over ε and h, and its order in each.

        max_starts max_k |I(k) − I(1)|    over t_k − t0 ≤ duration

    At each h one sweep as in `drift_order`, over round(duration / h) steps; the number of steps
    differs, so every h is compiled by itself. The drift at ε = 0 is the mesh's share: where it is
    above round-off its order in h is measured.

    An (ε, h) at which more than half of the starts fail is excluded. A start that fails at one of
    the others is left out at all of them.

    **Arguments**

    - `invariant`: an observable, or a sequence with one for each h (a discovered invariant
      belongs to the h it was found for).
    - `q0`, `p0`: one start; with ``batched=True`` many, along the first axis: (S, *state).
    - `epsilons`: strengths, shape (E,); `hs`: step sizes [time], shape (H,); both positive and
      increasing.
    - `duration`: how long each trajectory is [time], at least two of the longest steps.
    - `t0`, `args`, `method`, `newton`, `integrator`: as for `integrate`.

    **Returns** a `DriftSurface`.

    **Raises** `ValueError` for epsilons or hs that are not positive and increasing, a duration
    that is too short, starts that are not of one shape, observables that are not one for each
    step size, or one that is not a scalar.
    """
    epsilons = _positive("epsilons", epsilons, increasing=True)
    hs = _positive("hs", hs, increasing=True)
    is_number = isinstance(duration, int | float | np.number)
    if not is_number or not np.isfinite(duration) or duration < 2 * hs[-1]:
        raise ValueError(
            f"duration must hold at least two of the longest steps, {hs[-1]:g}; got {duration!r}."
        )
    given = isinstance(invariant, Sequence)
    invariants = list(invariant) if given else [invariant] * len(hs)
    if len(invariants) != len(hs):
        raise ValueError(
            f"give one observable for all step sizes or one for each: got {len(invariants)} for "
            f"{len(hs)} step sizes."
        )
    for each in invariants:
        _check_observable(each)
    q0, p0 = _starts(q0, p0, batched)
    num_steps = np.round(duration / hs).astype(int)
    settings = _settings(t0, args, method, newton, integrator)
    lanes = [
        _sweep(system, each, q0, p0, epsilons, float(h), int(steps), settings)
        for each, h, steps in zip(invariants, hs, num_steps, strict=True)
    ]
    kept = _kept(np.concatenate([lane.good for lane in lanes]))
    orders = tuple(_order(epsilons, lane, kept) for lane in lanes)
    floors = np.array([o.floor for o in orders])
    by_mesh = np.isfinite(floors) & np.array([o.floor_cause == "mesh" for o in orders])
    mesh_slope, mesh_stderr = line(np.log(hs[by_mesh]), np.log(floors[by_mesh]))
    return DriftSurface(epsilons, hs, num_steps, orders, by_mesh, mesh_slope, mesh_stderr)


class _Lanes(NamedTuple):
    """What a sweep brings back, shape (E + 1, S), the last row at ε = 0.

    `sizes` of the observable; `epsilon`: the relative rounding of one operation.
    """

    drifts: np.ndarray
    sizes: np.ndarray
    statuses: np.ndarray
    num_steps: int
    epsilon: float

    @property
    def good(self) -> np.ndarray:
        return self.statuses == "successful"


def _sweep(system, invariant, q0, p0, epsilons, h, num_steps, settings) -> _Lanes:
    """Every start at every ε and at 0, as one batch."""
    check_system(system)
    shape = len(epsilons) + 1, len(q0)
    strengths = jnp.repeat(jnp.append(jnp.asarray(epsilons, q0.dtype), 0), shape[1])
    starts = tuple(jnp.concatenate([x] * shape[0]) for x in (q0, p0))
    drifts, last, result = _run(
        system, invariant, strengths, starts, h, num_steps, settings, reads(invariant)
    )
    if drifts.ndim != 1:
        raise ValueError(
            f"the invariant must be a scalar, got values of shape {drifts.shape[1:]}: take one "
            "component."
        )
    drifts = np.asarray(drifts, float)
    # An odd observable may end near zero: its drift says how large it was.
    sizes = np.abs(np.asarray(last, float)[:, -1]) + drifts
    statuses = status_name(result)
    blind = (statuses == "successful") & ~np.isfinite(drifts)
    statuses = np.where(blind, "observable_not_finite", statuses)
    return _Lanes(
        drifts.reshape(shape),
        sizes.reshape(shape),
        statuses.reshape(shape),
        num_steps,
        float(jnp.finfo(q0.dtype).eps),
    )


@eqx.filter_jit
def _run(system, invariant, strengths, starts, h, num_steps: int, settings, _: Reads = ()):
    """Drift, last value and status of every lane; nothing is saved on the way."""

    def lane(epsilon, q0, p0):
        solution = integrate(
            system,
            q0,
            p0,
            h=h,
            num_steps=num_steps,
            epsilon=epsilon,
            save=Save(final=True),
            observe=(MaxDrift(invariant), invariant),
            throw=False,
            **settings,
        )
        return *solution.observed, solution.result

    return jax.vmap(lane)(strengths, *starts)


def _kept(good: np.ndarray) -> np.ndarray:
    """The starts that got through wherever most of them did, shape (S,); `good`: (points, S)."""
    return np.all(good[_passable(good)], axis=0)


def _passable(good: np.ndarray) -> np.ndarray:
    return 2 * good.sum(axis=1) >= good.shape[1]


def _order(epsilons: np.ndarray, lanes: _Lanes, kept: np.ndarray) -> DriftOrder:
    """The fit over the starts that count."""
    passed = _passable(lanes.good) & kept.any()
    largest = np.where(passed, lanes.drifts[:, kept].max(axis=1, initial=0), np.nan)
    drifts, floor = largest[:-1], float(largest[-1])
    rounding = lanes.sizes[-1, kept].max(initial=0) * lanes.epsilon
    floor = max(floor, 4 * rounding)
    # One rounding in each step, and ten thousand for the coefficients of the observable.
    cause = "round-off" if floor <= (10_000 + lanes.num_steps) * rounding else "mesh"
    excluded = np.full(len(epsilons), "", dtype="<U9")
    excluded[~(drifts > _ABOVE_FLOOR * floor)] = cause
    if not passed[-1]:
        cause = "failed"
        excluded[:] = "no floor"
    excluded[~passed[:-1]] = "failed"
    candidates = excluded == ""
    level = plateau_level(epsilons[candidates], drifts[candidates])
    excluded[candidates & ~(drifts > _ABOVE_FLOOR * level)] = "flat"
    used = excluded == ""
    fit = small_epsilon_exponent(epsilons[used], drifts[used], max(floor, level))
    return DriftOrder(
        epsilons, drifts, floor, cause, used, excluded, fit.slope, fit.stderr, kept, lanes.drifts,
        lanes.statuses, fit,
    )  # fmt: skip


def _check_observable(invariant: Any) -> None:
    if not callable(invariant):
        raise TypeError(
            f"invariant must be one observable, got {type(invariant).__name__}. Of a Discovery "
            "take one of its `invariants`."
        )


def _positive(name: str, values: Any, increasing: bool = False) -> np.ndarray:
    given = values
    try:
        values = np.asarray(values, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a list of positive numbers, got {given!r}.") from None
    if values.ndim != 1 or len(values) == 0 or not (np.isfinite(values) & (values > 0)).all():
        raise ValueError(f"{name} must be a list of positive numbers, got {values.tolist()}.")
    if increasing and (np.diff(values) <= 0).any():
        raise ValueError(f"{name} must increase, got {values.tolist()}.")
    if len(np.unique(values)) < len(values):
        raise ValueError(f"{name} must be distinct, got {values.tolist()}.")
    return values


def _starts(q0: Any, p0: Any, batched: bool):
    """The starts as arrays (S, *state)."""
    q0, p0 = start_state(q0, p0)
    if not batched:
        return q0[None], p0[None]
    if q0.ndim == 0:
        raise ValueError(
            "with batched=True, q0 and p0 must have a first axis of starts, (S, *state); got "
            "single numbers."
        )
    return q0, p0


def _settings(t0, args, method, newton, integrator) -> dict[str, Any]:
    integrator = chosen(integrator, method=method, root_finder=newton)
    return {"t0": t0, "args": jax.tree.map(as_parameter, args), "integrator": integrator}


def _span(values: np.ndarray) -> str:
    low, high = f"{values.min():.3g}", f"{values.max():.3g}"
    return low if low == high else f"{low} … {high}"


def _starts_left_out(kept: np.ndarray, statuses: np.ndarray) -> list[str]:
    """Lines about the starts that do not count; `statuses`: shape (points, S)."""
    lost = np.flatnonzero(~kept)
    if not len(lost):
        return []
    failed = statuses[:, lost]
    names = ", ".join(np.unique(failed[failed != "successful"]))
    some = ", ".join(map(str, lost[:8])) + (", …" if len(lost) > 8 else "")
    return [f"  left out: {len(lost)} of {len(kept)} starts ({names}): number {some}"]
