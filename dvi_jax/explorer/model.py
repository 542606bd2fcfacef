"""The pictures of the page as numbers: motion, section, orbit diagram, drifts. No browser."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.inputs import as_parameter
from ..base.results import RESULTS
from ..discover import Polynomials, discover_invariants, drift_order
from ..dynamics import bifurcation, poincare_section
from ..integration.integrate import integrate
from ..sweep import Axis
from .orbits import Plane, Strobe, in_chunks, indicator, onto_energy
from .subject import Settings, Subject, with_leaf

STEPS = (1000, 10_000, 100_000)
"""Choices of the number of steps; each is compiled once."""

MOST_POINTS, BINS = 15_000, 600
"""Points of a trajectory that are drawn, and pairs of least and largest values of a series."""

SECTION_STEPS, CROSSINGS = 20_000, 400
DIAGRAM_STEPS, DIAGRAM_CROSSINGS, DIAGRAM_SKIP, RUNS = 4000, 40, 20, 160
EPSILONS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
DRIFT_STEPS, DRIFT_STARTS, MOST_FUNCTIONS = 1000, 8, 500
MOST_ORBITS = 64

STROBE = "stroboscope"


class Motion(NamedTuple):
    """One trajectory, decimated.

    - `paths`: name → (x, y), one entry for each body. `is_line`: whether neighbouring points are
      neighbouring states, so that a line may join them.
    - `series`: (t, values) of the observable. `changes`: name → (t, size of the change).
    - `labels`: of x, y and the observable. `message`: "" or why it failed. `seconds`: of the work.
    """

    paths: dict[str, tuple[np.ndarray, np.ndarray]]
    is_line: bool
    series: tuple[np.ndarray, np.ndarray]
    changes: dict[str, tuple[np.ndarray, np.ndarray]]
    labels: tuple[str, str, str]
    message: str
    seconds: float


class SectionPicture(NamedTuple):
    """Crossings: x, y, shapes (orbits, crossings), NaN behind the last; `colour`: shape (orbits,).

    - `starts`: (x, y) of the orbits that were clicked.
    """

    x: np.ndarray
    y: np.ndarray
    colour: np.ndarray | None
    starts: np.ndarray
    labels: tuple[str, str]
    message: str
    seconds: float


class Diagram(NamedTuple):
    """Orbit diagram: `parameter`, shape (runs,), and y of the crossings, (runs, crossings)."""

    parameter: np.ndarray
    y: np.ndarray
    labels: tuple[str, str]
    message: str
    seconds: float


class Drifts(NamedTuple):
    """Drift of each invariant against ε: formulas, and their `DriftOrder`."""

    formulas: list[str]
    orders: list[Any]
    message: str


class Model:
    """What the page shows, and how it is computed. The page calls this, and so can a test.

    - `settings`: the numbers and choices of the pictures. `orbits`: (x, y) of the points of a
      section from which further orbits begin.
    """

    def __init__(self, subject: Subject):
        self.subject = subject
        self.settings: Settings = subject.start
        self.orbits: list[tuple[float, float]] = []

    # Changes

    def change(self, **choices: Any) -> None:
        """Change choices such as method="Strang", steps=1000."""
        self.settings = replace(self.settings, **choices)

    def move(self, key: str, value: float) -> None:
        """Set the number of a slider. **Raises** `ValueError`; the settings are then unchanged."""
        settings = self.subject.write(self.settings, key, value)
        self.subject.check(settings)
        self.settings = settings

    def click(self, x: float, y: float) -> None:
        """Begin an orbit at a point of the section.

        **Raises** `ValueError` where there is no state of the energy of the initial condition.
        """
        if len(self.orbits) >= MOST_ORBITS:
            raise ValueError(f"the section has {MOST_ORBITS} orbits already: clear it first.")
        _, p = self._states([(x, y)])
        if not np.isfinite(p).all():
            raise ValueError(
                f"no state at ({x:.4g}, {y:.4g}) has the energy {self._energy():.6g} of the initial"
                " condition and crosses the surface: click nearer to the other orbits."
            )
        self.orbits.append((x, y))

    # Choices

    def surfaces(self) -> list[str]:
        """The surfaces of sections: coordinates q[i] = value, and a stroboscope."""
        names = [n for n, (kind, _) in self.subject.coordinates.items() if kind == "q"]
        return [*(names[:12] if len(names) > 1 else []), STROBE]

    @property
    def surface(self) -> str:
        """The surface of the section."""
        return self.settings.surface or self.surfaces()[0]

    def section_axes(self) -> tuple[str, str]:
        """The coordinates that a section shows: those chosen, or the first free pair."""
        if self.settings.axes:
            return self.settings.axes
        names = [n for n, (kind, _) in self.subject.coordinates.items() if kind == "q"]
        free = next(n for n in names if n != self.surface)
        return free, "p" + free[1:]

    def orbit_axes(self) -> tuple[str, str]:
        """The coordinates of the picture of a trajectory."""
        names = list(self.subject.coordinates)
        count = len(names) // 2
        return self.settings.path or (names[0], names[1 if count > 1 else count])

    def diagram_range(self) -> tuple[str, float, float]:
        """The parameter of the orbit diagram, and its ends."""
        subject = self.subject
        names = self.diagram_parameters()
        if not names:
            raise ValueError(f"{subject.title} has neither a perturbation nor parameters to vary.")
        name = self.settings.parameter or names[0]
        control = next(c for c in subject.controls() if c.key == name)
        ends = self.settings.ends or (0.0 if name == "epsilon" else control.low, control.high)
        return name, *ends

    def diagram_parameters(self) -> list[str]:
        """ε and the numbers of args, but no entries of arrays."""
        keys = [control.key for control in self.subject.controls()]
        return [key for key in keys if key == "epsilon" or (key[:4] == "args" and "[" not in key)]

    # Pictures

    def run_options(self) -> dict[str, Any]:
        """The keywords of `dvi.integrate` that all pictures share."""
        settings = self.settings
        args = jax.tree.map(as_parameter, settings.args)
        method = self.subject.method(settings)
        return {"h": settings.h, "epsilon": settings.epsilon, "args": args, "method": method}

    def motion(self) -> Motion:
        """The trajectory, the observable, and the changes of the invariants."""
        began = time.perf_counter()
        subject, settings = self.subject, self.settings
        steps, observables = settings.steps, subject.observables
        solution = integrate(
            subject.system, settings.q0, settings.p0, num_steps=steps, observe=observables,
            throw=False, **self.run_options(),
        )  # fmt: skip
        ts, qs, ps = (np.asarray(x) for x in (solution.ts, solution.qs, solution.ps))
        initial = self._initial()
        values = {k: _with_initial(initial[k], v, steps) for k, v in solution.observed.items()}
        x, y = self.orbit_axes()
        return Motion(
            self._paths(qs, ps), steps < MOST_POINTS,
            _envelope(ts, self._series(qs, ps, values)),
            {name: _largest(ts, _change(values[name])) for name in subject.invariants},
            (subject.label(x), subject.label(y), settings.observable or next(iter(self.series()))),
            _message(solution), time.perf_counter() - began,
        )  # fmt: skip

    def series(self) -> list[str]:
        """What can be drawn over time: observables and coordinates."""
        return [*self.subject.observables, *self.subject.coordinates]

    def section(self) -> SectionPicture:
        """The Poincaré section of the orbit of the initial condition, and of those clicked."""
        began = time.perf_counter()
        subject, settings = self.subject, self.settings
        q, p = self.section_states()
        is_state: Any = np.all(np.isfinite(p.reshape(len(p), -1)), axis=1)
        q, p = q[is_state], p[is_state]
        options, surface = self.run_options(), self._surface()

        def crossings(q, p):
            section = poincare_section(
                subject.system, q, p, surface, num_steps=SECTION_STEPS, crossings=CROSSINGS,
                throw=False, **options,
            )  # fmt: skip
            return section.qs, section.ps, section.run == RESULTS.successful

        qs, ps, good = in_chunks(crossings, q, p)
        colour = None
        if settings.colour != "orbit":
            index = subject.coordinates[self.section_axes()[0]][1]
            of_orbits = options, (q, p), index, SECTION_STEPS
            colour = indicator(settings.colour, subject.system, *of_orbits)
        axes = self.section_axes()
        x, y = (subject.column(name, qs, ps) for name in axes)
        starts = np.array(self.orbits, float).reshape(-1, 2)[is_state[1:]]
        counts = {
            "orbits have no state of this energy": int((~is_state).sum()),
            "orbits failed": int((~good).sum()),
            "orbits do not cross the surface": int((~np.isfinite(x)).all(axis=1).sum()),
        }
        message = "; ".join(f"{n} of {len(is_state)} {text}" for text, n in counts.items() if n)
        labels = subject.label(axes[0]), subject.label(axes[1])
        return SectionPicture(x, y, colour, starts, labels, message, time.perf_counter() - began)

    def section_states(self) -> tuple[np.ndarray, np.ndarray]:
        """The initial conditions of the orbits of a section, that of the sliders first."""
        settings = self.settings
        first = settings.q0[None], settings.p0[None]
        if not self.orbits:
            return first
        pairs = zip(first, self._states(self.orbits), strict=True)
        q, p = (np.concatenate(pair) for pair in pairs)
        return q, p

    def diagram(self) -> Diagram:
        """Section points against ε or a parameter."""
        began = time.perf_counter()
        subject, settings = self.subject, self.settings
        name, low, high = self.diagram_range()
        if not low < high:
            raise ValueError(f"the range of {name} must increase, got {low:g} … {high:g}.")
        values, options = np.linspace(low, high, RUNS), self.run_options()
        if name == "epsilon":
            options["epsilon"] = values
        else:
            options["args"] = with_leaf(options["args"], name, Axis("parameter", values))
        section = bifurcation(
            subject.system, settings.q0, settings.p0, self._surface(), num_steps=DIAGRAM_STEPS,
            crossings=DIAGRAM_CROSSINGS, skip=DIAGRAM_SKIP, throw=False, **options,
        )  # fmt: skip
        axis = self.section_axes()[0]
        y = subject.column(axis, np.asarray(section.qs), np.asarray(section.ps))
        bad = int(np.sum(np.asarray(section.run != RESULTS.successful)))
        text = f"{bad} of {RUNS} orbits failed" if bad else ""
        labels = "ε" if name == "epsilon" else name.removeprefix("args."), subject.label(axis)
        return Diagram(values, y, labels, text, time.perf_counter() - began)

    def box(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Corners (q, p), (q, p) of a box around the trajectory, a tenth wider."""
        settings = self.settings
        solution = integrate(
            self.subject.system, settings.q0, settings.p0, num_steps=STEPS[0], **self.run_options()
        )
        low, high = ([f(np.asarray(x), 0) for x in (solution.qs, solution.ps)]
                     for f in (np.min, np.max))  # fmt: skip
        wide = [0.05 * np.maximum(b - a, 1e-3) for a, b in zip(low, high, strict=True)]
        q_low, p_low = (np.round(a - w, 6) for a, w in zip(low, wide, strict=True))
        q_high, p_high = (np.round(b + w, 6) for b, w in zip(high, wide, strict=True))
        return q_low, p_low, q_high, p_high

    def drifts(self, report: Callable[[int, int], None] = lambda count, total: None) -> Drifts:
        """Discover invariants in polynomials of order one in ε; measure their drifts against ε.

        - `report`: called with the parts that are done, and all parts.
        """
        subject, settings = self.subject, self.settings
        if not subject.has_perturbation:
            raise ValueError(f"{subject.title} has no perturbation: ε does not change its motion.")
        basis = Polynomials(settings.degree)
        size = basis.for_shape(subject.shape).size
        if size > MOST_FUNCTIONS:
            raise ValueError(
                f"polynomials of degree {settings.degree} in {2 * settings.q0.size} variables are "
                f"{size} functions, more than the {MOST_FUNCTIONS} of this page: lower the degree, "
                "or run `dvi-jax discover`."
            )
        report(0, 1)
        q_low, p_low, q_high, p_high = self.box()
        random = np.random.default_rng(0)
        count = max(64, 4 * size)
        samples = [random.uniform(a, b, (count, *subject.shape))
                   for a, b in ((q_low, q_high), (p_low, p_high))]  # fmt: skip
        # Different times, for a map that depends on them; of a slow time one unit.
        span = 1.0 if subject.system.slow_time else DRIFT_STEPS * abs(settings.h)
        samples.append(random.uniform(0.0, span, count))
        starts = [random.uniform(a, b, (DRIFT_STARTS, *subject.shape))
                  for a, b in ((q_low, q_high), (p_low, p_high))]  # fmt: skip
        options = self.run_options()
        del options["epsilon"]
        discovery = discover_invariants(
            subject.system, basis, 1, samples=samples, representative="simplest", **options
        )
        orders, total = [], 1 + discovery.count
        report(1, total)
        for series in discovery.invariants:
            order = drift_order(
                subject.system, series, *starts, epsilons=EPSILONS, num_steps=DRIFT_STEPS,
                batched=True, **options,
            )  # fmt: skip
            orders.append(order)
            report(1 + len(orders), total)
        text = "" if orders else f"no invariant in polynomials of degree {settings.degree}"
        return Drifts([str(series) for series in discovery.invariants], orders, text)

    # Parts

    def _energy(self) -> float:
        return self.subject.energy(self.settings)

    def _surface(self) -> Any:
        if self.surface == STROBE:
            return Strobe(self.settings.period)
        return Plane(self.subject.coordinates[self.surface][1], self.settings.value)

    def _states(self, points: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
        """States at points of the section: of the energy of the initial condition, NaN where there
        is no such state; those of a stroboscope as they are."""
        subject, settings = self.subject, self.settings
        q, p = (np.repeat(x[None], len(points), 0) for x in (settings.q0, settings.p0))
        _, index = subject.coordinates.get(self.surface, ("", ()))
        if self.surface != STROBE:
            q[(..., *index)] = settings.value
        for name, values in zip(self.section_axes(), np.transpose(points), strict=True):
            subject.column(name, q, p)[...] = values
        if self.surface == STROBE:
            return q, p
        if subject.system.constraint is not None:
            raise ValueError("a click cannot begin an orbit of a system with a constraint.")
        energy = jnp.asarray(self._energy())
        options = self.run_options()
        epsilon = jnp.asarray(options["epsilon"])

        def complete(q, p):
            return onto_energy(subject.system, index, q, p, energy, epsilon, options["args"])

        return q, in_chunks(complete, q, p)

    def _initial(self) -> dict[str, np.ndarray]:
        """The observables at the initial condition."""
        settings, options = self.settings, self.run_options()
        state = jnp.asarray(settings.q0), jnp.asarray(settings.p0)
        epsilon = jnp.asarray(options["epsilon"])
        return _values(self.subject.observables, self.subject.system, *state, epsilon,
                       options["args"])  # fmt: skip

    def _series(self, qs: np.ndarray, ps: np.ndarray, values: dict[str, np.ndarray]) -> Any:
        name = self.settings.observable or self.series()[0]
        if name in self.subject.coordinates:
            return self.subject.column(name, qs, ps)
        array = values[name]
        return array if array.ndim == 1 else _size(array)

    def _paths(self, qs: np.ndarray, ps: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        stride = max(1, -(-len(qs) // MOST_POINTS))
        qs, ps = qs[::stride], ps[::stride]
        subject = self.subject
        if len(subject.shape) == 2 and not self.settings.path:
            bodies, size = subject.shape
            return {f"body {i}": (qs[:, i, 0], qs[:, i, min(1, size - 1)]) for i in range(bodies)}
        x, y = (subject.column(name, qs, ps) for name in self.orbit_axes())
        return {"": (x, y)}


@eqx.filter_jit
def _values(observables: Any, system: Any, q, p, epsilon, args) -> dict[str, Any]:
    """Observables on a step of length zero."""
    time = jnp.zeros((), q.dtype)
    functions = {
        name: f.bind(system, epsilon) if hasattr(f, "bind") else f
        for name, f in observables.items()
    }
    return {name: f(time, time, q, p, q, p, args) for name, f in functions.items()}


def _with_initial(initial: Any, values: Any, steps: int) -> np.ndarray:
    """The values at all states: those of a step lack the initial one."""
    array = np.asarray(values)
    return array if len(array) > steps else np.concatenate([np.asarray(initial)[None], array])


def _change(values: np.ndarray) -> np.ndarray:
    """Size of the change since the start, relative to the size of the start unless it is zero."""
    size = float(np.linalg.norm(values[0]))
    return _size((values - values[0]) / (size if np.isfinite(size) and size else 1.0))


def _size(values: np.ndarray) -> np.ndarray:
    """The length of each value, or its size if it is a number."""
    return np.linalg.norm(values.reshape(len(values), -1), axis=1)


def _bins(values: np.ndarray) -> np.ndarray:
    """The values in rows, at most `BINS` of them; the last row is filled with its last value."""
    width = max(1, -(-len(values) // BINS))
    count = -(-len(values) // width)
    return np.concatenate([values, np.repeat(values[-1:], count * width - len(values))]).reshape(
        count, width
    )


def _envelope(ts: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest value of each bin, in turn; all values if they are few."""
    if len(values) <= 2 * BINS:
        return ts, values
    times, rows = _bins(ts)[:, 0], _bins(values)
    return np.repeat(times, 2), np.stack([rows.min(1), rows.max(1)], 1).ravel()


def _largest(ts: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest value of each bin; NaN where it is zero, which has no place on a log axis."""
    largest = _bins(values).max(1)
    return _bins(ts)[:, -1], np.where(largest > 0, largest, np.nan)


def _message(solution: Any) -> str:
    """Why a trajectory failed, or ""."""
    if solution.status in ("successful", "stopped"):
        return ""
    step, steps = int(solution.stats["failed_step"]), int(solution.stats["num_steps"])
    text = RESULTS[solution.result]
    return f"the trajectory failed at step {step} of {steps}: {solution.status}. {text}"
