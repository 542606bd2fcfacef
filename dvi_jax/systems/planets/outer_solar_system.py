"""The Sun and the planets from Jupiter to Pluto, with printed initial conditions."""

import math
from dataclasses import replace

import numpy as np

from .._problem import Problem
from ..n_body import n_body

# That of the Sun contains the inner planets.
_MASSES = [1.00000597682, 0.000954786104043, 0.000285583733151, 0.0000437273164546]
_MASSES += [0.0000517759138449, 1 / 1.3e8]
_POSITIONS = [
    [0, 0, 0],
    [-3.5023653, -3.8169847, -1.5507963],
    [9.0755314, -3.0458353, -1.6483708],
    [8.3101420, -16.2901086, -7.2521278],
    [11.4707666, -25.7294829, -10.8169456],
    [-15.5387357, -25.2225594, -3.1902382],
]
_VELOCITIES = [
    [0, 0, 0],
    [0.00565429, -0.00412490, -0.00190589],
    [0.00168318, 0.00483525, 0.00192462],
    [0.00354178, 0.00137102, 0.00055029],
    [0.00288930, 0.00114527, 0.00039677],
    [0.00276725, -0.00170702, -0.00136504],
]


def _barycentric(masses: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Vectors relative to their mean, weighted by the masses."""
    # Sums without rounding: a drift of the barycentre grows for millions of years.
    total = math.fsum(masses)
    return x - [math.fsum(column) / total for column in (masses[:, None] * x).T]


def outer_solar_system() -> Problem:
    """The Sun, Jupiter, Saturn, Uranus, Neptune and Pluto on 5 September 1994 at 0h.

    q [au] and p relative to the barycentre, which rests at 0 (the table is heliocentric), t [day],
    masses in solar masses with G = 2.95912208286e-4. The step suits `WisdomHolman`, with an energy
    error of 3e-7.

    **Source** Ahnerts Kalender für Sternfreunde 1994, in Hairer, Lubich & Wanner 2006, *Geometric
    Numerical Integration*, I.2.4, table 2.2.
    """
    masses = np.array(_MASSES)
    q, v = (_barycentric(masses, np.array(x, float)) for x in (_POSITIONS, _VELOCITIES))
    return replace(
        n_body(masses, q, masses[:, None] * v, h=100.0, G=2.95912208286e-4),
        name="outer_solar_system",
        units={"q": "au", "p": "solar mass au/day", "t": "day", "energy": "solar mass au²/day²"},
        source="Hairer, Lubich & Wanner 2006, Geometric Numerical Integration, I.2.4, table 2.2",
    )
