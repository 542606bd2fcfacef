"""Pictures of Poincaré sections: points of many orbits, and how they change with ε."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.lines import Line2D

from .house import COLOURS, canvas, in_style, legend
from .states import component, looks_of

_MANY = 3000
"""Points from which a picture has pixels of them in a file of vectors."""


class _Points(NamedTuple):
    """Crossings of every orbit: shape (orbits, room, *shape), NaN behind the last; how many."""

    qs: np.ndarray
    ps: np.ndarray
    counts: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        return self.qs.shape[2:]

    @property
    def there(self) -> np.ndarray:
        """Which rows are crossings, shape (orbits, room)."""
        return np.asarray(np.isfinite(self.qs).reshape(*self.qs.shape[:2], -1).all(-1))

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
    - `colour`: a number for each orbit, such as its MEGNO, told by a bar with `colour_label` from
      `limits` (low, high); NaN is grey. None: each orbit has a colour of its own. `labels`: one
      name for each orbit.
    - `size`: of a point, in points across; None: by their number. `units`: of "q" and "p".
    - `ax`: where to draw.

    10⁶ points and more are one collection, drawn as pixels. The legend tells of orbits that
    crossed more often than there was room for, and of those that never did; where there is no
    crossing at all, the axes say so.

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
    if labels is not None and len(labels) != count:
        raise ValueError(f"labels has {len(labels)} names for {count} orbits.")
    axis, new = canvas(ax, (5.8, 4.8))
    axis.set(xlabel=x_label, ylabel=y_label, title=title)
    handles: list[Any] = []
    if not there.any():
        _say_empty(axis)
    else:
        xs, ys = points.along(get_x), points.along(get_y)
        look = _dots(int(there.sum()), size)
        if colour is None and count <= len(COLOURS):
            for i in range(count):
                name = None if labels is None else str(labels[i])
                axis.scatter(xs[i][there[i]], ys[i][there[i]], color=looks.colours[i], label=name,
                             **look)  # fmt: skip
        else:
            # Orbits of neighbouring starts lie beside one another: neighbouring colours there.
            shades = np.asarray([_rgba(c) for c in looks.colours])
            each = np.repeat(np.arange(count), there.sum(1))
            axis.scatter(xs[there], ys[there], c=shades[each], **look)
        handles = axis.get_legend_handles_labels()[0]
    if looks.scale is not None:
        axis.figure.colorbar(looks.scale, ax=axis, label=colour_label)
    handles += looks.entries() + _notes(points)
    found = legend(axis, new, handles)
    for handle in found.legend_handles if found else ():
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([25])
    return axis


def _rgba(colour: Any) -> tuple[float, ...]:
    from matplotlib.colors import to_rgba

    return to_rgba(colour)


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
    (one,) = found
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
    if hasattr(one, "status"):  # a PoincareSection: just so many were asked for
        counts = np.minimum(counts, ts.shape[-1])
    return _Points(qs.reshape(shape), ps.reshape(shape), counts)


def _crossings_in(tree: Any) -> list[Any]:
    """Every `Crossings`, told by its fields, of a solution, its observables or a part of them."""
    if all(hasattr(tree, name) for name in ("ts", "qs", "ps")):
        return [tree] if _is_count(tree) else _crossings_in(getattr(tree, "observed", None))
    if isinstance(tree, Mapping):
        return [c for v in tree.values() for c in _crossings_in(v)]
    if isinstance(tree, list | tuple):
        return [c for v in tree for c in _crossings_in(v)]
    return []


def _is_count(tree: Any) -> bool:
    return hasattr(tree, "count") and not callable(tree.count)


def _notes(points: _Points) -> list[Any]:
    """What a legend says of orbits with more crossings than room, and with none."""
    total, room = len(points.counts), points.qs.shape[1]
    over, none = int(np.sum(points.counts > room)), int(np.sum(points.counts == 0))
    unknown = int(np.sum(~np.isfinite(points.counts)))
    texts = []
    if over:
        texts.append(f"{over} of {total} orbits crossed more often than the {room} times kept")
    if none and none < total:
        texts.append(f"{none} of {total} orbits did not cross")
    if unknown:
        texts.append(f"{unknown} of {total} orbits have no count of crossings")
    return [Line2D([], [], linestyle="none", label=text) for text in texts]


def _say_empty(axis: Any) -> None:
    axis.text(0.5, 0.5, "no orbit crossed the section", transform=axis.transAxes, ha="center",
              va="center", color="#555555")  # fmt: skip
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
    """What orbits show at a section against a parameter, such as ε.

    - `parameter`: shape (runs,). `name`: its label, with a unit if it has one.
    - `crossings`: a batch of `dvi.Crossings` with one axis, (runs,), or a `Solution` that observed
      one; or numbers, shape (runs, room), NaN where there are none.
    - `y`: as for `section`, a component or a function ``(q, p)``; the label if `crossings` are
      numbers.
    - `skip`: crossings at the beginning of each run that are left out, until it has settled.
    - `log`: a logarithmic axis of the parameter. `size`: of a point, in points across; `units`: of
      "q" and "p". `ax`: where to draw.

    **Returns** the `Axes`.

    **Raises** `ValueError` for shapes that do not fit, and for a parameter without a place on a
    logarithmic axis.
    """
    parameter = np.asarray(parameter, float)
    numbers = np.asarray(crossings) if _is_numeric(crossings) else None
    if numbers is not None:
        values = numbers.astype(float)
        label = "" if y == "q[-1]" else y if isinstance(y, str) else ""
        notes: list[Any] = []
    else:
        points = _points_of(crossings, "bifurcation")
        get, label = component(y, points.shape, units or {}, "bifurcation")
        values = np.where(points.there, points.along(get), np.nan)
        notes = _notes(points)
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
        axis.scatter(x[there], values[there], color="#000000", **_dots(int(there.sum()), size))
        if log:
            axis.set_xscale("log")
        silent = int(np.sum(~there.any(1)))
        if silent:
            text = f"{silent} of {len(values)} runs have no crossing"
            text += f" after the first {skip}" if skip else ""
            notes = [n for n in notes if "did not cross" not in n.get_label()]
            notes.append(Line2D([], [], linestyle="none", label=text))
            axis.plot(
                parameter[~there.any(1)], np.full(silent, 0.015), "|", color="#777777",
                markersize=6, transform=axis.get_xaxis_transform(),
            )  # fmt: skip
    else:
        _say_empty(axis)
    legend(axis, new, notes)
    return axis


def _is_numeric(x: Any) -> bool:
    return (
        not hasattr(x, "qs") and not isinstance(x, Mapping | tuple) and not hasattr(x, "observed")
    )
