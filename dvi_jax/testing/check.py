"""A check: a measurement of a method, its bound, and what to do when it fails."""

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

import dvi_jax as dvi
from dvi_jax.systems import Problem

from .candidate import Candidate


@dataclass(frozen=True)
class Measured:
    """One measured property of one method.

    - `value`: the number measured; NaN when nothing could be measured.
    - `allowed`: the bound in words, such as ``"≤ 1e-12"`` or ``"4 ± 0.2"``.
    - `passed`: whether the value meets the bound; never for a value that is NaN.
    - `claimed`: whether the method claims the property; if not, a missing property is no failure.
    - `detail`: the points of a fit, the status of a trajectory, and the like.
    """

    value: float
    allowed: str
    passed: bool
    claimed: bool = True
    detail: str = ""

    def __post_init__(self):
        if self.passed and not math.isfinite(self.value):
            raise ValueError(f"passed must be False for a value of {self.value}. {self.detail}")

    @property
    def ok(self) -> bool:
        """Whether the method has the property, or does not claim it."""
        return self.passed or not self.claimed

    @property
    def verdict(self) -> str:
        """``"pass"``, ``"FAIL"``, ``"NOT MEASURED"`` (a failure too) or ``"not claimed"``."""
        if not self.claimed:
            return "not claimed"
        if self.passed:
            return "pass"
        return "NOT MEASURED" if math.isnan(self.value) else "FAIL"


def at_most(value: float, bound: float, claimed: bool = True, detail: str = "") -> Measured:
    """value ≤ bound."""
    holds = math.isfinite(value) and value <= bound
    return Measured(float(value), f"≤ {bound:g}", holds, claimed, detail)


def not_measured(allowed: str, detail: str, claimed: bool = True) -> Measured:
    """Nothing could be measured, which is a failure where the property is claimed."""
    return Measured(math.nan, allowed, False, claimed, detail)


@dataclass(frozen=True)
class Check:
    """A check: its name, description, measurement, and advice when it fails."""

    name: str
    says: str
    measure: Callable[[Candidate], Measured]
    remedy: str
    digits: str
    any_problem: bool

    def __call__(self, candidate: Candidate) -> Measured:
        """The measurement; an exception that the method raises is a failure."""
        try:
            return self.measure(candidate)
        except Exception as error:  # whatever the user's method raises
            lines = str(error).strip().splitlines() or [""]
            return not_measured("no error", f"{type(error).__name__}: {lines[0][:200]}")


CHECKS: dict[str, Check] = {}
"""Name → check, in the order in which tables show them."""


def check(name: str, remedy: str, digits: str = ".0e", any_problem: bool = False):
    """Register a measurement, and turn it into a function that raises when the check fails.

    `any_problem`: whether the property can be measured on any problem.
    """

    def register(measure: Callable[[Candidate], Measured]):
        says = " ".join((measure.__doc__ or "").split())
        CHECKS[name] = Check(name, says, measure, remedy, digits, any_problem)

        def requirement(method: dvi.Method, problem: Problem | None = None) -> Measured:
            if problem is not None and not any_problem:
                raise ValueError(f"problem must be None: {name} is measured on a fixed problem.")
            return _require(Candidate(method, problem), [name])[name]

        # Not functools.wraps: the signature shown must be that of `required`.
        for attribute in ("__name__", "__qualname__", "__module__", "__doc__"):
            setattr(requirement, attribute, getattr(measure, attribute))
        return requirement

    return register


def check_method(method: dvi.Method, checks: Iterable[str] | None = None) -> dict[str, Measured]:
    """Require that a method has the properties that it claims.

    - `checks`: names of `CHECKS`; None for all, which takes 15 to 35 seconds.

    **Returns** name → `Measured`, also for properties that the method does not claim.

    **Raises** `AssertionError` with measured and required values and advice, for all checks that
    fail; `ValueError` for an unknown name, and where x64 is off.
    """
    return _require(Candidate(method), checks)


def _require(candidate: Candidate, checks: Iterable[str] | None) -> dict[str, Measured]:
    require_double_precision()
    results = {name: CHECKS[name](candidate) for name in selected_names("check", checks, CHECKS)}
    faults = [
        f"{name}: measured {result.value:.3g}, required {result.allowed}. {result.detail}\n"
        f"  What is measured: {CHECKS[name].says}\n  What to do: {CHECKS[name].remedy}"
        for name, result in results.items()
        if not result.ok
    ]
    if faults:
        claims = f"{type(candidate.method).__name__} does not have all properties that it claims:"
        raise AssertionError("\n".join([claims, *faults]))
    return results


def require_double_precision() -> None:
    """**Raises** `ValueError` where x64 is off: the bounds are those of double precision."""
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(
            "methods are measured in double precision, but x64 is off: first call "
            'jax.config.update("jax_enable_x64", True).'
        )


def selected_names(kind: str, names: Any, choices: Iterable[str], hint: str = "") -> list[str]:
    """`names` without repetitions, or all that are known for None.

    **Raises** `ValueError` for an unknown name and for none at all, `TypeError` for no list.
    """
    choices = list(choices)
    if names is None:
        return choices
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise TypeError(
            f"{kind}s must be a list of names such as [{choices[0]!r}], got {names!r:.200}.{hint}"
        )
    names = list(dict.fromkeys(names))
    if not names:
        raise ValueError(f"{kind}s is empty: give some of {', '.join(choices)}, or None for all.")
    lower_case = {name.lower(): name for name in choices}
    for name in names:
        if name not in choices:
            matches = difflib.get_close_matches(str(name).lower(), lower_case, n=1)
            proposal = f" (did you mean {lower_case[matches[0]]}?)" if matches else ""
            raise ValueError(
                f"{kind}s must be some of {', '.join(choices)}, got {name!r:.200}{proposal}.{hint}"
            )
    return names
