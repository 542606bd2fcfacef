"""The system of a TOML file, its parameters and state, and the times of the steps."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.base.signature import accepts
from dvi_jax.systems import rings
from dvi_jax.systems.planets.solar_system import EphemerisMissing, julian_date

from .._errors import (
    InputError,
    as_input_error,
    describe,
    in_toml,
    require,
    require_name,
    user_path,
)
from .expressions import parse_method
from .forces import add_forces
from .loader import Loader, in_one_line
from .schema import COUNT, Integration, RunFile, SweepFile, SystemFile, Times
from .table import NO_KEY


@dataclass(frozen=True)
class Source:
    """The system that a TOML file describes.

    - `problem`: the library's record, or that of a user's file; None for a `dvi.System` alone.
    - `jd`: the Julian date of the start of the solar system, if an ephemeris gives it.
    """

    file: SystemFile
    loader: Loader
    problem: systems.Problem | None
    system: dvi.System
    jd: float | None = None

    @property
    def name(self) -> str:
        """The name of the system."""
        return self.problem.name if self.problem is not None else self.file.system

    @contextmanager
    def at_work(
        self, key: str, action: str, rule: str, progress: Sequence[Any] | None = None
    ) -> Iterator[None]:
        """Within this an exception means that the input does not fit: an `InputError`, such as
        "kepler cannot be integrated: …", whatever a user's function raises while it is traced.

        - `progress`: of work that writes files as it goes on: has an item once the input is known
          to fit. Errors of files, and all errors after that, are raised as they are.
        """
        try:
            yield
        except Exception as error:
            writes = progress is not None and isinstance(error, dvi.StoreError | OSError)
            if progress or writes or isinstance(error, InputError):
                raise
            defect = f"{self.name} cannot be {action}: {self.error_line(error)}"
            raise InputError(key, defect, rule) from error

    def method(self, text: str) -> dvi.Method:
        """The method that a text of the file describes; for a ring one turn."""
        return rings.Turn() if self.file.ring is not None else parse_method(text)

    def error_line(self, error: BaseException) -> str:
        """An exception in one line, with its place in the user's files."""
        return in_toml(in_one_line(error, *self.loader.modules))

    @cached_property
    def args(self) -> Any:
        """The parameters of the system, with those of the file in their place."""
        values, problem = self.file.args, self.problem
        names: Any = getattr(problem, "args", None)
        if values is None or problem is None:
            return names if values is None else values
        if not isinstance(names, dict):
            cause = f"args of the type {type(names).__name__}: set them in its Python code"
            cause = "no parameters" if names is None else cause
            rule = f"no key args, because {problem.name} has {cause}"
            raise InputError("args", describe(values), rule)
        for name, value in values.items():
            require_name(f"args.{name}", name, names, defect="there is no such parameter")
            fits = isinstance(names[name], dict) or not isinstance(value, dict)
            rule = "a number or an array; in a sweep also an axis"
            require(fits, f"args.{name}", describe(value), rule)
        return {**names, **values}

    def array(self, name: str) -> Any:
        """q0 or p0 of the file, or else of the system."""
        value, default = getattr(self.file.state, name), getattr(self.problem, name, None)
        fits = value is not None or default is not None
        require(fits, f"state.{name}", NO_KEY, "an array of numbers (the system has no default)")
        return value if value is not None else np.asarray(default, float)

    def check_start(self, q0: Any, p0: Any, args: Any) -> None:
        """Reject an initial condition that the system cannot start from."""
        rule = f"the shape of q0, {np.shape(q0)}: a momentum for each q"
        require(np.shape(q0) == np.shape(p0), "state.p0", f"p0 has shape {np.shape(p0)}", rule)
        if self.problem is None or self.problem.check is None:
            return
        rule = "initial conditions from which the system can start"
        with (
            as_input_error("state", rule, ValueError),
            as_input_error("args", "args that fit the system", systems.ParameterError),
        ):
            self.problem.check(q0, p0, args)

    @property
    def h(self) -> Any:
        """The step size of the file, or else of the system."""
        h = self.file.h if self.file.h is not None else getattr(self.problem, "h", None)
        require(h is not None, "h", NO_KEY, "a number (the system has no default)")
        return h

    @property
    def jump(self) -> Sequence[dvi.Jump]:
        """The jumps of the file, or else of the system."""
        name = getattr(self.file, "jump", None)
        if name is None:
            return getattr(self.problem, "jumps", ())
        jumps = self.loader.load("jump", name)
        jumps = jumps if isinstance(jumps, list | tuple) else [jumps]
        fits = all(isinstance(jump, dvi.Jump) for jump in jumps)
        require(fits, "jump", describe(jumps), "a dvi.Jump or a list of them")
        return jumps

    def times(self, file: RunFile | SweepFile) -> dict[str, Any]:
        """The arguments of `dvi.integrate` that set the times of the steps, and ε."""
        if isinstance(file.lattice, Times):
            grid = {"lattice": dvi.Given(file.lattice.times), "h": None, "num_steps": None}
        else:
            grid = {"lattice": dvi.Uniform(), "h": self.h, "num_steps": file.steps}
            require(file.steps is not None, "steps", NO_KEY, COUNT)
        return grid | {"t0": file.t0, "epsilon": self.epsilon}

    @property
    def epsilon(self) -> Any:
        """The strength of the perturbation in the file, or else of the system."""
        rule = "a number: the system has a force or a perturbation (0.0: unperturbed)"
        value = getattr(self.file, "epsilon", None)
        with as_input_error("epsilon", rule, ValueError, text=lambda _: NO_KEY):
            strength = self.system.strength(value)
        is_left_out = value is None and hasattr(self.file, "epsilon") and strength == 0
        if is_left_out and self.system.depends_on_epsilon:
            warnings.warn(
                f"the key epsilon is missing, so the motion is that of {self.name} without its "
                "force, perturbation or slow time: write epsilon = 0.0 for this motion.",
                stacklevel=2,
            )
        return strength


def find_source(file: SystemFile, folder: Path) -> Source:
    """The system of a TOML file with its forces; files that it names are in `folder`.

    **Raises** `InputError`.
    """
    source = _without_forces(file, folder)
    if file.force is None:
        return source
    rule = "no forces for a dvi.System or a ring: they are added to a systems.Problem"
    fits = source.problem is not None and file.ring is None
    require(fits, "force", "it is given", rule)
    assert source.problem is not None
    problem = add_forces(source.problem, file.force, file.args or {}, source.loader)
    return replace(source, problem=problem, system=problem.system)


def _without_forces(file: SystemFile, folder: Path) -> Source:
    loader, name, date = Loader(folder), file.system, file.state.date
    rule = "q0 and p0; a date only with system = solar_system"
    require(date is None or name == "solar_system", "state.date", describe(date), rule)
    require(file.ring is None or name == "ring", "ring", "it is given", "only with system = ring")
    if name == "ring":
        return _of_a_ring(file, loader)
    if ":" not in name:
        return _of_the_library(file, loader)
    target, defect = loader.load("system", name), repr(name)
    if callable(target) and not isinstance(target, type | dvi.System) and accepts(target, 0):
        prefix, rule = f"{name!r} failed: ", "a function that returns a system"
        kinds, text = (Exception, SystemExit), lambda error: in_one_line(error, *loader.modules)
        with as_input_error("system", rule, *kinds, prefix=prefix, text=text):
            target, defect = target(), f"the result of {name!r}"
    if isinstance(target, systems.Problem):
        fits = not target.jumps or isinstance(file, Integration)
        require(fits, "system", f"{defect} has jumps", "a system without jumps")
        return Source(file, loader, target, target.system)
    if isinstance(target, dvi.System):
        return Source(file, loader, None, target)
    rule = "a dvi.System, a systems.Problem, or a function without arguments that returns one"
    kind = f"an object of type {type(target).__name__}"
    if isinstance(target, type):
        kind = f"the class {target.__name__}, not an object"
    elif callable(target):
        kind = "a function or object with required arguments"
    raise InputError("system", f"{defect} is {kind}", rule)


def _of_a_ring(file: SystemFile, loader: Loader) -> Source:
    require(file.ring is not None, "ring", NO_KEY, 'a table [ring] with file = "…"')
    ring, is_turn = file.ring, file.method in ("TypeII", "Turn")
    require(is_turn, "method", describe(file.method), "no method for a ring")
    assert ring is not None
    prefix, rule = f"{ring.file!r} cannot be read: ", "a lattice file that pyAT can read"
    with as_input_error("ring.file", rule, Exception, prefix=prefix, text=in_one_line):
        options = {"use": ring.use, "symplectic": ring.symplectic, "model": ring.model}
        read = rings.load(loader.folder / user_path("ring.file", ring.file), **options)
    record = rings.problem(read, planes=ring.planes, delta=ring.delta)
    units = {"q": "m", "t": "turns"}
    problem = systems.Problem("ring", *record[:4], args=record.args, units=units)
    return Source(file, loader, problem, problem.system)


def _of_the_library(file: SystemFile, loader: Loader) -> Source:
    name, date, jd = file.system, file.state.date, None
    require_name("system", name, systems.LIBRARY, '{}; or "file.py:name"')
    rule = 'a day that the ephemeris covers, such as "1900-01-01"'
    with (
        as_input_error("state.date", rule, ValueError),
        as_input_error("system", "an installed ephemeris", EphemerisMissing),
    ):
        if name == "solar_system" and file.state.q0 is None:
            jd = julian_date("1900-01-01" if date is None else date)
            problem = systems.solar_system(jd)
        else:
            problem = systems.LIBRARY[name]()
    return Source(file, loader, problem, problem.system, jd)
