"""Pictures: one house style, readable in print and by colour-blind eyes."""

from matplotlib import pyplot as plt  # noqa: F401 (plot.plt.close closes a figure)

from .drifts import (
    balance as balance,
    drift_orders as drift_orders,
    drift_surface as drift_surface,
)
from .fits import (
    fit_against_data as fit_against_data,
    fit_corner as fit_corner,
    fit_residuals as fit_residuals,
    learning_curve as learning_curve,
)
from .house import COLOURS as COLOURS, DASHES as DASHES, save as save, style as style
from .runs import (
    changes as changes,
    conserved as conserved,
    ephemeris_comparison as ephemeris_comparison,
    planet_orbits as planet_orbits,
    trajectory as trajectory,
)
from .sweeps import (
    failure_map as failure_map,
    slope_map as slope_map,
    sweep_map as sweep_map,
)
