"""Pictures of numbers along time: conserved quantities, observables, indicators of chaos."""

import itertools
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..base.checks import instance, one_of
from . import axes as draw
from .axes import canvas, check_shapes, counts_text, labels_of, legend, stack
from .states import Lane, check_momenta, each_state, lanes_of, looks_of, troubles
from .style import COLOURS, CROSS, DASHES, GREY, SMALL, in_style, look_of, sign_text, with_unit

_CHANGES = {
    "relative": ("relative change", "|ΔI/I$_0$|"), "absolute": ("change", "|ΔI|"),
    "value": ("", "|I|"),
}  # fmt: skip
"""Labels of each change, and of its size."""
_PANELS = 12

_NEAR_ROUNDING = 1e-12
"""Relative changes below it are compared with the rounding of one operation."""


def draw_series(
    axis: Any, t: np.ndarray, values: np.ndarray, label: str, log: bool = False, **look: Any
) -> dict[str, int]:
    """One line along time through the values that have a place on the axis; counts the others.

    Long series are drawn by the extremes of each piece.
    """
    masks = {"are not finite": ~np.isfinite(values)}
    if log:
        masks |= {"are exactly 0": values == 0, "are below 0": values < 0}
    numbers = np.where(np.logical_or.reduce(list(masks.values())), np.nan, values)
    axis.plot(*draw.envelope(t, numbers), label=label or None, **look)
    return {text: int(mask.sum()) for text, mask in masks.items()}


@in_style
def invariants(
    orbits: Any,
    values: Mapping[str, Any] | None = None,
    change: str = "relative",
    log: bool = False,
    **options: Any,
) -> Any:
    """Quantities against time and their changes, one panel above another.

    - `orbits`: a `Solution`, of one run or of a batch; or times alone, shape (..., S).
    - `values`: name → numbers, shape (..., S, *any), or (..., S − 1, *any) for those at the ends of
      steps; or a function ``(q, p)`` of one state. None: the observables in the dictionary
      ``solution.observed`` that have a value per step.
    - `change`: "relative", (I − I₀)/|I₀|; "absolute", I − I₀; "value", I itself. I₀ is the first
      finite number, of an observable that of the first step. For vectors and matrices it is the
      length of the change, relative to the length of I₀.
    - `log`: sizes, such as |ΔI/I₀|, on a logarithmic axis, on which several quantities of one orbit
      share a panel, and relative changes are compared with the machine epsilon. The legend counts
      values that are exactly 0, which such an axis cannot show.
    - `labels`, `colour`, `colour_label`, `units` (of "t", and of quantities whose change is not
      relative), `title`, `ax` (one `Axes` for each panel): as for all pictures.

    Crosses mark early ends of orbits, with the reason in the legend.

    **Returns** the `Axes`, an array of them for several panels. **Raises** `TypeError` for input
    without times or numbers; `ValueError` for shapes that do not fit, and for relative changes of a
    quantity that starts at 0 on every orbit (if others do not, such an orbit is left out and
    counted in the legend).
    """
    look = look_of(options)
    one_of("change", change, _CHANGES)
    ts, names, lanes, quantities = _read(orbits, values, look.labels)
    rows_of = {k: [_change_of(k, v, change, log) for v in rows] for k, rows in quantities.items()}
    if zero := [name for name, rows in rows_of.items() if all(v is None for v in rows)]:
        raise ValueError(f"{zero[0]!r} is 0 at the start of every orbit: use change='absolute'.")
    on_one_axis = log and len(ts) == 1 < len(quantities)
    count = 1 if on_one_axis else len(quantities)
    draw.at_most(_PANELS, count, "quantities", "values={...}")
    size = (6.4, 4.2) if count == 1 else (6.4, 1.4 + 1.45 * count)
    axes, new = stack(look.ax, count, "one for each quantity", size, sharex=True)
    looks = looks_of(len(quantities)) if on_one_axis else looks_of(len(ts), look.colour)
    zeros, from_zero = 0, []
    for i, (quantity, rows) in enumerate(quantities.items()):
        axis = axes[0 if on_one_axis else i]
        counts = {f"of {len(ts)} orbits start at 0": sum(v is None for v in rows_of[quantity])}
        from_zero += [f"{quantity}: {text}" for text in counts_text(counts)]
        title = quantity.replace("_", " ")
        for k, (t, v, old) in enumerate(zip(ts, rows_of[quantity], rows, strict=True)):
            v, t = np.full(len(old), np.nan) if v is None else v, t[len(t) - len(old) :]
            name = title if on_one_axis else names[k] if i == 0 else ""
            draw_series(axis, t, v, name, log, **looks.line(i if on_one_axis else k, 1.1))
            last = np.flatnonzero(np.isfinite(v))[-1:]
            if last.size and last[0] < len(v) - 1 and not (log and v[last[0]] == 0):
                axis.plot(t[last], v[last], ls="none", zorder=4, **CROSS)
            # The first value is the reference and therefore 0.
            zeros += int(np.sum(v[1:] == 0)) if log else 0
        kind, size = _CHANGES[change]
        if log or any(v[:1].size > 1 for v in rows):
            kind = f"{kind} {size}".lstrip() if on_one_axis else size
        unit = look.units.get(quantity) if change != "relative" and not on_one_axis else None
        title = "" if on_one_axis else textwrap.fill(title, 20) if kind else title
        kind = with_unit(kind, unit) if kind else ""
        text = f"{title}\n{kind}" if kind and title else kind or with_unit(title, unit)
        axis.set_ylabel(text, fontsize=9 if count > 1 else None)
        if log:
            axis.set_yscale("log")
    for axis in axes:
        if log and change == "relative" and axis.get_ylim()[0] < _NEAR_ROUNDING:
            _rounding(axis)
    axes[-1].set_xlabel(with_unit("time t", look.units.get("t")))
    axes[0].figure.align_ylabels(axes)
    notes = [*looks.entries, *counts_text({"values exactly 0": zeros}), *from_zero]
    looks.finish(axes, look, new, [*notes, *troubles(lanes)])
    return axes[0] if count == 1 else np.asarray(axes)


def _change_of(name: str, v: np.ndarray, change: str, log: bool) -> np.ndarray | None:
    """Changes since the first finite value, shape (S,); None if they are relative to 0."""
    draw.check_real(f"values[{name!r}]", v)
    v = v.reshape(len(v), -1).astype(float)
    first = next((row for row in v if np.isfinite(row).all()), np.full(v.shape[1], np.nan))
    v = v if change == "value" else v - first
    v = np.linalg.norm(v, axis=1) if v.shape[1] > 1 else v[:, 0]
    if change == "relative":
        size = np.linalg.norm(first)
        if size == 0:
            return None
        v = v / size
    return np.abs(v) if log else v


def panels_of(orbits: Any, values: Mapping[str, Any] | None, log: bool) -> int:
    """How many panels `invariants` draws."""
    ts, *_, quantities = _read(orbits, values, None)
    return 1 if log and len(ts) == 1 else len(quantities)


def _read(
    orbits: Any, values: Mapping[str, Any] | None, labels: Sequence[str] | None
) -> tuple[list[np.ndarray], list[str], list[Lane], dict[str, list[np.ndarray]]]:
    """(times and labels of every orbit, the orbits if there are states; name → their values)."""
    if isinstance(orbits, list | tuple) or hasattr(orbits, "qs"):
        lanes = lanes_of(orbits, labels, momenta=False)
        ts, names = [lane.ts for lane in lanes], [lane.label for lane in lanes]
    else:
        lanes, times = [], np.asarray(getattr(orbits, "ts", orbits))
        if times.dtype.kind not in "iuf" or times.ndim == 0:
            raise TypeError(
                f"orbits must be a Solution, (ts, qs, ps), a list, or times, got {orbits!r:.60}."
            )
        ts = list(times.reshape(-1, times.shape[-1]))
        names = labels_of(labels, len(ts), "orbits")
    quantities: dict[str, list[np.ndarray]] = {}
    if values is None:
        parts = orbits if isinstance(orbits, list) else [orbits]
        tables = [_observed(part) for part in parts]
        for name in tables[0]:
            if all(name in part for part in tables):
                pairs = zip(parts, tables, strict=True)
                quantities[name] = [x for part, table in pairs for x in _rows(name, table, part)]
    for name, column in (values or {}).items():
        if callable(column):
            check_momenta(lanes)
            label = f"values[{name!r}]"
            quantities[name] = [each_state(column, lane.qs, lane.ps, label) for lane in lanes]
        elif not isinstance(orbits, list):
            quantities[name] = _rows(name, {name: column}, orbits)
        elif isinstance(column, list) and len(column) == len(lanes):
            quantities[name] = [np.asarray(x) for x in column]
        else:
            kind = type(column).__name__
            kind += f" of length {len(column)}" if isinstance(column, list) else ""
            raise ValueError(
                f"values[{name!r}] must be a function (q, p), or a list of {len(lanes)} arrays, of "
                f"one for each orbit, got {kind}."
            )
    name = "the list of observables with a value per step" if values is None else "values"
    hint = "give values={'energy': f}, of a function (q, p) or an array"
    draw.check_not_empty(name, quantities, hint)
    return ts, names, lanes, quantities


def _observed(solution: Any) -> dict[str, Any]:
    """The observables of a solution that have a value per step."""
    observed = getattr(solution, "observed", None)
    if not isinstance(observed, Mapping):
        raise TypeError(
            "without values, orbits must have a dict of observables, got type "
            f"{type(observed).__name__}: give values."
        )
    *lead, n = np.shape(solution.ts)
    shapes, front = ((*lead, n), (*lead, n - 1)), len(lead) + 1
    return {k: v for k, v in observed.items() if hasattr(v, "shape") and v.shape[:front] in shapes}


def _rows(name: str, values: Mapping[str, Any], orbits: Any) -> list[np.ndarray]:
    """The values of a name along every orbit of a batch."""
    ts = np.asarray(orbits[0] if isinstance(orbits, tuple) else getattr(orbits, "ts", orbits))
    v, (*lead, n) = np.asarray(values[name]), ts.shape
    shapes = (*lead, n), (*lead, n - 1)
    rule = f"{name!r} must have one value for each time, shape {shapes[0]}, or for each step, "
    rule += f"shape {shapes[1]} (more axes may follow)"
    check_shapes(v.shape[: ts.ndim] in shapes, rule, values=v)
    return list(v.reshape(-1, *v.shape[len(lead) :]))


def _rounding(axis: Any) -> None:
    """A line at the rounding error of one operation in double precision."""
    eps = float(np.finfo(float).eps)
    axis.axhline(eps, color=GREY, lw=1, ls=":")
    paper = {"facecolor": "#ffffff", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
    look = SMALL | {"ha": "right", "va": "bottom", "zorder": 4, "bbox": paper}
    axis.annotate("machine epsilon", (1, eps), xycoords=("axes fraction", "data"), **look)


@in_style
def changes(ts: Any, series: Mapping[str, Any], time: str, title: str, ax: Any = None) -> Any:
    """Changes of quantities along a run, one panel above another.

    - `ts`: times, shape (S,). `series`: label → changes, shape (S,). `time`: label of the axis.

    A panel reports how many of its changes are not finite. **Returns** the `Axes`, shape
    (quantities,).
    """
    instance("series", series, Mapping, "a dict {name: values}")
    size = (6.4, 1.2 + 1.35 * len(series))
    axes, _ = stack(ax, len(series), "one for each quantity", size, sharex=True)
    colours = itertools.cycle(COLOURS)
    for axis, colour, (label, values) in zip(axes, colours, series.items(), strict=False):
        t, v = _pair(ts, values, label)
        counts = draw_series(axis, t, v, "", color=colour, lw=1.1)
        axis.set_ylabel(label, fontsize=9)
        for text in counts_text({f"of {len(v)} {cause}": n for cause, n in counts.items()}):
            where = {"ha": "right", "va": "top", "transform": axis.transAxes}
            axis.text(0.99, 0.95, text, **SMALL, **where)
    axes[0].set_title(title)
    axes[-1].set_xlabel(time)
    axes[0].figure.align_ylabels(axes)
    return np.asarray(axes)


@in_style
def conserved(ts: Any, series: Mapping[str, Any], time: str, title: str, ax: Any = None) -> Any:
    """Sizes of relative changes of conserved quantities, on one logarithmic axis.

    - `ts`: times, shape (S,). `series`: label → sizes, shape (S,). `time`: label of the axis.

    The legend counts values without a place on this axis: exact zeros, and values that are
    negative or not finite. **Returns** the `Axes`.
    """
    axis, new = canvas(ax)
    axis.set_yscale("log")
    notes: list[str] = []
    looks = itertools.cycle(zip(COLOURS, DASHES, strict=True))
    for (label, values), (colour, dash) in zip(series.items(), looks, strict=False):
        # The change at the start is 0 by definition and is left out.
        t, column = (x[1:] for x in _pair(ts, values, label))
        counts = draw_series(axis, t, column, label, True, color=colour, ls=dash, lw=0.9)
        texts = counts_text({f"of {len(column)} {cause}": n for cause, n in counts.items()})
        notes += [f"{label}: {text}" for text in texts]
    _rounding(axis)
    axis.set(xlabel=time, ylabel="relative change since the start |ΔI/I$_0$|", title=title)
    box = legend(axis, new, notes)
    for line in box.get_lines() if box else ():
        line.set_linewidth(2.0)
    return axis


def _pair(ts: Any, values: Any, label: str) -> tuple[np.ndarray, np.ndarray]:
    t, numbers = np.asarray(ts), np.asarray(values)
    rule = f"{label!r} must have one number for each time, shape (S,)"
    check_shapes(t.ndim == 1 and numbers.shape == t.shape, rule, ts=t, values=numbers)
    return t, numbers


class _Kind(NamedTuple):
    """How an indicator is drawn, and what regular motion shows: a level, or a slope."""

    label: str
    log: str = ""
    level: float | None = None
    slope: float | None = None


_KINDS: dict[str | None, _Kind] = {
    None: _Kind("indicator"),
    "megno": _Kind("MEGNO ⟨Y⟩", "x", level=2.0),
    "lyapunov": _Kind("finite-time Lyapunov exponent", "xy", slope=-1.0),
    "sali": _Kind("SALI", "xy"),
    "gali": _Kind("GALI", "xy"),
}


@in_style
def indicator(
    ts: Any,
    values: Any,
    kind: str | None = None,
    slope: float | None = None,
    t0: float | None = None,
    **options: Any,
) -> Any:
    """An indicator of chaos against time, with its reference for regular motion.

    - `ts`: times, shape (S,) or (..., S), or an object with `ts`, such as a `Solution`.
    - `values`: numbers, shape (..., S) or (..., S − 1) for those at the ends of steps; several
      exponents of one orbit are several lines; or label → such numbers.
    - `kind`: "megno", with a line at 2, its limit for regular motion (Cincotta & Simó 2000);
      "lyapunov", with a slope of −1, as the finite-time exponent falls for it (Benettin et al.
      1980, up to a logarithm); "sali" or "gali", which stay, or fall by a power, for regular and
      fall exponentially for chaotic motion (Skokos 2001; Skokos et al. 2007). None: any numbers.
    - `slope`: of a guide through the largest first value, on logarithmic axes, in place of that of
      the kind.
    - `t0`: time of the start; None: the first of `ts` if the values are those at ends of steps,
      else 0. A logarithmic axis shows |t − t0|, so that runs backward have their place.
    - `labels`, `colour`, `colour_label`, `units` (of "t" and "value"), `title`, `ax`: as for all
      pictures.

    The legend counts values that are not finite, and, on logarithmic axes, those that are not
    positive and those at the start itself.

    **Returns** the `Axes`. **Raises** `ValueError` for an unknown kind and for shapes that do not
    fit.
    """
    look, traits = look_of(options), _KINDS[one_of("kind", kind, _KINDS)]
    if slope is not None:
        traits = traits._replace(log="xy", slope=slope)
    lines, names = _lines_of(ts, values)
    names = labels_of(look.labels or names or None, len(lines), "lines")
    looks = looks_of(len(lines), look.colour)
    axis, new = canvas(look.ax)
    xlog, ylog = ("x" in traits.log), ("y" in traits.log)
    counter: Counter[str] = Counter()
    points, from_start = [], False
    for i, (t, v, start) in enumerate(lines):
        start = start if t0 is None else float(t0)
        from_start |= xlog and (start != 0 or bool((t < 0).any()))
        t = np.abs(t - start) if xlog else t
        at_start = (t == 0) & np.isfinite(v) & xlog
        t, v = t[~at_start], v[~at_start]
        v = np.where(np.isfinite(t), v, np.nan)
        counts = draw_series(axis, t, v, names[i], ylog, **looks.line(i, 1.2))
        counter["are not finite"] += counts["are not finite"]
        counter["at the start, t = t$_0$"] += int(at_start.sum())
        counter["are not positive"] += counts.get("are exactly 0", 0) + counts.get("are below 0", 0)
        positive = (t > 0) & (v > 0) & np.isfinite(v)
        points += [(t[positive], v[positive])] if positive.any() else []
    if xlog:
        draw.log_x(axis)
    axis.set_yscale("log" if ylog else "linear")
    if traits.level is not None:
        axis.axhline(traits.level, label=f"regular: {traits.level:g}", **draw.GUIDE)
    if traits.slope is not None and points:
        # Over all times, through the largest of the first values.
        value, first = max((v[0], t[0]) for t, v in points)
        ends = first, max(t[-1] for t, _ in points)
        draw.guide(axis, ends, value, traits.slope, label=f"slope {sign_text(traits.slope)}")
    time, units = "time since the start |t − t$_0$|" if from_start else "time t", look.units
    axis.set_xlabel(with_unit(time, units.get("t")))
    axis.set_ylabel(with_unit(traits.label, units.get("value")))
    notes = counts_text({f"values {text}": n for text, n in counter.items()})
    looks.finish([axis], look, new, [*looks.entries, *notes])
    return axis


def _lines_of(ts: Any, values: Any) -> tuple[list[tuple[np.ndarray, np.ndarray, float]], list[str]]:
    """(times, numbers, start) of every line, and their names if they have any.

    The start is the time before the values where `ts` have one more than there are values, else 0.
    """
    if isinstance(values, Mapping):
        groups = {name: _lines_of(ts, v)[0] for name, v in values.items()}
        entries = [(k, n, line) for k, group in groups.items() for n, line in enumerate(group, 1)]
        names = [name if len(groups[name]) == 1 else f"{name} {n}" for name, n, _ in entries]
        return [line for *_, line in entries], names
    t, v = np.asarray(getattr(ts, "ts", ts)), np.asarray(values)
    n, is_batch = t.shape[-1] if t.ndim else 0, t.ndim > 1
    numbers = v.dtype.kind in "iuf" and v.ndim and n and v.shape[-1] in (n, n - 1)
    fits = numbers and not (is_batch and t.shape[:-1] != v.shape[: t.ndim - 1])
    rule = f"values must have one number for each time or step, shape (..., {n}) or (..., {n - 1})"
    check_shapes(fits, rule, ts=t, values=v)
    start = t[..., 0] if n > v.shape[-1] else np.zeros(t.shape[:-1])
    t = t[..., n - v.shape[-1] :]
    if is_batch:  # the axes of a batch come first, those of the lines of one orbit behind
        inner = (1,) * (v.ndim - t.ndim)
        start, t = start.reshape(*start.shape, *inner), t.reshape(*t.shape[:-1], *inner, -1)
    start = np.broadcast_to(start, v.shape[:-1]).ravel().tolist()
    rows = (x.reshape(-1, v.shape[-1]) for x in (np.broadcast_to(t, v.shape), v))
    return list(zip(*rows, start, strict=True)), []
