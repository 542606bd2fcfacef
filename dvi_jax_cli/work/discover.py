"""One search for invariants: read, search the map, measure drifts, write."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

from .._errors import InputError, require, shown
from .._show import Table
from .expressions import parse_basis, parse_method
from .output import Report, opened
from .schema import DiscoverFile, Pair
from .system import Source, find_source

WRITTEN = ("discovery.npz", "invariants.json", "drifts.png")
"""Every file that a discovery may write; with `force` these are replaced and nothing else."""

_LEAST = 64
"""Samples that are taken at least, where the file has no number."""
_FOR_EACH = 4
"""Samples for each function of the basis, where the file has no number."""

State = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Search:
    """The arguments of `dvi.discover_invariants`, the initial conditions of the trajectories on
    which drifts are measured, and the system's source."""

    source: Source
    arguments: dict[str, Any]
    starts: State


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
    file, output = opened("discover", Path(path), out, WRITTEN, force)
    search = make_search(file, Path(path).parent)
    report = progress if progress is not None else lambda done, parts: None
    with output.reserved():
        began = time.perf_counter()
        found = _discovered(search)
        report(1, 1 + found.count)
        orders = []
        for series in found.invariants if file.drift.measure else ():
            orders.append(_drift(search, file, series))
            report(1 + len(orders), 1 + found.count)
        seconds = time.perf_counter() - began
    with output.writing():
        found.save(output.path("discovery.npz"))
        contents = output.about | _contents(search, found, orders) | {"seconds": seconds}
        output.write_json("invariants.json", contents)
        if orders and file.output.plots:
            labels = {f"invariant {i + 1}": order for i, order in enumerate(orders)}
            expected = [None if exact else found.order + 1 for exact in found.exact]
            output.draw({"drifts.png": lambda: plot.drift_orders(labels, expected)})
    return Report(
        contents,
        _tables(contents),
        str(found).splitlines(),
        f"{seconds:.1f} s (compilation included)",
        folder=output.folder,
        files=output.files,
    )


# The search


def make_search(file: DiscoverFile, folder: Path) -> Search:
    """The search that a file describes whose Python files are in `folder`.

    **Raises** `InputError`.
    """
    source = find_source(file, folder)
    arguments = {"system": source.system, "args": source.args, "h": float(source.h), "t0": file.t0}
    low, high, shape = _box(file, source)
    basis = parse_basis(file.basis, source.loader)
    try:
        size = basis.for_shape(shape).size
    except (TypeError, ValueError) as error:
        allowed = f"a basis for a q of shape {shape}"
        raise InputError("basis", source.reported(error), allowed) from None
    count = file.samples.count or max(_LEAST, _FOR_EACH * size)
    allowed = f"{2 * size} at least: twice the {size} functions"
    require(count >= 2 * size, "samples.count", shown(count), allowed)
    random = np.random.default_rng(file.samples.seed)

    def uniform(count: int) -> State:
        q, p = (random.uniform(a, b, (count, *shape)) for a, b in zip(low, high, strict=True))
        return q, p

    states, span = uniform(count), file.samples.times
    times = np.full(count, file.t0) if span is None else random.uniform(span[0], span[1], count)
    arguments |= {"basis": basis, "order": file.order, "samples": (*states, times)}
    arguments |= {"method": parse_method(file.method), "tolerance": file.tolerance}
    arguments |= {"representative": file.representative}
    return Search(source, arguments, uniform(file.drift.starts))


def _box(file: DiscoverFile, source: Source) -> tuple[State, State, tuple[int, ...]]:
    """The corners of the box, and the shape of q: that of the system's start, or of the corners."""
    corners = {"low": file.samples.low, "high": file.samples.high}
    if source.problem is not None or file.state.q0 is not None:
        shape = np.shape(source.array("q0"))
    else:
        shapes = {np.shape(x) for corner in corners.values() for x in (corner.q, corner.p)} - {()}
        seen = f"shapes {', '.join(map(str, sorted(shapes))) or 'of numbers alone'}"
        allowed = "arrays of the one shape of q in low and high"
        require(len(shapes) == 1, "samples.low", seen, allowed)
        shape = shapes.pop()
    low, high = (_corner(name, corner, shape) for name, corner in corners.items())
    is_below = all((a < b).all() for a, b in zip(low, high, strict=True))
    allowed = "low < high everywhere"
    require(is_below, "samples.low", "it is not below samples.high", allowed)
    return low, high, shape


def _corner(name: str, corner: Pair, shape: tuple[int, ...]) -> State:
    try:
        q, p = (np.broadcast_to(np.asarray(x, float), shape) for x in (corner.q, corner.p))
    except ValueError:
        seen = f"shapes {np.shape(corner.q)} and {np.shape(corner.p)}"
        allowed = f"numbers, or arrays of the shape of q, {shape}"
        raise InputError(f"samples.{name}", seen, allowed) from None
    return q, p


def _discovered(search: Search) -> dvi.Discovery:
    try:
        return dvi.discover_invariants(**search.arguments)
    except Exception as error:  # also whatever a user's function raises while it is traced
        allowed = "functions, basis, args and samples that fit one another, with samples.times "
        allowed += "where the map depends on the time"
        raise search.source.misfit("system", "searched", error, allowed) from error


def _drift(search: Search, file: DiscoverFile, series: Any) -> dvi.DriftOrder:
    settings = {name: search.arguments[name] for name in ("h", "t0", "args", "method")}
    settings |= {"epsilons": file.drift.epsilons, "num_steps": file.drift.steps, "batched": True}
    return dvi.drift_order(search.source.system, series, *search.starts, **settings)


# Results


def _contents(search: Search, found: dvi.Discovery, orders: list[dvi.DriftOrder]) -> dict[str, Any]:
    return {
        "functions": list(found.basis.names),
        "order": found.order,
        "survivors": found.survivors,
        "gap": found.gap,
        "refused": found.refused,
        "condition": found.condition,
        "samples": len(search.arguments["samples"][0]),
        "invariants": [_invariant(found, orders, i) for i in range(found.count)],
        "dependent": [str(series) for series in found.dependent_invariants],
        "lost": [str(law) for law in found.obstructions],
    }


def _invariant(found: dvi.Discovery, orders: list[dvi.DriftOrder], i: int) -> dict[str, Any]:
    names = ("coefficients", "residuals", "exact", "reach")
    invariant = {"formula": str(found.invariants[i])}
    invariant |= {name: getattr(found, name)[i] for name in names}
    if not orders:
        return invariant
    names = ("epsilons", "drifts", "used", "excluded", "floor", "floor_cause", "slope", "interval")
    drift = {name: getattr(orders[i], name) for name in (*names, "resolved", "model")}
    kept = orders[i].kept
    return invariant | {"drift": drift | {"starts": len(kept), "starts_kept": int(kept.sum())}}


def _tables(contents: dict[str, Any]) -> list[Table]:
    rows = []
    for i, found in enumerate(contents["invariants"], 1):
        residual = f"{np.max(found['residuals']):.1e}"
        expected = "exact" if found["exact"] else f"{contents['order'] + 1}"
        rows.append([str(i), residual, expected, *_drift_in_words(found.get("drift"))])
    if not rows:
        return []
    columns = ["number", "residual", "order expected", "drift ∝ ε^", "largest drift"]
    return [Table("Invariants, in the order of the formulas below", columns, rows)]


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
