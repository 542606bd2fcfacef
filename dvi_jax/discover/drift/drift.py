"""The order in ε to which something is conserved, measured along trajectories."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...base.checks import function
from ...base.inputs import as_parameter, as_scalar, start_state
from ...base.keywords import checked_keywords
from ...base.reads import Reads, reads
from ...base.results import status_name
from ...integration.integrate import integrate
from ...integration.keywords import MethodSettings, integrator_of
from ...observe import MaxDrift
from ...observe.solution import Save
from ...problem.system import System, check_system
from .exponents import line, plateau_level, small_epsilon_exponent
from .orders import ABOVE_FLOOR, DriftOrder, DriftSurface


@checked_keywords
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
    **settings: Unpack[MethodSettings],
) -> DriftOrder:
    r"""The exponent of ε in the largest drift of a scalar along trajectories.

        max over initial conditions and k of |I_ε(k) − I_ε(1)| ∝ ε^slope

    The slope is z + 1 for an invariant of order z. All ε and initial conditions are one batch,
    reduced on the device: memory does not grow with num_steps. The same runs at ε = 0 give the
    floor, which the mesh or round-off causes. The order is fitted to the points that are more
    than ten times above it, and above a plateau at the smallest ε if there is one; the others are
    excluded and reported.

    Several laws are compared: one power, the sum or the difference of two, saturation at large
    ε, a resonance. The report gives the order for ε → 0 only where the points determine it to
    ± 0.3 whichever of these laws holds. Otherwise it says that no order is resolved, and which ε
    would resolve it.

    An ε at which more than half of the initial conditions fail is excluded. One that fails at any
    other ε is left out at all of them: every point is the largest over the same ones.

    **Arguments**

    - `invariant`: an observable: a function of one step, an `InvariantSeries`, an
      `AdiabaticInvariant`.
    - `q0`, `p0`: one state; with ``batched=True`` many, along the first axis: (S, *state).
    - `epsilons`: strengths, shape (E,), positive, no two the same, in any order.
    - `h`, `num_steps`, and the keywords `t0`, `args`, `method`, `root_finder`,
      `integrator`: as for `integrate`.

    **Returns** a `DriftOrder`; its slope is NaN when fewer than three points can be used.

    **Raises** `ValueError` for epsilons that are not positive, finite and distinct, states that
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
    starts = _starts(q0, p0, batched)
    h = float(as_scalar("h", h, starts[0].dtype, zero_allowed=False))
    lanes = _sweep(system, invariant, starts, epsilons, h, num_steps, _run_settings(settings))
    return order_of(epsilons, lanes, valid_starts(lanes.good))


@checked_keywords
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
    **settings: Unpack[MethodSettings],
) -> DriftSurface:
    r"""The largest drift of a scalar over ε and h, and its order in each.

        max over initial conditions and k of |I(k) − I(1)|    with t_k − t0 ≤ duration

    At each h one sweep as in `drift_order`, over round(duration / h) steps; the number of steps
    differs, so each h is compiled on its own. The drift at ε = 0 is due to the mesh: where it is
    above round-off its order in h is measured. What fails is treated as in `drift_order`.

    **Arguments**

    - `invariant`: an observable, or a sequence with one for each h (a discovered invariant
      belongs to the h it was found for).
    - `q0`, `p0`: one state; with ``batched=True`` many, along the first axis: (S, *state).
    - `epsilons`: strengths, shape (E,); `hs`: step sizes [time], shape (H,); both positive and
      increasing.
    - `duration`: of each trajectory [time], at least two of the longest steps.
    - the keywords `t0`, `args`, `method`, `root_finder`, `integrator`: as for
      `integrate`.

    **Returns** a `DriftSurface`.

    **Raises** `ValueError` for epsilons or hs that are not positive and increasing, a duration
    that is too short, states that are not of one shape, observables that are not one for each
    step size, or one that is not a scalar.
    """
    epsilons = _positive("epsilons", epsilons, increasing=True)
    hs = _positive("hs", hs, increasing=True)
    is_number = isinstance(duration, int | float | np.number)
    if not is_number or not np.isfinite(duration) or duration < 2 * hs[-1]:
        raise ValueError(
            f"duration must be a finite number of at least {2 * hs[-1]}, twice the longest step in "
            f"hs, got {duration!r:.200}."
        )
    invariants = list(invariant if isinstance(invariant, Sequence) else [invariant] * len(hs))
    if len(invariants) != len(hs):
        raise ValueError(
            f"invariant must be one observable, or a list of {len(hs)}, one for each step size in "
            f"hs, got {len(invariants)}."
        )
    for observable in invariants:
        _check_observable(observable)
    starts, run = _starts(q0, p0, batched), _run_settings(settings)
    num_steps = np.round(duration / hs).astype(int)
    lanes = [
        _sweep(system, observable, starts, epsilons, float(h), int(steps), run)
        for observable, h, steps in zip(invariants, hs, num_steps, strict=True)
    ]
    valid = valid_starts(np.concatenate([lane.good for lane in lanes]))
    orders = tuple(order_of(epsilons, lane, valid) for lane in lanes)
    floors = np.array([o.floor for o in orders])
    by_mesh = np.isfinite(floors) & np.array([o.floor_cause == "mesh" for o in orders])
    mesh_slope, mesh_stderr = line(np.log(hs[by_mesh]), np.log(floors[by_mesh]))
    return DriftSurface(epsilons, hs, num_steps, orders, by_mesh, mesh_slope, mesh_stderr)


class Drifts(NamedTuple):
    """Results of a sweep, shape (E + 1, S), the last row at ε = 0; `sizes` of the observable;
    `epsilon`: the relative rounding of one operation."""

    drifts: np.ndarray
    sizes: np.ndarray
    statuses: np.ndarray
    num_steps: int
    epsilon: float

    @property
    def good(self) -> np.ndarray:
        return self.statuses == "successful"


def _sweep(system, invariant, starts, epsilons, h, num_steps, run) -> Drifts:
    """Every initial condition at every ε and at 0, as one batch."""
    check_system(system)
    shape, dtype = (len(epsilons) + 1, len(starts[0])), starts[0].dtype
    strengths = jnp.repeat(jnp.append(jnp.asarray(epsilons, dtype), 0), shape[1])
    starts = tuple(jnp.concatenate([x] * shape[0]) for x in starts)
    run = {"h": h, "num_steps": num_steps, **run}
    arrays = run_trajectories(system, invariant, strengths, starts, run, reads(invariant, run))
    drifts, last, result = arrays
    if drifts.ndim != 1:
        shape = drifts.shape[1:]
        raise ValueError(
            f"invariant must return a scalar, got an array of shape {shape}: take one component."
        )
    drifts = np.asarray(drifts, float)
    # An odd observable may end near zero: its drift shows how large it was.
    sizes = np.abs(np.asarray(last, float)[:, -1]) + drifts
    statuses = status_name(result)
    blind = (statuses == "successful") & ~np.isfinite(drifts)
    statuses = np.where(blind, "observable_not_finite", statuses)
    drifts, sizes, statuses = (x.reshape(shape) for x in (drifts, sizes, statuses))
    return Drifts(drifts, sizes, statuses, num_steps, float(jnp.finfo(dtype).eps))


@eqx.filter_jit
def run_trajectories(system, invariant, strengths, starts, run, _: Reads = ()):
    """Drift, last value and status of every trajectory; no state in between is saved."""

    def lane(epsilon, q0, p0):
        observe = (MaxDrift(invariant), invariant)
        keywords = {"epsilon": epsilon, "observe": observe, "save": Save(final=True), **run}
        solution = integrate(system, q0, p0, throw=False, **keywords)
        return *solution.observed, solution.result

    return jax.vmap(lane)(strengths, *starts)


def valid_starts(good: np.ndarray) -> np.ndarray:
    """The initial conditions that succeed wherever most do, shape (S,); `good`: (points, S)."""
    return np.all(good[_passable(good)], axis=0)


def _passable(good: np.ndarray) -> np.ndarray:
    return 2 * good.sum(axis=1) >= good.shape[1]


def order_of(epsilons: np.ndarray, lanes: Drifts, valid: np.ndarray) -> DriftOrder:
    """The fit over the initial conditions that count."""
    passable = _passable(lanes.good) & valid.any()
    largest = np.where(passable, lanes.drifts[:, valid].max(axis=1, initial=0), np.nan)
    drifts, floor = largest[:-1], float(largest[-1])
    rounding = lanes.sizes[-1, valid].max(initial=0) * lanes.epsilon
    floor = max(floor, 4 * rounding)
    # One rounding in each step, and ten thousand for the coefficients of the observable.
    cause = "round-off" if floor <= (10_000 + lanes.num_steps) * rounding else "mesh"
    reasons = np.full(len(epsilons), "", dtype="<U9")
    reasons[~(drifts > ABOVE_FLOOR * floor)] = cause
    if not passable[-1]:
        cause = "failed"
        reasons[:] = "no floor"
    reasons[~passable[:-1]] = "failed"
    candidates = reasons == ""
    level = plateau_level(epsilons[candidates], drifts[candidates])
    reasons[candidates & ~(drifts > ABOVE_FLOOR * level)] = "flat"
    is_fitted = reasons == ""
    fit = small_epsilon_exponent(epsilons[is_fitted], drifts[is_fitted], max(floor, level))
    points = epsilons, drifts, floor, cause, is_fitted, reasons
    return DriftOrder(*points, fit.slope, fit.stderr, valid, lanes.drifts, lanes.statuses, fit)


def _check_observable(invariant: Any) -> None:
    function("invariant", invariant, hint="If you have a Discovery, give one of its `invariants`.")


def _positive(name: str, values: Any, increasing: bool = False) -> np.ndarray:
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        array = np.zeros(())
    is_positive = array.ndim == 1 and array.size and (np.isfinite(array) & (array > 0)).all()
    ascending = array if increasing else np.sort(array, axis=None)
    if not is_positive or (np.diff(ascending) <= 0).any():
        rule = "in increasing order" if increasing else "no two of them equal"
        raise ValueError(f"{name} must be positive, finite numbers, {rule}, got {values!r:.200}.")
    return array


def _starts(q0: Any, p0: Any, is_batch: bool):
    """The initial conditions as arrays (S, *state)."""
    q0, p0 = start_state(q0, p0)
    if not is_batch:
        return q0[None], p0[None]
    if q0.ndim == 0:
        raise ValueError(
            "q0 and p0 must have the initial conditions along the first axis for batched=True, got "
            f"the numbers {q0} and {p0}."
        )
    return q0, p0


def _run_settings(settings: MethodSettings) -> dict[str, Any]:
    """The keywords of both functions as those of `integrate`."""
    integrator, run = integrator_of(settings)
    args = jax.tree.map(as_parameter, run.get("args"))
    return {"t0": 0.0, **run, "args": args, "integrator": integrator}
