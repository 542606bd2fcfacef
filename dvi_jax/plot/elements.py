"""Pictures of orbital elements along time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.checks import instance, one_of
from ..problem import elements as kinds
from .axes import check_shapes, counts_text, labels_of, legend, stack
from .series import draw_series
from .states import looks_of
from .style import SMALL, in_style, look_of, with_unit

SYMBOLS = {
    **{"inc": "i", "Omega": "Ω", "omega": "ω", "Lambda": "Λ", "xi": "ξ", "eta": "η"},
    **{"ex": "e cos ϖ", "ey": "e sin ϖ", "hx": "tan(i/2) cos Ω", "hy": "tan(i/2) sin Ω"},
    "longitude": "λ",
}
"""Name of an element → its symbol, where it is not the name; λ is ϖ + f or ϖ + M."""

_ANGLES = ("Omega", "omega", "M", "longitude")
_KINDS = (
    *(kinds.Keplerian, kinds.Equinoctial, kinds.ModifiedEquinoctial),
    *(kinds.Delaunay, kinds.Poincare),
)


@in_style
def elements(ts: Any, orbits: Any, names: Sequence[str] | None = None, **options: Any) -> Any:
    """Orbital elements against time, one panel above another; angles in degrees, without jumps.

    - `ts`: times, shape (S,). `orbits`: elements, each of shape (S,) or (S, bodies), such as those
      of ``Solution.elements``; of an observable ``kind(*np.moveaxis(values, -1, 0))``.
    - `names`: of the elements; None: all but the last, which is the fast one, or for `Delaunay` and
      `Poincare` all.
    - `labels` of the bodies, `units` (of "t" and of elements), `title`, `ax`: as for all plots.

    A panel reports how many of its values are not finite. **Returns** the `Axes`, shape
    (elements,).

    **Raises** `TypeError` for elements of no kind, `ValueError` for an unknown name and for shapes
    that do not fit.
    """
    look = look_of(options, "colour", "colour_label")
    instance("orbits", orbits, _KINDS, "elements, such as dvi.elements.Keplerian")
    fields = list(orbits._fields)
    all_but_fast = fields if fields[-1] in ("H", "p") else fields[:-1]
    names = [one_of("each of names", x, fields) for x in (all_but_fast if names is None else names)]
    ts = np.asarray(ts, float)
    columns = {name: np.asarray(getattr(orbits, name), float) for name in names}
    columns = {name: x[:, None] if x.ndim == 1 else x for name, x in columns.items()}
    fits = all(x.ndim == 2 and x.shape[:1] == ts.shape for x in columns.values())
    check_shapes(fits, "elements must have shape (S,) or (S, bodies), ts (S,)", ts=ts, **columns)
    count = max(x.shape[1] for x in columns.values())
    labels, looks = labels_of(look.labels, count, "bodies"), looks_of(count)
    size = (6.4, 1.2 + 1.35 * len(names))
    axes, new = stack(look.ax, len(names), "one for each element", size, sharex=True)
    for axis, (name, values) in zip(axes, columns.items(), strict=True):
        invalid = 0
        for k, column in enumerate(values.T):
            good = np.isfinite(column)
            angles = np.where(good, column, np.nan)
            if name in _ANGLES:
                angles[good] = np.unwrap(column[good])
            column = np.degrees(angles) if name in ("inc", *_ANGLES) else column
            label = labels[k] if axis is axes[0] else ""
            invalid += sum(draw_series(axis, ts, column, label, **looks.line(k, 1.1)).values())
        unit = "°" if name in ("inc", *_ANGLES) else look.units.get(name)
        axis.set_ylabel(with_unit(SYMBOLS.get(name, name), unit), fontsize=9)
        for text in counts_text({f"of {values.size} are not finite": invalid}):
            where = {"ha": "right", "va": "top", "transform": axis.transAxes}
            axis.text(0.99, 0.95, text, **SMALL, **where)
    axes[0].set_title(look.title)
    axes[-1].set_xlabel(with_unit("time t", look.units.get("t")))
    axes[0].figure.align_ylabels(axes)
    legend(axes[0], new)
    return np.asarray(axes)
