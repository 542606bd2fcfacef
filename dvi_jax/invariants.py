"""An older name of the part of `dvi_jax.discover` that deals with invariants."""

from .discover import (
    Balance as Balance,
    Discovery as Discovery,
    DriftLaw as DriftLaw,
    DriftOrder as DriftOrder,
    DriftSurface as DriftSurface,
    InvariantSeries as InvariantSeries,
    ShadowHamiltonian as ShadowHamiltonian,
    discover_invariants as discover_invariants,
    drift_order as drift_order,
    drift_surface as drift_surface,
    noether_balance as noether_balance,
)
