"""Where t1 comes from: one file for each lattice, over one abstract base."""

from ._base import Lattice as Lattice
from ._given import Given as Given
from ._time_transformed import TimeTransformed as TimeTransformed
from ._uniform import Uniform as Uniform
