"""Checks of the number of arguments of a function."""

import inspect
import warnings
from collections.abc import Callable
from typing import Any

import jax

from .checks import function as check_function
from .keywords import user_level


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


def check_takes(
    name: str, function: Any, arguments: str, hints: dict[int, str] | None = None
) -> None:
    """**Raises** `TypeError` for an object that is not a function of these positional arguments,
    such as "(t, q, p, args)"; `hints`: advice for functions of another number of arguments."""
    check_function(name, function, arguments)
    count = arguments.count(",") + 1
    if accepts(function, count):
        return
    signature = inspect.signature(function)
    hint = (hints or {}).get(len(signature.parameters), "")
    raise TypeError(
        f"{name} must take the arguments {arguments}, got {signature_of(function)}. {hint}".rstrip()
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
    try:
        names = list(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return
    letters = [argument[0] for argument in arguments.strip("()").split(", ")]
    initials = [name[:1].lower() for name in names]
    places = [letters.index("q"), letters.index("p")]
    if max(places) < len(names) and [initials[i] for i in places] == ["p", "q"]:
        warnings.warn(
            f"{name} is called with {arguments}, but its definition has the arguments "
            f"({', '.join(names)}). If it takes p before q, exchange them in the definition. If "
            "only the names are exchanged, rename them.",
            stacklevel=user_level(),
        )


def tracing_note(name: str, error: Exception) -> str:
    """Advice about an error in a function of the user that JAX traces."""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return (
            f"{name} is traced by JAX: its values are not known yet, so if and while cannot depend "
            "on them. Use jnp.where(condition, a, b), jax.lax.cond or jax.lax.while_loop."
        )
    errors = jax.errors
    if isinstance(error, errors.ConcretizationTypeError | errors.TracerArrayConversionError):
        return (
            f"{name} is traced by JAX: use jnp.cos, jnp.sqrt, … in place of np.cos, math.cos, "
            "float() or int()."
        )
    if isinstance(error, TypeError) and "NoneType" in str(error):
        return f"In this call args is None: if {name} uses args, pass args=... to the call."
    return f"{name} is traced by JAX: it must consist of functions of jax.numpy."
