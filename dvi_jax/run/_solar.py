"""The solar system beside the ephemeris that it was started from."""

from dataclasses import dataclass

import numpy as np

import dvi_jax as dvi

from ..systems.solar_system import (
    AU_IN_KM,
    BODIES,
    GM,
    ephemeris,
    perihelion_longitude,
    to_ecliptic,
)
from ._setup import Setup

CENTURY = 36525.0
"""A Julian century [day]."""

_ARCSEC = 180 * 3600 / np.pi
_LIGHT = 299792.458 * 86400 / AU_IN_KM  # speed of light [au/day]
_AGAIN = 4 * 365.25  # stretch that is done again to find the integrator's error [day]
_MERCURY = BODIES.index("Mercury")


@dataclass(frozen=True)
class Comparison:
    """An integration beside the ephemeris, at the saved times.

    - `years`: since the start, shape (T,). `heliocentric`: positions on ecliptic axes [au],
      shape (T, bodies, 3).
    - `errors`: distance between integrated and tabulated heliocentric position [km], shape
      (T, bodies). `angles`: the same as seen from the Sun [″].
    - `perihelion`: Mercury's longitude of perihelion, ephemeris minus integration [″], shape (T,).
    - `slope`, `intercept`: its least-squares line [″/century], [″]; `scatter`: the root mean
      square about the line [″].
    - `relativity`: what general relativity says the slope is [″/century].
    """

    years: np.ndarray
    heliocentric: np.ndarray
    errors: np.ndarray
    angles: np.ndarray
    perihelion: np.ndarray
    slope: float
    intercept: float
    scatter: float
    relativity: float


def compare(jd: np.ndarray, qs: np.ndarray, ps: np.ndarray, masses: np.ndarray) -> Comparison:
    r"""An integration of the ten bodies compared with DE421.

    - `jd`: TDB Julian dates of the saved states, shape (T,), the start first.
    - `qs` [au], `ps` [au⁴/day³]: barycentric, on ICRF axes, shape (T, bodies, 3). `masses`: GM.

    The longitude of perihelion ϖ = Ω + ω is that of the osculating heliocentric orbit on the
    ecliptic of J2000 (`perihelion_longitude`), from positions and velocities of either side;
    the slope of its difference is a least-squares fit over the saved times. Relativity's share is

        6π mu / (c² a (1 − e²)) per revolution,

    with the osculating a and e of the start. States that are not finite are left out of the fit.

    **Source** Einstein 1915; Park et al. 2017, *AJ* 153, 121 (42.98″ per century).
    """
    q_tab, v_tab = ephemeris(jd)
    vs = ps / masses[:, None]
    q, v, q_tab, v_tab = (to_ecliptic(x - x[:, :1]) for x in (qs, vs, q_tab, v_tab))
    distance = np.linalg.norm(q - q_tab, axis=-1)
    radius = np.maximum(np.linalg.norm(q_tab, axis=-1), np.finfo(float).tiny)

    m, mu = _MERCURY, GM[0] + GM[_MERCURY]
    tabulated = perihelion_longitude(q_tab[:, m], v_tab[:, m], mu)
    integrated = perihelion_longitude(q[:, m], v[:, m], masses[0] + masses[m])
    difference = (tabulated - integrated) * _ARCSEC
    years = (jd - jd[0]) / 365.25
    slope, intercept, scatter = _line(years / 100, difference)

    L = np.linalg.norm(np.cross(q_tab[0, m], v_tab[0, m]))
    a = 1 / (2 / np.linalg.norm(q_tab[0, m]) - np.sum(v_tab[0, m] ** 2) / mu)
    period = 2 * np.pi * np.sqrt(a**3 / mu)
    # a (1 − e²) = L²/mu
    relativity = 6 * np.pi * mu**2 / (_LIGHT * L) ** 2 * CENTURY / period * _ARCSEC
    return Comparison(
        years,
        q,
        distance * AU_IN_KM,
        distance / radius * _ARCSEC,
        difference,
        slope,
        intercept,
        scatter,
        float(relativity),
    )


def own_share(setup: Setup, qs: np.ndarray, ps: np.ndarray) -> float:
    """What the integrator itself adds to ephemeris minus integration [″/century].

    The first few years are done again with half the step; for a method of order r the slope of
    the perihelion then differs by 1 − 2⁻ʳ of the whole error (Richardson). NaN where that
    cannot be: a lattice that is not uniform, less than three saved states, a failed run.
    """
    if setup.h is None or setup.steps is None:
        return np.nan
    count = min(int(_AGAIN / (setup.every * abs(setup.h))), setup.steps // setup.every)
    if count < 3:
        return np.nan
    again = dvi.integrate(
        setup.system,
        setup.q0,
        setup.p0,
        h=setup.h / 2,
        num_steps=2 * setup.every * count,
        t0=setup.t0,
        epsilon=setup.epsilon,
        args=setup.args,
        method=setup.method,
        save=dvi.Save(every=2 * setup.every),
        throw=False,
    )
    masses = np.asarray(setup.args["masses"])[:, None]

    def perihelion(q, p):
        q, v = (to_ecliptic(x[:, _MERCURY] - x[:, 0]) for x in (q, p / masses))
        return perihelion_longitude(q, v, float(masses[0, 0] + masses[_MERCURY, 0]))

    whole = perihelion(qs[: count + 1], ps[: count + 1])
    half = perihelion(np.asarray(again.qs), np.asarray(again.ps))
    times = setup.h * setup.every * np.arange(count + 1) / CENTURY
    slope, _, _ = _line(times, (half - whole) * _ARCSEC)
    return slope / (1 - 0.5**setup.method.order)


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Slope, intercept and root mean square residual of the least-squares line; NaN for < 3."""
    good = np.isfinite(y)
    if good.sum() < 3:
        return np.nan, np.nan, np.nan
    slope, intercept = np.polyfit(x[good], y[good], 1)
    left = y[good] - slope * x[good] - intercept
    return float(slope), float(intercept), float(np.sqrt(np.mean(left**2)))
