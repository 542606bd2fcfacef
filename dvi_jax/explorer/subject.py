"""What is explored: a system, its initial condition, its observables, and what sliders change."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..base.inputs import as_scalar, start_state
from ..base.precision import refuse_double_without_x64
from ..integration.integrator import default_method
from ..methods import Method
from ..methods._names import as_method
from ..observe import of_steps
from ..problem.system import System, check_system, of_problem
from ..systems import Problem

METHODS = (
    *("TypeII", "Strang", "Yoshida(4)", "BlanesMoan(4)", "KahanLi(6)", "KahanLi(8)"),
    *("GaussLegendre(2)", "LobattoIIIAIIIB(3)", "RungeKutta4"),
)
"""Methods of the page for a system without a constraint."""

MOST_CONTROLS = 12
"""Coordinates, and numbers of args, that have a slider."""


class Control(NamedTuple):
    """A number that a slider changes: "epsilon", "h", "args.mu", "q0[1]".

    - `label`: with its meaning, for the reader. `low`, `high`: ends of the slider.
    """

    key: str
    label: str
    low: float
    high: float


@dataclass(frozen=True)
class Settings:
    """The numbers and choices of the pictures; `q0`, `p0` NumPy arrays of one shape.

    - `value`: of the coordinate on the surface of a section; `period`: of a stroboscope.
    - `steps`: of a trajectory. `path`: the coordinates of its picture; `observable`: what is drawn
      over time. `surface`, `axes`, `colour`: of a section. `parameter`, `ends`: of an orbit
      diagram. `degree`: of the polynomials of a discovery. "" and None: the default.
    """

    epsilon: float
    h: float
    args: Any
    q0: np.ndarray
    p0: np.ndarray
    method: str
    value: float = 0.0
    period: float = 2 * math.pi
    steps: int = 10_000
    path: tuple[str, str] | None = None
    observable: str = ""
    surface: str = ""
    axes: tuple[str, str] | None = None
    colour: str = "orbit"
    parameter: str = ""
    ends: tuple[float, float] | None = None
    degree: int = 4


class Subject:
    """A system that is explored.

    **Arguments** as for `dvi.explore`; `lines`: Python code that defines `problem`, for copies;
    `name`: of the system in a run file, or "".

    **Raises** `ValueError` and `TypeError` for a system with noise or without an initial condition.
    """

    def __init__(
        self, problem: Any, start: Mapping[str, Any], lines: str = "", name: str = "", title=""
    ):
        q0, p0, h, args = (start.get(key) for key in ("q0", "p0", "h", "args"))
        self.system, q0, p0, h, args = of_problem(problem, q0, p0, h, args)
        check_system(self.system)
        if h is None:
            raise ValueError("explore requires h, the step size: the system has no default.")
        self.problem = problem if isinstance(problem, Problem) else None
        q0, p0 = (np.array(x, float) for x in start_state(q0, p0))
        refuse_double_without_x64("q0", q0.dtype)
        h = as_scalar("h", h, float, zero_allowed=False)
        epsilon = start.get("epsilon")
        if epsilon is None:
            epsilon = self.system.epsilon or 0.0
        epsilon = as_scalar("epsilon", epsilon, float)
        self.title = title or (self.problem.name if self.problem else "a system")
        self.lines, self.name = lines, name
        self.units = dict(self.problem.units) if self.problem else {}
        self.methods = _methods(self.system, start.get("method"))
        self.shape = q0.shape
        method = next(iter(self.methods))
        self.start = Settings(float(epsilon), float(h), args, q0, p0, method)
        self.start = replace(self.start, period=_period(args))
        observables = dict(self.problem.observables) if self.problem else {}
        if "energy" not in observables and self.system.constraint is None:
            observables = {"energy": _Energy(self.system), **observables}
        self.observables: dict[str, Any] = {name: of_steps(f) for name, f in observables.items()}
        adiabatic = self.problem.adiabatic if self.problem else {}
        invariants = self.problem.invariants if self.problem else ()
        # The energy, and all that is known to be conserved or nearly so.
        names = ["energy", *invariants, *adiabatic]
        self.invariants = [name for name in dict.fromkeys(names) if name in self.observables]
        self.coordinates = {
            kind + _brackets(index): (kind, index)
            for kind in "qp"
            for index in np.ndindex(self.shape)
        }

    @property
    def has_perturbation(self) -> bool:
        """Whether ε changes the motion."""
        system = self.system
        return bool(system.force or system.perturbation or system.slow_time)

    def method(self, settings: Settings) -> Method:
        """The method with the name in the settings."""
        return self.methods[settings.method]

    def column(self, name: str, q: np.ndarray, p: np.ndarray) -> np.ndarray:
        """A coordinate of states of shape (…, *q0.shape), such as "q[1]"; shape (…)."""
        kind, index = self.coordinates[name]
        return (q if kind == "q" else p)[(..., *index)]

    def label(self, name: str) -> str:
        """The name of a coordinate with its unit."""
        unit = self.units.get(name[0], "1")
        return name if unit in ("", "1") else f"{name} [{unit}]"

    def controls(self) -> list[Control]:
        """The sliders, ε and h first, then the parameters, then the initial condition."""
        start, meanings = self.start, dict(self.problem.parameters) if self.problem else {}
        controls = []
        if self.has_perturbation:
            size = max(4 * abs(start.epsilon), 0.2)
            controls.append(Control("epsilon", "ε, strength of the perturbation", -size, size))
        unit = self.units.get("t", "1")
        label = "h, step size" + (f" [{unit}]" if unit not in ("", "1") else "")
        ends = sorted((start.h / 20, 4 * start.h))
        controls.append(Control("h", label, *ends))
        for name, value in self.parameters(start.args).items():
            meaning = meanings.get(name.removeprefix("args."), "")
            label = name.removeprefix("args.") + (f", {meaning}" if meaning else "")
            controls.append(Control(name, label, *_ends(value)))
        names = list(self.coordinates)
        if len(names) <= MOST_CONTROLS:
            values = [float(self.column(name, start.q0, start.p0)) for name in names]
            for name, value in zip(names, values, strict=True):
                size = max(1.0, 2 * abs(value))
                controls.append(Control(f"{name[0]}0{name[1:]}", self.label(name), -size, size))
        return controls

    def parameters(self, args: Any) -> dict[str, float]:
        """The first numbers of args: "args.name" → value, "args.name[1]" of an array.

        Whole numbers are left out: JAX compiles a program for each of them.
        """
        values: dict[str, float] = {}
        for name, leaf in _leaves(args).items():
            if np.issubdtype(np.asarray(leaf).dtype, np.floating):
                for index in np.ndindex(np.shape(leaf)):
                    values[name + _brackets(index)] = float(np.asarray(leaf)[index])
        return dict(list(values.items())[:MOST_CONTROLS])

    def read(self, settings: Settings, key: str) -> float:
        """The number of a slider."""
        if hasattr(settings, key):
            return getattr(settings, key)
        if key.startswith("args"):
            return self.parameters(settings.args)[key]
        name = key[0] + key[2:]
        return float(self.column(name, settings.q0, settings.p0))

    def write(self, settings: Settings, key: str, value: float) -> Settings:
        """Settings with another number. **Raises** `ValueError` for one that does not fit."""
        if not np.isfinite(value):
            raise ValueError(f"{key} must be a finite number, got {value}.")
        if key == "h" and value == 0:
            raise ValueError("h must not be zero.")
        if key == "period" and value <= 0:
            raise ValueError(f"the period of the stroboscope must be positive, got {value}.")
        if key in ("epsilon", "h", "value", "period"):
            return replace(settings, **{key: float(value)})
        if key.startswith("args"):
            return replace(settings, args=with_leaf(settings.args, key, float(value)))
        array, (_, index) = key[:2], self.coordinates[key[0] + key[2:]]
        state = getattr(settings, array).copy()
        state[index] = value
        return replace(settings, **{array: state})

    def check(self, settings: Settings) -> None:
        """**Raises** `ValueError` for an initial condition or parameters that do not fit."""
        if self.problem is not None and self.problem.check is not None:
            self.problem.check(settings.q0, settings.p0, settings.args)

    def energy(self, settings: Settings) -> float:
        """H at the initial condition, the perturbing Hamiltonian included."""
        state = settings.q0, settings.p0, settings.epsilon, settings.args
        return float(self.system.hamiltonian(0.0, 0.0, *state))


class _Energy(eqx.Module):
    """The Hamiltonian of a system without an observable of this name, at the end of a step."""

    system: System
    epsilon: Any = 0.0

    def bind(self, system: System, epsilon: Any) -> "_Energy":
        """The same observable for this ε."""
        return _Energy(system, epsilon)

    def __call__(self, t0, t1, q0, p0, q1, p1, args):
        return self.system.hamiltonian(t1, t1, q1, p1, self.epsilon, args)


def with_leaf(args: Any, key: str, value: Any) -> Any:
    """args with another value at "args.name" or "args.name[1]"."""

    def new_leaf(path: Any, leaf: Any) -> Any:
        name = _name(path)
        if name == key:
            return value
        if not key.startswith(f"{name}["):
            return leaf
        array = np.array(leaf, float)
        array[tuple(int(i) for i in key[len(name) + 1 : -1].split(","))] = value
        return array

    return jax.tree_util.tree_map_with_path(new_leaf, args)


def _leaves(args: Any) -> dict[str, Any]:
    return {_name(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(args)[0]}


def _name(path: Any) -> str:
    return "args" + "".join(f".{getattr(e, 'key', getattr(e, 'idx', e))}" for e in path)


def _brackets(index: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, index))}]" if index else ""


def _ends(value: float) -> tuple[float, float]:
    """The ends of the slider of a parameter, on one side of zero like its value."""
    return (-1.0, 1.0) if value == 0 else (min(0.0, 3 * value), max(0.0, 3 * value))


def _methods(system: System, method: Any) -> dict[str, Method]:
    """Name → method, that of the call, or else the default of the system, first."""
    if system.noise is not None:
        raise ValueError(
            "explore shows one trajectory, but the system has noise: run dvi.integrate with "
            "several paths, or leave out the noise."
        )
    methods = {name: as_method(name) for name in METHODS} if system.constraint is None else {}
    # Objects are compared by their text: that of a method has all its fields.
    first = as_method(method) or default_method(system)
    name = next((n for n, m in methods.items() if repr(m) == repr(first)), _text_of(first))
    return {name: first, **methods}


def _text_of(method: Method) -> str:
    name = type(method).__name__
    return name if repr(method) in (f"{name}()", name) else repr(method)


def _period(args: Any) -> float:
    """The period of a drive, if args has its frequency."""
    omega = args.get("omega") if isinstance(args, Mapping) else None
    return 2 * math.pi / (omega if isinstance(omega, float) and omega > 0 else 1.0)
