"""Many trajectories: grids of ε × initial conditions × parameters, stored and resumed."""

from . import starts as starts
from ._sweep import SweepInterrupted as SweepInterrupted, sweep as sweep, sweep_cost as sweep_cost
from .axes import Axis as Axis
from .cluster import ClusterError as ClusterError
from .cost import SweepCost as SweepCost
from .result import SweepResult as SweepResult, open_sweep as open_sweep
from .store import StoreError as StoreError, StoreMismatch as StoreMismatch
from .workers import SweepProgress as SweepProgress
