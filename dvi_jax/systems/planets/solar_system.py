"""The Sun and its planets, with initial conditions from a JPL ephemeris.

Newton's law between ten point masses. General relativity, the Sun's oblateness and the asteroids
are neglected; a comparison with the ephemeris shows their effect.
"""

import contextlib
import datetime
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...base.checks import array, finite
from ...problem.elements import Keplerian
from .._problem import Problem
from ..n_body import check_bodies, n_body

_BODIES = {
    "Sun": (10, 2.959122082855911e-4),
    "Mercury": (1, 4.91254957186794e-11),
    "Venus": (2, 7.243452332698441e-10),
    "Earth–Moon": (3, 8.997011408268049e-10),
    "Mars": (4, 9.54954869562239e-11),
    "Jupiter": (5, 2.82534584085505e-7),
    "Saturn": (6, 8.459706073308477e-8),
    "Uranus": (7, 1.29202482579265e-8),
    "Neptune": (8, 1.52435910924974e-8),
    "Pluto": (9, 2.17844105199052e-12),
}
"""Name → NAIF number and GM [au³/day²]."""

BODIES = tuple(_BODIES)
"""Names, in the order of every array here. Earth–Moon and other planets with moons are barycentres
of their systems."""

GM = np.array([gm for _, gm in _BODIES.values()])
"""G times mass [au³/day²], the values with which DE421 was computed."""

AU_IN_KM = 149597870.6996262
"""The astronomical unit of DE421 [km]."""

COVERAGE = (2414864.5, 2471184.5)
"""First and last TDB Julian date of DE421: 1899-07-29 and 2053-10-09."""

_OBLIQUITY = np.deg2rad(84381.448 / 3600)  # of the ecliptic at J2000 (IAU 1976)
_EXTRA = 'pip install "dvi-jax[ephemeris]"'


class EphemerisMissing(ImportError):
    """The ephemeris or its reader is not installed; the message has the command."""


def installed_file(name: str, contents: str) -> Path:
    """A file of the package skyfield-data; `what`: its contents, for the message.

    Nothing is downloaded. **Raises** `EphemerisMissing` where it is not installed.
    """
    # The package is located, not imported: its import warns about the age of its files.
    package = find_spec("skyfield_data")
    path = Path(getattr(package, "origin", None) or "").parent / "data" / name
    if package is None or not path.is_file():
        raise EphemerisMissing(
            f"{contents} requires {name} of the package skyfield-data: {_EXTRA}, or install its "
            "newest version"
        )
    return path


def julian_date(date: str | datetime.date | float) -> float:
    """TDB Julian date of a calendar day at 0h [day].

    - `date`: ``"1900-01-01"`` (Gregorian), a `datetime.date`, or a Julian date.

    **Raises** `ValueError` for another text, and for dates that DE421 does not cover.
    """
    with contextlib.suppress(ValueError):
        date = datetime.date.fromisoformat(date) if isinstance(date, str) else date
    if isinstance(date, str | datetime.datetime):
        raise ValueError(
            'date must be a day such as "1900-01-31", a datetime.date, or a Julian date (TDB), got '
            f"{date!r}."
        )
    if isinstance(date, datetime.date):
        jd, day = date.toordinal() + 1721424.5, f" ({date})"
    else:
        jd, day = finite("date", date, hint="Give a calendar day or a Julian date."), ""
    check_covered(jd, day)
    return jd


def check_covered(jd: Any, day: str = "") -> None:
    """Require TDB Julian dates that the ephemeris covers; `day`: the same date, for the message.

    **Raises** `ValueError`.
    """
    first, last = COVERAGE
    jd = np.atleast_1d(jd)
    invalid = jd[~((jd >= first) & (jd <= last))]  # NaN is outside
    if invalid.size:
        raise ValueError(
            f"dates must be from 1899-07-29 to 2053-10-09 (Julian dates {first} to {last}), got "
            f"{invalid[0]}{day}."
        )


def ephemeris(jd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric positions [au] and velocities [au/day] of `BODIES` by DE421.

    - `jd`: TDB Julian dates [day], shape (times,).

    Returns two arrays of shape (times, bodies, 3) on the axes of the ICRF (equator of J2000);
    velocities are derivatives of the ephemeris's Chebyshev polynomials. The file is the one in the
    package skyfield-data; nothing is downloaded.

    **Raises** `EphemerisMissing` without the extra `ephemeris`; `ValueError` for dates outside
    `COVERAGE`.

    **Source** Folkner, Williams & Boggs 2009, *The planetary and lunar ephemeris DE 421*, IPN
    Progress Report 42-178.
    """
    jd = array("jd", np.asarray(jd, float), ("times",), empty=True, hint="Give one date as [jd].")
    check_covered(jd)
    kernel = _kernel()
    states = [kernel[0, code].compute_and_differentiate(jd) for code, _ in _BODIES.values()]
    q, v = (np.stack([np.asarray(state[i]).T for state in states], axis=1) for i in (0, 1))
    return q / AU_IN_KM, v / AU_IN_KM


def to_ecliptic(vectors: Any) -> np.ndarray:
    """Vectors on ICRF axes, transformed to the ecliptic of J2000 (obliquity 84381.448″)."""
    x, y, z = np.moveaxis(np.asarray(vectors, float), -1, 0)
    c, s = np.cos(_OBLIQUITY), np.sin(_OBLIQUITY)
    return np.stack([x, c * y + s * z, c * z - s * y], axis=-1)


def perihelion_longitude(q: Any, v: Any, mu: float) -> np.ndarray:
    """Longitude of perihelion of the osculating orbit, ϖ = Ω + ω [rad].

    - `q`, `v`: heliocentric position [au] and velocity [au/day] on ecliptic axes, shape
      (times, 3). `mu`: GM of the Sun plus that of the planet [au³/day²].

    Returns shape (times,), continuous in time (unwrapped).
    """
    with jax.enable_x64(True):
        orbit = Keplerian.from_state(np.asarray(q, float), np.asarray(v, float), mu)
    return np.unwrap(np.asarray(orbit.Omega) + np.asarray(orbit.omega))


def check_start(q0: Any, p0: Any, args: Any) -> None:
    """`check_bodies` with the names of the planets."""
    check_bodies(q0, p0, args, BODIES)


def solar_system(date: str | datetime.date | float = "1900-01-01") -> Problem:
    """The Sun and nine bodies on a given day, in barycentric coordinates on the ICRF axes.

    - `date`: the initial day, as for `julian_date`.

    q [au], t [day] from that day, masses as GM [au³/day²] with G = 1, so that p = GM v [au⁴/day³]
    and energies are in au⁵/day⁴. The step suits `Yoshida(4)`: h = 1/32 day advances Mercury's
    perihelion by 0.04″ per century too much, an error that scales as h⁴.

    **Raises** as `ephemeris` and `julian_date`.
    """
    (q,), (v,) = ephemeris([julian_date(date)])
    return replace(
        n_body(GM, q, GM[:, None] * v, h=1 / 32),
        name="solar_system",
        units={"q": "au", "p": "au⁴/day³", "t": "day", "energy": "au⁵/day⁴"},
        source="JPL ephemeris DE421 (Folkner, Williams & Boggs 2009)",
        check=check_start,
        parameters={"masses": "G times mass of the bodies [au³/day²]", "G": "1, it is in GM [1]"},
    )


@cache
def _kernel() -> Any:
    try:
        from jplephem.spk import SPK
    except ImportError:
        raise EphemerisMissing(f"an ephemeris requires jplephem: {_EXTRA}") from None
    return SPK.open(installed_file("de421.bsp", "the ephemeris DE421"))
