"""Observed times of events: transits, eclipses, passages of an apsis."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..base.checks import one_of, whole
from ..base.printing import printable
from ..base.signature import with_time
from ..observe import Crossings
from .arrays import check_times, real_array, sigma_of
from .checks import require_all, require_shape

_DELAY = 0.05  # Part of an arc by which the last event may be later than it was observed


@printable
@dataclass(frozen=True, eq=False)
class EventTimes:
    r"""Observed times of one kind of event, g(t, q, p, args) = 0, for ``Observations(events=...)``.

    - `g`: function ``(q, p)`` or ``(t, q, p, args)`` → scalar, as for `Section`: x of a planet
      relative to its star for transits and eclipses, q·p for passages of the apsides.
    - `times`: shape (N,), ascending or descending, no two equal.
    - `sigma`: standard errors of the times: one number, or shape (N,).
    - `epochs`: numbers of the events in the order of time, integers, with gaps where an event was
      not observed. Their origin is arbitrary: the computed event nearest to the first observed one
      (as seen from t0) has its number, the others follow by counting. None: each time belongs to
      the nearest computed event, which may be wrong by whole periods for a poor initial guess.
    - `direction`: 1 for events where g increases with time, −1 where it decreases, 0 for both.
    - `max_events`: the largest number of computed events on the arc; None: half as many again as
      the epochs suggest, or without them the smallest distance between two times.

    The predictions are the times of a `Section`, differentiable by the implicit function theorem. A
    computed event that does not exist is NaN, and its trajectory has the status `not_reached`.

    **Raises** `ValueError` or `TypeError` for invalid input; in `fit` for a g that is not a scalar.

    **Example**

    ```python
    epochs = np.array([0, 1, 2, 4, 5])                    # one was missed
    seen = 1.0 + 2 * np.pi / 1.1 * epochs + 0.001 * np.random.default_rng(0).normal(size=5)
    rises = dvi.EventTimes(lambda q, p: q[0], seen, sigma=0.001, epochs=epochs)
    spring = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2)
    model = dvi.Model(spring, h=0.05, p0=[0.5], method=dvi.Yoshida(4))
    start = {"q0": np.array([-0.9]), "args": {"k": 1.2}}
    fit = dvi.fit(model, dvi.Observations(events=rises, t0=0.0), start)
    print(fit.status, round(float(fit.params["args"]["k"]), 3))
    # converged 1.21
    ```
    """

    g: Callable[..., Any]
    times: Any
    sigma: Any = None
    epochs: Any = None
    direction: int = 1
    max_events: int | None = None

    def __post_init__(self):
        times = real_array("times", self.times)
        require_shape("times", times, (times.size or 1,), hint="One time for each event.")
        check_times(times, "times")
        fields = {"g": with_time("g of EventTimes", self.g), "times": times}
        if self.sigma is not None:
            fields["sigma"] = sigma_of(self.sigma, times)
        if self.epochs is not None:
            epochs = real_array("epochs", self.epochs)
            require_shape("epochs", epochs, times.shape, hint="One number for each time.")
            require_all("epochs", epochs, epochs == np.rint(epochs), "integers")
            steps = np.diff(epochs, prepend=np.nan) * np.sign(np.diff(times, prepend=np.nan))
            hint = "The number of a later event is larger."
            require_all("epochs", epochs, ~(steps <= 0), "in the order of times", hint)
            fields["epochs"] = epochs
        one_of("direction", self.direction, (1, -1, 0))
        if self.max_events is not None:
            whole("max_events", self.max_events)
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def ordered(self, t0: float) -> "EventTimes":
        """The same in the order in which a run from t0 reaches the events, with `max_events`."""
        names = ("times", "sigma", "epochs")
        fields = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if abs(self.times[0] - t0) > abs(self.times[-1] - t0):
            fields = {name: values[::-1] for name, values in fields.items()}
        estimate = math.ceil(1.5 * abs(self.end(t0) - t0) / self.spacing(t0)) + 10
        return replace(self, max_events=self.max_events or estimate, **fields)

    def spacing(self, t0: float) -> float:
        """The time between two events, from their epochs or the nearest two."""
        if self.times.size == 1:
            return abs(self.times[0] - t0)
        if self.epochs is None:
            return np.abs(np.diff(self.times)).min()
        return abs(np.ptp(self.times) / np.ptp(self.epochs))

    def end(self, t0: float) -> float:
        """A time that a run has to reach, later than the last event seen from t0."""
        span = max(self.times - t0, key=abs)
        return t0 + (1 + _DELAY) * span + math.copysign(self.spacing(t0), span)

    def rows(self, t0: float) -> np.ndarray:
        """For each time, as `ordered`, see `computed_times`: the time by which an event is
        identified, the count from there, and the time between two events; shape (N, 3)."""
        is_counted = self.epochs is not None
        reference = np.full(self.times.shape, self.times[0]) if is_counted else self.times
        counts = np.abs(self.epochs - self.epochs[0]) if is_counted else np.zeros(self.times.shape)
        return np.stack([reference, counts, np.full(self.times.shape, self.spacing(t0))], axis=1)


def computed_times(crossed: Crossings, rows: Array) -> Array:
    """The computed time of each observed event, shape (N,); NaN if it does not exist.

    `rows`, (N, 3): the computed event nearest to a time, and so many events later; NaN where no
    event was observed.
    """
    size = crossed.ts.shape[0]
    distance = jnp.abs(lax.stop_gradient(crossed.ts)[None] - rows[:, :1])
    nearest = jnp.argmin(jnp.where(jnp.isnan(distance), jnp.inf, distance), axis=1)
    # The next event would be nearer, if there was a place for it.
    is_cut = (nearest == size - 1) & (crossed.count > size)
    index = jnp.where(is_cut, size, nearest + rows[:, 1].astype(int))
    return crossed.ts.at[index].get(mode="fill", fill_value=jnp.nan)
