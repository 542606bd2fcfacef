"""One search for invariants: read, search the map, measure drifts, write."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

from .._errors import as_input_error, describe, require, user_path
from .._show import TextTable
from .expressions import parse_basis
from .output import Report, open_report
from .schema import DiscoverFile
from .system import Source, find_source

RESULT_FILES = ("discovery.npz", "invariants.json", "drifts.png")
"""Every file that a discovery may write; with `force` these are replaced and nothing else."""

_MIN_SAMPLES, _SAMPLES_PER_FUNCTION = 64, 4
"""Samples where the file has no number of them: at least, and for each function of the basis."""


def discover_file(
    path: str | Path,
    out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """The search for invariants that a TOML file describes.

    - `path`: the file; its keys are in `DiscoverFile` and in the documentation.
    - `out`: directory to write to, as for `run_file`.
    - `force`: replace the results of an earlier search there.
    - `progress`: called as ``progress(done, parts)``.

    Writes discovery.npz (`Discovery.save`), invariants.json, and a picture of drifts against ε.

    **Raises** `InputError` for bad input; nothing is written then.
    """
    path = user_path("CONFIG", path)
    file, report = open_report("discover", path, out, RESULT_FILES, force)
    source = find_source(file, path.parent)
    search, starts = _arguments(file, source)
    show = progress if progress is not None else lambda count, parts: None
    drift = {name: search[name] for name in ("h", "t0", "args", "method")}
    drift |= {"epsilons": file.drift.epsilons, "num_steps": file.drift.steps, "batched": True}
    rule = "functions, basis, args and samples that fit one another, with samples.times where "
    rule += "the map depends on the time"
    with report.reservation():
        began = time.perf_counter()
        with source.at_work("system", "searched", rule):
            discovery = dvi.discover_invariants(source.system, **search)
        show(1, 1 + discovery.count)
        orders = []
        for series in discovery.invariants if file.drift.measure else ():
            orders.append(dvi.drift_order(source.system, series, *starts, **drift))
            show(1 + len(orders), 1 + discovery.count)
        seconds = time.perf_counter() - began
    with report.writing():
        discovery.save(report.path("discovery.npz"))
        samples = len(search["samples"][0])
        report.contents |= _contents(discovery, orders, samples) | {"seconds": seconds}
        report.write_contents("invariants.json")
        if orders and file.output.plots:
            labels = {f"invariant {i + 1}": order for i, order in enumerate(orders)}
            slopes = [None if exact else discovery.order + 1 for exact in discovery.exact]
            report.draw({"drifts.png": lambda: plot.drift_orders(labels, slopes)})
    report.tables = discovery_tables(report.contents)
    report.notes = str(discovery).splitlines()
    report.summary = f"{seconds:.1f} s (compilation included)"
    return report


# The search


def _arguments(file: DiscoverFile, source: Source) -> tuple[dict[str, Any], Any]:
    """The arguments of `dvi.discover_invariants`, and (q0, p0) of the trajectories on which drifts
    are measured."""
    low, high = box_of(file.samples, "samples", source)
    shape = low[0].shape
    basis = parse_basis(file.basis, source.loader)
    rule = f"a basis that can be used for q of shape {shape}"
    with as_input_error("basis", rule, text=source.error_line):
        size = basis.for_shape(shape).size
    count = file.samples.count or max(_MIN_SAMPLES, _SAMPLES_PER_FUNCTION * size)
    rule = f"at least {2 * size}, twice the number of functions"
    require(count >= 2 * size, "samples.count", describe(count), rule)
    random = np.random.default_rng(file.samples.seed)

    def uniform(count: int) -> list[np.ndarray]:
        return [random.uniform(a, b, (count, *shape)) for a, b in zip(low, high, strict=True)]

    states, span = uniform(count), file.samples.times
    times = np.full(count, file.t0) if span is None else random.uniform(span[0], span[1], count)
    search = {"args": source.args, "h": float(source.h), "t0": file.t0, "basis": basis}
    search |= {"method": source.method(file.method), "samples": (*states, times)}
    search |= {name: getattr(file, name) for name in ("order", "tolerance", "representative")}
    return search, uniform(file.drift.starts)


def box_of(table: Any, key: str, source: Source) -> list[tuple[np.ndarray, ...]]:
    """(q, p) of the lower corner and of the upper one, in the shape of q: that of the system's
    start, or else of the corners `low` and `high` of the table with this key."""
    tables = {name: getattr(table, name) for name in ("low", "high")}
    if source.problem is not None or source.file.state.q0 is not None:
        shape = np.shape(source.array("q0"))
    else:
        shapes = {np.shape(x) for corner in tables.values() for x in (corner.q, corner.p)} - {()}
        defect = f"low and high have shapes {', '.join(map(str, sorted(shapes))) or '()'}"
        rule = "arrays of the same shape, that of q, in low and high (not only numbers)"
        require(len(shapes) == 1, f"{key}.low", defect, rule)
        shape = shapes.pop()
    corners = []
    for name, corner in tables.items():
        pair = [np.asarray(x, float) for x in (corner.q, corner.p)]
        defect = f"q has shape {pair[0].shape} and p has shape {pair[1].shape}"
        rule = f"numbers, or arrays of the shape of q, {shape}"
        with as_input_error(f"{key}.{name}", rule, text=lambda _, text=defect: text):
            corners.append(tuple(np.broadcast_to(x, shape) for x in pair))
    is_below = all((a < b).all() for a, b in zip(*corners, strict=True))
    defect = f"it is not below {key}.high"
    require(is_below, f"{key}.low", defect, "low < high in each component")
    return corners


# Results


def _contents(result: dvi.Discovery, orders: list[dvi.DriftOrder], samples: int) -> dict[str, Any]:
    names = ("order", "survivors", "gap", "refused", "condition")
    return {
        "functions": list(result.basis.names),
        **{name: getattr(result, name) for name in names},
        "samples": samples,
        "invariants": [_invariant(result, orders, i) for i in range(result.count)],
        "dependent": [str(series) for series in result.dependent_invariants],
        "lost": [str(law) for law in result.obstructions],
    }


def _invariant(result: dvi.Discovery, orders: list[dvi.DriftOrder], i: int) -> dict[str, Any]:
    names = ("coefficients", "residuals", "exact", "reach")
    invariant = {"formula": str(result.invariants[i])}
    invariant |= {name: getattr(result, name)[i] for name in names}
    if not orders:
        return invariant
    names = ("epsilons", "drifts", "used", "excluded", "floor", "floor_cause", "slope", "interval")
    drift = {name: getattr(orders[i], name) for name in (*names, "resolved", "model")}
    mask = orders[i].kept
    return invariant | {"drift": drift | {"starts": len(mask), "starts_kept": int(mask.sum())}}


def discovery_tables(contents: dict[str, Any]) -> list[TextTable]:
    """The invariants with their residuals and drifts, from the contents of invariants.json."""
    rows = []
    for i, invariant in enumerate(contents["invariants"], 1):
        residual = f"{np.max(invariant['residuals']):.1e}"
        order = "exact" if invariant["exact"] else f"{contents['order'] + 1}"
        rows.append([str(i), residual, order, *_drift_in_words(invariant.get("drift"))])
    columns = ["number", "residual", "order expected", "drift ∝ ε^", "largest drift"]
    title = "Invariants, in the order of the formulas below"
    return [TextTable(title, columns, rows)] if rows else []


def _drift_in_words(drift: dict[str, Any] | None) -> tuple[str, str]:
    """The order of a drift, and the largest drift."""
    if drift is None:
        return "not measured", ""
    finite = [x for x in drift["drifts"] if np.isfinite(x)]
    largest = f"{max(finite):.2e}" if finite else "all failed"
    if not np.isfinite(drift["slope"]):
        reasons = sorted({str(x) for x in drift["excluded"]} - {""})
        return f"none: {', '.join(reasons)}", largest
    low, high = drift["interval"]
    if not drift["resolved"]:
        return f"not resolved ({low:.2f} … {high:.2f})", largest
    return f"{drift['slope']:.3f} ({low:.3f} … {high:.3f})", largest
