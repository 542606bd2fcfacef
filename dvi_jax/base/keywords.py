"""Keywords that a function declares as ``**settings: Unpack[...]`` of a `TypedDict`."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from .checks import argument_names, refuse_unknown, unpacked

F = TypeVar("F", bound=Callable[..., Any])


def checked_keywords(function: F) -> F:
    """Decorator of a function with ``**settings: Unpack[...]``, which Python itself does not check.

    **Raises** `TypeError` when it is called with an unknown keyword or without a necessary one.
    """
    names = frozenset(argument_names(function))
    required = sorted(getattr(unpacked(function), "__required_keys__", ()))

    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        refuse_unknown(
            function.__name__, function, [name for name in keywords if name not in names]
        )
        for name in required:
            if name not in keywords:
                raise TypeError(f"{function.__name__} requires {name}=...: give a value.")
        return function(*args, **keywords)

    return call  # pyright: ignore[reportReturnType]


def taken(keywords: dict[str, Any], names: str) -> dict[str, Any]:
    """Remove these keywords, separated by blanks, from those of a call, and return them."""
    return {name: keywords.pop(name) for name in names.split()}


def with_keywords_of(source: Callable[..., Any], names: str = "", **more: Any) -> Callable[[F], F]:
    """Decorator of a function that ends with ``**keywords``: these are the keywords of `source`.

    - `names`: those of `source` that are taken, separated by blanks; by default all.
    - `more`: further keywords, with their defaults.

    The function receives every keyword, with its default if it is not given. `inspect.signature`,
    `help` and the reference list them by name.

    **Raises** `TypeError` when it is called with an unknown keyword or without a necessary one.
    """
    known = inspect.signature(source).parameters
    kind, empty = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.empty
    listed = [known[n] for n in names.split()] or [p for p in known.values() if p.kind == kind]
    listed += [inspect.Parameter(name, kind, default=value) for name, value in more.items()]

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        *own, _ = signature.parameters.values()  # without **keywords
        passed = [p for p in listed if p.name not in signature.parameters]
        defaults = {p.name: p.default for p in passed}
        # `inspect` requires positional parameters before keyword-only ones.
        shown = sorted([*passed, *own], key=lambda p: p.kind)

        @functools.wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            known = call.__dict__["__signature__"].parameters
            if unknown := [name for name in given if name not in known]:
                refuse_unknown(function.__name__, call, unknown)
            given = {**defaults, **given}
            if missing := [name for name, value in given.items() if value is empty]:
                raise TypeError(f"{function.__name__} requires {missing[0]}=...: give a value.")
            return function(*args, **given)

        call.__dict__["__signature__"] = signature.replace(parameters=shown)
        return call  # pyright: ignore[reportReturnType]

    return decorate
