"""Magnetic and electric fields from coils and from grids, as functions of a position."""

from ._coils import (
    Filaments as Filaments,
    Polylines as Polylines,
    from_fourier as from_fourier,
)
from ._grid import Spline as Spline
