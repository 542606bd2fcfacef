"""Guiding centres in the magnetic fields of stellarators and tokamaks, in Boozer coordinates."""

from ._births import Births as Births, fusion_rate as fusion_rate
from ._bounce import Well as Well, second_invariant as second_invariant, well as well
from ._classes import Extremes as Extremes, classify as classify
from ._field import Field as Field, from_modes as from_modes, from_surfaces as from_surfaces
from ._files import (
    Geometry as Geometry,
    from_near_axis as from_near_axis,
    load_field as load_field,
    precise_qa as precise_qa,
    read_booz_xform as read_booz_xform,
    read_geometry as read_geometry,
    save_field as save_field,
    w7x as w7x,
)
from ._full_orbits import FullOrbits as FullOrbits
from ._losses import LossFraction as LossFraction, loss_fraction as loss_fraction
from ._particles import Coordinates as Coordinates, GuidingCentres as GuidingCentres
from ._plasma import Plasma as Plasma, Rates as Rates
from ._proxies import (
    lost_at as lost_at,
    mean_drift as mean_drift,
    radial_drift as radial_drift,
    symmetry_error as symmetry_error,
)
from ._slowing import End as End, SlowingDown as SlowingDown
from ._vmec import read_vmec as read_vmec
from ._wall import (
    Hits as Hits,
    Wall as Wall,
    read_wall as read_wall,
    wall_of_surface as wall_of_surface,
)
from ._waves import momentum_basis as momentum_basis
