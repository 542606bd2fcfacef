"""What a map conserves: symmetries, invariants, and the order in ε to which they hold."""

from .drift.balance import Balance as Balance, noether_balance as noether_balance
from .drift.drift import drift_order as drift_order, drift_surface as drift_surface
from .drift.orders import DriftOrder as DriftOrder, DriftSurface as DriftSurface
from .functions.basis import (
    AbstractBasis as AbstractBasis,
    Basis as Basis,
    BoundBasis as BoundBasis,
)
from .functions.families import (
    Chebyshev as Chebyshev,
    Polynomials as Polynomials,
    Radial as Radial,
    Trigonometric as Trigonometric,
)
from .functions.generators import (
    Generator as Generator,
    LatticePoint as LatticePoint,
    prolong as prolong,
)
from .functions.sampling import random_pairs as random_pairs, solution_pairs as solution_pairs
from .invariants.discovery import Discovery as Discovery
from .invariants.find import discover_invariants as discover_invariants
from .invariants.obstructions import DriftLaw as DriftLaw
from .invariants.series import InvariantSeries as InvariantSeries
from .invariants.shadow import ShadowHamiltonian as ShadowHamiltonian
from .symmetries.determining import (
    ConformalFactor as ConformalFactor,
    conformal_factor as conformal_factor,
    determining_residual as determining_residual,
    discrete_equations as discrete_equations,
)
from .symmetries.find import find_symmetries as find_symmetries
from .symmetries.gauge import (
    BasisGauge as BasisGauge,
    GaugeSolution as GaugeSolution,
    solve_gauge as solve_gauge,
)
from .symmetries.noether import (
    AdiabaticInvariant as AdiabaticInvariant,
    lattice_defect as lattice_defect,
    noether_identity as noether_identity,
)
from .symmetries.symmetry import Symmetries as Symmetries, Symmetry as Symmetry
