"""Symmetries of the discrete equations, and the invariants that follow from them."""

from .basis import (
    AbstractBasis as AbstractBasis,
    Basis as Basis,
    BoundBasis as BoundBasis,
)
from .determining import (
    ConformalFactor as ConformalFactor,
    conformal_factor as conformal_factor,
    determining_residual as determining_residual,
    discrete_equations as discrete_equations,
)
from .families import (
    Chebyshev as Chebyshev,
    Polynomials as Polynomials,
    Radial as Radial,
    Trigonometric as Trigonometric,
)
from .gauge import (
    BasisGauge as BasisGauge,
    GaugeSolution as GaugeSolution,
    solve_gauge as solve_gauge,
)
from .generators import Generator as Generator, LatticePoint as LatticePoint, prolong as prolong
from .noether import (
    AdiabaticInvariant as AdiabaticInvariant,
    lattice_defect as lattice_defect,
    noether_identity as noether_identity,
)
from .sampling import random_pairs as random_pairs, solution_pairs as solution_pairs
from .search import find_symmetries as find_symmetries
from .symmetries import Symmetries as Symmetries, Symmetry as Symmetry
