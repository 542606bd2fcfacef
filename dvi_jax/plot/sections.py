"""Pictures of Poincaré sections: points of many orbits, and how they change with ε."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_rgba

from .._results import status_name
from .axes import at_edge, canvas, check_labels, counted, legend
from .states import component, looks_of
from .style import COLOURS, GREY, in_style

_MANY = 3000
"""Points from which a picture has pixels of them in a file of vectors."""


_GOOD = ("", "successful", "stopped", "never_crossed", "too_few_crossings")
"""Statuses of orbits whose states are valid: all but "failed"."""


class _Points(NamedTuple):
    """Crossings of every orbit: shape (orbits, room, *shape), NaN behind the last; how many.

    - `statuses`: how each orbit came through the section, "" where that is not known. `reasons`:
      of its trajectory, as far as that is known.
    """

    qs: np.ndarray
    ps: np.ndarray
    counts: np.ndarray
    statuses: np.ndarray
    reasons: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        return self.qs.shape[2:]

    @property
    def there(self) -> np.ndarray:
        """Which rows are crossings, shape (orbits, room)."""
        return np.asarray(np.isfinite(self.qs).reshape(*self.qs.shape[:2], -1).all(-1))

    @property
    def failed(self) -> np.ndarray:
        """Which orbits failed, shape (orbits,)."""
        return np.isin(self.statuses, _GOOD, invert=True)

    def along(self, function: Any) -> np.ndarray:
        """A coordinate of every row, shape (orbits, room)."""
        flat = (x.reshape(-1, *self.shape) for x in (self.qs, self.ps))
        return np.asarray(function(*flat), float).reshape(self.qs.shape[:2])


@in_style
def section(
    crossings: Any,
    x: Any = "q[-1]",
    y: Any = "p[-1]",
    labels: Sequence[str] | None = None,
    colour: Any = None,
    colour_label: str = "",
    limits: tuple[float, float] | None = None,
    size: float | None = None,
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Where orbits crossed a surface (Poincaré 1892), a point for each crossing.

    - `crossings`: a `dvi.PoincareSection`, a `dvi.Crossings` of one orbit or of a batch, or a
      `Solution` that observed one.
    - `x`, `y`: what is drawn: "q[0]", "p[-1]", of bodies "q[0, 2]"; or a function ``(q, p)`` →
      number of one state, e.g. of an angle that is to be folded.
    - `colour`: a number for each orbit, such as its MEGNO, shown by a bar with `colour_label` from
      `limits` (low, high); NaN is grey. None: each orbit has a colour of its own. `labels`: one
      name for each orbit.
    - `size`: of a point, in points across; None: by their number. `units`: of "q" and "p".
    - `ax`: where to draw.

    10⁶ points and more are one collection, drawn as pixels. The legend counts orbits
    that crossed more often than could be stored, less often than requested, or never, and those
    that were stopped or failed; if there is no crossing at all, a text on the axes says so.

    An orbit that failed may have points far away: only the others set the limits of the axes, and
    the legend counts crossings of failed orbits outside them.

    **Returns** the `Axes`.

    **Raises** `TypeError` for what are no crossings, `ValueError` for components that are not
    there, and another number of colours or names.
    """
    points, units = _points_of(crossings, "section"), units or {}
    get_x, x_label = component(x, points.shape, units, "section")
    get_y, y_label = component(y, points.shape, units, "section")
    there = points.there
    count = len(there)
    looks = looks_of(count, colour, limits)
    check_labels(labels, count, "orbits")
    axis, new = canvas(ax, (5.8, 4.8))
    axis.set(xlabel=x_label, ylabel=y_label, title=title)
    far = np.zeros(0, bool)
    if not there.any():
        _say_empty(axis)
    else:
        xs, ys = points.along(get_x), points.along(get_y)
        look = _dots(int(there.sum()), size)
        failed = _leaves_limits(points)
        if colour is None and count <= len(COLOURS):
            for i in range(count):
                name = None if labels is None else str(labels[i])
                with _limits_kept(axis, bool(failed[i])):
                    xy = xs[i][there[i]], ys[i][there[i]]
                    axis.scatter(*xy, color=looks.colours[i], label=name, **look)
        else:
            # Orbits with neighbouring initial states have similar colours.
            shades = np.asarray([to_rgba(c) for c in looks.colours])
            _scatter(axis, xs, ys, there, failed, shades, look)
        far = _beyond(axis, xs, ys)[there & failed[:, None]]
    looks.colour_bar([axis], colour_label)
    found = legend(axis, new, [*looks.entries(), *_notes(points), *_far(far)])
    for handle in found.legend_handles if found else ():
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([25])
    return axis


def _leaves_limits(points: _Points) -> np.ndarray:
    """Which orbits do not set the limits of the axes: failed ones, unless there are no others."""
    others = points.there.any(1) & ~points.failed
    return points.failed & others.any()


def _scatter(
    axis: Any, x: np.ndarray, y: np.ndarray, there: Any, failed: Any, colours: Any, look: Any
) -> None:
    """The points of every orbit in its colour; those of failed ones do not set the limits."""
    for failing in (False, True):
        rows = there & (failed == failing)[:, None]
        if rows.any():
            with _limits_kept(axis, failing):
                axis.scatter(x[rows], y[rows], c=np.repeat(colours, rows.sum(1), axis=0), **look)


@contextmanager
def _limits_kept(axis: Any, kept: bool) -> Iterator[None]:
    """The limits of the data stay as they are, whatever is drawn inside."""
    before = axis.dataLim.get_points().copy()
    yield
    if kept:
        axis.dataLim.set_points(before)
        axis.autoscale_view()


def _beyond(axis: Any, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    """Which points lie outside the picture."""
    (left, right), (low, high) = sorted(axis.get_xlim()), sorted(axis.get_ylim())
    return ~((xs >= left) & (xs <= right) & (ys >= low) & (ys <= high))


def _far(beyond: np.ndarray) -> list[str]:
    """Legend text that counts crossings of failed orbits outside the picture."""
    text = f"of {len(beyond)} crossings of failed orbits lie outside the picture"
    return counted({text: beyond.sum()})


def _dots(count: int, size: float | None) -> dict[str, Any]:
    """How so many points look: smaller the more there are."""
    across = size if size is not None else float(np.clip(150 / math.sqrt(count), 0.5, 2.5))
    return {"s": across**2, "linewidths": 0, "rasterized": count > _MANY}


def _points_of(crossings: Any, what: str) -> _Points:
    found = _crossings_in(crossings)
    if len(found) != 1:
        raise TypeError(
            f"{what} takes the Crossings of a dvi.Section, solution.observed, "
            + (f"and there are {len(found)}: name one." if found else f"got {crossings!r:.60}.")
        )
    ((one, status),) = found
    qs, ps, ts = (np.asarray(v) for v in (one.qs, one.ps, one.ts))
    if ts.ndim == 0 or qs.shape[: ts.ndim] != ts.shape or qs.shape != ps.shape:
        raise ValueError(
            f"{what} takes crossings with ts of shape (..., room) and qs, ps of shape (..., room, "
            f"*state), got {ts.shape}, {qs.shape} and {ps.shape}."
        )
    if qs.ndim == ts.ndim:
        qs, ps = qs[..., None], ps[..., None]
    shape = (math.prod(ts.shape[:-1]), *qs.shape[ts.ndim - 1 :])
    counts = np.ravel(np.asarray(one.count))
    reasons: Any = status
    if hasattr(one, "status"):  # a PoincareSection, which stops at this number
        counts = np.minimum(counts, ts.shape[-1])
        status = one.status
        reasons = status_name(one.run) if hasattr(one, "run") else ""
    statuses, reasons = (
        np.broadcast_to(np.asarray(x, object), ts.shape[:-1]).ravel().astype(str)
        for x in (status, reasons)
    )
    return _Points(qs.reshape(shape), ps.reshape(shape), counts, statuses, reasons)


def _crossings_in(tree: Any, status: Any = "") -> list[tuple[Any, Any]]:
    """Every `Crossings` of a solution or of its observables, with the status of the solution."""
    if all(hasattr(tree, name) for name in ("ts", "qs", "ps")):
        if _is_count(tree):
            return [(tree, status)]
        return _crossings_in(getattr(tree, "observed", None), getattr(tree, "status", ""))
    parts = tree.values() if isinstance(tree, Mapping) else tree
    if isinstance(tree, Mapping | list | tuple):
        return [c for v in parts for c in _crossings_in(v, status)]
    return []


def _is_count(tree: Any) -> bool:
    return hasattr(tree, "count") and not callable(tree.count)


def _notes(points: _Points) -> list[str]:
    """Legend texts on orbits with too many, too few or no crossings, and on failed ones."""
    total, room, failed = len(points.counts), points.qs.shape[1], points.failed
    over = int(np.sum(points.counts > room))
    none = int(np.sum((points.counts == 0) & ~failed & (points.statuses != "stopped")))
    unknown = int(np.sum(~np.isfinite(points.counts) & ~failed))
    few, stopped = (int(np.sum(points.statuses == s)) for s in ("too_few_crossings", "stopped"))
    texts = []
    if few:
        texts.append(f"{few} of {total} orbits crossed less often than the {room} times asked for")
    if stopped:
        texts.append(f"{stopped} of {total} orbits stopped")
    reasons = np.where(np.isin(points.reasons, _GOOD), "", points.reasons)[failed].tolist()
    for reason in dict.fromkeys(reasons):
        why = f": {reason.replace('_', ' ')}" if reason else ""
        texts.append(f"{reasons.count(reason)} of {total} orbits failed{why}")
    if over:
        texts.append(f"{over} of {total} orbits crossed more often than the {room} times kept")
    if none and none < total:
        texts.append(f"{none} of {total} orbits did not cross")
    if unknown:
        texts.append(f"{unknown} of {total} orbits have no count of crossings")
    return texts


def _say_empty(axis: Any) -> None:
    look = {"ha": "center", "va": "center", "color": "#555555"}
    axis.text(0.5, 0.5, "no orbit crossed the section", transform=axis.transAxes, **look)
    axis.set(xticks=[], yticks=[])


@in_style
def bifurcation(
    parameter: Any,
    crossings: Any,
    y: Any = "q[-1]",
    skip: int = 0,
    name: str = "ε",
    log: bool = False,
    size: float | None = None,
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """A coordinate of orbits at a section against a parameter, such as ε.

    - `parameter`: shape (runs,). `name`: its label, with a unit if it has one.
    - `crossings`: a batch of `dvi.Crossings` with one axis, (runs,), or a `Solution` that observed
      one; or numbers, shape (runs, room), NaN where there are none.
    - `y`: as for `section`, a component or a function ``(q, p)``; the label if `crossings` are
      numbers.
    - `skip`: crossings at the beginning of each run that are left out, until it has settled.
    - `log`: a logarithmic axis of the parameter. `size`: of a point, in points across; `units`: of
      "q" and "p". `ax`: where to draw.

    The legend counts how orbits ended, and crossings of failed ones do not set the limits, as in
    `section`.

    **Returns** the `Axes`.

    **Raises** `ValueError` for shapes that do not fit, and for a parameter without a place on a
    logarithmic axis.
    """
    parameter = np.asarray(parameter, float)
    numbers = np.asarray(crossings) if _is_numeric(crossings) else None
    if numbers is not None:
        values, failed = numbers.astype(float), np.zeros(len(numbers), bool)
        label = "" if y == "q[-1]" else y if isinstance(y, str) else ""
        notes: list[str] = []
    else:
        points = _points_of(crossings, "bifurcation")
        get, label = component(y, points.shape, units or {}, "bifurcation")
        values = np.where(points.there, points.along(get), np.nan)
        notes, failed = _notes(points), _leaves_limits(points)
    if parameter.ndim != 1 or values.ndim != 2 or len(values) != len(parameter):
        raise ValueError(
            f"bifurcation takes a parameter of shape (runs,) and crossings of as many runs, got "
            f"{parameter.shape} and {values.shape[:1]} runs."
        )
    if isinstance(skip, bool) or not isinstance(skip, int) or skip < 0:
        raise ValueError(f"skip must be a number of crossings from 0, got {skip!r}.")
    if log and not (parameter > 0).all():
        raise ValueError("a logarithmic axis takes positive parameters: leave out log=True.")
    values = values[:, skip:]
    x = np.broadcast_to(parameter[:, None], values.shape)
    there = np.isfinite(values)
    axis, new = canvas(ax, (6.8, 4.4))
    axis.set(xlabel=name, ylabel=label, title=title)
    if there.any():
        look = _dots(int(there.sum()), size)
        failed = failed & (there.any(1) & ~failed).any()  # those left after the first
        black = np.tile(to_rgba("#000000"), (len(values), 1))
        _scatter(axis, x, values, there, failed, black, look)
        if log:
            axis.set_xscale("log")
        notes += _far(_beyond(axis, x, values)[there & failed[:, None]])
        silent = int(np.sum(~there.any(1)))
        if silent:
            text = f"{silent} of {len(values)} runs have no crossing"
            text += f" after the first {skip}" if skip else ""
            notes = [n for n in notes if "did not cross" not in n] + [text]
            at_edge(axis, parameter[~there.any(1)], "|", color=GREY)
    else:
        _say_empty(axis)
    legend(axis, new, notes)
    return axis


def _is_numeric(x: Any) -> bool:
    return (
        not hasattr(x, "qs") and not isinstance(x, Mapping | tuple) and not hasattr(x, "observed")
    )
