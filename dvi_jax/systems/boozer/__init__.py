"""Guiding centres in the magnetic fields of stellarators and tokamaks, in Boozer coordinates."""

from ._field import Field as Field, from_modes as from_modes, from_surfaces as from_surfaces
from ._particles import Coordinates as Coordinates, GuidingCentres as GuidingCentres
