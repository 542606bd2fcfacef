"""One keyword with two names."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_NAMES = {"newton", "root_finder"}


def both_names(function: F) -> F:
    """The same function or class, which takes how implicit steps are solved by either of its names:
    `root_finder`, as the field of `Integrator` is called, and `newton`. Its signature, with one of
    them, is unchanged.

    **Raises** `TypeError`, when it is called, for both names at once.
    """
    if isinstance(function, type):
        function.__init__ = both_names(function.__init__)
        return function  # pyright: ignore[reportReturnType]
    own, *more = _NAMES & set(inspect.signature(function).parameters)
    (other,) = _NAMES - {own}
    assert not more

    @functools.wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        if other in given:
            if own in given:
                raise TypeError("newton and root_finder are one keyword: give one of them.")
            given[own] = given.pop(other)
        return function(*args, **given)

    return call  # pyright: ignore[reportReturnType]
