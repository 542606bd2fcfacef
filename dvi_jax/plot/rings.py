"""Pictures of storage rings: Twiss functions with the magnets below, maps of tunes."""

import itertools
from typing import Any

import numpy as np

from ..base.checks import known
from .axes import check_attributes, check_shapes, entry, legend, stack
from .spectra import frequency_map
from .style import COLOURS, DASHES, GREY, in_style

_KINDS = "bend", "quadrupole", "sextupole", "other multipole"
_BOXES = (COLOURS[4], 0.45), (COLOURS[5], 1.0), (COLOURS[3], 0.75), (GREY, 0.55)
_COLUMNS = ("h", *(f"b{n}" for n in range(1, 12)))


@in_style
def twiss(ring: Any, optics: Any, title: str = "", ax: Any = None) -> Any:
    """β functions and dispersion along a ring, with its magnets below.

    - `ring`: a `rings.Ring`. `optics`: result of `rings.optics` for it. `ax`: two `Axes`.

    Bends are boxes on the line, other magnets boxes above it if their field b_n is positive (a
    quadrupole then focuses in x), otherwise below it; skew ones are not drawn. Inside an element
    β is a cubic polynomial with the slopes −2α/(1 + δ) at both ends, exact in a paraxial drift.

    **Returns** the two `Axes`; the dispersion has a scale of its own on the right. **Raises**
    `ValueError` for the optics of another ring.
    """
    names = "s", "orbit", "beta", "alpha", "dispersion"
    check_attributes(optics, names, "optics must be the result of rings.optics")
    check_attributes(ring, ["columns"], "ring must be a rings.Ring")
    s, orbit, beta, alpha, D = (known(name, getattr(optics, name)) for name in names)
    check_shapes(len(s) == len(ring) + 1, "optics must be those of this ring", s=s)
    p = 1 + orbit[:, 5]
    layout, purpose = {"height_ratios": [5, 1], "sharex": True}, "for functions and for magnets"
    (upper, lower), new = stack(ax, [["functions"], ["magnets"]], purpose, (7.0, 4.4), **layout)
    right = upper.twinx()
    right.grid(False)
    lines = [(upper, f"β$_{'xy'[i]}$", beta[:, i], -2 * alpha[:, i] / p) for i in (0, 1)]
    lines += [(right, f"D$_{'xy'[i]}$", D[:, 2 * i], D[:, 2 * i + 1] / p) for i in (0, 1)]
    for (axis, label, *curve), c, dash in zip(lines, (0, 1, 2, 6), DASHES, strict=False):
        if c < 6 or np.abs(curve[0]).max() > 1e-9:  # else there is no vertical dispersion
            axis.plot(*_cubic(s, *curve), color=COLOURS[c], ls=dash, lw=1.4, label=label)
    upper.set(ylabel="β [m]", title=title, xlim=(s[0], s[-1]))
    right.set(ylabel="dispersion [m]")
    lower.grid(False)
    lower.axhline(0, color=GREY, lw=0.8)
    lower.set(xlabel="s [m]", ylim=(-1.2, 1.2), yticks=[])
    legend(upper, new, right.get_legend_handles_labels()[0] + _draw_magnets(lower, ring, s))
    return np.asarray([upper, lower], object)


def _cubic(s: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> list[np.ndarray]:
    """Points of the cubic polynomials between the places `s` (Hermite interpolation)."""
    t, L = np.linspace(0, 1, 17)[None], np.diff(s)[:, None]
    (a, b), (da, db) = ((x[:-1, None], x[1:, None]) for x in (values, slopes))
    cubic = a + (b - a) * t * t * (3 - 2 * t) + L * t * (1 - t) * (da * (1 - t) - db * t)
    return [(s[:-1, None] + L * t).ravel(), cubic.ravel()]


def _draw_magnets(axis: Any, ring: Any, s: np.ndarray) -> list[Any]:
    """Boxes of the magnets, by their kind or by the lowest multipole; legend entries."""
    h, *b = (np.asarray(ring.columns.get(name, 0 * s)) for name in _COLUMNS)
    groups = set()
    for i, kind in enumerate(ring.kinds):
        n = next((n for n in range(11) if b[n][i]), -1)
        n = {"quadrupole": 0, "sextupole": 1, "octupole": 2}.get(kind, n)
        if h[i] or n >= 0:
            groups.add(group := 0 if h[i] else min(n + 1, 3))
            colour, height = _BOXES[group]
            low, high = -height * (group == 0 or b[n][i] < 0), height * (group == 0 or b[n][i] >= 0)
            look = {"align": "edge", "color": colour, "edgecolor": GREY, "lw": 0.6}
            axis.bar(s[i], high - low, s[i + 1] - s[i], low, **look)
    return [entry(_KINDS[group], color=_BOXES[group][0], lw=6) for group in sorted(groups)]


@in_style
def tune_map(
    x: Any, y: Any, frequencies: Any, order: int = 4, title: str = "", ax: Any = None
) -> Any:
    """Diffusion of the tunes over initial conditions, and in the plane of the tunes.

    - `x`, `y`: initial conditions [m], as they were given to `rings.frequency_map`; those of
      ``np.meshgrid`` are drawn as cells, others as points. `frequencies`: its result.
    - `order`: of the resonances (m, n, k), m Q_x + n Q_y = k: \\|m\\| + \\|n\\|. `ax`: two `Axes`.

    **Returns** two `Axes`. **Raises** `ValueError` for shapes that do not fit.
    """
    D, Q = np.asarray(frequencies.diffusion), np.asarray(frequencies.tune)
    x, y = (np.asarray(a, float) * 1e3 for a in np.broadcast_arrays(x, y))
    rule = "x and y must have the shape of the diffusion"
    check_shapes(x.shape == D.shape, rule, x=x, diffusion=D)
    axes, _ = stack(ax, 2, "for initial conditions and for tunes", (10.0, 4.2), 2)
    is_grid = x.ndim == 2 and bool((x == x[:1]).all() and (y == y[:, :1]).all())
    data = (x[0], y[:, 0], D.T) if is_grid else (x, y, D)
    label, names = "log₁₀ |ΔQ|", ("Q$_x$", "Q$_y$")
    places = ("x [mm]", "y [mm]")
    frequency_map(*data, names=places, title=title, ax=axes[0], diffusion_label=label)
    lines = _resonances(Q[np.isfinite(D)], order)
    tunes = Q[..., 0], Q[..., 1]
    frequency_map(*tunes, D, lines, names=names, ax=axes[1], diffusion_label=label)
    axes[1].locator_params(axis="x", nbins=5)
    return np.asarray(axes, object)


def _resonances(Q: np.ndarray, order: int) -> list[tuple[int, ...]]:
    """(m, n, k) of the lines m Q_x + n Q_y = k that cross the box around the tunes, each once."""
    lines = []
    for m, n in itertools.product(range(order + 1), range(-order, order + 1)):
        if len(Q) and 0 < m + abs(n) <= order and (m or n > 0):
            low, high = np.sort([Q.min(0) * [m, n], Q.max(0) * [m, n]], axis=0).sum(1)
            ks = range(int(np.ceil(low)), int(np.floor(high)) + 1)
            lines += [(m, n, k) for k in ks if np.gcd.reduce([m, n, k]) == 1]
    return lines
