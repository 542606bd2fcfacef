"""Pictures of frequencies: lines of a spectrum, maps of fundamental frequencies."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Patch

from . import axes as draw
from .axes import canvas, check_shapes, counts_text, labels_of, legend
from .states import looks_of
from .style import COLOURS, DASHES, GREY, MARKERS, SMALL, in_style, sign_text, with_unit

_RANGE = (2, 98)
"""Percentiles at the ends of the colours, so that a few extreme values do not determine them."""


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
      with `amplitudes`, real or complex, of the same shape; or an object with both as attributes.
    - `fundamental`: name → frequency, marked over the whole height.
    - `log`: a logarithmic axis of amplitudes. `labels`: one name for each signal.
    - `units`: of "frequency" and "amplitude". `ax`: where to draw.

    Lines that are not finite, or have no amplitude to draw, are counted in the legend.

    **Returns** the `Axes`. **Raises** `TypeError` without amplitudes, `ValueError` for shapes that
    do not fit.
    """
    if amplitudes is None:
        rule = "amplitudes must be given, or frequencies must be an object that has both"
        draw.check_attributes(frequencies, ("frequencies", "amplitudes"), rule)
        frequencies, amplitudes = frequencies.frequencies, frequencies.amplitudes
    w, A = np.asarray(frequencies), np.abs(np.asarray(amplitudes))
    rule = f"frequencies ({w.dtype}) must be real, of the same shape (..., count) as amplitudes"
    fits = w.shape == A.shape and w.ndim and w.size and w.dtype.kind in "iuf"
    check_shapes(fits, rule, frequencies=w, amplitudes=A)
    w, A = w.reshape(-1, w.shape[-1]), A.reshape(-1, A.shape[-1])
    names, colours = labels_of(labels, len(w), "signals"), looks_of(len(w)).colours
    units, markers = units or {}, itertools.cycle(MARKERS)
    valid = np.isfinite(w) & np.isfinite(A) & ((A > 0) | (not log))
    axis, new = canvas(ax)
    floor = A[valid].min() / 3 if log and valid.any() else 0.0
    rows = zip(w, A, valid, colours, markers, names, strict=False)
    for x, y, good, colour, marker, name in rows:
        axis.vlines(x[good], floor, y[good], color=colour, lw=1.3)
        axis.plot(x[good], y[good], marker, color=colour, label=name or None)
    if log:
        axis.set_yscale("log")
    if valid.any():
        axis.set_ylim(bottom=floor)
    for (name, frequency), dash in zip((fundamental or {}).items(), itertools.cycle(DASHES[1:])):
        axis.axvline(frequency, color=GREY, lw=1, ls=dash, label=name, zorder=0.8)
    axis.set(xlabel=with_unit("frequency", units.get("frequency", "rad per unit of time")))
    axis.set(ylabel=with_unit("amplitude", units.get("amplitude")), title=title)
    cause = f"of {valid.size} lines have no frequency or amplitude"
    legend(axis, new, counts_text({cause: np.sum(~valid)}))
    return axis


@in_style
def frequency_map(
    x: Any,
    y: Any,
    diffusion: Any = None,
    resonances: Sequence[tuple[int, ...]] = (),
    limits: tuple[float, float] | None = None,
    names: tuple[str, str] | None = None,
    diffusion_label: str = "log₁₀ |Δω/ω|",
    title: str = "",
    ax: Any = None,
) -> Any:
    """Fundamental frequencies against each other, or their rate of change over initial conditions.

    - `x`, `y`: of each orbit, any one shape: two frequencies, drawn as points; or, with `diffusion`
      of shape (len(x), len(y)), the coordinates of a grid of initial conditions, drawn as cells.
    - `diffusion`: log₁₀ of the relative change of a frequency from one window to the next (Laskar
      1993), as colours; low is regular. NaN is hatched or grey, and counted in the legend.
    - `resonances`: (k₁, k₂) of lines k₁x + k₂y = 0, of frequencies against each other; (k₁, k₂, k)
      of lines k₁x + k₂y = k, of tunes.
    - `limits`: (low, high) of the colours; None: from the 2nd to the 98th percentile.
    - `names`: labels of x and y; None: ω₁ and ω₂, of a grid x and y. `ax`: where to draw.

    **Returns** the `Axes`. **Raises** `ValueError` for shapes that do not fit, for a resonance (0,
    0), and for resonances over a grid of initial conditions, whose coordinates are not frequencies.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    D = None if diffusion is None else np.asarray(diffusion, float)
    arrays = {"x": x, "y": y} | ({} if D is None else {"diffusion": D})
    on_grid = D is not None and x.ndim == y.ndim == 1 and D.shape == (len(x), len(y))
    rule = "x, y and diffusion must have one shape, or diffusion the shape (len(x), len(y))"
    check_shapes(on_grid or len({a.shape for a in arrays.values()}) == 1, rule, **arrays)
    if on_grid and len(resonances):
        raise ValueError(
            "resonances require frequencies as x and y, of the shape of diffusion, got a grid of "
            f"initial conditions of shape {(len(x), len(y))}."
        )
    axis, new = canvas(ax, (6.0, 4.8))
    numbers = D if on_grid or D is None else D[np.isfinite(x) & np.isfinite(y)]
    norm, ends = (None, "") if numbers is None else draw.scale_of(numbers, limits, False, _RANGE)
    artist, extra = (_draw_plane if on_grid else _draw_points)(axis, x, y, D, norm)
    if D is not None:
        axis.figure.colorbar(artist, ax=axis, label=diffusion_label, extend=ends)
    _draw_resonances(axis, resonances)
    names = names or (("x", "y") if on_grid else ("ω$_1$", "ω$_2$"))
    axis.set(xlabel=names[0], ylabel=names[1], title=title)
    legend(axis, new, extra)
    return axis


def _draw_plane(axis: Any, x: Any, y: Any, D: Any, norm: Any) -> tuple[Any, list[Any]]:
    """(cells over a grid of initial conditions, legend entries)."""
    for name, values in (("x", x), ("y", y)):
        wrong = ~np.isfinite(values) | ~(np.diff(values, prepend=-np.inf) > 0)
        if wrong.any():
            i = int(np.argmax(wrong))
            raise ValueError(
                f"{name} of a grid must be increasing and finite, got {name}[{i}] = {values[i]}"
                + (f" after {values[i - 1]}." if i else ".")
            )
    mesh = draw.cells(axis, draw.cell_edges(x), draw.cell_edges(y), D.T, norm, draw.SHADES)
    texts = counts_text({f"of {D.size} orbits have no value": np.sum(~np.isfinite(D))})
    return mesh, [Patch(label=text, **draw.HATCH) for text in texts]


def _draw_points(axis: Any, x: Any, y: Any, D: Any, norm: Any) -> tuple[Any, list[Any]]:
    """(a point for each orbit, legend entries)."""
    valid = np.isfinite(x) & np.isfinite(y)
    has_value = valid if D is None else valid & np.isfinite(D)
    grey, count = valid & ~has_value, int(valid.sum())
    look: Any = {"s": float(np.clip(3000 / max(count, 1), 2, 16)), "linewidths": 0}
    look["rasterized"] = count > 3000
    shades = {} if D is None else {"c": D[has_value], "norm": norm, "cmap": draw.SHADES}
    artist = axis.scatter(x[has_value], y[has_value], **shades or {"color": COLOURS[0]}, **look)
    if grey.any():
        label = f"{grey.sum()} orbits without a diffusion"
        axis.scatter(x[grey], y[grey], color=draw.PALE, label=label, **look)
    return artist, counts_text({f"of {valid.size} orbits have no frequencies": np.sum(~valid)})


def _draw_resonances(axis: Any, resonances: Sequence[tuple[int, ...]]) -> None:
    """Lines ax + by = c with their numbers where they leave the picture.

    That is at the top or at the right, else inside of the left, as the numbers of the axis are
    outside. A line leaves at two edges, so that one of the three is among them.
    """
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    axis.autoscale(False)
    for k in resonances:
        if len(k) not in (2, 3) or tuple(k[:2]) == (0, 0):
            raise ValueError(
                f"resonances must be (k1, k2) or (k1, k2, k), k1 and k2 not both 0, got {k!r}."
            )
        a, b, c = (*k, 0)[:3]
        x, y = (i * c / (a * a + b * b) for i in (a, b))
        axis.axline((x, y), (x + b, y - a), color=GREY, lw=0.8, ls="--", zorder=0.9)
        places = [(((c - b * high) / a, high), "center", "bottom", (0, 2))] if a else []
        if b:
            places += [((right, (c - a * right) / b), "left", "center", (2, 0))]
            places += [((left, (c - a * left) / b), "left", "center", (3, 0))]
        for (at_x, at_y), horizontal, vertical, offset in places:
            if not (left <= at_x <= right or right <= at_x <= left):
                continue
            if low <= at_y <= high or high <= at_y <= low:
                look = SMALL | {"ha": horizontal, "va": vertical, "textcoords": "offset points"}
                look["rotation"] = 90 if vertical == "bottom" and len(k) == 3 else 0
                text = f"({', '.join(map(sign_text, k))})"
                axis.annotate(text, (at_x, at_y), xytext=offset, annotation_clip=False, **look)
                break
