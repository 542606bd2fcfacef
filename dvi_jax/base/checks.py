"""Checks of arguments: each returns the argument or raises an error that names what is allowed."""

import difflib
import inspect
import math
import numbers
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Unpack, get_args, get_origin

import numpy as np

Dimension = int | str
"""The length of an axis: a number, or the name of a length that may have any positive value."""

Shape = tuple[Dimension, ...]


_TRACED = "it is traced by JAX, but must be known here: compute it outside of jit, grad and vmap."


def known(name: str, values: Any, dtype: Any = None) -> np.ndarray:
    """An array of NumPy. **Raises** `TypeError` for traced values, for a list with parts of
    different lengths, and for values that do not have the `dtype`."""
    try:
        entries = np.asarray(values)
        return entries if dtype is None else entries.astype(dtype, casting="same_kind", copy=False)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must be a real number or an array of real numbers, got {values!r:.200}: "
            f"{_TRACED if 'Tracer' in type(error).__name__ else error}"
        ) from None


def whole(name: str, value: Any, low: int = 1, high: int | None = None, hint: str = "") -> int:
    """A whole number from `low` to `high` (None: any), not a bool. **Raises** `ValueError`."""
    # True is an integer in Python, but as a number it is nearly always a mistake.
    fits = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not fits or value < low or (high is not None and value > high):
        span = f"of at least {low}" if high is None else f"from {low} to {high}"
        text = f"{value!r:.200}" + ("" if fits else f" (type {type(value).__name__})")
        hint = f"However, {_TRACED}" if "Tracer" in type(value).__name__ else hint
        raise ValueError(f"{name} must be an integer {span}, got {text}.{_sentence(hint)}")
    return int(value)


def positive(name: str, value: Any, zero: bool = False, hint: str = "") -> float:
    """A positive and finite number; `zero`: or 0. **Raises** `ValueError`."""
    kind = "zero or a positive finite number" if zero else "a positive and finite number"
    return _number(name, value, kind, lambda x: x > 0 or (zero and x == 0), hint)


def electronvolts(name: str, value: Any, low: float) -> float:
    """An energy [eV] not below `low`, as one in another unit is. **Raises** `ValueError`."""
    hint = "The unit is eV: 1 MeV is 1e6, 1 GeV is 1e9."
    return _number(name, value, f"an energy of at least {low:g} eV", lambda x: x >= low, hint)


def in_range(name: str, values: Any, low: float, high: float, hint: str = "") -> None:
    """**Raises** `ValueError` for a number that is not from `low` to `high`; `TypeError` for what
    is not a number."""
    entries = known(name, values, float)
    for x in entries[~((entries >= low) & (entries <= high))].ravel().tolist():
        raise ValueError(f"{name} must be between {low:g} and {high:g}, got {x}.{_sentence(hint)}")


def fraction(name: str, value: Any) -> float:
    """A number between 0 and 1, both excluded. **Raises** `ValueError`."""
    return _number(name, value, "between 0 and 1 (both excluded)", lambda x: 0 < x < 1)


def finite(name: str, value: Any, hint: str = "") -> float:
    """A finite number. **Raises** `ValueError`."""
    return _number(name, value, "a finite number", lambda x: True, hint)


def _number(
    name: str, value: Any, kind: str, is_allowed: Callable[[Any], bool], hint: str = ""
) -> float:
    if not _is_number(name, value) or not math.isfinite(value) or not is_allowed(value):
        raise ValueError(f"{name} must be {kind}, got {value!r}.{_sentence(hint)}")
    return float(value)


def array(
    name: str, value: Any, *shapes: Shape, verb: str = "be", integers=False, empty=False, hint=""
) -> Any:
    """A real array, or anything else with a shape and a dtype, of one of the shapes.

    - `shapes`: such as (), a scalar, or (3, "m"), for any m ≥ 1; `empty`: also m = 0.
    - `verb`: "return" for the value of a function.
    - `integers`: whether they are allowed, next to floating-point numbers.

    **Raises** `ValueError`.
    """
    kind = value.dtype.kind
    # By name: bfloat16, which NumPy does not know, has no kind.
    is_real = kind == "f" or "float" in str(value.dtype) or (integers and kind in "iub")
    if not is_real or not any(_has_shape(value.shape, shape, empty) for shape in shapes):
        kinds = (f"array of shape {_shape_text(shape)}" if shape else "scalar" for shape in shapes)
        raise ValueError(
            f"{name} must {verb} a real {' or '.join(kinds).replace('or array of shape', 'or')}"
            f"{'' if integers else ' of a floating-point type'}, got shape {value.shape} and dtype "
            f"{value.dtype}.{_sentence(hint)}"
        )
    return value


def all_finite(name: str, values: Any, positive: bool = False, hint: str = "") -> None:
    """**Raises** `ValueError` for an array with a number that is not finite, or not `positive`."""
    entries = known(name, values)
    is_real = entries.dtype.kind in "iubf" or "float" in str(entries.dtype)
    is_good = np.isfinite(entries) if is_real else np.zeros(entries.shape, bool)
    if is_real and positive:
        is_good = is_good & (entries > 0)
    if not is_good.all():
        index = tuple(np.argwhere(~is_good)[0].tolist())
        place = (f" at index {list(index)}" if index else "") + f".{_sentence(hint)}"
        raise ValueError(
            f"{name} must be {'positive and ' * positive}finite, got {entries[index]}{place}"
        )


def in_order(name: str, values: Any, strictly: bool = False, hint: str = "") -> None:
    """**Raises** `ValueError` unless the values are finite, in ascending or descending order;
    `strictly`: without equal neighbours."""
    entries = known(name, values)
    steps = np.diff(entries)
    rises = steps * (np.sign(steps[steps != 0][:1]).sum() or 1)
    is_good = np.isfinite(steps) & (rises > 0 if strictly else rises >= 0)
    if not np.isfinite(entries).all() or not is_good.all():
        k = 0 if is_good.all() else int(np.argmin(is_good))  # one place, since the list may be long
        raise ValueError(
            f"{name} must be finite and in {'strictly ' if strictly else ''}ascending or descending"
            f" order, got {entries[k : k + 2].tolist()} at index {k}.{_sentence(hint)}"
        )


def only_one(kind: type[Exception] = ValueError, /, **values: Any) -> None:
    """**Raises** an error of this `kind` if more than one of the arguments is not None."""
    texts = [f"{name}={value!r:.100}" for name, value in values.items() if value is not None]
    if len(texts) > 1:
        raise kind(f"only one of {_enumeration(values)} can be given, got {_enumeration(texts)}.")


def require(owner: str, values: Mapping[str, Any], absent: Any = None, hint: str = "") -> None:
    """**Raises** `TypeError` for arguments with the value `absent`, which `owner` requires."""
    names = [name for name, value in values.items() if value is absent]
    if names:
        raise TypeError(f"{owner} requires {_enumeration(names)}.{_sentence(hint)}")


def require_system(name: str, system: Any) -> None:
    """**Raises** `ValueError` for an observable without a system, which `bind` gives it."""
    if system is None:
        raise ValueError(
            f"{name} has no system: give it to dvi.integrate(observe=...), or call its method "
            "bind(system, epsilon)."
        )


def one_of(name: str, value: Any, choices: Iterable[Any], hint: str = "") -> Any:
    """One of the known values. **Raises** `ValueError`."""
    choices = list(choices)
    value = value.item() if isinstance(value, np.integer) else value
    # The types are compared as well: True == 1, and an array has no truth value.
    if not any(
        value is choice or (type(value) is type(choice) and value == choice) for choice in choices
    ):
        names = ("one of " if len(choices) > 1 else "") + ", ".join(map(repr, choices))
        kind = f" (type {type(value).__name__})" if isinstance(value, bool | float) else ""
        raise ValueError(f"{name} must be {names}, got {value!r:.200}{kind}.{_sentence(hint)}")
    return value


def instance(name: str, value: Any, kind: Any, description: str, hint: str = "") -> Any:
    """An instance of a class, or of one of several. **Raises** `TypeError`."""
    if not isinstance(value, kind):
        value_text = f"{value!r:.200}"
        # The class in place of an object is the usual mistake: dvi.Strang for dvi.Strang().
        if isinstance(value, type):
            value_text = f"the class {value.__name__} (is a pair of parentheses missing?)"
        elif inspect.isfunction(value):  # its repr has an address
            value_text = f"the function {value.__name__}"
        raise TypeError(f"{name} must be {description}, got {value_text}.{_sentence(hint)}")
    return value


def function(name: str, value: Any, arguments: str = "", hint: str = "") -> Callable[..., Any]:
    """A function; `arguments`: of what, such as "(t, q, p, args)". **Raises** `TypeError`."""
    if not callable(value) or isinstance(value, type):
        kind = f" of {arguments}" if arguments else ""
        raise TypeError(f"{name} must be a function{kind}, got {value!r:.200}.{_sentence(hint)}")
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
    **dict.fromkeys(("H", "hamiltonian", "Hamiltonian"), "H_D"),
    **dict.fromkeys(("W", "F", "forces"), "force"),
    **dict.fromkeys(("L", "l"), "length"),
    **dict.fromkeys(("errors", "error", "std", "yerr"), "sigma"),
    **dict.fromkeys(("x", "y", "data"), "values"),
    **dict.fromkeys(("E", "E0"), "energy"),
    **dict.fromkeys(("T", "kT", "k_BT"), "temperature"),
    **dict.fromkeys(("x0", "y0", "q"), "q0"),
    **dict.fromkeys(("v0", "p0_"), "p0"),
    **dict.fromkeys(("g", "dt_dtau", "monitor"), "speed"),
}
"""Names of arguments in other packages → the name here."""


def settings_type(function: Callable[..., Any]) -> Any:
    """The `TypedDict` of a function with ``**settings: Unpack[...]``; None for others."""
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind == parameter.VAR_KEYWORD and get_origin(parameter.annotation) is Unpack:
            return get_args(parameter.annotation)[0]
    return None


def argument_names(function: Callable[..., Any]) -> list[str]:
    """The arguments that a function accepts, those of an unpacked `TypedDict` included."""
    parameters = inspect.signature(function).parameters.values()
    names = [entry.name for entry in parameters if entry.kind != entry.VAR_KEYWORD]
    return [*names, *getattr(settings_type(function), "__annotations__", ())]


def refuse_unknown(name: str, function: Callable[..., Any], keywords: Iterable[str]) -> None:
    """**Raises** `TypeError` for keywords that the function does not have, with the one meant."""
    for keyword in keywords:
        names = argument_names(function)
        # Upper case is no other word: K1 is k1.
        spellings = {name.lower(): name for name in reversed(names)}
        close = difflib.get_close_matches(keyword.lower(), spellings, 1, 0.6)
        # Synonyms first: by spelling alone the nearest name to dt0 would be t0.
        suggestion = SYNONYMS.get(keyword) if SYNONYMS.get(keyword) in names else None
        suggestion = suggestion or (spellings[close[0]] if close else None)
        hint = f" {arguments_text(names)}"
        if suggestion:
            hint = f" Did you mean {suggestion!r}?"
        if keyword in ("rtol", "atol", "tolerance"):
            hint = " No tolerance controls the size of the steps: choose h."
        raise TypeError(f"{name} has no argument {keyword!r}.{hint}")


def arguments_text(names: list[str]) -> str:
    """A sentence with the arguments of a function, for messages."""
    return f"Its arguments are {', '.join(names)}." if names else "It has no arguments."


def _is_number(name: str, value: Any) -> bool:
    """Whether it is a real number of Python, NumPy or JAX, or an array of one; `name`: of what."""
    # Arrays of JAX, traced or not, by their attributes: this file does not import JAX.
    if isinstance(value, np.ndarray) or hasattr(value, "__jax_array__") or hasattr(value, "aval"):
        value = known(name, value)
        return value.ndim == 0 and (value.dtype.kind in "iu" or "float" in str(value.dtype))
    return isinstance(value, numbers.Real | np.number) and not isinstance(value, bool)


def _has_shape(shape: tuple[int, ...], pattern: Shape, empty: bool) -> bool:
    return len(shape) == len(pattern) and all(
        size > 0 or empty if isinstance(length, str) else size == length
        for size, length in zip(shape, pattern, strict=True)
    )


def _shape_text(pattern: Shape) -> str:
    return f"({', '.join(map(str, pattern))}{',' * (len(pattern) == 1)})"


def _enumeration(texts: Iterable[str]) -> str:
    """Such as "a, b and c"."""
    *first, last = texts
    return f"{', '.join(first)} and {last}" if first else last


def _sentence(hint: str) -> str:
    return f" {hint}" if hint else ""
