"""One search for invariants: read, search the map, measure drifts, write."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

from .._errors import InputError, shown
from .._show import Table
from .expressions import parse_basis, parse_method
from .output import Output, Report, output_for, provenance
from .schema import BASIS, BOX, DiscoverFile, Pair
from .system import Source, find_source
from .table import read_file

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
    path = Path(path)
    file, raw = read_file(path, DiscoverFile)
    output = output_for(path, out, file.output.dir, WRITTEN, force)
    search = make_search(file, path.parent)
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
    about = provenance("discover", path, raw)
    with output.writing():
        return _write(about, search, found, orders, seconds, output, file.output.plots)


# The search


def make_search(file: DiscoverFile, folder: Path) -> Search:
    """The search that a file describes whose Python files are in `folder`.

    **Raises** `InputError`.
    """
    source = find_source(file, folder)
    arguments = {"system": source.system, "args": source.args, "h": float(source.h), "t0": file.t0}
    low, high, shape = _box(file, source)
    if file.basis is None:
        raise InputError("basis", "the key is missing", BASIS)
    basis = parse_basis(file.basis, source.loader)
    try:
        size = basis.for_shape(shape).size
    except (TypeError, ValueError) as error:
        allowed = f"a basis for a q of shape {shape}"
        raise InputError("basis", source.reported(error), allowed) from None
    count = file.samples.count or max(_LEAST, _FOR_EACH * size)
    if count < 2 * size:
        allowed = f"{2 * size} at least: twice the {size} functions"
        raise InputError("samples.count", shown(count), allowed)
    random = np.random.default_rng(file.samples.seed)
    states = _uniform(random, low, high, count)
    span = file.samples.times
    times = np.full(count, file.t0) if span is None else random.uniform(span[0], span[1], count)
    arguments |= {"basis": basis, "order": file.order, "samples": (*states, times)}
    arguments |= {"method": parse_method(file.method), "tolerance": file.tolerance}
    arguments |= {"representative": file.representative}
    return Search(source, arguments, _uniform(random, low, high, file.drift.starts))


def _uniform(random: np.random.Generator, low: State, high: State, count: int) -> State:
    q, p = (random.uniform(a, b, (count, *a.shape)) for a, b in zip(low, high, strict=True))
    return q, p


def _box(file: DiscoverFile, source: Source) -> tuple[State, State, tuple[int, ...]]:
    """The corners of the box, and the shape of q."""
    given = {name: getattr(file.samples, name) for name in ("low", "high")}
    for name, corner in given.items():
        if corner is None:
            raise InputError(f"samples.{name}", "the key is missing", f"a corner of the box, {BOX}")
    shape = _shape(file, source, [x for c in given.values() for x in (c.q, c.p)])
    low, high = (_corner(name, corner, shape) for name, corner in given.items())
    if not all((a < b).all() for a, b in zip(low, high, strict=True)):
        allowed = "low < high everywhere"
        raise InputError("samples.low", "it is not below samples.high", allowed)
    return low, high, shape


def _shape(file: DiscoverFile, source: Source, corners: list[Any]) -> tuple[int, ...]:
    """The shape of q: that of the system's start, or of the corners of the box."""
    if source.problem is not None or file.state.q0 is not None:
        return np.shape(source.array("q0"))
    shapes = {np.shape(x) for x in corners} - {()}
    if len(shapes) != 1:
        seen = f"shapes {', '.join(map(str, sorted(shapes))) or 'of numbers alone'}"
        allowed = "arrays of the one shape of q in low and high"
        raise InputError("samples.low", seen, allowed)
    return shapes.pop()


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
    names = ("h", "t0", "args", "method")
    settings: dict[str, Any] = {name: search.arguments[name] for name in names}
    return dvi.drift_order(
        search.source.system, series, *search.starts, epsilons=file.drift.epsilons,
        num_steps=file.drift.steps, batched=True, **settings,
    )  # fmt: skip


# Results


def _write(
    about: dict[str, Any],
    search: Search,
    found: dvi.Discovery,
    orders: list[dvi.DriftOrder],
    seconds: float,
    output: Output,
    plots: bool,
) -> Report:
    found.save(output.folder / "discovery.npz")
    contents = about | {
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
        "seconds": seconds,
    }
    output.write_json("invariants.json", contents)
    report = Report(contents, _tables(contents), str(found).splitlines(), folder=output.folder)
    report.files = ["discovery.npz", "invariants.json"]
    report.summary = f"{seconds:.1f} s (compilation included)"
    if orders and plots:
        labels = {f"invariant {i + 1}": order for i, order in enumerate(orders)}
        expected = [None if exact else found.order + 1 for exact in found.exact]
        pictures = {"drifts.png": lambda: plot.drift_orders(labels, expected)}
        report.files += output.draw(pictures)
    return report


def _invariant(found: dvi.Discovery, orders: list[dvi.DriftOrder], i: int) -> dict[str, Any]:
    invariant = {
        "formula": str(found.invariants[i]),
        "coefficients": found.coefficients[i],
        "residuals": found.residuals[i],
        "exact": found.exact[i],
        "reach": found.reach[i],
    }
    if not orders:
        return invariant
    order = orders[i]
    names = ("epsilons", "drifts", "used", "excluded", "floor", "floor_cause", "slope", "interval",
             "resolved", "model")  # fmt: skip
    drift = {name: getattr(order, name) for name in names}
    counts = {"starts": len(order.kept), "starts_kept": int(order.kept.sum())}
    return invariant | {"drift": drift | counts}


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
