"""Pictures of numbers along time: what is conserved, what was watched, indicators of chaos."""

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .house import (
    COLOURS,
    DASHES,
    GREY,
    canvas,
    envelope,
    in_style,
    legend,
    named,
    note,
    signed,
    stack,
)
from .states import CROSS, Looks, cross, each_state, lanes_of, looks_of, troubles

_CHANGES = ("relative", "absolute", "value")
_PANELS = 12

_NEAR_ROUNDING = 1e-12
"""Relative changes below it are compared with the rounding of one operation."""


class _Series(NamedTuple):
    """One quantity along every orbit: times and numbers, shape (S,) each.

    `size`: whether the numbers are lengths of vectors. `nought`: orbits without a relative change.
    """

    name: str
    ts: list[np.ndarray]
    values: list[np.ndarray]
    size: bool
    nought: int


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
    """Quantities along time and how well they are kept, one panel above another.

    - `orbits`: a `Solution`, of one run or of a batch; or times alone, shape (..., S).
    - `values`: name → numbers, shape (..., S, *any), or (..., S − 1, *any) for those at the ends of
      steps; or a function ``(q, p)`` of one state. None: what stands alone in
      ``solution.observed``, a dictionary.
    - `change`: "relative", (I − I₀)/|I₀|; "absolute", I − I₀; "value", I itself. I₀ is the first
      number there is, of an observable that of the first step. Of vectors and matrices it is the
      length of the change, relative to the length of I₀.
    - `log`: sizes on a logarithmic axis, on which several quantities of one orbit share a panel,
      and relative changes stand beside the rounding of one operation. What is exactly 0 has no
      place there: the legend counts it.
    - `labels`, `colour`, `colour_label`: of the orbits, as for `phase_portrait`.
    - `units`: of "t" and of quantities by their name, where the change is not relative.
    - `ax`: where to draw, one `Axes` for each panel.

    Lines of many points are drawn by the least and largest of each piece. Crosses stand where an
    orbit ended too early, and the legend says why.

    **Returns** the `Axes`, an array of them for several panels.

    **Raises** `TypeError` for what has no times or no numbers; `ValueError` for shapes that do not
    fit, and for relative changes of what always starts at 0 (an orbit of a batch is left out, and
    named in the legend).
    """
    if change not in _CHANGES:
        raise ValueError(f"change must be one of {', '.join(_CHANGES)}, got {change!r}.")
    units = units or {}
    ts, lanes = _times(orbits, labels)
    series = [
        _changed(name, ts, v, change, log) for name, v in _watched(orbits, values, lanes).items()
    ]
    count = _count_of_panels(len(series), len(ts), log)
    together = count < len(series)
    if count > _PANELS:
        raise ValueError(
            f"{count} quantities have no room in {_PANELS} panels: name some by values=."
        )
    size = (6.4, 4.2) if count == 1 else (6.4, 1.4 + 1.45 * count)
    axes, new = stack(ax, count, "one for each quantity", size, sharex=True)
    looks = looks_of(len(series) if together else len(ts), None if together else colour)
    zeros = 0
    for i, one in enumerate(series):
        axis = axes[0 if together else i]
        for k, (t, v) in enumerate(zip(one.ts, one.values, strict=True)):
            look = i if together else k
            name = one.name if together else (lanes[k].label if lanes else "")
            if not together and not lanes and labels is not None:
                name = labels[k]
            # The first number is the one that others are compared with: no wonder it is 0.
            zeros += int(np.sum(v[1:] == 0)) if log else 0
            _draw(axis, t, v, looks, look, log, name if i == 0 or together else "")
        name = _name_of_axis("" if together else one.name, change, log, one.size, units)
        axis.set_ylabel(name, fontsize=9 if count > 1 else None)
        if log:
            axis.set_yscale("log")
            if change == "relative" and axis.get_ylim()[0] < _NEAR_ROUNDING:
                _rounding(axis)
    axes[0].set_title(title)
    axes[-1].set_xlabel(named("time t", units.get("t")))
    if len(axes) > 1:
        axes[0].figure.align_ylabels(axes)
    if looks.scale is not None:
        axes[0].figure.colorbar(looks.scale, ax=list(axes), label=colour_label)
    handles = axes[0].get_legend_handles_labels()[0] + looks.entries()
    if zeros:
        handles.append(note(f"{zeros} values exactly 0"))
    for one in series:
        if one.nought:
            text = f"{one.name}: {one.nought} of {len(ts)} orbits start at 0"
            handles.append(note(text))
    handles += [cross(text) for text in troubles(lanes)]
    legend(axes[0], new, handles)
    return axes[0] if count == 1 else np.asarray(axes)


def panels_of(orbits: Any, values: Mapping[str, Any] | None, log: bool) -> int:
    """How many panels `invariants` draws."""
    ts, lanes = _times(orbits, None)
    return _count_of_panels(len(_watched(orbits, values, lanes)), len(ts), log)


def _count_of_panels(quantities: int, orbits: int, log: bool) -> int:
    return 1 if log and orbits == 1 else quantities


def _times(orbits: Any, labels: Sequence[str] | None) -> tuple[list[np.ndarray], list[Any]]:
    """Times of every orbit, and the orbits themselves if there are states."""
    if isinstance(orbits, list | tuple) or hasattr(orbits, "qs"):
        lanes = lanes_of(orbits, "invariants", labels, momenta=False)
        return [lane.ts for lane in lanes], lanes
    ts = np.asarray(getattr(orbits, "ts", orbits))
    if ts.dtype.kind not in "iuf" or ts.ndim == 0:
        raise TypeError(
            f"invariants takes a Solution, or times of shape (S,) with values, got {orbits!r}."
        )
    ts = ts.reshape(-1, ts.shape[-1])
    if labels is not None and len(labels) != len(ts):
        raise ValueError(f"labels has {len(labels)} names for {len(ts)} orbits.")
    return list(ts), []


def _watched(
    orbits: Any, values: Mapping[str, Any] | None, lanes: Sequence[Any]
) -> dict[str, list[np.ndarray]]:
    """Name → the numbers of every orbit, one array each."""
    if values is None:
        several = orbits if isinstance(orbits, list) else [orbits]
        found = [_alone(one) for one in several]
        common = [name for name in found[0] if all(name in one for one in found)]
        if not isinstance(orbits, list):
            values = found[0]
        else:  # each may be a batch: its orbits one after another
            values = {
                name: [
                    v
                    for one, all_ in zip(several, found, strict=True)
                    for v in _of_every_orbit(name, all_[name], one, ())
                ]
                for name in common
            }
    if not values:
        raise ValueError("there is nothing to draw: nothing was watched that has a value per step.")
    return {name: _of_every_orbit(name, v, orbits, lanes) for name, v in values.items()}


def _alone(one: Any) -> dict[str, Any]:
    """What a solution observed that has a value per step."""
    observed = getattr(one, "observed", None)
    if not isinstance(observed, Mapping):
        raise TypeError(
            "invariants draws the dictionary of observables that stand alone, "
            "integrate(..., observe={'energy': f}), or values={'energy': numbers or a function "
            "(q, p)}: there is neither."
        )
    lead, n = np.shape(one.ts)[:-1], np.shape(one.ts)[-1]
    shapes = (*lead, n), (*lead, n - 1)
    return {
        name: v
        for name, v in observed.items()
        if hasattr(v, "shape") and np.shape(v)[: len(lead) + 1] in shapes
    }


def _of_every_orbit(name: str, v: Any, orbits: Any, lanes: Sequence[Any]) -> list[np.ndarray]:
    if callable(v):
        if any(lane.ps is None for lane in lanes) or not lanes:
            raise TypeError(f"{name!r} is a function (q, p): it takes a Solution, or (ts, qs, ps).")
        return [each_state(v, lane.qs, lane.ps, "invariants") for lane in lanes]
    if isinstance(orbits, list):
        if not isinstance(v, list) or len(v) != len(lanes):
            raise ValueError(f"{name!r} must be a list of numbers, one array for each solution.")
        return [np.asarray(x) for x in v]
    ts = np.asarray(orbits[0] if isinstance(orbits, tuple) else getattr(orbits, "ts", orbits))
    v = np.asarray(v)
    lead, n = ts.shape[:-1], ts.shape[-1]
    if v.shape[: ts.ndim] not in ((*lead, n), (*lead, n - 1)):
        raise ValueError(
            f"{name!r} must have one value for each time, shape {(*lead, n)}, or for each step, "
            f"{(*lead, n - 1)}, and more axes behind; got {v.shape}."
        )
    return list(v.reshape(-1, *v.shape[len(lead) :]))


def _changed(
    name: str, ts: list[np.ndarray], values: list[np.ndarray], change: str, log: bool
) -> _Series:
    times, found, vector, nought = [], [], False, 0
    for t, v in zip(ts, values, strict=True):
        if v.dtype.kind not in "biuf":
            raise TypeError(f"{name!r} is {v.dtype}, and only real numbers can be drawn.")
        v = v.reshape(len(v), -1).astype(float)
        first = next((row for row in v if np.isfinite(row).all()), np.full(v.shape[1], np.nan))
        if change != "value":
            v = v - first
        vector = vector or v.shape[1] > 1
        size = np.linalg.norm(first)
        if v.shape[1] > 1:
            v = np.linalg.norm(v, axis=1)
        else:
            v = v[:, 0]
        if change == "relative":
            nought += int(size == 0)
            v = v / size if size else np.full(len(v), np.nan)
        times.append(t[len(t) - len(v) :])
        found.append(np.abs(v) if log else v)
    if nought and nought == len(ts):
        raise ValueError(
            f"every orbit starts at 0 of {name!r}, so that no change is relative to it: take "
            "change='absolute'."
        )
    return _Series(name, times, found, vector, nought)


def _draw(
    axis: Any, t: np.ndarray, v: np.ndarray, looks: Looks, k: int, log: bool, name: str
) -> None:
    finite = np.flatnonzero(np.isfinite(v))
    shown = np.where(v == 0, np.nan, v) if log else v
    axis.plot(*envelope(t, shown), color=looks.colours[k], linestyle=looks.dashes[k],
              linewidth=1.1, label=name.replace("_", " ") or None)  # fmt: skip
    if 0 < finite.size < len(v) and finite[-1] < len(v) - 1:
        at = finite[-1:]
        axis.plot(t[at], shown[at], linestyle="none", zorder=4, **CROSS)


def _name_of_axis(name: str, change: str, log: bool, vector: bool, units: Mapping[str, str]) -> str:
    kind = {"relative": "relative change", "absolute": "change", "value": ""}[change]
    if (log or vector) and kind:
        kind = f"size of {kind}"
    elif log or (vector and change == "value"):
        kind = "size"
    unit = units.get(name) if change != "relative" else None
    name = name.replace("_", " ")
    if kind and name:
        return f"{textwrap.fill(name, 20)}\n{named(kind, unit)}"
    return named(name or kind, unit)


def _rounding(axis: Any) -> None:
    """What one operation in double precision rounds by."""
    eps = float(np.finfo(float).eps)
    axis.axhline(eps, color=GREY, linewidth=1, linestyle=":")
    axis.annotate(
        "rounding of one operation", (1, eps), xycoords=("axes fraction", "data"),
        ha="right", va="bottom", fontsize=8, color="#555555", zorder=4,
        bbox={"facecolor": "#ffffff", "edgecolor": "none", "alpha": 0.75, "pad": 0.5},
    )  # fmt: skip


@in_style
def changes(ts: Any, series: Mapping[str, Any], time: str, title: str, ax: Any = None) -> Any:
    """How quantities change along a run, one panel above another.

    - `ts`: times, shape (S,). `series`: label → changes, shape (S,). `time`: label of the axis.
    - `ax`: where to draw, one `Axes` for each quantity.

    A panel says how many of its changes are no numbers.

    **Returns** the `Axes`, shape (quantities,).
    """
    size = (6.4, 1.2 + 1.35 * len(series))
    axes, _ = stack(ax, len(series), "one for each quantity", size, sharex=True)
    for axis, (label, values), colour in zip(
        axes, series.items(), itertools.cycle(COLOURS), strict=False
    ):
        t, v = _pair(ts, values, label)
        axis.plot(*envelope(t, v), color=colour, linewidth=1.1)
        axis.set_ylabel(label, fontsize=9)
        if lost := int(np.sum(~np.isfinite(v))):
            axis.text(0.99, 0.95, f"{lost} of {len(v)} are no numbers", ha="right", va="top",
                      transform=axis.transAxes, fontsize=8, color="#555555")  # fmt: skip
    axes[0].set_title(title)
    axes[-1].set_xlabel(time)
    axes[0].figure.align_ylabels(axes)
    return np.asarray(axes)


@in_style
def conserved(ts: Any, series: Mapping[str, Any], time: str, title: str, ax: Any = None) -> Any:
    """Sizes of relative changes of conserved quantities, on one logarithmic axis.

    - `ts`: times, shape (S,). `series`: label → sizes, shape (S,). `ax`: where to draw.

    What has no place on this axis is counted in the legend: exact zeros, and what is no number.

    **Returns** the `Axes`.
    """
    axis, new = canvas(ax)
    notes: list[Any] = []
    looks = zip(itertools.cycle(COLOURS), itertools.cycle(DASHES))
    for (label, values), (colour, dash) in zip(series.items(), looks, strict=False):
        # The start itself, where the change is 0, has no place on this axis.
        t, v = (x[1:] for x in _pair(ts, values, label))
        shown = np.where(np.isfinite(v) & (v > 0), v, np.nan)
        axis.semilogy(*envelope(t, shown), color=colour, linestyle=dash, linewidth=0.9, label=label)
        lost = {"exactly 0": v == 0, "no numbers": ~np.isfinite(v), "below 0": v < 0}
        notes += [
            note(f"{label}: {here.sum()} of {len(v)} are {what}")
            for what, here in lost.items() if here.any()
        ]  # fmt: skip
    _rounding(axis)
    axis.set(xlabel=time, ylabel="relative change since the start", title=title)
    found = legend(axis, new, axis.get_legend_handles_labels()[0] + notes)
    for line in found.get_lines() if found else ():
        line.set_linewidth(2.0)
    return axis


def _pair(ts: Any, values: Any, label: str) -> tuple[np.ndarray, np.ndarray]:
    t, v = np.asarray(ts), np.asarray(values)
    if t.ndim != 1 or v.shape != t.shape:
        raise ValueError(
            f"{label!r} must have one number for each time, shape (S,): got ts of shape {t.shape} "
            f"and values of shape {v.shape}."
        )
    return t, v


# --- indicators of chaos ------------------------------------------------------------------------


class _Kind(NamedTuple):
    """How an indicator is drawn: its name, scales, and what regular motion shows."""

    label: str
    xlog: bool
    ylog: bool
    level: float | None = None
    slope: float | None = None


_KINDS = {
    "megno": _Kind("MEGNO ⟨Y⟩", True, False, level=2.0),
    "lyapunov": _Kind("finite-time Lyapunov exponent", True, True, slope=-1.0),
    "sali": _Kind("SALI", True, True),
    "gali": _Kind("GALI", True, True),
}


@in_style
def indicator(
    ts: Any,
    values: Any,
    kind: str | None = None,
    slope: float | None = None,
    labels: Sequence[str] | None = None,
    colour: Any = None,
    colour_label: str = "",
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
    t0: float | None = None,
) -> Any:
    """An indicator of chaos against time, beside what it shows of regular motion.

    - `ts`: times, shape (S,) or (..., S), or what has them, such as a `Solution`.
    - `values`: numbers, shape (..., S) or (..., S − 1) for those at the ends of steps; several
      exponents of one orbit are several lines; or label → such numbers.
    - `kind`: "megno", with a line at 2, where it tends for regular motion (Cincotta & Simó 2000);
      "lyapunov", with a slope of −1, as the finite-time exponent falls for it (Benettin et al.
      1980, up to a logarithm); "sali" or "gali", which stay, or fall by a power, for regular and
      fall exponentially for chaotic motion (Skokos 2001; Skokos et al. 2007). None: any numbers.
    - `slope`: of a guide through the largest first value, on logarithmic axes, in place of that of
      the kind.
    - `labels`, `colour`, `colour_label`: of the lines, as for `phase_portrait`. `units`: of "t" and
      "value". `ax`: where to draw.
    - `t0`: time of the start; None: the first of `ts` if the values are those at ends of steps,
      else 0. A logarithmic axis shows |t − t0|, so that runs backward have their place.

    The legend counts values that are no numbers, and, on logarithmic axes, those that are not
    positive and those at the start itself.

    **Returns** the `Axes`.

    **Raises** `ValueError` for an unknown kind and for shapes that do not fit.
    """
    if kind is not None and kind not in _KINDS:
        raise ValueError(f"kind must be one of {', '.join(_KINDS)}, or None, got {kind!r}.")
    about, units = _KINDS.get(kind or "", _Kind("indicator", False, False)), units or {}
    if slope is not None:
        about = about._replace(xlog=True, ylog=True, slope=slope)
    found, names = _lines_of(ts, values)
    found = [(t, v, start if t0 is None else float(t0)) for t, v, start in found]
    lines = [(np.abs(t - start) if about.xlog else t, v) for t, v, start in found]
    shifted = about.xlog and any(start != 0 or (t < 0).any() for t, _, start in found)
    names = names if labels is None else list(labels)
    if len(names) not in (0, len(lines)):
        raise ValueError(f"labels has {len(names)} names for {len(lines)} lines.")
    looks = looks_of(len(lines), colour)
    axis, new = canvas(ax)
    lost, at_start, low = 0, 0, 0
    for i, (t, v) in enumerate(lines):
        there = np.isfinite(v) & np.isfinite(t)
        early = there & (t == 0) & about.xlog
        under = there & ~early & (v <= 0) & about.ylog
        placeable = there & ~early & ~under
        lost, at_start = lost + int(np.sum(~there)), at_start + int(np.sum(early))
        low += int(np.sum(under))
        axis.plot(*envelope(t, np.where(placeable, v, np.nan)), color=looks.colours[i],
                  linestyle=looks.dashes[i], linewidth=1.2,
                  label=str(names[i]) if names else None)  # fmt: skip
    axis.set(xscale="log" if about.xlog else "linear", yscale="log" if about.ylog else "linear")
    if about.level is not None:
        axis.axhline(about.level, color=GREY, linewidth=1, linestyle="--",
                     label=f"regular: {about.level:g}")  # fmt: skip
    if about.slope is not None:
        _guide(axis, lines, about.slope)
    time = "time since the start |t − t$_0$|" if shifted else "time t"
    axis.set(xlabel=named(time, units.get("t")), ylabel=named(about.label, units.get("value")))
    axis.set_title(title)
    if looks.scale is not None:
        axis.figure.colorbar(looks.scale, ax=axis, label=colour_label)
    handles = axis.get_legend_handles_labels()[0] + looks.entries()
    counts = {
        "are no numbers": lost, "at the start, t = t$_0$": at_start, "are not positive": low
    }  # fmt: skip
    handles += [note(f"{n} values {text}") for text, n in counts.items() if n]
    legend(axis, new, handles)
    return axis


def _lines_of(ts: Any, values: Any) -> tuple[list[tuple[np.ndarray, np.ndarray, float]], list[str]]:
    """(times, numbers, start) of every line, and their names if they have any.

    The start is the time before the values where `ts` have one more than there are values, else 0.
    """
    if isinstance(values, Mapping):
        lines, names = [], []
        for name, v in values.items():
            found, _ = _lines_of(ts, v)
            lines += found
            names += (
                [name] if len(found) == 1 else [f"{name} {i}" for i in range(1, len(found) + 1)]
            )
        return lines, names
    t, v = np.asarray(getattr(ts, "ts", ts)), np.asarray(values)
    n = t.shape[-1] if t.ndim else 0
    if v.dtype.kind not in "iuf" or not v.ndim or n == 0 or v.shape[-1] not in (n, n - 1):
        raise ValueError(
            f"an indicator has one number for each time or step, shape (..., {n}) or (..., "
            f"{n - 1}): got ts of shape {t.shape} and values of shape {v.shape}."
        )
    start = t[..., 0] if n > v.shape[-1] else np.zeros(t.shape[:-1])
    t = t[..., n - v.shape[-1] :]
    if t.ndim > 1 and t.shape[:-1] != v.shape[: t.ndim - 1]:
        raise ValueError(f"ts of shape {t.shape} do not go with values of shape {v.shape}.")
    if t.ndim > 1:
        start = start.reshape(*start.shape, *(1,) * (v.ndim - t.ndim))
        t = t.reshape(*t.shape[:-1], *(1,) * (v.ndim - t.ndim), t.shape[-1])
    t, start = np.broadcast_to(t, v.shape), np.broadcast_to(start, v.shape[:-1])
    rows = (t.reshape(-1, t.shape[-1]), v.reshape(-1, v.shape[-1]), start.ravel().tolist())
    return list(zip(*rows, strict=True)), []


def _guide(axis: Any, lines: Sequence[tuple[np.ndarray, np.ndarray]], slope: float) -> None:
    """A line of a slope over all times, through the largest of the first values."""
    starts, ends = [], []
    for t, v in lines:
        good = np.flatnonzero((t > 0) & (v > 0) & np.isfinite(v))
        if good.size:
            starts.append((v[good[0]], t[good[0]]))
            ends.append(t[good[-1]])
    if starts:
        value, first = max(starts)
        x = np.array([first, max(ends)])
        axis.plot(x, value * (x / first) ** slope, color=GREY, linewidth=1, linestyle="--",
                  label=f"slope {signed(slope)}")  # fmt: skip
