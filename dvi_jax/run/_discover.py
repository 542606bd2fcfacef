"""One discovery: read, search the map, measure drifts, write."""

import ast
import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import dvi_jax as dvi

from .. import plot
from ..symmetry import AbstractBasis
from ._config import read_config
from ._discover_config import DISCOVER_KEYS
from ._errors import InputError, one_of, shown
from ._report import Report, Table, plain
from ._run import reserve, writing
from ._setup import (
    Loader,
    arguments_of,
    find_problem,
    lattice_of,
    parse_method,
    said,
    state_of,
)

WRITTEN = ("discovery.npz", "invariants.json", "drifts.png")
"""Every file that a discovery may write; with `force` these are replaced and nothing else."""

_LEAST = 64
"""Samples that are taken at least, where the file does not say."""
_FOR_EACH = 4
"""Samples for each function of the basis, where the file does not say."""


@dataclass(frozen=True)
class DiscoverSetup:
    """What `dvi.discover_invariants` and `dvi.drift_order` get."""

    name: str
    system: dvi.System
    basis: Any
    h: float
    args: Any
    method: dvi.Method
    samples: tuple[np.ndarray, ...]
    starts: tuple[np.ndarray, np.ndarray]
    files: tuple[Path, ...] = ()


def discover_file(
    path: str | Path,
    out: str | Path | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """The search for invariants that a TOML file describes.

    - `path`: the file; its keys are in `DISCOVER_KEYS` and in the documentation.
    - `out`: directory to write to instead of the file's ``output.dir``; either is relative to
      the working directory. It must not exist, or be empty.
    - `force`: replace what an earlier search wrote there.
    - `progress`: called as ``progress(done, parts)``.

    Writes discovery.npz (`Discovery.save`), invariants.json, and a picture of drifts against ε.

    **Raises** `InputError` for input that cannot be meant; nothing is written then.
    """
    path = Path(path)
    values, raw = read_config(path, DISCOVER_KEYS)
    folder = Path(out if out is not None else values["output.dir"] or f"results/{path.stem}")
    setup = make_discover_setup(values, path.parent)
    made = reserve(folder, "--out" if out is not None else "output.dir", force)
    tell = progress if progress is not None else lambda done, parts: None
    began = time.perf_counter()
    try:
        found = _discovered(setup, values)
        parts = 1 + found.count
        tell(1, parts)
        orders = []
        if values["drift.measure"]:
            for i, series in enumerate(found.invariants):
                orders.append(_drift(setup, values, series))
                tell(2 + i, parts)
    except BaseException:
        if made:
            folder.rmdir()
        raise
    seconds = time.perf_counter() - began
    with writing(folder, force):
        return _write(setup, values, raw, found, orders, seconds, folder, path)


# What is asked for


def make_discover_setup(values: dict[str, Any], folder: Path) -> DiscoverSetup:
    """What a discovery file means; files that it names are looked for from `folder`.

    **Raises** `InputError`.
    """
    loader = Loader(folder)
    problem, system, _ = find_problem(values, loader)
    args = arguments_of(values["args"], problem)
    _, h, _ = lattice_of(dict(values, lattice="uniform", steps=1), problem)
    low, high = values["samples.low"], values["samples.high"]
    for name, corner in (("low", low), ("high", high)):
        if corner is None:
            raise InputError(
                f"samples.{name}", "the key is missing", "{q = […], p = […]}, a corner of the box"
            )
    shape = _shape(values, problem, low, high)
    low, high = (_corner(name, c, shape) for name, c in (("low", low), ("high", high)))
    if not all((a < b).all() for a, b in zip(low, high, strict=True)):
        raise InputError("samples.low", "it is not below samples.high", "low < high everywhere")
    basis = parse_basis(values["basis"], loader)
    try:
        size = basis.for_shape(shape).size
    except (TypeError, ValueError) as error:
        raise InputError(
            "basis", said(error, *loader.modules), f"a basis for a q of shape {shape}"
        ) from None
    count = values["samples.count"] or max(_LEAST, _FOR_EACH * size)
    if count < 2 * size:
        raise InputError(
            "samples.count", shown(count), f"{2 * size} at least: twice the {size} functions"
        )
    random = np.random.default_rng(values["samples.seed"])
    t0 = values["t0"]
    samples = tuple(random.uniform(a, b, (count, *shape)) for a, b in zip(low, high, strict=True))
    if values["samples.times"] is not None:
        first, last = values["samples.times"]
        samples += (random.uniform(first, last, count),)
    else:
        samples += (np.full(count, t0),)
    starts = values["drift.starts"]
    qs, ps = (random.uniform(a, b, (starts, *shape)) for a, b in zip(low, high, strict=True))
    name = problem.name if problem is not None else values["system"]
    return DiscoverSetup(name, system, basis, float(h), args, parse_method(values["method"]),
                         samples, (qs, ps), tuple(loader.modules))  # fmt: skip


def _shape(values: dict[str, Any], problem: Any, *corners: Any) -> tuple[int, ...]:
    """The shape of q: of the system's start, or of the corners of the box."""
    if problem is not None or values["state.q0"] is not None:
        return np.shape(state_of(values, "q0", getattr(problem, "q0", None)))
    shapes = {np.shape(x) for corner in corners for x in corner} - {()}
    if len(shapes) != 1:
        raise InputError(
            "samples.low", f"shapes {', '.join(map(str, sorted(shapes))) or 'of numbers alone'}",
            "arrays of the one shape of q in low and high",
        )  # fmt: skip
    return shapes.pop()


def _corner(name: str, corner: Any, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    try:
        q, p = (np.broadcast_to(np.asarray(x, float), shape) for x in corner)
    except ValueError:
        raise InputError(
            f"samples.{name}", f"shapes {np.shape(corner[0])} and {np.shape(corner[1])}",
            f"numbers, or arrays of the shape of q, {shape}",
        ) from None  # fmt: skip
    return q, p


def parse_basis(given: str | None, loader: Loader) -> Any:
    """The basis that a text such as ``"Polynomials(2) + Radial((-1,))"`` names; nothing is run but
    a file that it names.

    **Raises** `InputError`.
    """
    if given is None:
        raise InputError("basis", "the key is missing", 'text such as "Polynomials(4)"')
    if ".py:" in given:
        made = loader.load("basis", given)
        if isinstance(made, list | dict):
            made = dvi.Basis(made)
    else:
        try:
            made = _made(ast.parse(given.strip(), mode="eval").body)
        except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
            if isinstance(error, InputError):
                raise
            reason = "it does not read as one" if isinstance(error, SyntaxError) else str(error)
            raise InputError("basis", f"{given!r}: {reason}", _allowed()) from None
    if not isinstance(made, AbstractBasis):
        raise InputError("basis", f"{given!r}", _allowed())
    return made


def _bases() -> dict[str, type]:
    """The bases behind the public door that are written with numbers and names alone."""
    return {
        name: thing
        for name, thing in vars(dvi).items()
        if isinstance(thing, type) and issubclass(thing, AbstractBasis) and thing is not dvi.Basis
    }


def _allowed(seen: str = "") -> str:
    return f'{one_of(_bases(), seen)}, their sums and products; or "file.py:name"'


def _made(node: ast.expr) -> Any:
    match node:
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _made(left) + _made(right)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _made(left) * _made(right)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=keywords):
            if name not in (known := _bases()):
                raise InputError("basis", f"{name!r}", _allowed(name))
            options: Any = {k.arg: ast.literal_eval(k.value) for k in keywords}
            return known[name](*(ast.literal_eval(a) for a in arguments), **options)
        case ast.Name(id=name):
            raise InputError("basis", f"{name!r} without (…)", _allowed(name))
    raise ValueError(f"{ast.unparse(node)!r} is no basis")


# What is found


def _discovered(setup: DiscoverSetup, values: dict[str, Any]) -> dvi.Discovery:
    try:
        return dvi.discover_invariants(
            setup.system,
            setup.basis,
            values["order"],
            h=setup.h,
            samples=setup.samples,
            t0=values["t0"],
            args=setup.args,
            method=setup.method,
            tolerance=values["tolerance"],
            representative=values["representative"],
        )
    except Exception as error:
        # Whatever a user's function raises while it is traced comes through here.
        raise InputError(
            "system",
            f"the map of {setup.name} cannot be searched: {said(error, *setup.files)}",
            "functions, basis, samples (with samples.times where the map depends on the time) and "
            "args that fit one another",
        ) from error


def _drift(setup: DiscoverSetup, values: dict[str, Any], series: Any) -> dvi.DriftOrder:
    q0, p0 = setup.starts
    return dvi.drift_order(
        setup.system, series, q0, p0, epsilons=values["drift.epsilons"], h=setup.h,
        num_steps=values["drift.steps"], batched=True, t0=values["t0"], args=setup.args,
        method=setup.method,
    )  # fmt: skip


def _write(
    setup: DiscoverSetup,
    values: dict[str, Any],
    raw: dict[str, Any],
    found: dvi.Discovery,
    orders: list[dvi.DriftOrder],
    seconds: float,
    folder: Path,
    path: Path,
) -> Report:
    for name in WRITTEN:  # of an earlier search; no file of it must stay beside this one's
        (folder / name).unlink(missing_ok=True)
    found.save(folder / "discovery.npz")
    contents = {
        "discover": str(path),
        "config": raw,
        "versions": {n: version(n) for n in ("dvi-jax", "jax", "jaxlib", "numpy")}
        | {"python": platform.python_version()},
        "functions": list(found.basis.names),
        "order": found.order,
        "survivors": found.survivors,
        "gap": found.gap,
        "refused": found.refused,
        "condition": found.condition,
        "samples": len(setup.samples[0]),
        "invariants": [_invariant(found, orders, i) for i in range(found.count)],
        "dependent": [str(series) for series in found.dependent_invariants],
        "lost": [str(law) for law in found.obstructions],
        "seconds": seconds,
    }
    text = json.dumps(plain(contents), indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "invariants.json").write_text(text + "\n", encoding="utf-8")
    report = Report(True, "", folder, ["discovery.npz", "invariants.json"], contents)
    report.tables = _tables(contents)
    report.notes = str(found).splitlines()
    if orders and values["output.plots"]:
        with plot.style():
            labels = {f"invariant {i + 1}": order for i, order in enumerate(orders)}
            promised = [None if e else found.order + 1 for e in found.exact]
            plot.save(plot.drift_orders(labels, promised), folder / "drifts.png")
        report.files.append("drifts.png")
    return report


def _invariant(found: dvi.Discovery, orders: list[dvi.DriftOrder], i: int) -> dict[str, Any]:
    told = {
        "formula": str(found.invariants[i]),
        "coefficients": found.coefficients[i],
        "residuals": found.residuals[i],
        "exact": found.exact[i],
        "reach": found.reach[i],
    }
    if not orders:
        return told
    o = orders[i]
    return told | {
        "drift": {
            "epsilons": o.epsilons,
            "drifts": o.drifts,
            "used": o.used,
            "excluded": o.excluded,
            "floor": o.floor,
            "floor_cause": o.floor_cause,
            "slope": o.slope,
            "interval": o.interval,
            "resolved": o.resolved,
            "model": o.model,
            "starts": len(o.kept),
            "starts_kept": int(o.kept.sum()),
        }
    }


def _tables(contents: dict[str, Any]) -> list[Table]:
    rows = []
    for i, told in enumerate(contents["invariants"], 1):
        drift = told.get("drift")
        slope = "not measured"
        if drift is not None and np.isfinite(drift["slope"]):
            low, high = drift["interval"]
            slope = f"{drift['slope']:.3f} ({low:.3f} … {high:.3f})"
            if not drift["resolved"]:
                slope = f"not resolved ({low:.2f} … {high:.2f})"
        elif drift is not None:
            reasons = sorted({str(x) for x in drift["excluded"]} - {""})
            slope = f"none: {', '.join(reasons)}"
        finite = [] if drift is None else [x for x in drift["drifts"] if np.isfinite(x)]
        largest = "" if drift is None else f"{max(finite):.2e}" if finite else "all failed"
        promised = "exact" if told["exact"] else f"{contents['order'] + 1}"
        rows.append([str(i), f"{np.max(told['residuals']):.1e}", promised, slope, largest])
    if not rows:
        return []
    return [
        Table(
            "Invariants, in the order of the formulas below",
            ["number", "residual", "order promised", "drift ∝ ε^", "largest drift"],
            rows,
        )
    ]
