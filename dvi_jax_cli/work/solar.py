"""The solar system in comparison with the ephemeris that it was started from."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.systems.n_body import OBSERVABLES
from dvi_jax.systems.planets import solar_system as planets
from dvi_jax.systems.planets.solar_system import AU_IN_KM, BODIES, GM, to_ecliptic

from .._show import TextTable
from .observables import Observed
from .output import Report

CENTURY = 36525.0
"""A Julian century [day]."""

_ARCSEC = 180 * 3600 / np.pi
_LIGHT = 299792.458 * 86400 / AU_IN_KM  # speed of light [au/day]
_STRETCH = 4 * 365.25  # stretch that is repeated to find the integrator's error [day]
_MERCURY = BODIES.index("Mercury")


class Comparison(NamedTuple):
    """An integration and the ephemeris at the saved times."""

    years: np.ndarray
    """Since the start, shape (T,)."""
    heliocentric: np.ndarray
    """Positions on ecliptic axes [au], shape (T, bodies, 3)."""
    errors: np.ndarray
    """Distance between integrated and tabulated heliocentric position [km], shape (T, bodies)."""
    angles: np.ndarray
    """The same as seen from the Sun [″]."""
    perihelion: np.ndarray
    """Mercury's longitude of perihelion, ephemeris minus integration [″], shape (T,)."""
    slope: float
    """Slope of its least-squares line [″/century]."""
    intercept: float
    """Intercept of that line [″]."""
    scatter: float
    """Root mean square about that line [″]."""
    relativity: float
    """The slope according to general relativity [″/century]."""


def compare(jd: np.ndarray, qs: np.ndarray, ps: np.ndarray, masses: np.ndarray) -> Comparison:
    r"""An integration of the ten bodies compared with DE421.

    - `jd`: TDB Julian dates of the saved states, shape (T,), the start first.
    - `qs` [au], `ps` [au⁴/day³]: barycentric, on ICRF axes, shape (T, bodies, 3). `masses`: GM.

    The longitude of perihelion ϖ = Ω + ω is that of the osculating heliocentric orbit on the
    ecliptic of J2000 (`perihelion_longitude`), from positions and velocities of either side;
    the slope of its difference is a least-squares fit over the saved times. That of relativity is

        6π mu / (c² a (1 − e²)) per revolution,

    with the osculating a and e of the start. States that are not finite are left out of the fit.

    **Source** Einstein 1915; Park et al. 2017, *AJ* 153, 121 (42.98″ per century).
    """
    q_tab, v_tab = planets.ephemeris(jd)
    vs = ps / masses[:, None]
    q, v, q_tab, v_tab = (to_ecliptic(x - x[:, :1]) for x in (qs, vs, q_tab, v_tab))
    distance = np.linalg.norm(q - q_tab, axis=-1)
    radius = np.maximum(np.linalg.norm(q_tab, axis=-1), np.finfo(float).tiny)

    m, mu = _MERCURY, GM[0] + GM[_MERCURY]
    longitude = planets.perihelion_longitude(q_tab[:, m], v_tab[:, m], mu)
    own_longitude = planets.perihelion_longitude(q[:, m], v[:, m], masses[0] + masses[m])
    difference = (longitude - own_longitude) * _ARCSEC
    years = (jd - jd[0]) / 365.25

    L = np.linalg.norm(np.cross(q_tab[0, m], v_tab[0, m]))
    a = 1 / (2 / np.linalg.norm(q_tab[0, m]) - np.sum(v_tab[0, m] ** 2) / mu)
    period = 2 * np.pi * np.sqrt(a**3 / mu)
    # a (1 − e²) = L²/mu
    relativity = float(6 * np.pi * mu**2 / (_LIGHT * L) ** 2 * CENTURY / period * _ARCSEC)
    errors, angles = distance * AU_IN_KM, distance / radius * _ARCSEC
    line = _line(years / 100, difference)
    return Comparison(years, q, errors, angles, difference, *line, relativity)


def own_share(run: dict[str, Any], qs: np.ndarray, ps: np.ndarray) -> float:
    """The integrator's own contribution to ephemeris minus integration [″/century].

    - `run`: arguments of `dvi.integrate`.

    The first few years are integrated again with half the step; for a method of order r the slope
    of the perihelion then differs by 1 − 2⁻ʳ of the whole error (Richardson). NaN for a time grid
    that is not uniform, fewer than three saved states, a failed run.
    """
    if run["h"] is None:
        return np.nan
    stride = run["save"].every
    span = run["h"] * stride  # from one saved state to the next
    count = min(int(_STRETCH / abs(span)), run["num_steps"] // stride)
    if count < 3:
        return np.nan
    finer = {"h": run["h"] / 2, "num_steps": 2 * stride * count, "save": dvi.Save(every=2 * stride)}
    half_step = dvi.integrate(**run | finer, throw=False)
    masses, longitudes = np.asarray(run["args"]["masses"])[:, None], []
    for q, p in ((qs[: count + 1], ps[: count + 1]), (half_step.qs, half_step.ps)):
        pair = (np.asarray(q), np.asarray(p) / masses)
        q, v = (to_ecliptic(x[:, _MERCURY] - x[:, 0]) for x in pair)
        mu = float(masses[0, 0] + masses[_MERCURY, 0])
        longitudes.append(planets.perihelion_longitude(q, v, mu))
    full, half = longitudes
    slope, _, _ = _line(span * np.arange(count + 1) / CENTURY, (half - full) * _ARCSEC)
    return slope / (1 - 0.5 ** run["method"].order)


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Slope, intercept and root mean square residual of the least-squares line; NaN for < 3."""
    good = np.isfinite(y)
    if good.sum() < 3:
        return np.nan, np.nan, np.nan
    slope, intercept = np.polyfit(x[good], y[good], 1)
    residual = y[good] - slope * x[good] - intercept
    return float(slope), float(intercept), float(np.sqrt(np.mean(residual**2)))


def report(
    report: Report, jd: Any, qs: Any, ps: Any, run: dict[str, Any], observed: dict[str, Observed]
) -> dict[str, Callable[[], Any]]:
    """Add the comparison to a report: contents, tables, notes.

    - `jd`, `qs`, `ps`: the saved states, as for `compare`. `run`: the arguments of `dvi.integrate`.
    - `observed`: `OBSERVABLES` and their drifts.

    **Returns** file name → function that draws: orbits, the comparison, conserved quantities.
    """
    c = compare(jd, qs, ps, np.asarray(run["args"]["masses"]))
    share = own_share(run, qs, ps)
    largest = {name: observed[f"{name}_drift"].summary()["relative"] for name in OBSERVABLES}
    errors = {
        name: {
            "largest_km": np.nanmax(c.errors[:, i], initial=0.0),
            "last_km": c.errors[-1, i],
            "largest_arcsec": np.nanmax(c.angles[:, i], initial=0.0),
        }
        for i, name in enumerate(BODIES)
        if i > 0
    }
    report.contents["solar_system"] = {
        "years": float(c.years[-1]),
        "position_error": errors,
        "largest_relative_change": largest,
        "mercury_perihelion": {
            "ephemeris_minus_integration_arcsec_per_century": c.slope,
            "integrators_share_arcsec_per_century": share,
            "scatter_arcsec": c.scatter,
            "general_relativity_arcsec_per_century": c.relativity,
        },
    }
    changes = {name.replace("_", " "): np.abs(observed[name].change()) for name in OBSERVABLES}
    indices = np.unique(np.linspace(0, len(c.years) - 1, 11).round().astype(int))
    rows = [[f"{c.years[k]:.1f}", *(f"{x[k]:.1e}" for x in changes.values())] for k in indices]
    rows.append(["largest, every step", *(f"{x:.1e}" for x in largest.values())])
    title = "Conserved: relative change (linear momentum: of Σ|p|)"
    report.tables.append(TextTable(title, ["years", *changes], rows))
    rows = [[name, *(f"{x:.3g}" for x in error.values())] for name, error in errors.items()]
    columns = ["planet", "largest [km]", "last [km]", "largest, from the Sun [″]"]
    report.tables.append(TextTable("Heliocentric position compared with DE421", columns, rows))
    if np.isfinite(c.slope):
        report.notes.append(
            f"Mercury's perihelion, ephemeris minus integration: {c.slope:.2f}″ per century "
            f"(scatter about the line {c.scatter:.2f}″); general relativity contributes "
            f"{c.relativity:.2f}″."
        )
    if np.isfinite(c.slope) and np.isfinite(share):
        note = f"The integrator contributes {share:.2f}″ per century, measured with half the step."
        if abs(share) > 0.02 * c.relativity:
            note += " That is too much to measure relativity: take a smaller h."
        report.notes.append(note)
    title = f"Ten bodies with {type(run['method']).__name__}"
    title += f", h = {run['h']:g} day" if run["h"] is not None else ""
    curves = (c.years, c.errors[:, 1:], BODIES[1:], c.perihelion, c.slope, c.intercept)
    return {
        "orbits.png": lambda: plot.planet_orbits(c.heliocentric[:, 1:], BODIES[1:]),
        "ephemeris.png": lambda: plot.ephemeris_comparison(*curves),
        "invariants.png": lambda: plot.conserved(c.years, changes, "years since the start", title),
    }
