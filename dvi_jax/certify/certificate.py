"""Every method under every check, and whether every check can fail."""

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

import dvi_jax as dvi

from . import problems
from .candidate import Candidate
from .checks import CHECKS
from .controls import CONTROLS, Control
from .measured import Measured
from .registry import METHODS
from .table import Table, markdown, tables

_WORKERS = 2
"""Methods at a time: while one compiles another is traced."""


@dataclass(frozen=True)
class Certificate:
    """What was measured.

    - `methods`: name → method. `rows`: name → check → `Measured`.
    - `controls`: the broken methods with what the check that must catch each has measured.
    """

    methods: Mapping[str, dvi.Method]
    rows: Mapping[str, Mapping[str, Measured]]
    controls: tuple[tuple[Control, Measured], ...]

    @property
    def failures(self) -> list[tuple[str, str, Measured]]:
        """(method, check, measured) wherever a method does not keep what it promises."""
        return [(m, c, x) for m, row in self.rows.items() for c, x in row.items() if not x.ok]

    @property
    def missed(self) -> list[Control]:
        """The controls that no number caught (an exception is none): their checks prove nothing."""
        return [control for control, measured in self.controls if measured.verdict != "FAIL"]

    @property
    def ok(self) -> bool:
        """Whether every method keeps its promises and every control was caught."""
        return not self.failures and not self.missed

    @property
    def summary(self) -> str:
        """Two lines: the methods, the controls."""
        good = len(self.rows) - len({method for method, _, _ in self.failures})
        caught = len(self.controls) - len(self.missed)
        return (
            f"methods: {good} of {len(self.rows)} keep what they promise\n"
            f"controls: {caught} of {len(self.controls)} caught"
        )

    def tables(self) -> list[Table]:
        """The tables, as text."""
        return tables(self.methods, self.rows, self.controls)

    def markdown(self) -> str:
        """The page of the documentation."""
        return markdown(self.tables(), self.summary, self.failures)

    def __str__(self) -> str:
        return self.markdown()


def certify(
    methods: Mapping[str, dvi.Method] | Iterable[str] | None = None,
    checks: Iterable[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Certificate:
    """What methods promise, measured: order, structure, long runs, gradients, compilation.

    Each check holds a number of the method's against a bound, and each is shown to catch at least
    one method that is broken on purpose (the controls).

    **Arguments**

    - `methods`: name → `Method`, your own for instance; or names of `METHODS`; None for all those.
    - `checks`: names of `CHECKS`; None for all.
    - `progress`: called as ``progress(done, total)`` after each method and each control.

    **Returns** a `Certificate`; ``print`` it, or read `ok`, `failures`, `rows`.

    **Raises** `ValueError` for a name that is not there, for none at all, and where x64 is off;
    `TypeError` for what is no method. An exception that a method raises is a failure of the check
    at hand.

    **Accuracy** the bounds are those of double precision. All methods of the package take some
    ten minutes of processor time, nearly all of it compilation, and 2 GB of memory or more; one
    method takes 15 to 35 seconds.
    """
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(
            "certify measures in double precision, and x64 is off. Turn it on before anything "
            'else: jax.config.update("jax_enable_x64", True).'
        )
    chosen = _chosen_methods(methods)
    wanted = list(CHECKS) if checks is None else _names("check", checks, CHECKS)
    controls = [control for control in CONTROLS if control.check in wanted]
    if {"order", "forced-order"} & set(wanted):
        for epsilon in (0.0, problems.FORCED):
            problems.reference(epsilon)  # here, not in each worker at once

    def row(method: dvi.Method, names: list[str]) -> dict[str, Measured]:
        candidate = Candidate(method)
        return {name: CHECKS[name](candidate) for name in names}

    work = [(method, wanted) for method in chosen.values()]
    work += [(control.method, [control.check]) for control in controls]
    pool = ThreadPoolExecutor(_WORKERS)
    try:
        futures = [pool.submit(row, *each) for each in work]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            if progress is not None:
                progress(done, len(futures))
        found = [future.result() for future in futures]
    finally:
        pool.shutdown(cancel_futures=True)
    rows = dict(zip(chosen, found, strict=False))
    outcomes = [x[c.check] for c, x in zip(controls, found[len(chosen) :], strict=True)]
    return Certificate(chosen, rows, tuple(zip(controls, outcomes, strict=True)))


def _chosen_methods(methods: Any) -> dict[str, dvi.Method]:
    if methods is None:
        return dict(METHODS)
    if isinstance(methods, Mapping):
        for name, method in methods.items():
            if not isinstance(method, dvi.Method):
                raise TypeError(f"{name!r} must be a method such as dvi.TypeII(), got {method!r}.")
            order = method.order
            if isinstance(order, bool) or not isinstance(order, int | float):
                raise TypeError(f"the order of {name!r} must be a number, got {order!r}.")
            if not (math.isfinite(order) and order > 0):
                raise ValueError(f"the order of {name!r} must be positive, got {order!r}.")
        if not methods:
            raise ValueError("no method was given: certify({}) would certify nothing.")
        return {str(name): method for name, method in methods.items()}
    if isinstance(methods, dvi.Method):
        raise TypeError(f'give the method a name: certify({{"mine": {methods!r}}}).')
    return {name: METHODS[name] for name in _names("method", methods, METHODS)}


def _names(kind: str, given: Any, known: Mapping[str, Any]) -> list[str]:
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise TypeError(f"{kind}s must be a list of names, got {given!r}.")
    given = list(dict.fromkeys(given))
    if not given:
        raise ValueError(f"no {kind} was named; known are {', '.join(known)}.")
    for name in given:
        if name not in known:
            lowered = {k.lower(): k for k in known}
            near = difflib.get_close_matches(str(name).lower(), lowered, n=1)
            hint = f" (did you mean {lowered[near[0]]}?)" if near else ""
            raise ValueError(
                f"there is no {kind} {name!r}{hint}; known are {', '.join(known)}."
                + (" A method of your own: certify({name: method})." if kind == "method" else "")
            )
    return given
