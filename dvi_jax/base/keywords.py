"""Keywords that a function declares as ``**settings: Unpack[...]`` of a `TypedDict`."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from .checks import argument_names, only_one, refuse_unknown, require, settings_type

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

_ABSENT = inspect.Parameter.empty

INTEGRATOR = "method lattice root_finder arithmetic layout integrator"
"""Keywords of functions that run trajectories which `chosen` turns into one `Integrator`."""


def checked_keywords(function: F) -> F:
    """Decorator of a function with ``**settings: Unpack[...]``, which Python itself does not check.

    **Raises** `TypeError` when it is called with an unknown keyword or without a necessary one.
    """
    names = frozenset(argument_names(function))
    necessary = sorted(getattr(settings_type(function), "__required_keys__", ()))

    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        unknown = [name for name in keywords if name not in names]
        refuse_unknown(function.__name__, function, unknown)
        values: dict[str, Any] = {name: keywords.get(name, _ABSENT) for name in necessary}
        require(function.__name__, values, _ABSENT)
        return function(*args, **keywords)

    return call  # pyright: ignore[reportReturnType]


def take(keywords: dict[str, Any], names: str) -> dict[str, Any]:
    """Remove these keywords, separated by blanks, from those of a call, and return them."""
    return {name: keywords.pop(name) for name in names.split()}


def with_keywords_of(source: Callable[..., Any], names: str = "", **extra: Any) -> Callable[[F], F]:
    """Decorator of a function that ends with ``**keywords``: these are the keywords of `source`.

    - `names`: those of `source` that are taken, separated by blanks; by default all.
    - `extra`: further keywords, with their defaults.

    The function receives every keyword, with its default if it is not given. `inspect.signature`,
    `help` and the reference list them by name.

    **Raises** `TypeError` when it is called with an unknown keyword or without a necessary one.
    """
    parameters = inspect.signature(source).parameters
    kind = inspect.Parameter.KEYWORD_ONLY
    keywords = [parameters[name] for name in names.split()]
    keywords = keywords or [entry for entry in parameters.values() if entry.kind == kind]
    keywords += [inspect.Parameter(name, kind, default=value) for name, value in extra.items()]

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        *positional, _ = signature.parameters.values()  # without **keywords
        additional = [entry for entry in keywords if entry.name not in signature.parameters]
        defaults = {entry.name: entry.default for entry in additional}
        # `inspect` requires positional parameters before keyword-only ones.
        ordering = sorted([*additional, *positional], key=lambda parameter: parameter.kind)

        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            names = call.__dict__["__signature__"].parameters
            refuse_unknown(function.__name__, call, [x for x in options if x not in names])
            options = {**defaults, **options}
            require(function.__name__, options, _ABSENT)
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
            only_one(TypeError, newton=options["newton"], root_finder=options.get("root_finder"))
            options["root_finder"] = options.pop("newton")
        construct(self, *args, **options)

    # In place: `isinstance` and pickles refer to this class, not to a subclass of it.
    cls.__init__ = init
    return cls
