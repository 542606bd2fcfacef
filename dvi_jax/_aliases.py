"""Other names of public objects: standard terms, and names in other packages."""

from ._solution import Save as SaveAt
from .dynamics import frequencies as naff
from .engine.simplified import SimplifiedNewton as Chord
from .methods import (
    RungeKutta4 as RK4,
    Strang as Leapfrog,
    Strang as StormerVerlet,
    TypeII as SymplecticEuler,
)
from .observe import Range as PeakToPeak, Stop as Event, Trend as LinearTrend

ALIASES = {
    "Chord": Chord,
    "Event": Event,
    "Leapfrog": Leapfrog,
    "LinearTrend": LinearTrend,
    "PeakToPeak": PeakToPeak,
    "RK4": RK4,
    "SaveAt": SaveAt,
    "StormerVerlet": StormerVerlet,
    "SymplecticEuler": SymplecticEuler,
    "naff": naff,
}
"""Alias → object; the table in docs/migration.md lists them."""
