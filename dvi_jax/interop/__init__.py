"""Interoperability with diffrax, REBOUND, SciPy, astropy, ArviZ and jplephem.

``from dvi_jax import interop``. A function imports the other package when it is called; without it
there is an `ImportError` with the line that installs it.
"""

from .arviz_side import to_inference_data as to_inference_data
from .diffrax_side import diffrax_solver as diffrax_solver, diffrax_term as diffrax_term
from .fields import vector_field as vector_field
from .jplephem_side import EphemerisPath as EphemerisPath, ephemeris_path as ephemeris_path
from .rebound_side import (
    ReboundProblem as ReboundProblem,
    from_archive as from_archive,
    from_rebound as from_rebound,
    to_rebound as to_rebound,
)
from .scipy_side import solve_ivp as solve_ivp
from .units import UnitSolution as UnitSolution, UnitSystem as UnitSystem, integrate as integrate
