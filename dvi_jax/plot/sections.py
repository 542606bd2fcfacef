"""Pictures of Poincaré sections: points of many orbits, and how they change with ε."""

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import to_rgba_array

from ..base.checks import whole
from ..base.results import status_name
from .axes import at_edge, canvas, check_shapes, counts_text, labels_of, legend, log_x
from .states import component, looks_of
from .style import COLOURS, GREY, SMALL, in_style, look_of

_PIXEL_COUNT = 3000
"""Number of points above which they are pixels in a vector file."""

_GOOD = ("", "successful", "stopped", "never_crossed", "too_few_crossings")
"""Statuses of orbits whose states are valid: all but "failed"."""


class _Points(NamedTuple):
    """Crossings of every orbit, shape (orbits, room, *shape), NaN behind the last; their number.

    `statuses`: of each orbit in the section; `reasons`: of its trajectory; "" if unknown.
    """

    qs: np.ndarray
    ps: np.ndarray
    counts: np.ndarray
    statuses: np.ndarray
    reasons: np.ndarray

    @property
    def finite(self) -> np.ndarray:
        return np.all(np.isfinite(self.qs), axis=tuple(range(2, self.qs.ndim)))

    @property
    def has_failed(self) -> np.ndarray:
        return np.isin(self.statuses, _GOOD, invert=True)

    def values_of(self, coordinate: Any, units: Mapping[str, str]) -> tuple[np.ndarray, str]:
        """A coordinate of every row, shape (orbits, room), NaN behind the last; its label."""
        get, label = component(coordinate, self.qs.shape[2:], units)
        flat = (x.reshape(-1, *x.shape[2:]) for x in (self.qs, self.ps))
        values = np.asarray(get(*flat), float).reshape(self.qs.shape[:2])
        return np.where(self.finite, values, np.nan), label

    def notes(self) -> list[str]:
        """Legend texts on orbits with too many, too few or no crossings, and on failed ones."""
        counts, statuses, has_failed = self.counts, self.statuses, self.has_failed
        total, room = self.qs.shape[:2]
        none = int(np.sum((counts == 0) & ~has_failed & (statuses != "stopped")))
        reasons = np.where(np.isin(self.reasons, _GOOD), "", self.reasons)[has_failed].tolist()
        causes = Counter(f": {r.replace('_', ' ')}" if r else "" for r in reasons)
        texts = {
            f"crossed less than the required {room} times": statuses == "too_few_crossings",
            "stopped": statuses == "stopped",
            **{f"failed{cause}": count for cause, count in causes.items()},
            f"crossed more than the {room} times stored": counts > room,
            "did not cross": none if none < total else 0,
            "have no count of crossings": ~np.isfinite(counts) & ~has_failed,
        }
        sums = {f"of {total} orbits {text}": np.sum(number) for text, number in texts.items()}
        return counts_text(sums)

    def draw(
        self, axis: Any, x: Any, y: Any, colours: Any, size: float | None, names: Any = None, skip=0
    ) -> list[str]:
        """The points of every orbit in its colour, with `names` an artist for each orbit.

        Points of failed orbits do not set the limits of the axes, unless there are no others;
        returns the legend text that counts those outside.
        """
        valid = self.finite[:, skip:]
        if not valid.any():
            where = {"ha": "center", "va": "center", "transform": axis.transAxes}
            axis.text(0.5, 0.5, "no orbit crossed the section", color=SMALL["color"], **where)
            axis.set(xticks=[], yticks=[])
            return []
        has_failed = self.has_failed & (valid.any(1) & ~self.has_failed).any()
        total = int(valid.sum())
        diameter = float(np.clip(150 / math.sqrt(total), 0.5, 2.5)) if size is None else size
        look: Any = {"s": diameter**2, "linewidths": 0, "rasterized": total > _PIXEL_COUNT}
        groups = np.eye(len(x), dtype=bool) if names else (~has_failed, has_failed)
        for k, group in enumerate(groups):
            rows = valid & group[:, None]
            if names or rows.any():
                label, repeats = (names[k] or None, 1) if names else (None, rows.sum(1)[group])
                limits = axis.dataLim.get_points().copy()
                point_colours = np.repeat(colours[group], repeats, axis=0)
                axis.scatter(x[rows], y[rows], color=point_colours, label=label, **look)
                if has_failed[group].any():
                    axis.dataLim.set_points(limits)
                    axis.autoscale_view()
        (left, right), (low, high) = sorted(axis.get_xlim()), sorted(axis.get_ylim())
        in_view = (x >= left) & (x <= right) & (y >= low) & (y <= high)
        outliers = ~in_view[valid & has_failed[:, None]]
        text = f"of {len(outliers)} crossings of failed orbits lie outside the picture"
        return counts_text({text: outliers.sum()})


@in_style
def section(
    crossings: Any,
    x: Any = "q[-1]",
    y: Any = "p[-1]",
    limits: tuple[float, float] | None = None,
    size: float | None = None,
    **options: Any,
) -> Any:
    """Poincaré section: one point for each crossing of a surface by an orbit (Poincaré 1892).

    - `crossings`: a `dvi.PoincareSection`, a `dvi.Crossings` of one orbit or of a batch, or a
      `Solution` that observed one.
    - `x`, `y`: what is drawn: "q[0]", "p[-1]", of bodies "q[0, 2]"; or a function ``(q, p)`` →
      number of one state, e.g. of an angle that is to be folded.
    - `limits`: (low, high) of the scale of `colour`. `size`: diameter of a point, in points; None:
      by their number.
    - `labels`, `colour` (such as the MEGNO of each orbit), `colour_label`, `units` (of "q" and
      "p"), `title`, `ax`: as for all pictures.

    All points are one collection, drawn as pixels if they are many. The legend counts orbits that
    crossed more often than could be stored, less often than required, or never, and those that were
    stopped or failed; if there is no crossing at all, a text on the axes says so. An orbit that
    failed may have points far away: only the others set the limits of the axes, and the legend
    counts crossings of failed orbits outside them.

    **Returns** the `Axes`. **Raises** `TypeError` for input without crossings, `ValueError` for
    components that do not exist, and another number of colours or names.
    """
    look, points = look_of(options), _points_of(crossings)
    xs, x_label = points.values_of(x, look.units)
    ys, y_label = points.values_of(y, look.units)
    count = len(xs)
    looks = looks_of(count, look.colour, limits)
    names = labels_of(look.labels, count, "orbits")
    axis, new = canvas(look.ax, (5.8, 4.8))
    axis.set(xlabel=x_label, ylabel=y_label)
    # Orbits with neighbouring initial states have similar colours.
    colours = to_rgba_array(looks.colours)
    single = names if look.colour is None and count <= len(COLOURS) else None
    far = points.draw(axis, xs, ys, colours, size, single)
    box = looks.finish([axis], look, new, [*looks.entries, *points.notes(), *far])
    for handle in box.legend_handles if box else ():
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([25])
    return axis


def _points_of(crossings: Any) -> _Points:
    pairs = _crossings_in(crossings)
    if len(pairs) != 1:
        raise TypeError(
            "crossings must have the result of one dvi.Section, such as solution.observed['name'], "
            f"got type {type(crossings).__name__} with {len(pairs)}."
        )
    ((crossing, status),) = pairs
    qs, ps, ts = (np.asarray(column) for column in (crossing.qs, crossing.ps, crossing.ts))
    fits = ts.ndim and qs.shape[: ts.ndim] == ts.shape and qs.shape == ps.shape
    rule = "crossings must have ts of shape (..., n), and qs and ps of shape (..., n, *state)"
    check_shapes(fits, rule, ts=ts, qs=qs, ps=ps)
    *lead, room = ts.shape
    shape = (math.prod(lead), room, *(qs.shape[ts.ndim :] or (1,)))
    counts, reasons = np.ravel(np.asarray(crossing.count)), status
    if hasattr(crossing, "status"):  # a PoincareSection, which stops at this number
        counts = np.minimum(counts, room)
        reasons = status_name(crossing.run) if hasattr(crossing, "run") else ""
        status = crossing.status
    texts = (np.broadcast_to(np.asarray(x, object), lead).ravel() for x in (status, reasons))
    return _Points(qs.reshape(shape), ps.reshape(shape), counts, *(t.astype(str) for t in texts))


def _crossings_in(tree: Any, status: Any = "") -> list[tuple[Any, Any]]:
    """Every `Crossings` of a solution or of its observables, with the status of the solution."""
    if all(hasattr(tree, name) for name in ("ts", "qs", "ps")):
        if hasattr(tree, "count") and not callable(tree.count):
            return [(tree, status)]
        tree, status = [getattr(tree, "observed", None)], getattr(tree, "status", "")
    parts = tree.values() if isinstance(tree, Mapping) else tree
    if isinstance(tree, Mapping | list | tuple):
        return [pair for part in parts for pair in _crossings_in(part, status)]
    return []


@in_style
def bifurcation(
    parameter: Any,
    crossings: Any,
    y: Any = "q[-1]",
    skip: int = 0,
    name: str = "ε",
    log: bool = False,
    size: float | None = None,
    **options: Any,
) -> Any:
    """Bifurcation diagram: a coordinate of section points against a parameter, such as ε.

    - `parameter`: shape (runs,). `name`: its label, with a unit if it has one.
    - `crossings`: a batch of `dvi.Crossings` with one axis, (runs,), or a `Solution` that observed
      one; or numbers, shape (runs, room), NaN without a crossing.
    - `y`: as for `section`, a component or a function ``(q, p)``; the label if `crossings` are
      numbers.
    - `skip`: crossings at the beginning of each run that are left out, until it has settled.
    - `log`: a logarithmic axis of the parameter. `size`: diameter of a point, in points.
    - `units` (of "q" and "p"), `title`, `ax`: as for all pictures.

    The legend counts how orbits ended, and crossings of failed ones do not set the limits, as in
    `section`.

    **Returns** the `Axes`. **Raises** `ValueError` for shapes that do not fit, and for a parameter
    without a place on a logarithmic axis.
    """
    look = look_of(options, "labels", "colour", "colour_label")
    parameter = np.asarray(parameter, float)
    if any(hasattr(crossings, name) for name in ("qs", "observed")) or isinstance(
        crossings, Mapping | tuple
    ):
        points = _points_of(crossings)
        values, label = points.values_of(y, look.units)
    else:
        values = np.asarray(crossings, float)
        blank = np.full(len(values), "")
        counts = np.isfinite(values).reshape(len(values), -1).sum(1)
        points = _Points(values[..., None], values[..., None], counts, blank, blank)
        label = y if isinstance(y, str) and y != "q[-1]" else ""
    rule = "parameter must have shape (runs,), and crossings shape (runs, n)"
    fits = parameter.ndim == 1 and values.ndim == 2 and len(values) == len(parameter)
    check_shapes(fits, rule, parameter=parameter, crossings=values)
    skip = whole("skip", skip, 0)
    if log and not (parameter > 0).all():
        raise ValueError(f"log=True requires a positive parameter, got {parameter.min()}.")
    values = values[:, skip:]
    x = np.broadcast_to(parameter[:, None], values.shape)
    axis, new = canvas(look.ax, (6.8, 4.4))
    axis.set(xlabel=name, ylabel=label, title=look.title)
    if log:
        log_x(axis)
    black = np.tile((0.0, 0.0, 0.0, 1.0), (len(values), 1))
    notes = points.notes() + points.draw(axis, x, values, black, size, skip=skip)
    silent = ~np.isfinite(values).any(1)
    if silent.any() and not silent.all():
        text = f"{silent.sum()} of {len(values)} runs have no crossing"
        text += f" after the first {skip}" if skip else ""
        notes = [n for n in notes if "did not cross" not in n] + [text]
        at_edge(axis, parameter[silent], "|", color=GREY)
    legend(axis, new, notes)
    return axis
