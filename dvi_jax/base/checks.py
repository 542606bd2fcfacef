"""Checks of arguments: each returns the argument or raises an error that names what is allowed."""

import difflib
import inspect
import math
import numbers
from collections.abc import Callable, Iterable
from typing import Any, Unpack, get_args, get_origin

import numpy as np


def whole(name: str, value: Any, least: int = 1, most: int | None = None, hint: str = "") -> int:
    """A whole number from `least` to `most` (None: any), not a bool. **Raises** `ValueError`."""
    # True is an integer in Python, but as a number it is nearly always a mistake.
    fits = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not fits or value < least or (most is not None and value > most):
        span = f"of at least {least}" if most is None else f"from {least} to {most}"
        text = f"{value!r:.200}" + ("" if fits else f" (type {type(value).__name__})")
        raise ValueError(f"{name} must be an integer {span}, got {text}.{_sentence(hint)}")
    return int(value)


def positive(name: str, value: Any, zero: bool = False, hint: str = "") -> float:
    """A positive and finite number; `zero`: or 0. **Raises** `ValueError`."""
    fits = _is_number(value) and math.isfinite(value)
    if not fits or value < 0 or (value == 0 and not zero):
        kind = "zero or a positive finite number" if zero else "a positive and finite number"
        raise ValueError(f"{name} must be {kind}, got {value!r}.{_sentence(hint)}")
    return float(value)


def fraction(name: str, value: Any) -> float:
    """A number between 0 and 1, both excluded. **Raises** `ValueError`."""
    if not _is_number(value) or not 0 < value < 1:
        raise ValueError(f"{name} must be a number between 0 and 1 (both excluded), got {value!r}.")
    return float(value)


def finite(name: str, value: Any, hint: str = "") -> float:
    """A finite number. **Raises** `ValueError`."""
    if not _is_number(value) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}.{_sentence(hint)}")
    return float(value)


def one_of(name: str, value: Any, choices: Iterable[Any], hint: str = "") -> Any:
    """One of the known values. **Raises** `ValueError`."""
    choices = list(choices)
    # The types are compared as well: True == 1, and an array has no truth value.
    if not any(
        value is choice or (type(value) is type(choice) and value == choice) for choice in choices
    ):
        names = ("one of " if len(choices) > 1 else "") + ", ".join(map(repr, choices))
        kind = f" (type {type(value).__name__})" if isinstance(value, bool | float) else ""
        raise ValueError(f"{name} must be {names}, got {value!r:.200}{kind}.{_sentence(hint)}")
    return value


def instance(name: str, value: Any, kind: Any, description: str, hint: str = "") -> Any:
    """An instance of a class (or of one of several); `called` is its name in the message.

    **Raises** `TypeError`.
    """
    if not isinstance(value, kind):
        text = f"{value!r:.200}"
        # The class in place of an object is the usual mistake: dvi.Strang for dvi.Strang().
        if isinstance(value, type):
            text = f"the class {value.__name__} (is a pair of parentheses missing?)"
        elif inspect.isfunction(value):  # its repr has an address
            text = f"the function {value.__name__}"
        raise TypeError(f"{name} must be {description}, got {text}.{_sentence(hint)}")
    return value


def function(name: str, value: Any, arguments: str = "", hint: str = "") -> Callable[..., Any]:
    """A function; `arguments`: of what, such as "(t, q, p, args)". **Raises** `TypeError`."""
    if not callable(value):
        signature = f" of {arguments}" if arguments else ""
        raise TypeError(
            f"{name} must be a function{signature}, got {value!r:.200}.{_sentence(hint)}"
        )
    return value


SYNONYMS = {
    **dict.fromkeys(("dt", "dt0", "step", "step_size", "stepsize"), "h"),
    **dict.fromkeys(("n_steps", "nsteps", "steps", "n", "N", "max_steps"), "num_steps"),
    **dict.fromkeys(("eps", "strength"), "epsilon"),
    **dict.fromkeys(("solver", "scheme", "stepper"), "method"),
    **dict.fromkeys(("tf", "t_end", "t_final", "tmax", "t_span"), "t1"),
    **dict.fromkeys(("parameters", "params", "p"), "args"),
    **dict.fromkeys(("observables", "observable"), "observe"),
    "saveat": "save",
    "event": "stop",
    "events": "stop",
    "grid": "lattice",
    "newton": "root_finder",
}
"""Names of arguments in other packages → the name here."""


def unpacked(function: Callable[..., Any]) -> Any:
    """The `TypedDict` of a function with ``**settings: Unpack[...]``; None for others."""
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind == parameter.VAR_KEYWORD and get_origin(parameter.annotation) is Unpack:
            return get_args(parameter.annotation)[0]
    return None


def argument_names(function: Callable[..., Any]) -> list[str]:
    """The arguments that a function accepts, those of an unpacked `TypedDict` included."""
    parameters = inspect.signature(function).parameters.values()
    own = [x.name for x in parameters if x.kind != x.VAR_KEYWORD]
    return [*own, *getattr(unpacked(function), "__annotations__", ())]


def refuse_unknown(name: str, function: Callable[..., Any], keywords: Iterable[str]) -> None:
    """**Raises** `TypeError` for keywords that the function does not have, with the one meant."""
    for keyword in keywords:
        names = argument_names(function)
        close = difflib.get_close_matches(keyword, names, 1, 0.6)
        # Synonyms first: by spelling alone the nearest name to dt0 would be t0.
        suggestion = SYNONYMS.get(keyword) if SYNONYMS.get(keyword) in names else None
        suggestion = suggestion or (close[0] if close else None)
        hint = (
            f" Did you mean {suggestion!r}?"
            if suggestion
            else f" Its arguments are {', '.join(names)}."
        )
        if keyword in ("rtol", "atol", "tolerance"):
            hint = " No tolerance controls the size of the steps: choose h."
        raise TypeError(f"{name} has no argument {keyword!r}.{hint}")


def _is_number(value: Any) -> bool:
    """Whether it is a real number of Python, NumPy or JAX, or an array of one."""
    # Arrays of JAX, traced or not, by their attributes: this file does not import JAX.
    if isinstance(value, np.ndarray) or hasattr(value, "__jax_array__") or hasattr(value, "aval"):
        value = np.asarray(value)
        return value.ndim == 0 and value.dtype.kind in "iuf"
    return isinstance(value, numbers.Real | np.number) and not isinstance(value, bool)


def _sentence(hint: str) -> str:
    return f" {hint}" if hint else ""
