"""One keyword with two names."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_NAMES = {"newton", "root_finder"}


def both_names(function: F) -> F:
    """The same function or class, which accepts the solver of implicit steps as `root_finder` and
    as `newton`; a call with both **raises** `TypeError`. The signature shows one of them."""
    if isinstance(function, type):
        # In place: `isinstance` and pickles refer to this class, not to a subclass of it.
        function.__init__ = both_names(function.__init__)
        return function  # pyright: ignore[reportReturnType]
    own, *more = _NAMES & set(inspect.signature(function).parameters)
    (other,) = _NAMES - {own}
    assert not more

    @functools.wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        if other in given:
            if own in given:
                raise TypeError(f"{own} and {other} are two names of one argument: leave one out.")
            given[own] = given.pop(other)
        return function(*args, **given)

    return call  # pyright: ignore[reportReturnType]
