"""The observables of a TOML file, and how those of a run changed."""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems.n_body import linear_momentum

from .._errors import InputError, one_of
from .expressions import Expressions, public
from .system import Source

_A_FUNCTION = "a function (t0, t1, q0, p0, q1, p1, args)"


def read_observables(given: dict[str, str] | None, source: Source) -> dict[str, Any]:
    """The observables by name; without a table all that the system knows, and their drifts.

    **Raises** `InputError`.
    """
    known = dict(source.problem.observables) if source.problem is not None else {}
    if given is None:
        return {**known, **{f"{name}_drift": dvi.MaxDrift(f) for name, f in known.items()}}
    return {n: _observable(f"observables.{n}", text, known, source) for n, text in given.items()}


def _observable(key: str, text: str, known: dict[str, Callable], source: Source) -> Any:
    indicators = public(dvi.Deviations)
    reductions = public(dvi.Reduction, dvi.Deviations, *indicators.values())
    inner, wrap = text.strip(), None
    if found := re.fullmatch(r"(\w+)\((.*)\)", inner):
        if found[1] in indicators:  # as it is written in Python, such as GALI(4, log10=True)
            example = "; with numbers alone, as in LyapunovSpectrum(2) or MEGNO()"
            return Expressions(key, dvi.Deviations, indicators, example).read(inner)
        if found[1] not in reductions:
            names = one_of([*reductions, *indicators], found[1])
            raise InputError(key, repr(text), f"a reduction: {names}")
        wrap, inner = reductions[found[1]], found[2].strip()
    if ":" in inner:
        function = _function(key, inner, source)
    elif inner in known:
        function = known[inner]
    else:
        calls = ", ".join(f"{name}()" for name in indicators)
        allowed = f'{one_of(known, inner)}; or "file.py:name"; alone or in {", ".join(reductions)}'
        raise InputError(key, repr(inner), f"{allowed}; or {calls}")
    return wrap(function) if wrap is not None else function


def _function(key: str, text: str, source: Source) -> Any:
    function = source.loader.load(key, text)
    if not callable(function):
        raise InputError(key, f"{text!r} is {type(function).__name__}", _A_FUNCTION)
    if hasattr(function, "bind"):  # an energy, which is called with the system
        return function
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # a builtin without a signature
        return function
    try:
        signature.bind(*range(7))
    except TypeError:
        raise InputError(key, f"{text!r} takes {signature}", _A_FUNCTION) from None
    return function


@dataclass(frozen=True)
class Observed:
    """One observable of a run.

    - `start`: its value at the start. `values`: at the saved times, the start first, shape
      (S, …), for one without a reduction; else the reduced value.
    - `scale`: size that changes are divided by; 1 where the start gives none.
    - `reduction`: name of the reduction, or "".
    """

    start: np.ndarray
    values: np.ndarray
    scale: float
    reduction: str

    @property
    def is_relative(self) -> bool:
        """Whether changes are relative to the start."""
        return self.scale != 1.0

    def change(self) -> np.ndarray:
        """Change since the start over `scale`, shape (S,): with its sign, or as a length."""
        change = self.values - self.start
        if change.ndim > 1:
            change = np.linalg.norm(change.reshape(len(change), -1), axis=-1)
        return change / self.scale

    def summary(self) -> dict[str, Any]:
        """The entry of the report."""
        if not self.reduction:
            change = np.abs(self.change())
            largest = np.max(change, where=np.isfinite(change), initial=-np.inf)
            found = {"start": self.start, "end": self.values[-1]}
            found["largest_saved_change"] = float(largest) if largest >= 0 else np.nan
            return found | {"scale": self.scale}
        found = {"reduction": self.reduction, "value": self.values}
        if self.reduction in ("MaxDrift", "Range"):
            found["relative"] = float(np.linalg.norm(self.values)) / self.scale
        return found | {"scale": self.scale}


def observe(
    run: Mapping[str, Any], observables: Mapping[str, Any], values: Mapping[str, Any]
) -> dict[str, Observed]:
    """The observables of a run, given by the arguments of `dvi.integrate`, with start and scale.

    The scale is the size of the start value; of a linear momentum, whose total may be nearly
    zero, the sum Σ|p_i| over the bodies.
    """
    q0, p0 = jnp.asarray(run["q0"]), jnp.asarray(run["p0"])
    t0 = jnp.asarray(run["t0"], q0.dtype)
    found = {}
    for name, observable in observables.items():
        is_reduced = isinstance(observable, dvi.Reduction)
        function: Any = observable.function if is_reduced else observable
        if hasattr(function, "bind"):  # it requires the system and ε of the run
            function = function.bind(run["system"], run["epsilon"])
        start = np.asarray(function(t0, t0, q0, p0, q0, p0, run["args"]))  # a step of length zero
        scale = float(np.linalg.norm(start))
        if function is linear_momentum:
            scale = float(np.linalg.norm(run["p0"], axis=-1).sum())
        if not np.isfinite(scale) or scale == 0:
            scale = 1.0
        reached = np.asarray(values[name])
        if not is_reduced:
            reached = np.concatenate([start[None], reached])
        found[name] = Observed(
            start, reached, scale, type(observable).__name__ if is_reduced else ""
        )
    return found
