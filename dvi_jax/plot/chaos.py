"""Pictures of indicators of chaos along time."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._checks import one_of
from .axes import canvas, check_shapes, counted, guide, labels_of, legend
from .series import draw_series
from .states import looks_of
from .style import GREY, in_style, named, signed


class _Kind(NamedTuple):
    """How an indicator is drawn: its name, scales, and what regular motion shows."""

    label: str
    xlog: bool
    ylog: bool
    level: float | None = None
    slope: float | None = None


_KINDS: dict[str | None, _Kind] = {
    None: _Kind("indicator", False, False),
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
    """An indicator of chaos against time, with its reference for regular motion.

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
    about, units = _KINDS[one_of("kind", kind, _KINDS)], units or {}
    if slope is not None:
        about = about._replace(xlog=True, ylog=True, slope=slope)
    lines, names = _lines_of(ts, values)
    names = labels_of(labels or names or None, len(lines), "lines")
    looks = looks_of(len(lines), colour)
    axis, new = canvas(ax)
    lost: Counter[str] = Counter()
    drawn, shifted = [], False
    for i, (t, v, start) in enumerate(lines):
        start = start if t0 is None else float(t0)
        shifted |= about.xlog and (start != 0 or bool((t < 0).any()))
        t = np.abs(t - start) if about.xlog else t
        at_start = (t == 0) & np.isfinite(v) & about.xlog
        t, v = t[~at_start], v[~at_start]
        v = np.where(np.isfinite(t), v, np.nan)
        counts = draw_series(axis, t, v, names[i], about.ylog, **looks.line(i, 1.2))
        lost["are no numbers"] += counts["are no numbers"]
        lost["at the start, t = t$_0$"] += int(at_start.sum())
        lost["are not positive"] += counts.get("are exactly 0", 0) + counts.get("are below 0", 0)
        drawn.append((t, v))
    axis.set(xscale="log" if about.xlog else "linear", yscale="log" if about.ylog else "linear")
    if about.level is not None:
        look = {"color": GREY, "linewidth": 1, "linestyle": "--"}
        axis.axhline(about.level, label=f"regular: {about.level:g}", **look)
    if about.slope is not None:
        _guide(axis, drawn, about.slope)
    time = "time since the start |t − t$_0$|" if shifted else "time t"
    axis.set(xlabel=named(time, units.get("t")), ylabel=named(about.label, units.get("value")))
    axis.set_title(title)
    looks.colour_bar([axis], colour_label)
    notes = counted({f"values {text}": n for text, n in lost.items()})
    legend(axis, new, [*looks.entries(), *notes])
    return axis


def _lines_of(ts: Any, values: Any) -> tuple[list[tuple[np.ndarray, np.ndarray, float]], list[str]]:
    """(times, numbers, start) of every line, and their names if they have any.

    The start is the time before the values where `ts` have one more than there are values, else 0.
    """
    if isinstance(values, Mapping):
        found = {name: _lines_of(ts, v)[0] for name, v in values.items()}
        names = [
            name if len(some) == 1 else f"{name} {i}"
            for name, some in found.items()
            for i in range(1, len(some) + 1)
        ]
        return [line for some in found.values() for line in some], names
    t, v = np.asarray(getattr(ts, "ts", ts)), np.asarray(values)
    n, several = t.shape[-1] if t.ndim else 0, t.ndim > 1
    numbers = v.dtype.kind in "iuf" and v.ndim and n and v.shape[-1] in (n, n - 1)
    fits = numbers and not (several and t.shape[:-1] != v.shape[: t.ndim - 1])
    wanted = (
        f"an indicator has one number for each time or step, shape (..., {n}) or (..., {n - 1})"
    )
    check_shapes(fits, wanted, ts=t, values=v)
    start = t[..., 0] if n > v.shape[-1] else np.zeros(t.shape[:-1])
    t = t[..., n - v.shape[-1] :]
    if several:
        inner = (1,) * (v.ndim - t.ndim)
        start, t = start.reshape(*start.shape, *inner), t.reshape(*t.shape[:-1], *inner, -1)
    start = np.broadcast_to(start, v.shape[:-1]).ravel().tolist()
    rows = (x.reshape(-1, v.shape[-1]) for x in (np.broadcast_to(t, v.shape), v))
    return list(zip(*rows, start, strict=True)), []


def _guide(axis: Any, lines: Sequence[tuple[np.ndarray, np.ndarray]], slope: float) -> None:
    """A line of a slope over all times, through the largest of the first values."""
    positive = [(t, v, (t > 0) & (v > 0) & np.isfinite(v)) for t, v in lines]
    good = [(t[here], v[here]) for t, v, here in positive if here.any()]
    if good:
        value, first = max((v[0], t[0]) for t, v in good)
        last = max(t[-1] for t, _ in good)
        guide(axis, (first, last), value, slope, label=f"slope {signed(slope)}")
