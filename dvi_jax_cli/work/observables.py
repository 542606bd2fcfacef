"""The observables of a TOML file, and how those of a run changed."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.base.signature import signature_of
from dvi_jax.observe import FORMS, OfState, of_steps
from dvi_jax.systems.n_body import OBSERVABLES

from .._errors import as_input_error, require, require_name
from .expressions import Expressions, public
from .system import Source

_A_FUNCTION = f"a function {FORMS}"


def read_observables(texts: dict[str, str] | None, source: Source) -> dict[str, Any]:
    """The observables by name; without a table all that the system knows, and their drifts.

    **Raises** `InputError`.
    """
    defaults = of_steps(dict(source.problem.observables)) if source.problem is not None else {}
    if texts is None:
        return with_drifts(defaults)
    return {
        key: _observable(f"observables.{key}", text, defaults, source)
        for key, text in texts.items()
    }


def with_drifts(observables: dict[str, Any]) -> dict[str, Any]:
    """Observables, and the largest drift of each."""
    return observables | {f"{name}_drift": dvi.MaxDrift(f) for name, f in observables.items()}


def _observable(key: str, text: str, names: dict[str, Callable], source: Source) -> Any:
    indicators = public(dvi.Deviations)
    reductions = public(dvi.Reduction, dvi.Deviations, *indicators.values())
    inner, wrap = text.strip(), lambda function: function
    if match := re.fullmatch(r"(\w+)\((.*)\)", inner):
        if match[1] in indicators:  # as it is written in Python, such as GALI(4, log10=True)
            example = "; with numbers alone, as in LyapunovSpectrum(2) or MEGNO()"
            return Expressions(key, dvi.Deviations, indicators, example).read(inner)
        kinds = [*reductions, *indicators]
        require_name(key, match[1], kinds, "a reduction: {}", f"{match[1]!r} is not a reduction")
        wrap, inner = reductions[match[1]], match[2].strip()
    if ":" in inner:
        function = source.loader.load(key, inner)
        defect = f"{inner!r} has the type {type(function).__name__}"
        require(callable(function), key, defect, _A_FUNCTION)
        defect = f"{inner!r} has other arguments, {signature_of(function)}"
        with as_input_error(key, _A_FUNCTION, text=lambda _: defect):
            return wrap(of_steps(function))
    calls = ", ".join(f"{name}()" for name in indicators)
    rule = f'{{}}; or "file.py:name"; alone or in {", ".join(reductions)}; or {calls}'
    require_name(key, inner, names, rule, f"{inner!r} is unknown")
    return wrap(names[inner])


@dataclass(frozen=True)
class Observed:
    """One observable of a run.

    - `start`: its value at the start. `values`: at the saved times, the start first, shape
      (S, …), for one without a reduction; else the reduced value; the number of crossings.
    - `scale`: size that changes are divided by; 1 where the start value is zero or not finite.
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
        if self.reduction:
            entry = {"reduction": self.reduction, "value": self.values}
            if self.reduction in ("MaxDrift", "Range"):
                entry["relative"] = float(np.linalg.norm(self.values)) / self.scale
        else:
            change = np.abs(self.change())
            largest = np.max(change, where=np.isfinite(change), initial=-np.inf)
            entry = {"start": self.start, "end": self.values[-1]}
            entry["largest_saved_change"] = float(largest) if largest >= 0 else np.nan
        return entry | {"scale": self.scale}


def observe(
    run: Mapping[str, Any], observables: Mapping[str, Any], values: Mapping[str, Any]
) -> dict[str, Observed]:
    """The observables of a run, given by the arguments of `dvi.integrate`, with start and scale.

    The scale is the size of the start value; of a linear momentum, whose total may be nearly
    zero, the sum Σ|p_i| over the bodies.
    """
    q0, p0 = jnp.asarray(run["q0"]), jnp.asarray(run["p0"])
    t0 = jnp.asarray(run["t0"], q0.dtype)
    results = {}
    for name, observable in observables.items():
        reduction = type(observable).__name__ if isinstance(observable, dvi.Reduction) else ""
        function: Any = observable.function if reduction else observable
        if hasattr(function, "bind"):  # it requires the system and ε of the run
            function = function.bind(run["system"], run["epsilon"])
        is_of_state = isinstance(function, OfState)
        start = np.asarray(function(t0, t0, q0, p0, q0, p0, run["args"]))  # a step of length zero
        scale = float(np.linalg.norm(start))
        if function is OBSERVABLES["linear_momentum"]:
            scale = float(np.linalg.norm(run["p0"], axis=-1).sum())
        scale = scale if np.isfinite(scale) and scale else 1.0
        value: Any = values[name]
        series = np.asarray(value.count if isinstance(value, dvi.Crossings) else value)
        if not (reduction or is_of_state):  # no step has reached the start
            series = np.concatenate([start[None], series])
        results[name] = Observed(start, series, scale, reduction)
    return results
