"""What is conserved along trajectories, and to what order in ε."""

from .balance import Balance as Balance, noether_balance as noether_balance
from .discovery import (
    Discovery as Discovery,
    InvariantSeries as InvariantSeries,
    discover_invariants as discover_invariants,
)
from .drift import DriftOrder as DriftOrder, drift_order as drift_order
