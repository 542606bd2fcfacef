"""Functions that pass keywords on to another one, which need not repeat them."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def with_keywords_of(source: Callable[..., Any], names: str = "", **more: Any) -> Callable[[F], F]:
    """Decorator of a function that ends with ``**keywords``: these are the keywords of `source`.

    - `names`: those of `source` that are taken, separated by blanks; by default all.
    - `more`: further keywords, with their defaults.

    The function receives every keyword, with its default if it is not given. `inspect.signature`,
    `help` and the reference list them by name.

    **Raises** `TypeError`, as Python does, when it is called with an unknown keyword or without a
    necessary one.
    """
    known = inspect.signature(source).parameters
    kind, empty = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.empty
    listed = [known[n] for n in names.split()] or [p for p in known.values() if p.kind == kind]
    listed += [inspect.Parameter(name, kind, default=value) for name, value in more.items()]

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        *own, _ = signature.parameters.values()
        passed = [p for p in listed if p.name not in signature.parameters]
        defaults = {p.name: p.default for p in passed}
        allowed = {*defaults, *(p.name for p in own)}

        @functools.wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            if unknown := [name for name in given if name not in allowed]:
                raise TypeError(
                    f"{function.__name__}() got an unexpected keyword argument {unknown[0]!r}"
                )
            given = {**defaults, **given}
            if missing := [name for name, value in given.items() if value is empty]:
                raise TypeError(
                    f"{function.__name__}() missing the required keyword argument {missing[0]!r}"
                )
            return function(*args, **given)

        call.__dict__["__signature__"] = signature.replace(parameters=[*own, *passed])
        return call  # pyright: ignore[reportReturnType]

    return decorate
