"""Pictures of Poincaré sections: points of many orbits, and how they change with ε."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_rgba_array

from .._checks import whole
from .._results import status_name
from .axes import at_edge, canvas, check_shapes, counted, labels_of, legend
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
    def there(self) -> np.ndarray:
        """Which rows are crossings, shape (orbits, room)."""
        return np.all(np.isfinite(self.qs), axis=tuple(range(2, self.qs.ndim)))

    @property
    def failed(self) -> np.ndarray:
        """Which orbits failed, shape (orbits,)."""
        return np.isin(self.statuses, _GOOD, invert=True)

    def along(self, which: Any, units: Mapping[str, str]) -> tuple[np.ndarray, str]:
        """A coordinate of every row, shape (orbits, room), and its label."""
        get, label = component(which, self.qs.shape[2:], units)
        flat = (x.reshape(-1, *x.shape[2:]) for x in (self.qs, self.ps))
        return np.asarray(get(*flat), float).reshape(self.qs.shape[:2]), label


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
    points, units = _points_of(crossings), units or {}
    xs, x_label = points.along(x, units)
    ys, y_label = points.along(y, units)
    count = len(xs)
    looks = looks_of(count, colour, limits)
    names = labels_of(labels, count, "orbits")
    axis, new = canvas(ax, (5.8, 4.8))
    axis.set(xlabel=x_label, ylabel=y_label, title=title)
    # Orbits with neighbouring initial states have similar colours.
    colours = to_rgba_array(looks.colours)
    single = names if colour is None and count <= len(COLOURS) else None
    far = _draw(axis, xs, ys, points.there, points.failed, colours, size, single)
    looks.colour_bar([axis], colour_label)
    found = legend(axis, new, [*looks.entries(), *_notes(points), *far])
    for handle in found.legend_handles if found else ():
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([25])
    return axis


def _draw(
    axis: Any,
    x: np.ndarray,
    y: np.ndarray,
    there: np.ndarray,
    failed: np.ndarray,
    colours: np.ndarray,
    size: float | None,
    names: Sequence[str] | None = None,
) -> list[str]:
    """The points of every orbit in its colour, with `names` an artist for each orbit.

    Points of failed orbits do not set the limits of the axes, unless there are no others; returns
    the legend text that counts those outside.
    """
    if not there.any():
        look = {"ha": "center", "va": "center", "color": "#555555"}
        axis.text(0.5, 0.5, "no orbit crossed the section", transform=axis.transAxes, **look)
        axis.set(xticks=[], yticks=[])
        return []
    failed = failed & (there.any(1) & ~failed).any()
    total = int(there.sum())
    across = float(np.clip(150 / math.sqrt(total), 0.5, 2.5)) if size is None else size
    look: Any = {"s": across**2, "linewidths": 0, "rasterized": total > _MANY}
    for k, group in enumerate(np.eye(len(x), dtype=bool) if names else (~failed, failed)):
        rows = there & group[:, None]
        if names or rows.any():
            label, each = (names[k] or None, 1) if names else (None, rows.sum(1)[group])
            before = axis.dataLim.get_points().copy()
            shown = np.repeat(colours[group], each, axis=0)
            axis.scatter(x[rows], y[rows], color=shown, label=label, **look)
            if failed[group].any():
                axis.dataLim.set_points(before)
                axis.autoscale_view()
    (left, right), (low, high) = sorted(axis.get_xlim()), sorted(axis.get_ylim())
    beyond = ~((x >= left) & (x <= right) & (y >= low) & (y <= high))[there & failed[:, None]]
    text = f"of {len(beyond)} crossings of failed orbits lie outside the picture"
    return counted({text: beyond.sum()})


def _points_of(crossings: Any) -> _Points:
    found = _crossings_in(crossings)
    if len(found) != 1:
        raise TypeError(
            "crossings must be the Crossings of a dvi.Section, solution.observed, "
            + (f"and there are {len(found)}: name one." if found else f"got {crossings!r:.60}.")
        )
    ((one, status),) = found
    qs, ps, ts = (np.asarray(v) for v in (one.qs, one.ps, one.ts))
    fits = ts.ndim and qs.shape[: ts.ndim] == ts.shape and qs.shape == ps.shape
    wanted = "crossings have ts of shape (..., room) and qs, ps of shape (..., room, *state)"
    check_shapes(fits, wanted, ts=ts, qs=qs, ps=ps)
    *lead, room = ts.shape
    shape = (math.prod(lead), room, *(qs.shape[ts.ndim :] or (1,)))
    counts, reasons = np.ravel(np.asarray(one.count)), status
    if hasattr(one, "status"):  # a PoincareSection, which stops at this number
        counts = np.minimum(counts, room)
        status, reasons = one.status, status_name(one.run) if hasattr(one, "run") else ""
    texts = [
        np.broadcast_to(np.asarray(x, object), lead).ravel().astype(str) for x in (status, reasons)
    ]
    return _Points(qs.reshape(shape), ps.reshape(shape), counts, *texts)


def _crossings_in(tree: Any, status: Any = "") -> list[tuple[Any, Any]]:
    """Every `Crossings` of a solution or of its observables, with the status of the solution."""
    if all(hasattr(tree, name) for name in ("ts", "qs", "ps")):
        if hasattr(tree, "count") and not callable(tree.count):
            return [(tree, status)]
        tree, status = [getattr(tree, "observed", None)], getattr(tree, "status", "")
    parts = tree.values() if isinstance(tree, Mapping) else tree
    if isinstance(tree, Mapping | list | tuple):
        return [c for v in parts for c in _crossings_in(v, status)]
    return []


def _notes(points: _Points) -> list[str]:
    """Legend texts on orbits with too many, too few or no crossings, and on failed ones."""
    counts, statuses, failed = points.counts, points.statuses, points.failed
    total, room = points.qs.shape[:2]
    none = int(np.sum((counts == 0) & ~failed & (statuses != "stopped")))
    reasons = np.where(np.isin(points.reasons, _GOOD), "", points.reasons)[failed].tolist()
    why = {f": {r.replace('_', ' ')}" if r else "": n for r, n in Counter(reasons).items()}
    texts = {
        f"crossed less often than the {room} times asked for": statuses == "too_few_crossings",
        "stopped": statuses == "stopped",
        **{f"failed{reason}": n for reason, n in why.items()},
        f"crossed more often than the {room} times kept": counts > room,
        "did not cross": none if none < total else 0,
        "have no count of crossings": ~np.isfinite(counts) & ~failed,
    }
    return counted({f"of {total} orbits {text}": np.sum(n) for text, n in texts.items()})


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
    if any(hasattr(crossings, name) for name in ("qs", "observed")) or isinstance(
        crossings, Mapping | tuple
    ):
        points = _points_of(crossings)
        values, label = points.along(y, units or {})
        there, failed, notes = points.there, points.failed, _notes(points)
    else:
        values = np.asarray(crossings, float)
        there, failed, notes = np.isfinite(values), np.zeros(len(values), bool), []
        label = y if isinstance(y, str) and y != "q[-1]" else ""
    wanted = "a bifurcation has a parameter of shape (runs,) and crossings of as many runs"
    fits = parameter.ndim == 1 and values.ndim == 2 and len(values) == len(parameter)
    check_shapes(fits, wanted, parameter=parameter, crossings=values)
    skip = whole("skip", skip, 0)
    if log and not (parameter > 0).all():
        raise ValueError("a logarithmic axis takes positive parameters: leave out log=True.")
    values, there = values[:, skip:], (there & np.isfinite(values))[:, skip:]
    x = np.broadcast_to(parameter[:, None], values.shape)
    axis, new = canvas(ax, (6.8, 4.4))
    axis.set(xlabel=name, ylabel=label, title=title)
    if log:
        axis.set_xscale("log")
    black = np.tile((0.0, 0.0, 0.0, 1.0), (len(values), 1))
    notes += _draw(axis, x, values, there, failed, black, size)
    silent = ~there.any(1)
    if silent.any() and not silent.all():
        text = f"{silent.sum()} of {len(values)} runs have no crossing"
        text += f" after the first {skip}" if skip else ""
        notes = [n for n in notes if "did not cross" not in n] + [text]
        at_edge(axis, parameter[silent], "|", color=GREY)
    legend(axis, new, notes)
    return axis
