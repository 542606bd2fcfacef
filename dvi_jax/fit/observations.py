"""Observations: times, values and errors, checked."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeAlias

import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, instance
from ..base.inputs import refuse_unit_or_mask
from ..base.printing import printable
from ..base.signature import with_time
from .arrays import check_times, covariance_of, period_of, real_array, sigma_of
from .checks import require_all, requires
from .events import EventTimes

# Observables of a state that have a name.
OBSERVABLES: dict[str, Callable[..., Any]] = {
    "positions": lambda t, q, p, args: q,
    "momenta": lambda t, q, p, args: p,
    "state": lambda t, q, p, args: jnp.concatenate([jnp.ravel(q), jnp.ravel(p)]),
}


@printable
@dataclass(frozen=True, eq=False)
class Observations:
    r"""Observed values along one arc of a trajectory.

    - `ts`: times, shape (N,), ascending or descending, no two equal, and all on one side of t0.
      Either order may be combined with either sign of h; a `FitResult` has the order given here.
    - `values`: observed values, shape (N, ...), for one component also (N,); NaN, or a masked
      number, where a component is missing. Only `values` may be masked.
    - `observe`: the observable of a state: ``"positions"`` (q, the default), ``"momenta"`` (p),
      ``"state"`` (both in one vector), or a function ``(q, p)`` or ``(t, q, p, args)`` that
      returns an array of the shape of one value: a range, an angle, one body of many.
    - `sigma`: standard errors: one number, or an array that broadcasts to `values`. Without them
      all values have the same error, whose size is estimated from the residuals.
    - `covariance`: instead of sigma, covariances of the K components of one observation in the
      order of ``ravel``: shape (K, K) for all, or (N, K, K).
    - `t0`: time of the arc's start, to which the model's q0 and p0 belong; ``ts[0]`` if left out.
      A fit of a model with a given q0 or p0 warns then, unless ``ts[0]`` is 0.
      The sign of the model's h must lead from t0 to the observations.
    - `period`: of values that are equal modulo it, such as angles (2π, 360): one positive number,
      or an array that broadcasts to one value, infinite for components without. Residuals then
      are between −period/2 and period/2, and the predictions of a result on the branch nearest to
      the observed values.

    - `events`: observed times of events on the same arc, an `EventTimes` or several, one for each
      planet for instance; `ts` and `values` may then be left out. t0 is required, best shortly
      before the first event. A result has their times as the last components, at the union of all
      times, NaN where an event was not observed.

    Other observations of several kinds along one arc are one `observe` that returns them all, at
    the union of their times, with NaN for what was not observed.

    **Raises** `ValueError` or `TypeError` for invalid input: times that are not finite, not in
    order, equal or on both sides of t0; values of another shape, infinite, or all missing; errors
    that are zero, negative or NaN; a covariance that is not positive definite.
    """

    ts: Any = None
    values: Any = None
    observe: str | Callable[..., Any] = "positions"
    sigma: Any = None
    covariance: Any = None
    t0: float | None = None
    period: Any = None
    events: Any = ()
    t0_is_given: bool = field(init=False, default=False, repr=False)
    _by_time: ClassVar[tuple[str, ...]] = ("ts", "values", "sigma", "covariance")

    def __post_init__(self):
        values = self.values
        if np.ma.is_masked(values):
            values = np.ma.filled(values.astype(float), np.nan)
        events = (self.events,) if isinstance(self.events, EventTimes) else tuple(self.events)
        for i, kind in enumerate(events):
            instance(f"events[{i}]", kind, EventTimes, "a dvi.EventTimes")
        ts = self.ts
        if events and ts is None and values is None:
            ts, values = np.zeros(0), np.zeros((0, 0))
            fits = all(x is None for x in (self.sigma, self.covariance, self.period))
            rule = "ts and values (dvi.EventTimes has its own sigma)"
            requires(fits, "sigma, covariance or period", rule, "events alone")
        ts, values = real_array("ts", ts), real_array("values", values)
        is_name, observe = isinstance(self.observe, str), self.observe
        if is_name and observe not in OBSERVABLES:
            raise TypeError(
                'observe must be "positions", "momenta", "state" or a function (q, p) or '
                f"(t, q, p, args), got {observe!r:.200}."
            )
        if not is_name:
            hint = 'or "positions", "momenta" or "state"'
            object.__setattr__(self, "observe", with_time(f"observe ({hint})", observe))
        if ts.ndim != 1 or (ts.size == 0 and not events) or values.shape[:1] != ts.shape:
            raise ValueError(
                "ts must be a one-dimensional array of times, not empty, and values must have one "
                f"row for each, got shapes {ts.shape} and {values.shape}."
            )
        check_times(ts)
        require_all("values", values, ~np.isinf(values), "finite", "NaN means a missing value.")
        if values.size and np.isnan(values).all():
            count = values.size
            raise ValueError(f"values must have at least one number, got {count} values, all NaN.")
        refuse_unit_or_mask("t0", self.t0)
        requires(self.t0 is not None or not events, "events of dvi.Observations", "t0", "None")
        t0 = finite("t0", ts[0] if self.t0 is None else self.t0)
        times = np.concatenate([ts, *(kind.times for kind in events)])
        if times.min() < t0 < times.max():
            raise ValueError(
                f"ts must be on one side of t0 = {t0}, got times from {times.min()} to "
                f"{times.max()}. "
                "Leave out those before t0, or fit the state at the first time: t0=ts[0]."
            )
        hint = "A start at an event is no event of a run: give an earlier t0, or a later one."
        is_start = any(t0 in kind.times for kind in events)
        requires(not is_start, "an event", "a time other than t0", f"t0 = {t0}", hint)
        fields: dict[str, Any] = {"ts": ts, "values": values, "t0": t0, "events": events}
        if self.sigma is not None:
            fields["sigma"] = sigma_of(self.sigma, values)
        if self.covariance is not None:
            if self.sigma is not None:
                raise ValueError("only one of sigma and covariance can be given, got both.")
            fields["covariance"] = covariance_of(self.covariance, values)
        if self.period is not None:
            fields["period"] = period_of(self.period, values.shape[1:])
        errors = [self.sigma is not None or self.covariance is not None] * bool(ts.size)
        errors += [kind.sigma is not None for kind in events]
        fits = all(errors) or not (any(errors) or (events and ts.size))
        requires(fits, "an arc of several kinds", "sigma of all of them", f"{errors}")
        fields["t0_is_given"] = self.t0 is not None
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def in_columns(self) -> "Observations":
        """The same observations with values of shape (N, 1) in place of (N,)."""
        sigma = None if self.sigma is None else self.sigma[:, None]
        return replace(self, values=self.values[:, None], sigma=sigma)

    @property
    def function(self) -> Callable[..., Any]:
        """`observe` as a function (t, q, p, args)."""
        return OBSERVABLES[self.observe] if isinstance(self.observe, str) else self.observe

    def in_time_order(self) -> "Observations":
        """The same observations in the order in which a run from t0 reaches them."""
        if abs(self.ts[0] - self.t0) <= abs(self.ts[-1] - self.t0):
            return self
        fields = {name: getattr(self, name) for name in self._by_time}
        return replace(self, **{n: None if x is None else x[::-1] for n, x in fields.items()})

    @property
    def components(self) -> int:
        """Number of components of one observation."""
        return int(np.prod(self.values.shape[1:], dtype=int))

    @property
    def has_errors(self) -> bool:
        """Whether sigma or covariance was given."""
        of_values = self.sigma is not None or self.covariance is not None
        return of_values or any(kind.sigma is not None for kind in self.events)

    @property
    def errors(self) -> np.ndarray:
        """Standard error of each value, of the shape of `values`; NaN where none was given."""
        if self.covariance is not None:
            return np.sqrt(np.einsum("nii->ni", self.covariance)).reshape(self.values.shape)
        return np.full(self.values.shape, np.nan) if self.sigma is None else self.sigma

    def whitening(self) -> np.ndarray:
        """Factors by which residuals become independent with unit variance.

        Shape (N, K), or (N, K, K) for covariances: L⁻¹ of C = L Lᵀ of the observed components;
        rows and columns of missing ones are zero.
        """
        flat = self.values.reshape(len(self.ts), -1)
        is_observed = ~np.isnan(flat)
        if self.covariance is None:
            sigma = 1.0 if self.sigma is None else self.sigma.reshape(flat.shape)
            return np.where(is_observed, 1 / np.where(is_observed, sigma, 1.0), 0.0)
        factors = np.zeros((*flat.shape, flat.shape[1]))
        for i, (C, good) in enumerate(zip(self.covariance, is_observed, strict=True)):
            if good.any():
                L = np.linalg.cholesky(C[np.ix_(good, good)])
                factors[i][np.ix_(good, good)] = np.linalg.solve(L, np.eye(len(L)))
        return factors


@dataclass(frozen=True, eq=False)
class JoinedObservations(Observations):
    """Values and event times of one arc at the union of their times, shape (N, K + E).

    `plain_shape`: the shape of one value, None if there are only events. `kinds`: the E events,
    `rows` their `EventTimes.rows`, (N, E, 3). `reach`: the time that a run has to reach.
    """

    plain_shape: tuple[int, ...] | None = None
    kinds: tuple[EventTimes, ...] = ()
    rows: Any = None
    reach: float = 0.0
    _by_time: ClassVar[tuple[str, ...]] = (*Observations._by_time, "rows")

    def __post_init__(self):  # the parts have been checked
        object.__setattr__(self, "t0_is_given", True)

    def in_columns(self) -> "JoinedObservations":
        return self


def joined(arc: Observations) -> Observations:
    """The arc with its events as further components of its values."""
    if not arc.events:
        return arc
    t0, kinds = arc.t0, tuple(kind.ordered(t0=arc.t0) for kind in arc.events)
    ts = np.unique(np.concatenate([arc.ts, *(kind.times for kind in kinds)]))
    count, width = len(ts), arc.components
    values, errors = np.full((2, count, width + len(kinds)), np.nan)
    rows, period = np.full((count, len(kinds), 3), np.nan), np.full(width + len(kinds), np.inf)
    place = np.searchsorted(ts, arc.ts)
    values[place, :width] = arc.values.reshape(len(place), width)
    errors[place, :width] = arc.errors.reshape(len(place), width)
    for i, kind in enumerate(kinds):
        moment = np.searchsorted(ts, kind.times)
        values[moment, width + i] = kind.times
        errors[moment, width + i] = np.nan if kind.sigma is None else kind.sigma
        rows[moment, i] = kind.rows(t0)
    fields: dict[str, Any] = {"sigma": errors if arc.has_errors else None}
    if arc.covariance is not None:
        full = np.eye(width + len(kinds)) * np.where(np.isnan(errors), 1.0, errors)[:, None] ** 2
        full[place, :width, :width] = arc.covariance
        fields = {"covariance": full}
    if arc.period is not None:
        period[:width] = arc.period.ravel()
        fields["period"] = period
    ends = [kind.end(t0) for kind in kinds] + [arc.ts[i] for i in (0, -1) if width]
    fields |= {"reach": max(ends, key=lambda t: abs(t - t0)), "kinds": kinds, "rows": rows}
    shape = arc.values.shape[1:] if width else None
    return JoinedObservations(ts, values, arc.observe, t0=t0, plain_shape=shape, **fields)


# One arc, or several.
Data: TypeAlias = Observations | list[Observations] | tuple[Observations, ...]


def as_arcs(data: Any) -> tuple[list[Observations], bool]:
    """The arcs, with their events as components, and whether they were given as a list.

    **Raises** `TypeError` for anything but `Observations`, `ValueError` for an empty list and when
    some arcs have errors and some have none.
    """
    if isinstance(data, Observations):
        return [joined(data)], False
    instance("data", data, list | tuple, "a dvi.Observations or a list of them, one for each arc")
    if not data:
        raise ValueError(f"data must contain at least one dvi.Observations, got {data!r}.")
    for i, arc in enumerate(data):
        instance(f"data[{i}]", arc, Observations, "a dvi.Observations")
    flags = [arc.has_errors for arc in data]
    if any(flags) and not all(flags):
        raise ValueError(
            "all arcs must have sigma or covariance, or none of them, got one for "
            f"data[{flags.index(True)}], but not for data[{flags.index(False)}]."
        )
    return [joined(arc) for arc in data], True


def nearest_branch(values: Any, observed: Any, period: Any) -> Any:
    """Predictions shifted by whole periods to the branch nearest to the observed values; `period`:
    infinite for components that are not periodic, or None for all."""
    if period is None:
        return values
    period = jnp.broadcast_to(period, values.shape)
    turns = jnp.round((values - observed) / period)
    return values - jnp.where(jnp.isfinite(period), period, 0.0) * turns
