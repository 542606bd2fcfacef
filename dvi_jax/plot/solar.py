"""Pictures of the solar system and of its comparison with an ephemeris."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from .axes import check_shapes, legend, stack
from .style import COLOURS, MARKERS, STAR, in_style


@in_style
def planet_orbits(positions: Any, names: Sequence[str], ax: Any = None) -> Any:
    """Heliocentric orbits projected onto the ecliptic [au]: the inner planets, and the others.

    - `positions`: shape (times, planets, 3); `names` of the planets. `ax`: two `Axes`.

    **Returns** the `Axes`, shape (2,).
    """
    positions = np.asarray(positions)
    rule = f"positions must have shape (times, {len(names)}, 3), a planet for each of names"
    fits = positions.ndim == 3 and positions.shape[1:] == (len(names), 3)
    check_shapes(fits, rule, positions=positions)
    axes, new = stack(ax, 2, "inner and outer planets", (9.6, 5.4), ncols=2)
    groups = range(len(names))[:4], range(len(names))[4:]
    mark: Any = {"ms": 7, "mec": "black", "mew": 0.7}
    for axis, group, title in zip(axes, groups, ("Inner planets", "Outer planets"), strict=True):
        for i, colour, marker in zip(group, itertools.cycle(COLOURS), MARKERS, strict=False):
            x, y = positions[:, i, 0], positions[:, i, 1]
            axis.plot(x, y, ".", ms=1, color=colour, alpha=0.35, rasterized=True)
            axis.plot(x[:1], y[:1], marker, color=colour, label=names[i], **mark)
        axis.plot(0, 0, **STAR)
        axis.set(xlabel="x [au]", ylabel="y [au]", title=title)
        axis.set_aspect("equal", adjustable="datalim")
        if new:  # a legend for each, below it
            axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, handletextpad=0.2)
        else:
            legend(axis, new)
    if new:
        heading = "Heliocentric orbits on the ecliptic of J2000; marks: positions at the start"
        axes[0].figure.suptitle(heading, fontsize=10)
    return np.asarray(axes)


@in_style
def ephemeris_comparison(
    years: Any,
    errors: Any,
    names: Sequence[str],
    perihelion: Any,
    slope: float,
    intercept: float,
    ax: Any = None,
) -> Any:
    """Position errors of the planets, and Mercury's perihelion, relative to an ephemeris.

    - `years`: since the start, shape (T,). `errors`: [km], shape (T, planets).
    - `perihelion`: ephemeris minus integration [″], shape (T,); `slope` [″/century] and
      `intercept` [″] of its fitted line.
    - `ax`: three `Axes`: of the errors, of the perihelion, of its residual.

    **Returns** the `Axes`, shape (3,).
    """
    years, errors, perihelion = np.asarray(years), np.asarray(errors), np.asarray(perihelion)
    places, purpose = [[0, 1], [0, 2]], "for the errors, the perihelion and its residual"
    axes, new = stack(ax, places, purpose, (10.4, 5.2), height_ratios=(3, 1))
    left, right, bottom = axes
    if new:
        bottom.sharex(right)
    for i, name in enumerate(names):
        # The largest value of each of about a hundred pieces is a readable line.
        pieces = 100 if len(years) > 200 else len(years) - 1
        parts = np.array_split(np.arange(1, len(years)), pieces)
        x, y = years[[part[-1] for part in parts]], [errors[part, i].max() for part in parts]
        look: Any = {"color": COLOURS[i % len(COLOURS)], "lw": 1.3, "marker": MARKERS[i]}
        look |= {"ls": "-" if i < len(COLOURS) else "--"}
        left.semilogy(x, y, markevery=(i * 2 % 12, 12), label=name, **look)
    left.set(xlabel="years since the start", ylabel="distance from the ephemeris [km]")
    left.set_title("Heliocentric position, integration − DE421")
    if new:
        left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    else:
        legend(left, new)
    right.plot(years, perihelion, ".", color=COLOURS[0], ms=2, label="osculating orbits")
    line = intercept + slope * years / 100
    if np.isfinite(slope):
        look = {"color": COLOURS[1], "lw": 1.2, "ls": "--"}
        right.plot(years, line, label=f"line: {slope:.2f}″ per century", **look)
        bottom.plot(years, perihelion - line, color=COLOURS[0], lw=0.5)
        bottom.axhline(0, **look)
    right.set_title("Mercury's perihelion, DE421 − integration")
    right.set_ylabel("ϖ(DE421) − ϖ(integration) [″]")
    right.legend(loc="best", markerscale=3)
    right.tick_params(labelbottom=False)
    bottom.set(xlabel="years since the start", ylabel="residual [″]")
    left.figure.align_ylabels([right, bottom])
    return np.asarray(axes)
