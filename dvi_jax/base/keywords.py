"""Keywords that a function declares as ``**settings: Unpack[...]`` of a `TypedDict`."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from .checks import argument_names, refuse_unknown, unpacked

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


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
