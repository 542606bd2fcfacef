"""Pictures of frequencies: lines of a spectrum, maps of fundamental frequencies."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Patch

from .axes import canvas, cell_edges, cells, check_labels, counted, interval, legend
from .states import looks_of
from .style import COLOURS, DASHES, GREY, HATCH, MARKERS, PALE, SHADES, in_style, named, signed

_PERCENTILES = (2, 98)
"""Range of the colours, so that a few extreme values do not determine it."""


@in_style
def spectrum(
    frequencies: Any,
    amplitudes: Any = None,
    fundamental: Mapping[str, float] | None = None,
    log: bool = True,
    labels: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Lines of a spectrum: sizes of amplitudes at their frequencies.

    - `frequencies`: shape (count,), or (signals, count) such as one for each degree of freedom;
      with `amplitudes`, real or complex, of the same shape; or what has both as attributes.
    - `fundamental`: name → frequency, marked over the whole height.
    - `log`: a logarithmic axis of amplitudes. `labels`: one name for each signal.
    - `units`: of "frequency" and "amplitude". `ax`: where to draw.

    Lines that are not finite, or have no amplitude to draw, are counted in the legend.

    **Returns** the `Axes`.

    **Raises** `TypeError` without amplitudes, `ValueError` for shapes that do not fit.
    """
    if amplitudes is None:
        if not hasattr(frequencies, "frequencies") or not hasattr(frequencies, "amplitudes"):
            raise TypeError("spectrum takes frequencies and amplitudes, or what has both.")
        frequencies, amplitudes = frequencies.frequencies, frequencies.amplitudes
    w, A = np.asarray(frequencies), np.abs(np.asarray(amplitudes))
    if w.shape != A.shape or w.ndim == 0 or w.size == 0 or w.dtype.kind not in "iuf":
        raise ValueError(
            f"spectrum takes real frequencies and amplitudes of one shape (count,) or (signals, "
            f"count), got {w.shape} of {w.dtype} and {A.shape}."
        )
    w, A = w.reshape(-1, w.shape[-1]), A.reshape(-1, A.shape[-1])
    check_labels(labels, len(w), "signals")
    looks, units = looks_of(len(w)), units or {}
    there = np.isfinite(w) & np.isfinite(A) & ((A > 0) | (not log))
    axis, new = canvas(ax)
    least = A[there].min() if there.any() else 1.0
    floor = least / 3 if log else 0.0
    for i, (x, y, good) in enumerate(zip(w, A, there, strict=True)):
        look = {"color": looks.colours[i], "label": None if labels is None else str(labels[i])}
        axis.vlines(x[good], floor, y[good], color=looks.colours[i], linewidth=1.3)
        axis.plot(x[good], y[good], MARKERS[i % len(MARKERS)], **look)
    if log:
        axis.set_yscale("log")
    if there.any():
        axis.set_ylim(bottom=floor)
    for (name, at), dash in zip((fundamental or {}).items(), itertools.cycle(DASHES[1:])):
        axis.axvline(at, color=GREY, linewidth=1, linestyle=dash, label=name, zorder=0.8)
    axis.set(xlabel=named("frequency", units.get("frequency", "rad per unit of time")))
    axis.set(ylabel=named("amplitude", units.get("amplitude")), title=title)
    lost = f"of {there.size} lines have no frequency or amplitude"
    legend(axis, new, counted({lost: np.sum(~there)}))
    return axis


@in_style
def frequency_map(
    x: Any,
    y: Any,
    diffusion: Any = None,
    resonances: Sequence[tuple[int, int]] = (),
    limits: tuple[float, float] | None = None,
    names: tuple[str, str] | None = None,
    diffusion_label: str = "log₁₀ |Δω/ω|",
    title: str = "",
    ax: Any = None,
) -> Any:
    """Fundamental frequencies against each other, or how fast they change over a plane of starts.

    - `x`, `y`: of each orbit, any one shape: two frequencies, drawn as points; or, with `diffusion`
      of shape (len(x), len(y)), the coordinates of a grid of starts, drawn as cells.
    - `diffusion`: log₁₀ of the relative change of a frequency from one window to the next (Laskar
      1993), as colours; low is regular. NaN is hatched or grey, and counted in the legend.
    - `resonances`: (k₁, k₂) of lines k₁x + k₂y = 0, of frequencies against each other.
    - `limits`: (low, high) of the colours; None: from the 2nd to the 98th percentile.
    - `names`: labels of x and y; None: ω₁ and ω₂, of a plane of starts x and y. `ax`: where to
      draw.

    **Returns** the `Axes`.

    **Raises** `ValueError` for shapes that do not fit, for a resonance (0, 0), and for resonances
    over a plane of starts, whose coordinates are no frequencies.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    D = None if diffusion is None else np.asarray(diffusion, float)
    on_grid = D is not None and x.ndim == y.ndim == 1 and D.shape == (len(x), len(y))
    if not on_grid and (x.shape != y.shape or (D is not None and D.shape != x.shape)):
        shape = "" if D is None else f" and diffusion of shape {D.shape}"
        raise ValueError(
            "frequency_map takes x, y and diffusion of one shape, or diffusion of shape (len(x), "
            f"len(y)): got x of shape {x.shape}, y of shape {y.shape}{shape}."
        )
    if on_grid and len(resonances):
        raise ValueError(
            "a resonance is a line among frequencies, and x and y are coordinates of starts here: "
            "leave out resonances, or give the frequencies of each start, x and y of shape "
            f"{(len(x), len(y))}."
        )
    axis, new = canvas(ax, (6.0, 4.8))
    if on_grid:
        assert D is not None
        drawn, extra = _draw_plane(axis, x, y, D, limits)
    else:
        drawn, extra = _draw_points(axis, x, y, D, limits)
    if drawn is not None:
        axis.figure.colorbar(drawn[0], ax=axis, label=diffusion_label, extend=drawn[1])
    _draw_resonances(axis, resonances)
    names = names or (("x", "y") if on_grid else ("ω$_1$", "ω$_2$"))
    axis.set(xlabel=names[0], ylabel=names[1], title=title)
    legend(axis, new, extra)
    return axis


def _draw_plane(
    axis: Any, x: np.ndarray, y: np.ndarray, D: np.ndarray, limits: Any
) -> tuple[Any, list[Any]]:
    """Cells over a plane of initial conditions; ((cells, ends of the bar), legend entries)."""
    for name, values in (("x", x), ("y", y)):
        if not (np.diff(values) > 0).all() or not np.isfinite(values).all():
            raise ValueError(f"the coordinates {name} of a grid of starts must rise.")
    low, high, beyond = interval(D, limits, _PERCENTILES)
    mesh = cells(axis, cell_edges(x), cell_edges(y), D.T, Normalize(low, high), SHADES)
    texts = counted({f"of {D.size} starts without a value": np.sum(~np.isfinite(D))})
    return (mesh, beyond), [Patch(label=text, **HATCH) for text in texts]


def _draw_points(
    axis: Any, x: np.ndarray, y: np.ndarray, D: np.ndarray | None, limits: Any
) -> tuple[Any, list[Any]]:
    """A point for each orbit; ((points, ends of the bar) or None, legend entries)."""
    there = np.isfinite(x) & np.isfinite(y)
    count = int(there.sum())
    size = float(np.clip(3000 / max(count, 1), 2, 16))
    look: Any = {"s": size, "linewidths": 0, "rasterized": count > 3000}
    drawn = None
    if D is None:
        axis.scatter(x[there], y[there], color=COLOURS[0], **look)
    else:
        known, grey = there & np.isfinite(D), there & ~np.isfinite(D)
        low, high, beyond = interval(D[there], limits, _PERCENTILES)
        norm = Normalize(low, high)
        drawn = axis.scatter(x[known], y[known], c=D[known], norm=norm, cmap=SHADES, **look), beyond
        if grey.any():
            label = f"{grey.sum()} orbits without a diffusion"
            axis.scatter(x[grey], y[grey], color=PALE, label=label, **look)
    return drawn, counted({f"of {there.size} orbits have no frequencies": np.sum(~there)})


def _draw_resonances(axis: Any, resonances: Sequence[tuple[int, int]]) -> None:
    limits = axis.get_xlim(), axis.get_ylim()
    for k in resonances:
        if tuple(k) == (0, 0) or len(k) != 2:
            raise ValueError(f"a resonance is two integers that are not both 0, got {k!r}.")
        a, b = k
        # Through the origin, along (b, −a).
        axis.axline((0, 0), (b, -a), color=GREY, linewidth=0.8, linestyle="--", zorder=0.9)
        _name_resonance(axis, (a, b), limits)
    axis.set(xlim=limits[0], ylim=limits[1])


def _name_resonance(axis: Any, k: tuple[int, int], limits: Any) -> None:
    """Its numbers where the line leaves the picture: at the top or at the right, else inside of the
    left, without which are numbers of the axis. It leaves at two edges, so that is all."""
    (left, right), (low, high) = limits
    a, b = k

    def crossed(level: float, slope: tuple[int, int], within: tuple[float, float]) -> float | None:
        at = -slope[1] * level / slope[0] if slope[0] else None
        return at if at is not None and min(within) <= at <= max(within) else None

    top = crossed(high, (a, b), (left, right))
    at_right, at_left = (crossed(x, (b, a), (low, high)) for x in (right, left))
    if top is not None:
        place, how, off = (top, high), {"ha": "center", "va": "bottom"}, (0, 2)
    elif at_right is not None:
        place, how, off = (right, at_right), {"ha": "left", "va": "center"}, (2, 0)
    elif at_left is not None:
        place, how, off = (left, at_left), {"ha": "left", "va": "center"}, (3, 0)
    else:
        return
    look = {"fontsize": 8, "color": "#555555", "annotation_clip": False} | how
    name = f"({signed(a)}, {signed(b)})"
    axis.annotate(name, place, xytext=off, textcoords="offset points", **look)
