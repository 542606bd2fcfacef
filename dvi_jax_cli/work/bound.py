"""One proof: read, bound the changes of invariants in a step, write the certificate."""

import time
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi

from .._errors import as_input_error, require, user_path
from .._show import TextTable
from .discover import box_of
from .output import Report, open_report
from .system import find_source
from .table import NO_KEY

RESULT_FILES = ("bound.json", "certificate.json")
"""Every file that a proof may write; with `force` these are replaced and nothing else."""


def bound_file(path: str | Path, out: str | Path | None = None, force: bool = False) -> Report:
    """The proof that a TOML file describes; its keys are in `BoundFile`.

    - `out`: directory to write to, as for `run_file`. `force`: replace the results there.

    **Raises** `InputError` for bad input; nothing is written then.
    """
    path = user_path("CONFIG", path)
    file, report = open_report("bound", path, out, RESULT_FILES, force)
    source = find_source(file, path.parent)
    low, high = box_of(file.domain, "domain", source)
    functions = source.loader.load("invariants", file.invariants)
    condition = file.domain.inside and source.loader.load("domain.inside", file.domain.inside)
    options = {"h": float(source.h), "args": source.args, "method": source.method(file.method)}
    times, periodic = file.domain.times, np.asarray(file.domain.periodic)
    options |= {"time": times, "inside": condition, "periodic": periodic}
    has_epsilon = file.epsilon is not None or not source.system.depends_on_epsilon
    rule = "[least, largest] for a system with a perturbation or a slow time"
    require(has_epsilon, "epsilon", NO_KEY, rule)
    domain = tuple(np.stack(pair) for pair in zip(low, high, strict=True))
    options |= {"epsilon": file.epsilon and tuple(file.epsilon), "domain": domain}
    rule = "invariants, a domain and a method that fit the system"
    began, bound = time.perf_counter(), None
    with report.reservation(), source.at_work("invariants", "bounded", rule):
        try:
            with as_input_error("system", "an installation with python-flint", ImportError):
                bound = dvi.bound_drift(functions, source.system, **options, **dict(file.bound))
        except dvi.ProofError as error:
            report.message = f"nothing is proved: {error}"
    with report.writing():
        if bound is not None:
            bound.save(report.path("certificate.json"))
            report.contents |= _contents(bound)
            report.notes = str(bound).splitlines()
            report.tables = bound_tables(report.contents)
        else:
            report.contents["message"] = report.message
        report.write_contents("bound.json")
    report.summary = f"{time.perf_counter() - began:.1f} s"
    return report


def _contents(bound: dvi.DriftBound) -> dict[str, Any]:
    names = ("per_step", "rounding", "seen", "level", "steps", "start", "change", "boxes", "reason")
    return {"formulas": bound.formulas} | {name: getattr(bound, name) for name in names}


def bound_tables(contents: dict[str, Any]) -> list[TextTable]:
    """The bound of each invariant, from the contents of bound.json."""
    rows, change = [], contents["change"]
    for k, (b, r) in enumerate(zip(contents["per_step"], contents["rounding"], strict=True)):
        steps = change // (b + r) if b + r else np.inf
        rows.append([f"I_{k}", f"{b:.2e}", f"{r:.2e}", f"{steps:.3g}"])
    columns = ["invariant", "change in a step ≤", "by rounding ≤", f"steps for {change:g}"]
    return [TextTable("Proved bounds", columns, rows)]
