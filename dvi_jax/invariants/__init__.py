"""What is conserved along trajectories, and to what order in ε."""

from .balance import Balance as Balance, noether_balance as noether_balance
from .discovery import discover_invariants as discover_invariants
from .drift import (
    DriftOrder as DriftOrder,
    DriftSurface as DriftSurface,
    drift_order as drift_order,
    drift_surface as drift_surface,
)
from .found import Discovery as Discovery
from .obstructions import DriftLaw as DriftLaw
from .series import InvariantSeries as InvariantSeries
from .shadow import ShadowHamiltonian as ShadowHamiltonian
