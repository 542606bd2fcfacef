"""Pictures of numbers along time: conserved quantities, observables, indicators of chaos."""

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._checks import one_of
from .axes import canvas, check_shapes, counted, envelope, labels_of, legend, stack
from .states import each_state, lanes_of, looks_of, troubles
from .style import COLOURS, CROSS, DASHES, GREY, in_style, named

_KINDS = {"relative": "relative change", "absolute": "change", "value": ""}
_PANELS = 12

_NEAR_ROUNDING = 1e-12
"""Relative changes below it are compared with the rounding of one operation."""


def draw_series(
    axis: Any, t: np.ndarray, v: np.ndarray, label: str, log: bool = False, **look: Any
) -> dict[str, int]:
    """One line along time through the values that have a place on the axis; counts the others.

    Long series are drawn by the extremes of each piece.
    """
    lost = {"are no numbers": ~np.isfinite(v)}
    if log:
        lost |= {"are exactly 0": v == 0, "are below 0": v < 0}
    shown = np.where(np.logical_or.reduce(list(lost.values())), np.nan, v)
    axis.plot(*envelope(t, shown), label=label or None, **look)
    return {text: int(here.sum()) for text, here in lost.items()}


class _Series(NamedTuple):
    """One quantity along every orbit: times and values, shape (S,) each.

    `size`: whether the values are lengths of vectors. `from_zero`: number of orbits that start at
    0 and therefore have no relative change.
    """

    name: str
    ts: list[np.ndarray]
    values: list[np.ndarray]
    size: bool
    from_zero: int


@in_style
def invariants(
    orbits: Any,
    values: Mapping[str, Any] | None = None,
    change: str = "relative",
    log: bool = False,
    labels: Sequence[str] | None = None,
    colour: Any = None,
    colour_label: str = "",
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Quantities along time and how well they are conserved, one panel above another.

    - `orbits`: a `Solution`, of one run or of a batch; or times alone, shape (..., S).
    - `values`: name → numbers, shape (..., S, *any), or (..., S − 1, *any) for those at the ends of
      steps; or a function ``(q, p)`` of one state. None: the observables
      in the dictionary ``solution.observed`` that have a value per step.
    - `change`: "relative", (I − I₀)/|I₀|; "absolute", I − I₀; "value", I itself. I₀ is the first
      number there is, of an observable that of the first step. Of vectors and matrices it is the
      length of the change, relative to the length of I₀.
    - `log`: sizes on a logarithmic axis, on which several quantities of one orbit share a panel,
      and relative changes are compared with the rounding of one operation. The legend counts
      values that are exactly 0, which have no place there.
    - `labels`, `colour`, `colour_label`: of the orbits, as for `phase_portrait`.
    - `units`: of "t" and of quantities by their name, where the change is not relative.
    - `ax`: where to draw, one `Axes` for each panel.

    Lines of many points are drawn by the extremes of each piece. Crosses mark early ends of orbits,
    with the reason in the legend.

    **Returns** the `Axes`, an array of them for several panels.

    **Raises** `TypeError` for what has no times or no numbers; `ValueError` for shapes that do not
    fit, and for relative changes of what always starts at 0 (an orbit of a batch is left out, and
    named in the legend).
    """
    one_of("change", change, _KINDS)
    units = units or {}
    ts, names, lanes = _times(orbits, labels)
    watched = _watched(orbits, values, lanes)
    series = [_changed(name, ts, v, change, log) for name, v in watched.items()]
    count = _count_of_panels(len(series), len(ts), log)
    together = count < len(series)
    if count > _PANELS:
        raise ValueError(
            f"{count} quantities are too many for {_PANELS} panels: name some, values="
        )
    size = (6.4, 4.2) if count == 1 else (6.4, 1.4 + 1.45 * count)
    axes, new = stack(ax, count, "one for each quantity", size, sharex=True)
    looks = looks_of(len(series) if together else len(ts), None if together else colour)
    zeros = 0
    for i, one in enumerate(series):
        axis = axes[0 if together else i]
        for k, (t, v) in enumerate(zip(one.ts, one.values, strict=True)):
            name = one.name if together else names[k] if i == 0 else ""
            _draw_change(axis, t, v, name, log, looks.line(i if together else k, 1.1))
            # The first value is the reference and therefore 0.
            zeros += int(np.sum(v[1:] == 0)) if log else 0
        label = _name_of_axis("" if together else one.name, change, log, one.size, units)
        axis.set_ylabel(label, fontsize=9 if count > 1 else None)
        if log:
            axis.set_yscale("log")
        if log and change == "relative" and axis.get_ylim()[0] < _NEAR_ROUNDING:
            _rounding(axis)
    _finish(axes, named("time t", units.get("t")), title)
    looks.colour_bar(axes, colour_label)
    notes = [*looks.entries(), *counted({"values exactly 0": zeros})]
    for one in series:
        texts = counted({f"of {len(ts)} orbits start at 0": one.from_zero})
        notes += [f"{one.name}: {text}" for text in texts]
    legend(axes[0], new, notes + troubles(lanes))
    return axes[0] if count == 1 else np.asarray(axes)


def _finish(axes: Sequence[Any], time: str, title: str) -> None:
    """Title, name of the times, and aligned names of the y axes."""
    axes[0].set_title(title)
    axes[-1].set_xlabel(time)
    axes[0].figure.align_ylabels(axes)


def panels_of(orbits: Any, values: Mapping[str, Any] | None, log: bool) -> int:
    """How many panels `invariants` draws."""
    ts, _, lanes = _times(orbits, None)
    return _count_of_panels(len(_watched(orbits, values, lanes)), len(ts), log)


def _count_of_panels(quantities: int, orbits: int, log: bool) -> int:
    return 1 if log and orbits == 1 else quantities


def _times(
    orbits: Any, labels: Sequence[str] | None
) -> tuple[list[np.ndarray], list[str], list[Any]]:
    """Times and labels of every orbit, and the orbits themselves if there are states."""
    if isinstance(orbits, list | tuple) or hasattr(orbits, "qs"):
        lanes = lanes_of(orbits, labels, momenta=False)
        return [lane.ts for lane in lanes], [lane.label for lane in lanes], lanes
    ts = np.asarray(getattr(orbits, "ts", orbits))
    if ts.dtype.kind not in "iuf" or ts.ndim == 0:
        raise TypeError(
            f"invariants takes a Solution, or times of shape (S,) with values, got {orbits!r}."
        )
    ts = ts.reshape(-1, ts.shape[-1])
    return list(ts), labels_of(labels, len(ts), "orbits"), []


def _watched(
    orbits: Any, values: Mapping[str, Any] | None, lanes: Sequence[Any]
) -> dict[str, list[np.ndarray]]:
    """Name → the values of every orbit, one array each."""
    if values is None and isinstance(orbits, list):  # each may be a batch
        pairs = [(one, _observed(one)) for one in orbits]
        shared = [n for n in pairs[0][1] if all(n in observed for _, observed in pairs)]
        values = {
            n: [v for one, seen in pairs for v in _of_every_orbit(n, seen[n], one, ())]
            for n in shared
        }
    elif values is None:
        values = _observed(orbits)
    if not values:
        raise ValueError("there is nothing to draw: no observable has a value per step.")
    return {name: _of_every_orbit(name, v, orbits, lanes) for name, v in values.items()}


def _observed(one: Any) -> dict[str, Any]:
    """The observables of a solution that have a value per step."""
    observed = getattr(one, "observed", None)
    if not isinstance(observed, Mapping):
        raise TypeError(
            "invariants draws the observables of integrate(..., observe={'energy': f}), or "
            "values={'energy': numbers or a function (q, p)}: there is neither."
        )
    *lead, n = np.shape(one.ts)
    shapes, front = ((*lead, n), (*lead, n - 1)), len(lead) + 1
    return {k: v for k, v in observed.items() if hasattr(v, "shape") and v.shape[:front] in shapes}


def _of_every_orbit(name: str, v: Any, orbits: Any, lanes: Sequence[Any]) -> list[np.ndarray]:
    if callable(v):
        if any(lane.ps is None for lane in lanes) or not lanes:
            raise TypeError(f"{name!r} is a function (q, p): it takes a Solution, or (ts, qs, ps).")
        return [each_state(v, lane.qs, lane.ps) for lane in lanes]
    if isinstance(orbits, list):
        if not isinstance(v, list) or len(v) != len(lanes):
            raise ValueError(f"{name!r} must be a list of numbers, one array for each solution.")
        return [np.asarray(x) for x in v]
    ts = np.asarray(orbits[0] if isinstance(orbits, tuple) else getattr(orbits, "ts", orbits))
    v, (*lead, n) = np.asarray(v), ts.shape
    shapes = (*lead, n), (*lead, n - 1)
    wanted = f"{name!r} must have one value for each time, shape {shapes[0]}, or for each step, "
    wanted += f"{shapes[1]}, and possibly more axes after these"
    check_shapes(v.shape[: ts.ndim] in shapes, wanted, values=v)
    return list(v.reshape(-1, *v.shape[len(lead) :]))


def _changed(
    name: str, ts: list[np.ndarray], values: list[np.ndarray], change: str, log: bool
) -> _Series:
    """The changes of a quantity since its first finite value, along every orbit."""
    times, found, vector, from_zero = [], [], False, 0
    for t, v in zip(ts, values, strict=True):
        if v.dtype.kind not in "biuf":
            raise TypeError(f"{name!r} is {v.dtype}, and only real numbers can be drawn.")
        v = v.reshape(len(v), -1).astype(float)
        first = next((row for row in v if np.isfinite(row).all()), np.full(v.shape[1], np.nan))
        v = v if change == "value" else v - first
        vector = vector or v.shape[1] > 1
        v = np.linalg.norm(v, axis=1) if v.shape[1] > 1 else v[:, 0]
        if change == "relative":
            size = np.linalg.norm(first)
            from_zero += int(size == 0)
            v = v / (size or np.nan)
        times.append(t[len(t) - len(v) :])
        found.append(np.abs(v) if log else v)
    if from_zero and from_zero == len(ts):
        raise ValueError(
            f"every orbit starts at 0 of {name!r}, so that no change is relative to it: take "
            "change='absolute'."
        )
    return _Series(name, times, found, vector, from_zero)


def _draw_change(axis: Any, t: Any, v: np.ndarray, name: str, log: bool, look: Any) -> None:
    """One orbit's line, with a cross where its values end too early."""
    draw_series(axis, t, v, name.replace("_", " "), log, **look)
    finite = np.flatnonzero(np.isfinite(v))
    if finite.size and finite[-1] < len(v) - 1 and not (log and v[finite[-1]] == 0):
        axis.plot(t[finite[-1:]], v[finite[-1:]], linestyle="none", zorder=4, **CROSS)


def _name_of_axis(name: str, change: str, log: bool, vector: bool, units: Mapping[str, str]) -> str:
    kind = _KINDS[change]
    if log or vector:
        kind = f"size of {kind}" if kind else "size"
    unit = units.get(name) if change != "relative" else None
    name = name.replace("_", " ")
    if kind and name:
        return f"{textwrap.fill(name, 20)}\n{named(kind, unit)}"
    return named(name or kind, unit)


def _rounding(axis: Any) -> None:
    """A line at the rounding error of one operation in double precision."""
    eps = float(np.finfo(float).eps)
    axis.axhline(eps, color=GREY, linewidth=1, linestyle=":")
    paper = {"facecolor": "#ffffff", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
    look = {"ha": "right", "va": "bottom", "fontsize": 8, "color": "#555555", "zorder": 4}
    where = ("axes fraction", "data")
    axis.annotate("rounding of one operation", (1, eps), xycoords=where, bbox=paper, **look)


@in_style
def changes(ts: Any, series: Mapping[str, Any], time: str, title: str, ax: Any = None) -> Any:
    """Changes of quantities along a run, one panel above another.

    - `ts`: times, shape (S,). `series`: label → changes, shape (S,). `time`: label of the axis.
    - `ax`: where to draw, one `Axes` for each quantity.

    A panel reports how many of its changes are not finite.

    **Returns** the `Axes`, shape (quantities,).
    """
    size = (6.4, 1.2 + 1.35 * len(series))
    axes, _ = stack(ax, len(series), "one for each quantity", size, sharex=True)
    colours = itertools.cycle(COLOURS)
    for axis, colour, (label, values) in zip(axes, colours, series.items(), strict=False):
        t, v = _pair(ts, values, label)
        lost = draw_series(axis, t, v, "", color=colour, linewidth=1.1)
        axis.set_ylabel(label, fontsize=9)
        look = {"ha": "right", "va": "top", "fontsize": 8, "color": "#555555"}
        for text in counted({f"of {len(v)} {what}": n for what, n in lost.items()}):
            axis.text(0.99, 0.95, text, transform=axis.transAxes, **look)
    _finish(axes, time, title)
    return np.asarray(axes)


@in_style
def conserved(ts: Any, series: Mapping[str, Any], time: str, title: str, ax: Any = None) -> Any:
    """Sizes of relative changes of conserved quantities, on one logarithmic axis.

    - `ts`: times, shape (S,). `series`: label → sizes, shape (S,). `ax`: where to draw.

    The legend counts values without a place on this axis: exact zeros, and values that are
    negative or not finite.

    **Returns** the `Axes`.
    """
    axis, new = canvas(ax)
    axis.set_yscale("log")
    notes: list[str] = []
    looks = itertools.cycle(zip(COLOURS, DASHES, strict=True))
    for (label, values), (colour, dash) in zip(series.items(), looks, strict=False):
        # The change at the start is 0 by definition and is left out.
        t, v = (x[1:] for x in _pair(ts, values, label))
        lost = draw_series(axis, t, v, label, True, color=colour, linestyle=dash, linewidth=0.9)
        texts = counted({f"of {len(v)} {what}": n for what, n in lost.items()})
        notes += [f"{label}: {text}" for text in texts]
    _rounding(axis)
    axis.set(xlabel=time, ylabel="relative change since the start", title=title)
    found = legend(axis, new, notes)
    for line in found.get_lines() if found else ():
        line.set_linewidth(2.0)
    return axis


def _pair(ts: Any, values: Any, label: str) -> tuple[np.ndarray, np.ndarray]:
    t, v = np.asarray(ts), np.asarray(values)
    wanted = f"{label!r} must have one number for each time, shape (S,)"
    check_shapes(t.ndim == 1 and v.shape == t.shape, wanted, ts=t, values=v)
    return t, v
