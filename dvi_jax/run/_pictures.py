"""Which pictures a run gets."""

from typing import Any

import numpy as np

from .. import plot
from ..systems.n_body import OBSERVABLES
from ..systems.solar_system import BODIES
from ._setup import Setup
from ._solar import Comparison
from ._watched import Watched


def draw(
    setup: Setup, ts: np.ndarray, qs: np.ndarray, ps: np.ndarray, watched: dict[str, Watched]
) -> dict[str, Any]:
    """File name → axes: the trajectory, and how what was watched changes along it."""
    time = _label("t", setup.units.get("t"))
    position, momentum = setup.units.get("q"), setup.units.get("p")
    title = setup.name.replace("_", " ")
    drawn = {"trajectory.png": plot.trajectory(ts, qs, ps, time, position, momentum, title)}
    series = {_change_label(name, w): w.change() for name, w in watched.items() if not w.reduction}
    if series:
        drawn["invariants.png"] = plot.changes(ts, series, time, f"{title}: what was watched")
    return drawn


def draw_solar_system(setup: Setup, c: Comparison, always: dict[str, Watched]) -> dict[str, Any]:
    """File name → axes: orbits, the comparison with the ephemeris, conserved quantities."""
    series = {name.replace("_", " "): np.abs(always[name].change()) for name in OBSERVABLES}
    title = f"Ten bodies with {type(setup.method).__name__}"
    if setup.h is not None:
        title += f", h = {setup.h:g} day"
    return {
        "orbits.png": plot.planet_orbits(c.heliocentric[:, 1:], BODIES[1:]),
        "ephemeris.png": plot.ephemeris_comparison(
            c.years,
            c.errors[:, 1:],
            BODIES[1:],
            c.perihelion,
            c.slope,
            c.intercept,
        ),
        "invariants.png": plot.conserved(c.years, series, "years since the start", title),
    }


def _label(name: str, unit: str | None) -> str:
    return name if unit in (None, "", "1") else f"{name} [{unit}]"


def _change_label(name: str, w: Watched) -> str:
    size = "" if w.values.ndim == 1 else "size of "
    kind = "relative change" if w.is_relative else "change"
    return f"{name.replace('_', ' ')}\n{size}{kind}"
