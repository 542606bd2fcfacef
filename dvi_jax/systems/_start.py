"""Checks of initial conditions and parameters, as data."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._checks import finite as finite, positive as positive

Check = Callable[[str, Any], Any]
"""Function of a parameter's name and value that raises `ValueError`."""


class ParameterError(ValueError):
    """An invalid parameter in args."""


@dataclass(frozen=True)
class Start:
    """A check of initial conditions and parameters: a function of (q0, p0, args).

    - `system`: the system in words, for messages.
    - `shape`: of q0 and of p0, with None for any number from `least` on; None for any shape.
    - `parameters`: name in args → check of its value.
    - `singular`: name of a singular point → the point, or a function of args.
    - `also`: a further check, function of q0, p0 (NumPy arrays) and args.

    **Raises** `ValueError` that shows what was seen; `ParameterError` for a parameter.
    """

    system: str
    shape: tuple[int | None, ...] | None
    parameters: Mapping[str, Check] = field(default_factory=dict)
    singular: Mapping[str, Any] = field(default_factory=dict)
    also: Callable[[Any, Any, Any], None] | None = None
    least: int = 1

    def __call__(self, q0: Any, p0: Any, args: Any) -> None:
        check_shape(q0, p0, self._fits, f"{self.system}: q0 and p0 of {self._wanted}")
        for name, check in self.parameters.items():
            check_parameter(args, name, check)
        if not (self.singular or self.also):
            return
        q, p = np.asarray(q0, float), np.asarray(p0, float)
        for what, at in self.singular.items():
            point: Any = at(args) if callable(at) else at
            if (q == point).all():
                raise ValueError(
                    f"q0 is on top of {what} at {list(point)}: the system is singular there."
                )
        if self.also is not None:
            self.also(q, p, args)

    def _fits(self, seen: tuple[int, ...]) -> bool:
        if self.shape is None:
            return True
        pairs = zip(seen, self.shape, strict=False)
        return len(seen) == len(self.shape) and all(
            n >= self.least if m is None else n == m for n, m in pairs
        )

    @property
    def _wanted(self) -> str:
        if self.shape is None:
            return "one shape, any"
        range_of_n = f", n ≥ {self.least}" if None in self.shape else ""
        return f"shape {self.shape}{range_of_n}".replace("None", "n")


def check_shape(q0: Any, p0: Any, fits: Callable[[tuple[int, ...]], bool], wanted: str) -> None:
    """Require q0 and p0 of one shape for which `fits` holds; `wanted`: these shapes, a sentence."""
    q, p = np.shape(q0), np.shape(p0)
    if q != p or not fits(q):
        raise ValueError(f"{wanted}; got q0 of shape {q} and p0 of shape {p}.")


def parameter(args: Any, name: str) -> Any:
    """The parameter of this name. **Raises** `ParameterError`, with the names that args has."""
    if not isinstance(args, Mapping) or name not in args:
        there = ", ".join(map(str, args)) if isinstance(args, Mapping) else ""
        raise ParameterError(
            f"the parameter {name} is missing: args must be a dict that has {name!r}; "
            f"got {f'one with {there}' if there else repr(args)}."
        )
    return args[name]


def check_parameter(args: Any, name: str, check: Check) -> None:
    """Apply a check to the parameter of this name. **Raises** `ParameterError`."""
    value = parameter(args, name)
    try:
        check(name, value)
    except ValueError as error:
        raise ParameterError(str(error)) from None


def gyrates(name: str, value: Any) -> None:
    """A check for the charge of a particle or the strength of a magnetic field."""
    if finite(name, value) == 0:
        raise ValueError(f"{name} is 0: the particle does not gyrate. Take another system.")


def between(low: float, high: float) -> Check:
    """A check for a number in the open interval."""

    def check(name: str, value: Any) -> None:
        if not low < finite(name, value) < high:
            raise ValueError(f"{name} must be between {low} and {high}, got {value}.")

    return check


def vector(size: int) -> Check:
    """A check for `size` finite numbers."""

    def check(name: str, given: Any) -> None:
        try:
            value = np.asarray(given, float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be {size} numbers: {error}") from None
        if value.shape != (size,):
            raise ValueError(f"{name} must have shape ({size},), got {value.shape}.")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, got {value}.")

    return check
