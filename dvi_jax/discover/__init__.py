"""What a map conserves: symmetries, invariants, and the order in ε to which they hold."""

from .balance import Balance as Balance, noether_balance as noether_balance
from .basis import AbstractBasis as AbstractBasis, Basis as Basis, BoundBasis as BoundBasis
from .determining import (
    ConformalFactor as ConformalFactor,
    conformal_factor as conformal_factor,
    determining_residual as determining_residual,
    discrete_equations as discrete_equations,
)
from .drift import drift_order as drift_order, drift_surface as drift_surface
from .families import (
    Chebyshev as Chebyshev,
    Polynomials as Polynomials,
    Radial as Radial,
    Trigonometric as Trigonometric,
)
from .found import Discovery as Discovery
from .gauge import (
    BasisGauge as BasisGauge,
    GaugeSolution as GaugeSolution,
    solve_gauge as solve_gauge,
)
from .generators import Generator as Generator, LatticePoint as LatticePoint, prolong as prolong
from .invariant_search import discover_invariants as discover_invariants
from .noether import (
    AdiabaticInvariant as AdiabaticInvariant,
    lattice_defect as lattice_defect,
    noether_identity as noether_identity,
)
from .obstructions import DriftLaw as DriftLaw
from .orders import DriftOrder as DriftOrder, DriftSurface as DriftSurface
from .sampling import random_pairs as random_pairs, solution_pairs as solution_pairs
from .series import InvariantSeries as InvariantSeries
from .shadow import ShadowHamiltonian as ShadowHamiltonian
from .symmetries import Symmetries as Symmetries, Symmetry as Symmetry
from .symmetry_search import find_symmetries as find_symmetries
