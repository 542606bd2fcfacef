"""Keywords that a function declares as ``**settings: Unpack[...]`` of a `TypedDict`."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from .checks import argument_names, only_one, refuse_unknown, require, settings_type
from .machine import refuse_fork

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

_ABSENT = object()


def checked_keywords(function: F) -> F:
    """Decorator of a function with ``**settings: Unpack[...]``, which Python itself does not check:
    an unknown keyword, or the absence of a necessary one, **raises** `TypeError`. In a process that
    was forked after JAX had started it raises `RuntimeError`."""
    names = frozenset(argument_names(function))
    necessary = sorted(getattr(settings_type(function), "__required_keys__", ()))

    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        unknown = [name for name in keywords if name not in names]
        refuse_unknown(function.__name__, function, unknown)
        values: dict[str, Any] = {name: keywords.get(name, _ABSENT) for name in necessary}
        require(function.__name__, values, _ABSENT)
        refuse_fork()
        return function(*args, **keywords)

    return call  # pyright: ignore[reportReturnType]


def accept_newton(cls: type[T]) -> type[T]:
    """Decorator of a class: `newton=` means `root_finder=`; both at once **raise** `TypeError`."""
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
