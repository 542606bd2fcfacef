"""Every method under every check, and whether every check can fail."""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

import dvi_jax as dvi

from ..base.checks import instance, positive
from ..base.printing import printable
from .candidate import Candidate
from .check import CHECKS, Measured, require_double_precision, selected_names
from .controls import CONTROLS, Control
from .page import Sheet, markdown, tables
from .problems import COUPLED, STRENGTH, reference
from .registry import METHODS

_WORKERS = 2
"""Methods at a time: while one compiles another is traced."""


@printable
@dataclass(frozen=True)
class Certificate:
    """The measurements of `certify`.

    - `methods`: name → method. `rows`: name → check → `Measured`.
    - `controls`: the broken methods, each with the result of the check that must find its defect.
    """

    methods: Mapping[str, dvi.Method]
    rows: Mapping[str, Mapping[str, Measured]]
    controls: tuple[tuple[Control, Measured], ...]

    @property
    def failures(self) -> list[tuple[str, str, Measured]]:
        """(method, check, measured) wherever a method lacks a property that it claims."""
        results = ((name, check, row[check]) for name, row in self.rows.items() for check in row)
        return [entry for entry in results if not entry[2].ok]

    @property
    def missed(self) -> list[Control]:
        """The controls without a measured number that fails (an exception is not one)."""
        return [control for control, result in self.controls if result.verdict != "FAIL"]

    @property
    def ok(self) -> bool:
        """Whether there are no `failures`, and no control is `missed`."""
        return not self.failures and not self.missed

    @property
    def summary(self) -> str:
        """Two lines: the methods, the controls."""
        good = len(self.rows) - len({method for method, _, _ in self.failures})
        detections = len(self.controls) - len(self.missed)
        return (
            f"methods: {good} of {len(self.rows)} have the properties that they claim\n"
            f"controls: {detections} of {len(self.controls)} caught"
        )

    def tables(self) -> list[Sheet]:
        """The tables, as text."""
        return tables(self.methods, self.rows, self.controls)

    def __str__(self) -> str:
        return markdown(self.tables(), self.summary, self.failures)

    markdown = __str__


def certify(
    methods: Mapping[str, dvi.Method] | Iterable[str] | None = None,
    checks: Iterable[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Certificate:
    """The properties that methods claim, measured, with a control for each check.

    **Arguments**

    - `methods`: name → `Method`, such as your own; or names of `METHODS`; None for all of these.
    - `checks`: names of `CHECKS`; None for all.
    - `progress`: called as ``progress(done, total)`` after each method and each control.

    **Returns** a `Certificate`; ``print`` it, or read `ok`, `failures`, `rows`.

    **Raises** `ValueError` for an unknown name, for no name at all, and where x64 is off;
    `TypeError` for an object that is not a method. An exception of a method is a failure of the
    check that called it.

    **Accuracy** the bounds are those of double precision. All methods of the package take about
    ten minutes of processor time, nearly all of it compilation, and 2 GB of memory or more; one
    method takes 15 to 35 seconds.
    """
    require_double_precision()
    by_name = _methods_by_name(methods)
    names = selected_names("check", checks, CHECKS)
    controls = [control for control in CONTROLS if control.check in names]
    if {"order", "forced-order"} & set(names):
        for epsilon in (0.0, STRENGTH):
            reference(COUPLED, epsilon)  # here, not in each worker at once

    def row(method: dvi.Method, names: list[str]) -> dict[str, Measured]:
        candidate = Candidate(method)
        return {name: CHECKS[name](candidate) for name in names}

    pool = ThreadPoolExecutor(_WORKERS)
    try:
        rows = {name: pool.submit(row, method, names) for name, method in by_name.items()}
        trials = [(c, pool.submit(row, c.method, [c.check])) for c in controls]
        futures = [*rows.values(), *(future for _, future in trials)]
        for count, future in enumerate(as_completed(futures), 1):
            future.result()
            if progress is not None:
                progress(count, len(futures))
    finally:
        pool.shutdown(cancel_futures=True)
    outcomes_of = {name: future.result() for name, future in rows.items()}
    outcomes = tuple((c, future.result()[c.check]) for c, future in trials)
    return Certificate(by_name, outcomes_of, outcomes)


def _methods_by_name(methods: Any) -> dict[str, dvi.Method]:
    """Name → method, checked."""
    if isinstance(methods, dvi.Method):
        raise TypeError(
            f'methods must be a dict such as {{"mine": {methods!r}}}, got a method without a name.'
        )
    if not isinstance(methods, Mapping):
        hint = " For your own method call certify({name: method})."
        return {name: METHODS[name] for name in selected_names("method", methods, METHODS, hint)}
    for name, method in methods.items():
        instance(f"methods[{name!r}]", method, dvi.Method, "a method such as dvi.TypeII()")
        order = method.order
        if isinstance(order, bool) or not isinstance(order, int | float):
            raise TypeError(f"methods[{name!r}].order must be an int or a float, got {order!r}.")
        positive(f"methods[{name!r}].order", order)
    if not methods:
        raise ValueError('methods is empty: give {"mine": dvi.TypeII()}, or None for all.')
    return {str(name): method for name, method in methods.items()}
