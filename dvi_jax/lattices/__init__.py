"""Time grids, here called lattices: one file for each, over one abstract base."""

from ._adaptive import AdaptiveReversible as AdaptiveReversible
from ._base import Lattice as Lattice, Place as Place, Run as Run
from ._given import Given as Given
from ._time_transformed import TimeTransformed as TimeTransformed
from ._uniform import Uniform as Uniform
from ._variational import LatticeCondition as LatticeCondition, Variational as Variational
