"""From the values of a run file to what `integrate` takes."""

import ast
import importlib.util
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dvi_jax as dvi

from .. import systems
from ..systems.solar_system import EphemerisMissing, check_covered, julian_date
from ._errors import InputError, one_of, reason, shown


@dataclass(frozen=True)
class Setup:
    """All that one run needs; `jd` is the Julian date of the start when it is an ephemeris's;
    `files` are the user's Python files."""

    name: str
    system: dvi.System
    q0: np.ndarray
    p0: np.ndarray
    t0: float
    h: float | None
    steps: int | None
    epsilon: float
    args: Any
    method: dvi.Method
    lattice: dvi.Lattice
    every: int
    observables: dict[str, Any]
    units: dict[str, str] = field(default_factory=dict)
    jd: float | None = None
    files: tuple[Path, ...] = ()


def make_setup(values: dict[str, Any], folder: Path) -> Setup:
    """What a run file means; files that it names are looked for from `folder`.

    **Raises** `InputError`.
    """
    loader = Loader(folder)
    problem, system, jd = find_problem(values, loader)
    args = arguments_of(values["args"], problem)
    q0, p0 = (state_of(values, name, getattr(problem, name, None)) for name in ("q0", "p0"))
    check_start(problem, q0, p0, args)
    lattice, h, steps = lattice_of(values, problem)
    setup = Setup(
        name=problem.name if problem is not None else values["system"],
        system=system,
        q0=q0,
        p0=p0,
        t0=values["t0"],
        h=h,
        steps=steps,
        epsilon=values["epsilon"],
        args=args,
        method=parse_method(values["method"]),
        lattice=lattice,
        every=values["output.every"],
        observables=observables_of(values["observables"], problem, loader),
        units=dict(problem.units) if problem is not None else {},
        jd=jd,
        files=tuple(loader.modules),
    )
    if jd is not None:
        _check_dates(setup)
    return setup


# The system


_A_FILE = '"file.py:name", a Python file in the folder of the TOML file and a name in it'


class Loader:
    """Objects named ``file.py:name``; every file is run once, however often it is named."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.modules: dict[Path, Any] = {}

    def load(self, key: str, text: str) -> Any:
        """The object that `text` names.

        **Raises** `InputError` with the key when the file or the name does not exist, or when
        running the file fails: with the line of it that did.
        """
        file, _, name = text.rpartition(":")
        if os.path.isabs(file) or ".." in Path(file).parts:
            raise InputError(key, f"{shown(text)} leaves the folder of the TOML file", _A_FILE)
        try:
            path = (self.folder / file).resolve()
            path.is_file()
        except (OSError, ValueError) as error:  # a name that no file can have
            raise InputError(key, f"{shown(text)}: {reason(error)}", _A_FILE) from None
        if path not in self.modules:
            self.modules[path] = self._run(key, text, path)
        module = self.modules[path]
        try:
            return getattr(module, name)
        except AttributeError:
            names = [n for n in vars(module) if not n.startswith("_")]
            raise InputError(
                key, f"{file} has no {name!r}", f"a name in that file: {one_of(names, name)}"
            ) from None

    def _run(self, key: str, text: str, path: Path) -> Any:
        allowed = _A_FILE
        if not path.is_file():
            raise InputError(key, f"{text!r}: there is no file {path}", allowed)
        spec = importlib.util.spec_from_file_location(f"dvi_jax_run_{path.stem}", path)
        if spec is None or spec.loader is None:
            raise InputError(key, f"{text!r}: {path.name} is not a Python file", allowed)
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses and pickle look their module up
        sys.path.insert(0, str(path.parent))  # so that it may import its neighbours
        try:
            spec.loader.exec_module(module)
        except (Exception, SystemExit) as error:
            raise InputError(
                key, f"{text!r} does not import: {said(error, path)}", "a file that imports"
            ) from error
        finally:
            sys.path.remove(str(path.parent))
        return module


def said(error: BaseException, *files: Path) -> str:
    """An exception in one line, with the last place in the user's files that it came through."""
    if isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {error.msg} (line {error.lineno})"
    places = traceback.extract_tb(error.__traceback__)
    inside = [p for p in places if Path(p.filename) in files]
    where = f" ({Path(inside[-1].filename).name}, line {inside[-1].lineno})" if inside else ""
    if isinstance(
        error, (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)
    ):
        return (
            f"{type(error).__name__}{where}: what a function gets stands for values to come; write "
            "it with jax.numpy in place of math and numpy, jnp.where in place of if"
        )
    return f"{type(error).__name__}: {error}{where}"


def find_problem(
    values: dict[str, Any], loader: Loader
) -> tuple[systems.Problem | None, dvi.System, float | None]:
    """The library's record if there is one, the system, the Julian date of the start."""
    text = values["system"]
    date, jd = values["state.date"], None
    if date is not None:
        if text != "solar_system":
            raise InputError(
                "state.date", shown(date), "q0 and p0; a date only with system = solar_system"
            )
        if values["state.q0"] is not None or values["state.p0"] is not None:
            raise InputError("state.date", "given beside q0 or p0", "date, or q0 and p0")
    if ":" in text:
        made = loader.load("system", text)
        is_factory = callable(made) and not isinstance(made, type) and not _takes_arguments(made)
        if is_factory and not isinstance(made, dvi.System):
            try:
                made = made()
            except (Exception, SystemExit) as error:
                raise InputError(
                    "system",
                    f"{text!r} failed: {said(error, *loader.modules)}",
                    "a function that returns a system",
                ) from error
        if isinstance(made, dvi.System):
            return None, made, None
        if not isinstance(made, systems.Problem):
            raise InputError(
                "system",
                f"{text!r} is {type(made).__name__}",
                "a dvi.System, a systems.Problem, or a function without arguments that returns one",
            )
        return made, made.system, None
    if text not in systems.LIBRARY:
        raise InputError(
            "system", f"{text!r}", f'{one_of(systems.LIBRARY, text)}; or "file.py:name"'
        )
    try:
        if text == "solar_system" and values["state.q0"] is None:
            date = "1900-01-01" if date is None else date
            jd = julian_date(date)
            return (problem := systems.solar_system(jd)), problem.system, jd
        problem = systems.LIBRARY[text]()
    except EphemerisMissing as error:
        raise InputError("system", f"{text!r}: {error}", "an installed ephemeris") from None
    except ValueError as error:
        raise InputError("state.date", str(error), "a day that the ephemeris covers") from None
    return problem, problem.system, None


def _takes_arguments(function: Any) -> bool:
    try:
        inspect.signature(function).bind()
    except (TypeError, ValueError):
        return True
    return False


# Its start and parameters


def state_of(values: dict[str, Any], name: str, default: Any) -> Any:
    """What the file gives as q0 or p0, or else the system's own."""
    given = values[f"state.{name}"]
    if given is None:
        if default is None:
            raise InputError(
                f"state.{name}", "the key is missing", "an array of numbers; this system has none"
            )
        return np.asarray(default, float)
    return given


def check_start(problem: systems.Problem | None, q0: Any, p0: Any, args: Any) -> None:
    """Refuse a start that the system cannot go on from."""
    if np.shape(q0) != np.shape(p0):
        raise InputError(
            "state.p0",
            f"shape {np.shape(p0)}",
            f"the shape of q0, {np.shape(q0)}: a momentum for each q",
        )
    if problem is not None and problem.check is not None:
        try:
            problem.check(q0, p0, args)
        except systems.ParameterError as error:
            raise InputError("args", str(error), "args that fit the system") from None
        except ValueError as error:
            raise InputError(
                "state", str(error), "a start that the system can go on from"
            ) from None


def arguments_of(given: dict[str, Any] | None, problem: systems.Problem | None) -> Any:
    """The parameters of the system with those of the file in their place."""
    known = problem.args if problem is not None else None
    if given is None:
        return known
    if problem is None:
        return given
    if not isinstance(known, dict):
        if known is None:
            raise InputError("args", shown(given), f"nothing: {problem.name} has no parameters")
        raise InputError("args", shown(given), "nothing: this system's args are not a table")
    for name in given:
        if name not in known:
            raise InputError(f"args.{name}", "there is no such parameter", one_of(known, name))
        if isinstance(given[name], dict) and not isinstance(known[name], dict):
            raise InputError(
                f"args.{name}", shown(given[name]), "a number or an array; in a sweep also an axis"
            )
    return {**known, **given}


# How it is integrated


def lattice_of(
    values: dict[str, Any], problem: systems.Problem | None
) -> tuple[dvi.Lattice, Any, Any]:
    """The lattice, h and the number of steps, as `integrate` takes them."""
    times = values["lattice"]
    if isinstance(times, np.ndarray):
        for name in ("h", "steps"):
            if values[name] is not None:
                raise InputError(name, shown(values[name]), "nothing: lattice.times sets the steps")
        if values["t0"] not in (0.0, times[0]):
            raise InputError("t0", shown(values["t0"]), "nothing: lattice.times has the start")
        return dvi.Given(times), None, None
    h = values["h"] if values["h"] is not None else getattr(problem, "h", None)
    if h is None:
        raise InputError("h", "the key is missing", "a number; this system has none of its own")
    if values["steps"] is None:
        raise InputError("steps", "the key is missing", "a positive whole number")
    return dvi.Uniform(), h, values["steps"]


def parse_method(text: str) -> dvi.Method:
    """The method that a text such as ``"Yoshida(4)"`` or ``"Adjoint(TypeII)"`` names.

    Read as a name with numbers, lists of numbers or further methods as arguments; nothing in
    it is run.

    **Raises** `InputError`.
    """
    try:
        made = _made(ast.parse(text.strip(), mode="eval").body)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        if isinstance(error, InputError):
            raise
        reason = "it does not read as one" if isinstance(error, SyntaxError) else str(error)
        raise InputError("method", f"{text!r}: {reason}", one_of(_methods())) from None
    if not isinstance(made, dvi.Method):
        raise InputError("method", f"{text!r}", one_of(_methods()))
    return made


def _methods() -> dict[str, type[dvi.Method]]:
    """The methods behind the public door: new ones are allowed here without being listed."""
    return {
        name: thing
        for name, thing in vars(dvi).items()
        if isinstance(thing, type) and issubclass(thing, dvi.Method) and thing is not dvi.Method
    }


def _made(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_made(operand)
        case ast.List(elts=items) | ast.Tuple(elts=items):
            return [_made(item) for item in items]
        case ast.Name(id=name):
            arguments, options = [], {}
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=keywords):
            options = {k.arg: _made(k.value) for k in keywords if k.arg is not None}
        case _:
            raise ValueError(f"{ast.unparse(node)!r} is neither a method nor a number")
    if name not in (known := _methods()):
        raise InputError("method", f"{name!r}", one_of(known, name))
    return known[name](*(_made(a) for a in arguments), **options)


# What is watched


def observables_of(
    given: dict[str, str] | None, problem: systems.Problem | None, loader: Loader
) -> dict[str, Any]:
    """What is watched, by name; all that the system knows and their drifts if nothing is said."""
    known = dict(problem.observables) if problem is not None else {}
    if given is None:
        drifts = {f"{name}_drift": dvi.MaxDrift(f) for name, f in known.items()}
        return {**known, **drifts}
    return {
        name: _observable(f"observables.{name}", text, known, loader)
        for name, text in given.items()
    }


def _observable(key: str, text: str, known: dict[str, Callable], loader: Loader) -> Any:
    indicators = _named(dvi.Deviations)
    reductions = {n: r for n, r in _named(dvi.Reduction).items() if n not in indicators}
    del reductions["Deviations"]
    inner, wrap = text.strip(), None
    if found := re.fullmatch(r"(\w+)\((.*)\)", inner):
        if found[1] in indicators:
            return _indicator(key, inner, indicators[found[1]])
        if found[1] not in reductions:
            known_ones = [*reductions, *indicators]
            raise InputError(key, f"{text!r}", f"a reduction: {one_of(known_ones, found[1])}")
        wrap, inner = reductions[found[1]], found[2].strip()
    if ":" in inner:
        function = loader.load(key, inner)
        if not callable(function):
            raise InputError(
                key, f"{inner!r} is {type(function).__name__}",
                _AN_OBSERVABLE,
            )  # fmt: skip
        if not hasattr(function, "bind"):
            _check_takes_seven(key, inner, function)
    elif inner in known:
        function = known[inner]
    else:
        raise InputError(
            key,
            f"{inner!r}",
            f'{one_of(known, inner)}; or "file.py:name"; alone or in {", ".join(reductions)}; '
            f"or {', '.join(f'{name}()' for name in indicators)}",
        )
    return wrap(function) if wrap is not None else function


_AN_OBSERVABLE = "a function (t0, t1, q0, p0, q1, p1, args)"


def _check_takes_seven(key: str, text: str, function: Callable) -> None:
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # one that does not tell
        return
    try:
        signature.bind(*range(7))
    except TypeError:
        raise InputError(key, f"{text!r} takes {signature}", _AN_OBSERVABLE) from None


def _named(base: type) -> dict[str, Any]:
    """The public classes that are kinds of `base`, by name."""
    return {
        name: thing
        for name, thing in vars(dvi).items()
        if isinstance(thing, type) and issubclass(thing, base) and thing is not base
    }


def _indicator(key: str, text: str, kind: type) -> Any:
    """An indicator of chaos as it is written in Python, such as ``GALI(4, log10=True)``."""
    try:
        call: Any = ast.parse(text, mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
            raise ValueError("more than one call")
        options: Any = {k.arg: ast.literal_eval(k.value) for k in call.keywords}
        return kind(*(ast.literal_eval(a) for a in call.args), **options)
    except (SyntaxError, TypeError, ValueError) as error:
        why = "" if "malformed" in str(error) else f" ({error})"
        raise InputError(
            key, f"{text!r}{why}", "numbers alone, as in LyapunovSpectrum(2) or MEGNO()"
        ) from None


# Dates


def _check_dates(setup: Setup) -> None:
    """Refuse, before the work, a run that leaves the ephemeris it is to be compared with."""
    assert setup.jd is not None
    if isinstance(setup.lattice, dvi.Given):
        times = np.asarray(setup.lattice.ts)
        span = times[-1] - times[0]
    else:
        assert setup.h is not None
        assert setup.steps is not None
        span = setup.h * setup.steps
    try:
        check_covered(setup.jd + span)
    except ValueError as error:
        raise InputError(
            "steps",
            f"the run ends {span:g} days after its start: {error}",
            "fewer steps, a smaller h, or another date",
        ) from None
