"""Checks of the number of arguments of a function."""

import inspect
from collections.abc import Callable
from typing import Any

from .._checks import function as check_function


def accepts(function: Callable[..., Any], count: int) -> bool:
    """Whether `function` takes `count` positional arguments; True where that is not known."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature: the call itself raises if it does not
        return True
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
    called = getattr(function, "__name__", type(function).__name__)
    hint = (hints or {}).get(len(signature.parameters), "")
    raise TypeError(
        f"{name} must take {_WORDS[count]} positional arguments {arguments}; "
        f"{called}{signature} does not. {hint}".rstrip()
    )


_WORDS = {4: "four", 5: "five"}
