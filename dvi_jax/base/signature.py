"""Checks of the number of arguments of a function."""

import inspect
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .checks import function as check_function
from .indices import out_of_bounds
from .keywords import tracing_note, user_level


def accepts(function: Callable[..., Any], count: int) -> bool:
    """Whether `function` takes `count` positional arguments; True where that is not known."""
    try:
        # Bound, not counted: defaults and *rest are then taken into account.
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature: the call itself raises if it does not
        pass
    return True


def takes_state(function: Callable[..., Any]) -> bool:
    """Whether `function` takes (q, p); (t, q) and (q, args) do not, by their names."""
    names = argument_names(function)[:2]
    return accepts(function, 2) and not {"t", "t0", "t1", "time", "tau", "args"} & set(names)


def argument_names(function: Callable[..., Any]) -> list[str]:
    """The names of the arguments; none for a builtin function without a signature."""
    try:
        return list(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return []


# Modules and not closures: compiled programs are looked up by the function inside.
class _Short(eqx.Module):
    function: Callable[..., Any]

    @property
    def __name__(self) -> str:
        return getattr(self.function, "__name__", type(self.function).__name__)


class _OfPoint(_Short):
    """A function (q, p) that is called with (t, q, p, args)."""

    def __call__(self, t, q, p, args):
        return self.function(q, p)


class _OfStep(_Short):
    """A function (q0, v) that is called with (t0, t1, q0, v, args)."""

    def __call__(self, t0, t1, q0, v, args):
        return self.function(q0, v)


def with_time(
    name: str, function: Any, arguments: str = "(t, q, p, args)", hints: Any = None
) -> Callable[..., Any]:
    """A function of `arguments`, the times and args among them; from one of the state alone, such
    as (q, p), too. **Raises** `TypeError` for another one; `hints`: as for `check_takes`."""
    names = arguments.strip("()").split(", ")
    short = f"({', '.join(n for n in names if n[0] != 't' and n != 'args')})"
    # The longest form first: a function with defaults or *rest accepts several of them.
    is_short = not isinstance(function, type) and not accepts(function, len(names))
    if callable(function) and is_short and takes_state(function):
        warn_of_exchanged(name, function, short)
        return (_OfPoint if len(names) == 4 else _OfStep)(function)
    check_takes(name, function, arguments, hints, f"{short} or ")
    return function


def check_takes(
    name: str, function: Any, arguments: str, hints: dict[int, str] | None = None, short: str = ""
) -> None:
    """**Raises** `TypeError` for an object that is not a function of these positional arguments,
    such as "(t, q, p, args)"; `hints`: advice for functions of another number of arguments;
    `short`: other arguments, for the message."""
    check_function(name, function, f"{short}{arguments}")
    count = arguments.count(",") + 1
    if accepts(function, count):
        return
    signature = inspect.signature(function)
    hint = (hints or {}).get(len(signature.parameters), "")
    raise TypeError(
        f"{name} must take the arguments {short}{arguments}, got "
        f"{signature_of(function)}. {hint}".rstrip()
    )


def signature_of(function: Callable[..., Any]) -> str:
    """Name and arguments of a function, for messages."""
    name = getattr(function, "__name__", type(function).__name__)
    try:
        return f"{name}{inspect.signature(function)}"
    except (TypeError, ValueError):
        return name


def warn_of_exchanged(name: str, function: Callable[..., Any], arguments: str) -> None:
    """Warn if the names of the arguments suggest that the function takes p before q."""
    names = argument_names(function)
    letters = [argument[0] for argument in arguments.strip("()").split(", ")]
    initials = [name[:1].lower() for name in names]
    places = [i for i, letter in enumerate(letters) if letter in "qpv"][:2]
    if max(places) < len(names) and [initials[i] for i in places] == [
        letters[i] for i in places[::-1]
    ]:
        warnings.warn(
            f"{name} is called with {arguments}, but its definition has the arguments "
            f"({', '.join(names)}). If it takes p before q, exchange them in the definition. If "
            "only the names are exchanged, rename them.",
            stacklevel=user_level(),
        )


def array_type(name: str, value: Any, hint: str = "") -> jax.ShapeDtypeStruct:
    """Shape and type of what a user's function returned. **Raises** `TypeError` for no array."""
    # A constant of Python is an array of no axes.
    if isinstance(value, int | float):
        return jax.ShapeDtypeStruct((), jnp.result_type(value))
    if not hasattr(value, "shape"):
        kind = "None (is a return missing?)" if value is None else type(value).__name__
        raise TypeError(f"{name} must return one array, got {kind}. {hint}".rstrip())
    return jax.ShapeDtypeStruct(value.shape, value.dtype)


@contextmanager
def notes_of(name: str) -> Iterator[None]:
    """Within this an error in a user's function, `name`, gets notes for the user."""
    try:
        yield
    except Exception as error:
        # The error itself stays: its type and traceback show the line of the user.
        error.add_note(f"(in {name})")
        error.add_note(tracing_note(name.partition("(")[0], error))
        raise


def output_of(
    name: str, function: Callable[..., Any], *arguments: Any, hint: str = ""
) -> jax.ShapeDtypeStruct:
    """Shape and type of the value of a user's function; `name`: of what, for its errors."""
    with notes_of(name):
        program, *out = eqx.filter_make_jaxpr(function)(*arguments)
    # JAX moves such an index to the end of the array, so that the result would be wrong silently.
    for index, size in out_of_bounds(program):
        raise IndexError(f"{name} uses the index {index}, out of bounds for an axis of {size}.")
    return array_type(name, eqx.combine(*out), hint)
