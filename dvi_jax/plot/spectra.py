"""Pictures of frequencies: lines of a spectrum, maps of fundamental frequencies."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patches import Patch

from .house import (
    COLOURS,
    DASHES,
    GREY,
    HATCH,
    MARKERS,
    SHADES,
    canvas,
    cell_edges,
    in_style,
    legend,
    named,
    note,
    signed,
)
from .states import looks_of


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
    if labels is not None and len(labels) != len(w):
        raise ValueError(f"labels has {len(labels)} names for {len(w)} signals.")
    looks, units = looks_of(len(w)), units or {}
    there = np.isfinite(w) & np.isfinite(A) & ((A > 0) | (not log))
    axis, new = canvas(ax)
    least = A[there].min() if there.any() else 1.0
    floor = least / 3 if log else 0.0
    for i, (x, y, good) in enumerate(zip(w, A, there, strict=True)):
        axis.vlines(x[good], floor, y[good], color=looks.colours[i], linewidth=1.3)
        axis.plot(x[good], y[good], MARKERS[i % len(MARKERS)], color=looks.colours[i],
                  label=None if labels is None else str(labels[i]))  # fmt: skip
    if log:
        axis.set_yscale("log")
    if there.any():
        axis.set_ylim(bottom=floor)
    for i, (name, at) in enumerate((fundamental or {}).items()):
        axis.axvline(at, color=GREY, linewidth=1, linestyle=DASHES[1 + i % (len(DASHES) - 1)],
                     label=name, zorder=0.8)  # fmt: skip
    axis.set(xlabel=named("frequency", units.get("frequency", "rad per unit of time")))
    axis.set(ylabel=named("amplitude", units.get("amplitude")), title=title)
    handles = axis.get_legend_handles_labels()[0]
    if not there.all():
        text = f"{np.sum(~there)} of {there.size} lines have no frequency or amplitude"
        handles.append(note(text))
    legend(axis, new, handles)
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
    on_grid = D is not None and D.ndim == 2 and x.ndim == y.ndim == 1 and (
        D.shape == (len(x), len(y))
    )  # fmt: skip
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
    handles: list[Any] = []
    if on_grid:
        assert D is not None
        _draw_plane(axis, x, y, D, limits, diffusion_label, handles)
    else:
        _draw_points(axis, x, y, D, limits, diffusion_label, handles)
    _draw_resonances(axis, resonances)
    names = names or (("x", "y") if on_grid else ("ω$_1$", "ω$_2$"))
    axis.set(xlabel=names[0], ylabel=names[1])
    axis.set_title(title)
    legend(axis, new, axis.get_legend_handles_labels()[0] + handles)
    return axis


def _norm(D: np.ndarray, limits: tuple[float, float] | None) -> tuple[Normalize, str]:
    """The scale of colours, and at which ends numbers lie beyond it."""
    known = D[np.isfinite(D)]
    if limits is None:
        low, high = np.percentile(known, [2, 98]) if known.size else (0.0, 1.0)
    else:
        low, high = (float(v) for v in limits)
    if high <= low:
        low, high = low - 0.5, high + 0.5
    below, above = bool((known < low).any()), bool((known > high).any())
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    return Normalize(low, high), extend[int(below), int(above)]


def _draw_plane(
    axis: Any, x: np.ndarray, y: np.ndarray, D: np.ndarray, limits: Any, label: str, handles: list
) -> None:
    for name, values in (("x", x), ("y", y)):
        if not (np.diff(values) > 0).all() or not np.isfinite(values).all():
            raise ValueError(f"the coordinates {name} of a grid of starts must rise.")
    norm, extend = _norm(D, limits)
    axis.grid(False)
    axis.patch.set(**HATCH)
    mesh = axis.pcolormesh(cell_edges(x), cell_edges(y), np.ma.masked_invalid(D.T), norm=norm,
                           cmap=SHADES, rasterized=True)  # fmt: skip
    axis.figure.colorbar(mesh, ax=axis, label=label, extend=extend)
    lost = int(np.sum(~np.isfinite(D)))
    if lost:
        handles.append(Patch(label=f"{lost} of {D.size} starts without a value", **HATCH))


def _draw_points(
    axis: Any, x: np.ndarray, y: np.ndarray, D: np.ndarray | None, limits: Any, label: str,
    handles: list,
) -> None:  # fmt: skip
    there = np.isfinite(x) & np.isfinite(y)
    count = int(there.sum())
    look: Any = {"s": float(np.clip(3000 / max(count, 1), 2, 16)), "linewidths": 0,
                 "rasterized": count > 3000}  # fmt: skip
    if D is None:
        axis.scatter(x[there], y[there], color=COLOURS[0], **look)
    else:
        known = there & np.isfinite(D)
        norm, extend = _norm(D[there], limits)
        drawn = axis.scatter(x[known], y[known], c=D[known], norm=norm, cmap=SHADES, **look)
        axis.figure.colorbar(drawn, ax=axis, label=label, extend=extend)
        grey = there & ~np.isfinite(D)
        if grey.any():
            axis.scatter(x[grey], y[grey], c=np.zeros(grey.sum()), cmap=ListedColormap(["#b8b8b8"]),
                         label=f"{grey.sum()} orbits without a diffusion", **look)  # fmt: skip
    lost = int(np.sum(~there))
    if lost:
        text = f"{lost} of {there.size} orbits have no frequencies"
        handles.append(note(text))


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
    axis.annotate(f"({signed(a)}, {signed(b)})", place, fontsize=8, color="#555555",
                  xytext=off, textcoords="offset points", annotation_clip=False,
                  **how)  # fmt: skip
