"""What a function can be called with, and the refusal of one that cannot."""

import inspect
from collections.abc import Callable
from typing import Any

from .._checks import function as check_function


def accepts(function: Callable[..., Any], count: int) -> bool:
    """Whether `function` takes `count` positional arguments; True where nobody can tell."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a builtin without a signature: calling it will tell
        return True
    return True


def check_takes(
    name: str, function: Any, arguments: str, hints: dict[int, str] | None = None
) -> None:
    """Refuse what is no function of these positional arguments, such as "(t, q, p, args)".

    - `hints`: what to do with a function of another number of arguments.

    **Raises** `TypeError`.
    """
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
