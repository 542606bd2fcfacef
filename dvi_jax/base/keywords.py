"""Keywords that a function declares as ``**settings: Unpack[...]`` of a `TypedDict`."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from .checks import argument_names, refuse_unknown, unpacked

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

INTEGRATOR = "method lattice root_finder arithmetic layout integrator"
"""Keywords of functions that run trajectories which `chosen` turns into one `Integrator`."""


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


def take(keywords: dict[str, Any], names: str) -> dict[str, Any]:
    """Remove these keywords, separated by blanks, from those of a call, and return them."""
    return {name: keywords.pop(name) for name in names.split()}


def with_keywords_of(source: Callable[..., Any], names: str = "", **extra: Any) -> Callable[[F], F]:
    """Decorator of a function that ends with ``**keywords``: these are the keywords of `source`.

    - `names`: those of `source` that are taken, separated by blanks; by default all.
    - `more`: further keywords, with their defaults.

    The function receives every keyword, with its default if it is not given. `inspect.signature`,
    `help` and the reference list them by name.

    **Raises** `TypeError` when it is called with an unknown keyword or without a necessary one.
    """
    parameters = inspect.signature(source).parameters
    kind, empty = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.empty
    keywords = [parameters[n] for n in names.split()] or [
        p for p in parameters.values() if p.kind == kind
    ]
    keywords += [inspect.Parameter(name, kind, default=value) for name, value in extra.items()]

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        *positional, _ = signature.parameters.values()  # without **keywords
        additional = [p for p in keywords if p.name not in signature.parameters]
        defaults = {p.name: p.default for p in additional}
        # `inspect` requires positional parameters before keyword-only ones.
        ordering = sorted([*additional, *positional], key=lambda p: p.kind)

        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            names = call.__dict__["__signature__"].parameters
            if strangers := [name for name in options if name not in names]:
                refuse_unknown(function.__name__, call, strangers)
            options = {**defaults, **options}
            if gaps := [name for name, value in options.items() if value is empty]:
                raise TypeError(f"{function.__name__} requires {gaps[0]}=...: give a value.")
            return function(*args, **options)

        call.__dict__["__signature__"] = signature.replace(parameters=ordering)
        return call  # pyright: ignore[reportReturnType]

    return decorate


def accept_newton(cls: type[T]) -> type[T]:
    """Decorator of a class whose keyword `root_finder` has `newton` as a second name; both at once
    **raise** `TypeError`."""
    construct = cls.__init__

    @functools.wraps(construct)
    def init(self: T, *args: Any, **options: Any) -> None:
        if "newton" in options:
            if "root_finder" in options:
                raise TypeError("newton and root_finder are two names of one argument: give one.")
            options["root_finder"] = options.pop("newton")
        construct(self, *args, **options)

    # In place: `isinstance` and pickles refer to this class, not to a subclass of it.
    cls.__init__ = init
    return cls
